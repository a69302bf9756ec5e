"""The networks: the paper's trunk, and the heads that stand on it. The only definition there is.

What is exported is these very modules, so a trained network and its ONNX file cannot drift apart.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from touchd.training.network.recipe import TRUNK


class Normalise(nn.Module):
    """A residual without the plate's own drift, as its direction (unit length) and its log-norm.

    The direction says where a finger is, the norm how hard it presses: separated, the first does not
    depend on the second.

    Parameters
    ----------
    drift : tensor of shape (k, inputs), optional
        Orthonormal directions in which the untouched plate moves by itself: what lies along them is left out.
    """

    drift: Tensor

    def __init__(self, drift: Tensor | None = None) -> None:
        super().__init__()
        self.directions = 0 if drift is None else drift.shape[0]
        self.register_buffer("drift", torch.zeros(0, 1) if drift is None else drift)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the direction (n, inputs) and the natural logarithm of the norm (n, 1)."""
        if self.directions:
            features = features - (features @ self.drift.T) @ self.drift
        norm = features.square().sum(dim=1, keepdim=True).clamp_min(1e-12).sqrt()
        return features / norm, norm.log()


def trunk(inputs: int, widths: tuple[int, ...], dropout: float) -> nn.Sequential:
    """Return the paper's stages: batch normalisation, linear, ReLU, dropout while training."""
    stages: list[nn.Module] = []
    for width in widths:
        stages += [nn.BatchNorm1d(inputs), nn.Linear(inputs, width), nn.ReLU()]
        if dropout:
            stages.append(nn.Dropout(dropout))
        inputs = width
    return nn.Sequential(*stages)


