"""Networks that estimate a position: ours, and the paper's regression.

The ONNX export traces these modules, so training and inference share one definition.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from touchd.training.network.recipe import TRUNK


class Normalise(nn.Module):
    """Projects out drift, and splits a residual into direction (unit length) and log-norm.

    The direction depends on the position, the norm on the force.

    Parameters
    ----------
    drift : tensor of shape (k, inputs), optional
        Orthonormal directions of baseline drift, which are projected out.
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


class PositionNetwork(nn.Module):
    """Estimates position, standard error and finger confidence.

    The last layer returns a histogram each for x and y, whose means are the position. It is trained by cross-entropy
    against a narrow Gaussian (HL-Gauss: Imani and White, ICML 2018), which is several times more precise than a squared
    error: the field is a product of two waves with many lobes, and the mean of two candidate lobes is never right.

    Parameters
    ----------
    inputs : int
        Length of the feature vector.
    size_mm : tuple of two floats
        Width and height of the plate.
    drift : tensor of shape (k, inputs), optional
        See `Normalise`.
    area_mm : tensor of shape (2, 2), optional
        Lower and upper corner of the area of interest, by default the whole plate. Positions outside are clamped to its
        edge. A smaller area has finer bins.
    noise_apart : bool
        Whether to return the standard error due to noise separately, per noise-to-signal ratio. The network cannot see
        the noise in a residual; the daemon measures it on the untouched plate.
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
        # The log-norm joins the last stage, because a weak touch has a larger error and resembles noise.
        self.last: nn.Module = nn.BatchNorm1d(widths[-1] + 1)
        self.head = nn.Linear(widths[-1] + 1, 2 * bins)
        self.finger = nn.Linear(widths[-1] + 1, 1)
        self.noise_apart = noise_apart
        self.log_error = nn.Linear(widths[-1] + 1, 1 + noise_apart)
        nn.init.constant_(self.log_error.bias, 4.0)  # initial sigma: 55 mm, half a plate
        self.bins = bins
        self.register_buffer("size_mm", torch.tensor(size_mm))
        area_mm = torch.stack([torch.zeros(2), self.size_mm]) if area_mm is None else area_mm
        self.register_buffer("corner_mm", area_mm[0])
        self.register_buffer("span_mm", area_mm[1] - area_mm[0])
        # Relative to the area's centre, in units of its size; bins beyond the edge allow a mean on the edge itself.
        reach = 0.5 + 1.5 / bins
        edges = torch.linspace(-reach, reach, bins + 1)
        self.register_buffer("edges", edges)
        self.register_buffer("centres", (edges[1:] + edges[:-1]) / 2)

    def heads(self) -> tuple[nn.Linear, ...]:
        """Return the layers that `last` feeds."""
        return self.head, self.log_error, self.finger

    def raw(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return histogram logits (n, 2, bins), log errors in mm (n, 1 or 2), finger logit (n, 1).

        The errors are sigma and, with `noise_apart`, the error due to noise as strong as the features.
        """
        direction, log_norm = self.normalise(features)
        stage = self.last(torch.cat([self.trunk(direction), log_norm], dim=1))
        votes = self.head(stage).reshape(-1, 2, self.bins)
        # Detached: the gradient of the error's likelihood is erratic while errors are large.
        log_error: Tensor = self.log_error(stage.detach())
        finger: Tensor = self.finger(stage)
        return votes, log_error, finger

    def log_sigma(self, log_error: Tensor, noise: Tensor) -> Tensor:
        """Combine log errors and noise-to-signal ratio (n, 1) into the log of sigma (n, 1)."""
        if log_error.shape[1] == 1:
            return log_error
        return torch.logaddexp(2 * log_error[:, :1], 2 * (log_error[:, 1:] + noise.log())) / 2

    def position_mm(self, votes: Tensor) -> Tensor:
        """Return the means of histograms given as logits (n, 2, bins): positions (n, 2), mm."""
        mean: Tensor = (votes.softmax(dim=2) * self.centres).sum(dim=2)
        return (mean.clamp(-0.5, 0.5) + 0.5).mul(self.span_mm) + self.corner_mm

    def truth_mm(self, position: Tensor) -> Tensor:
        """Convert relative positions (n, 2) to mm, clamped to the area."""
        position_mm = (position + 0.5) * self.size_mm
        return torch.minimum(torch.maximum(position_mm, self.corner_mm), self.corner_mm + self.span_mm)

    def forward(self, features: Tensor) -> tuple[Tensor, ...]:
        """Return position in mm (n, 2), sigma in mm (n, 1), confidence (n, 1), and with `noise_apart` noise_mm (n, 1).

        `noise_mm` is the error due to noise per noise-to-signal ratio; sigma then excludes noise.
        """
        votes, log_error, logit = self.raw(features)
        error_mm = log_error.clamp(-5.0, 5.0).exp()
        said = self.position_mm(votes), error_mm[:, :1], logit.sigmoid()
        return (*said, error_mm[:, 1:]) if self.noise_apart else said

    def targets(self, position: Tensor, spread: float) -> Tensor:
        """Return the target histograms (n, 2, bins) of relative positions (n, 2).

        They are Gaussians with a deviation of `spread` bins, truncated at the histogram's ends.
        """
        width = spread * (self.edges[1] - self.edges[0])
        within = (self.truth_mm(position) - self.corner_mm) / self.span_mm - 0.5
        below = torch.special.ndtr((self.edges - within[:, :, None]) / width)
        share: Tensor = below[:, :, 1:] - below[:, :, :-1]
        return share / share.sum(dim=2, keepdim=True)


class PaperNetwork(nn.Module):
    """The paper's regression network, trained on the squared error of x and y.

    It estimates no error and no confidence: sigma is one number, set after training, and the confidence is 1.
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
        """Return the position relative to the plate's centre, in units of its size, shape (n, 2)."""
        position: Tensor = self.head(self.last(self.trunk(features)))
        return position

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return position in mm (n, 2), sigma in mm (n, 1), and confidence (n, 1)."""
        position = self.raw(features)
        same = torch.zeros_like(position[:, :1])
        return (position.clamp(-0.5, 0.5) + 0.5) * self.size_mm, same + self.sigma_mm, same + 1.0