class Regression(nn.Module):
    """Position, its standard error, and whether it is a finger at all.

    The last layer votes for x and for y with a histogram each; their means are the position. Trained by
    cross-entropy against a narrow Gaussian (HL-Gauss: Imani and White, ICML 2018), this places a finger
    several times finer than a squared error does: the field is the product of two waves, and between
    its many lobes an average of two candidates is the one place where the finger is not.

    Parameters
    ----------
    inputs : int
        Length of the feature vector.
    size_mm : tuple of two floats
        Width and height of the plate.
    drift : tensor of shape (k, inputs), optional
        See `Normalise`.
    area_mm : tensor of shape (2, 2), optional
        Lower and upper corner of the part of the plate that matters, by default all of it: every position lies on
        it, those beyond it on its edge. The smaller it is, the finer are the bins.
    noise_apart : bool
        Whether the standard error that noise gives is told apart, per noise-to-signal amplitude: how much noise
        there is in a residual cannot be seen in it, but who measured the untouched plate knows.
    """

    outputs: tuple[str, ...] = ("position_mm", "sigma_mm", "confidence", "noise_mm")
    size_mm: Tensor
    corner_mm: Tensor
    span_mm: Tensor
    edges: Tensor
    centres: Tensor

    def __init__(
        self,
        inputs: int,
        size_mm: tuple[float, float],
        widths: tuple[int, ...] = TRUNK,
        bins: int = 32,
        drift: Tensor | None = None,
        area_mm: Tensor | None = None,
        *,
        noise_apart: bool = True,
    ) -> None:
        super().__init__()
        self.normalise = Normalise(drift)
        self.trunk = trunk(inputs, widths, dropout=0.0)
        # The log-norm joins the last stage: weak touches are placed less well and look more like noise.
        self.last: nn.Module = nn.BatchNorm1d(widths[-1] + 1)
        self.head = nn.Linear(widths[-1] + 1, 2 * bins)
        self.finger = nn.Linear(widths[-1] + 1, 1)
        self.noise_apart = noise_apart
        self.log_error = nn.Linear(widths[-1] + 1, 1 + noise_apart)
        nn.init.constant_(self.log_error.bias, 4.0)  # nothing is known at first: half a plate
        self.bins = bins
        self.register_buffer("size_mm", torch.tensor(size_mm))
        area_mm = torch.stack([torch.zeros(2), self.size_mm]) if area_mm is None else area_mm
        self.register_buffer("corner_mm", area_mm[0])
        self.register_buffer("span_mm", area_mm[1] - area_mm[0])
        # In sizes of the area from its centre; bins beyond the edge let a mean come to lie on the edge itself.
        reach = 0.5 + 1.5 / bins
        edges = torch.linspace(-reach, reach, bins + 1)
        self.register_buffer("edges", edges)
        self.register_buffer("centres", (edges[1:] + edges[:-1]) / 2)

    def heads(self) -> tuple[nn.Linear, ...]:
        """Return the layers that `last` feeds."""
        return self.head, self.log_error, self.finger

    def raw(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return logits of the histograms (n, 2, bins), logs of the errors in mm (n, 1 or 2), finger logit (n, 1).

        The errors are sigma and, where it is told apart, that of noise as strong as the features.
        """
        direction, log_norm = self.normalise(features)
        stage = self.last(torch.cat([self.trunk(direction), log_norm], dim=1))
        votes = self.head(stage).reshape(-1, 2, self.bins)
        # They watch the trunk and do not bend it: their likelihood is wild while errors are large.
        log_error: Tensor = self.log_error(stage.detach())
        finger: Tensor = self.finger(stage)
        return votes, log_error, finger

    def log_sigma(self, log_error: Tensor, noise: Tensor) -> Tensor:
        """Return the log of the standard error (n, 1), of the errors' logs and the noise-to-signal amplitude (n, 1)."""
        if log_error.shape[1] == 1:
            return log_error
        return torch.logaddexp(2 * log_error[:, :1], 2 * (log_error[:, 1:] + noise.log())) / 2

    def place_mm(self, votes: Tensor) -> Tensor:
        """Return the positions (n, 2) in mm that histograms of logits (n, 2, bins) mean."""
        mean: Tensor = (votes.softmax(dim=2) * self.centres).sum(dim=2)
        return (mean.clamp(-0.5, 0.5) + 0.5).mul(self.span_mm) + self.corner_mm

    def truth_mm(self, position: Tensor) -> Tensor:
        """Return what is to be said (n, 2) in mm of positions in plate sizes from the centre, (n, 2)."""
        place_mm = (position + 0.5) * self.size_mm
        return torch.minimum(torch.maximum(place_mm, self.corner_mm), self.corner_mm + self.span_mm)

    def forward(self, features: Tensor) -> tuple[Tensor, ...]:
        """Return position in mm (n, 2), sigma in mm (n, 1), confidence (n, 1), and the error of noise in mm (n, 1).

        The last only where it is told apart: per noise-to-signal amplitude; sigma is then what is left without noise.
        """
        votes, log_error, logit = self.raw(features)
        error_mm = log_error.clamp(-5.0, 5.0).exp()
        said = self.place_mm(votes), error_mm[:, :1], logit.sigmoid()
        return (*said, error_mm[:, 1:]) if self.noise_apart else said

    def targets(self, position: Tensor, spread: float) -> Tensor:
        """Return the histograms (n, 2, bins) of positions in plate sizes from the centre, (n, 2).

        Gaussians of a deviation of `spread` bins, cut off at the histogram's ends.
        """
        width = spread * (self.edges[1] - self.edges[0])
        within = (self.truth_mm(position) - self.corner_mm) / self.span_mm - 0.5
        below = torch.special.ndtr((self.edges - within[:, :, None]) / width)
        share: Tensor = below[:, :, 1:] - below[:, :, :-1]
        return share / share.sum(dim=2, keepdim=True)


class PlainRegression(nn.Module):
    """The paper's regression network: features in, x and y out, trained on the squared error alone.

    It knows neither how sure it is nor what is no finger; so its sigma is one number, set after training,
    and its confidence is always 1.
    """

    outputs: tuple[str, ...] = ("position_mm", "sigma_mm", "confidence")
    size_mm: Tensor
    sigma_mm: Tensor

    def __init__(
        self,
        inputs: int,
        size_mm: tuple[float, float],
        widths: tuple[int, ...] = TRUNK,
        dropout: float = 0.3,
    ) -> None:
        super().__init__()
        self.trunk = trunk(inputs, widths, dropout)
        self.last: nn.Module = nn.BatchNorm1d(widths[-1])
        self.head = nn.Linear(widths[-1], 2)
        self.register_buffer("size_mm", torch.tensor(size_mm))
        self.register_buffer("sigma_mm", torch.ones(1, 1))

    def heads(self) -> tuple[nn.Linear, ...]:
        """Return the layer that `last` feeds."""
        return (self.head,)

    def raw(self, features: Tensor) -> Tensor:
        """Return the position in plate sizes from the centre, shape (n, 2)."""
        position: Tensor = self.head(self.last(self.trunk(features)))
        return position

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return position in mm (n, 2), sigma in mm (n, 1), and confidence (n, 1)."""
        position = self.raw(features)
        same = torch.zeros_like(position[:, :1])
        return (position.clamp(-0.5, 0.5) + 0.5) * self.size_mm, same + self.sigma_mm, same + 1.0


class Classifier(nn.Module):
    """Probabilities of zones or keys: the paper's grid and keypad heads.

    Parameters
    ----------
    classes : int
        N^2 zones, row by row, or the keys and the zone beside them.
    normalised : bool
        Whether only the direction of the features counts; the paper takes them as they are.
    drift : tensor of shape (k, inputs), optional
        See `Normalise`.
    """

    outputs: tuple[str, ...] = ("probability",)

    def __init__(
        self,
        inputs: int,
        classes: int,
        widths: tuple[int, ...] = TRUNK,
        dropout: float = 0.0,
        normalised: bool = True,
        drift: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.normalise = Normalise(drift) if normalised else None
        self.trunk = trunk(inputs, widths, dropout)
        self.last: nn.Module = nn.BatchNorm1d(widths[-1])
        self.head = nn.Linear(widths[-1], classes)

    def heads(self) -> tuple[nn.Linear, ...]:
        """Return the layer that `last` feeds."""
        return (self.head,)

    def raw(self, features: Tensor) -> Tensor:
        """Return logits of shape (n, classes)."""
        if self.normalise is not None:
            features, _ = self.normalise(features)
        logits: Tensor = self.head(self.last(self.trunk(features)))
        return logits

    def forward(self, features: Tensor) -> Tensor:
        """Return probabilities of shape (n, classes)."""
        return self.raw(features).softmax(dim=1)


BESIDE_MM = 10.0
"""A keypad knows positions so far beside its outermost keys: far enough for none to be mistaken for a key."""


class Keypad(Regression):
    """Probabilities of keys, from a position and its standard error.

    A key's probability is that of a Gaussian about the position to lie on it. So any layout can be laid over
    what was learned of the whole plate, and a touch that comes to lie on a key's border is not called sure.
    All probabilities add up to the confidence that there is a finger at all.

    Parameters
    ----------
    keys_mm : tensor of shape (keys, 4)
        Left and upper edges, right and lower edges.
    """

    outputs: tuple[str, ...] = ("probability",)
    low_mm: Tensor
    high_mm: Tensor

    def __init__(
        self,
        inputs: int,
        size_mm: tuple[float, float],
        keys_mm: Tensor,
        widths: tuple[int, ...] = TRUNK,
        bins: int = 32,
        drift: Tensor | None = None,
    ) -> None:
        area_mm = torch.stack([keys_mm[:, :2].amin(dim=0) - BESIDE_MM, keys_mm[:, 2:].amax(dim=0) + BESIDE_MM])
        # A probability is one figure: what noise is usual has to be in it.
        super().__init__(inputs, size_mm, widths, bins, drift, area_mm, noise_apart=False)
        self.register_buffer("low_mm", keys_mm[:, :2])
        self.register_buffer("high_mm", keys_mm[:, 2:])

    def forward(self, features: Tensor) -> Tensor:  # type: ignore[override]  # keys are read from the position
        """Return probabilities of shape (n, keys + 1): the last one is beside all keys."""
        place_mm, sigma_mm, confidence = super().forward(features)
        reach = math.sqrt(2) * sigma_mm[:, :, None]
        on = (
            torch.erf((self.high_mm - place_mm[:, None]) / reach) - torch.erf((self.low_mm - place_mm[:, None]) / reach)
        ) / 2
        key = on[:, :, 0] * on[:, :, 1]
        beside = (1 - key.sum(dim=1, keepdim=True)).clamp_min(0)
        return torch.cat([key, beside], dim=1) * confidence


Network = Regression | PlainRegression | Classifier


def multiply_adds(network: Network) -> int:
    """Return the multiply-adds of one inference: those of the linear layers, and of leaving drift out."""
    layers = sum(layer.weight.numel() for layer in network.modules() if isinstance(layer, nn.Linear))
    drift = sum(2 * part.drift.numel() for part in network.modules() if isinstance(part, Normalise))
    return layers + drift
