"""Networks that estimate a position, and the losses they are trained on: ours, and the paper's regression.

The ONNX export traces these modules, so training and inference share one definition.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from touchd.evaluation.metrics import position_scores
from touchd.training.network.recipe import TRUNK

DROPOUT = 0.3  # the paper's
BINS = 32  # of each histogram
SPREAD_BINS = 0.75  # deviation of the target histograms, from the HL-Gauss paper
WITHIN_SIGMA = 0.683  # share of errors per axis within sigma, as for Gaussian errors
FINGER_SHARE = 0.5  # weight of the finger cross-entropy relative to the position's

Positions = NDArray[np.float32]


class Batch(NamedTuple):
    """One training batch: n fingers, then m - n non-fingers."""

    features: Tensor
    """Shape (m, inputs), m >= n."""
    position: Tensor
    """Positions of the fingers relative to the plate's centre, in units of its size, shape (n, 2)."""
    noise: Tensor
    """Noise-to-signal ratio of the fingers' features, by norms, shape (n, 1); 0 if unknown."""


class Normalise(nn.Module):
    """Projects out drift, and splits a residual into direction (unit length) and log-norm.

    The direction depends on the position, the norm on the force. `drift`, of shape (k, inputs), holds orthonormal
    directions of baseline drift.
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


class Network(nn.Module, ABC):
    """The paper's stages, batch normalisation, linear, ReLU, and dropout while training; heads follow `last`."""

    head: nn.Linear
    outputs: tuple[str, ...]
    """Names of what `forward` returns."""

    def __init__(self, inputs: int, widths: tuple[int, ...], dropout: float = 0.0, more: int = 0) -> None:
        super().__init__()
        stages: list[nn.Module] = []
        for width in widths:
            stages += [nn.BatchNorm1d(inputs), nn.Linear(inputs, width), nn.ReLU()]
            if dropout:
                stages.append(nn.Dropout(dropout))
            inputs = width
        self.trunk = nn.Sequential(*stages)
        self.last: nn.Module = nn.BatchNorm1d(inputs + more)

    def heads(self) -> tuple[nn.Linear, ...]:
        """Return the layers that `last` feeds."""
        return (self.head,)

    @abstractmethod
    def loss(self, batch: Batch) -> Tensor:
        """Return the loss of a batch."""

    @abstractmethod
    def estimate_mm(self, features: Tensor) -> Tensor:
        """Return positions (n, 2), mm."""

    def clamp_mm(self, position_mm: Tensor) -> Tensor:
        """Return true positions (n, 2) as far as the network resolves them, mm."""
        return position_mm

    def rmse_mm(self, features: NDArray[np.float32], position_mm: Positions) -> float:
        """Return the root mean square error of touches."""
        with torch.inference_mode():
            error_mm = self.eval().estimate_mm(torch.from_numpy(features)) - self.clamp_mm(
                torch.from_numpy(position_mm)
            )
        return position_scores(error_mm.numpy())["rmse_mm"]


class PositionNetwork(Network):
    """Estimates position, standard error and finger confidence.

    The last layer returns a histogram each for x and y, whose means are the position. It is trained by cross-entropy
    against a narrow Gaussian (HL-Gauss: Imani and White, ICML 2018), which is several times more precise than a squared
    error: the field is a product of two waves with many lobes, and the mean of two candidate lobes is never right.

    `area_mm`, of shape (2, 2), are the lower and upper corner of the area of interest, by default the whole plate.
    Positions outside are clamped to its edge; a smaller area has finer bins. With `noise_apart` the network returns the
    standard error due to noise separately, per noise-to-signal ratio: it cannot see the noise in a residual; the daemon
    measures it on the untouched plate. For `drift` see `Normalise`.
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
        drift: Tensor | None = None,
        area_mm: Tensor | None = None,
        *,
        noise_apart: bool = True,
    ) -> None:
        # The log-norm joins the last stage, because a weak touch has a larger error and resembles noise.
        super().__init__(inputs, widths, more=1)
        self.normalise = Normalise(drift)
        self.head = nn.Linear(widths[-1] + 1, 2 * BINS)
        self.finger = nn.Linear(widths[-1] + 1, 1)
        self.noise_apart = noise_apart
        self.log_error = nn.Linear(widths[-1] + 1, 1 + noise_apart)
        nn.init.constant_(self.log_error.bias, 4.0)  # initial sigma: 55 mm, half a plate
        self.register_buffer("size_mm", torch.tensor(size_mm))
        area_mm = torch.stack([torch.zeros(2), self.size_mm]) if area_mm is None else area_mm
        self.register_buffer("corner_mm", area_mm[0])
        self.register_buffer("span_mm", area_mm[1] - area_mm[0])
        # Relative to the area's centre, in units of its size; bins beyond the edge allow a mean on the edge itself.
        reach = 0.5 + 1.5 / BINS
        edges = torch.linspace(-reach, reach, BINS + 1)
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
        votes = self.head(stage).reshape(-1, 2, BINS)
        # Detached: the gradient of the error's likelihood is erratic while errors are large.
        return votes, self.log_error(stage.detach()), self.finger(stage)

    def log_sigma(self, log_error: Tensor, noise: Tensor) -> Tensor:
        """Combine log errors and noise-to-signal ratio (n, 1) into the log of sigma (n, 1)."""
        if log_error.shape[1] == 1:
            return log_error
        return torch.logaddexp(2 * log_error[:, :1], 2 * (log_error[:, 1:] + noise.log())) / 2

    def position_mm(self, votes: Tensor) -> Tensor:
        """Return the means of histograms given as logits (n, 2, bins): positions (n, 2), mm."""
        mean: Tensor = (votes.softmax(dim=2) * self.centres).sum(dim=2)
        return (mean.clamp(-0.5, 0.5) + 0.5).mul(self.span_mm) + self.corner_mm

    def clamp_mm(self, position_mm: Tensor) -> Tensor:
        """Clamp positions (n, 2) to the area, mm."""
        return torch.minimum(torch.maximum(position_mm, self.corner_mm), self.corner_mm + self.span_mm)

    def truth_mm(self, position: Tensor) -> Tensor:
        """Convert relative positions (n, 2) to mm, clamped to the area."""
        return self.clamp_mm((position + 0.5) * self.size_mm)

    def forward(self, features: Tensor) -> tuple[Tensor, ...]:
        """Return position in mm (n, 2), sigma in mm (n, 1), confidence (n, 1), and with `noise_apart` noise_mm (n, 1).

        `noise_mm` is the error due to noise per noise-to-signal ratio; sigma then excludes noise.
        """
        votes, log_error, logit = self.raw(features)
        error_mm = log_error.clamp(-5.0, 5.0).exp()
        said = self.position_mm(votes), error_mm[:, :1], logit.sigmoid()
        return (*said, error_mm[:, 1:]) if self.noise_apart else said

    def estimate_mm(self, features: Tensor) -> Tensor:
        """Return positions (n, 2), mm."""
        return self.position_mm(self.raw(features)[0])

    def targets(self, position: Tensor) -> Tensor:
        """Return the target histograms (n, 2, bins) of relative positions (n, 2).

        They are Gaussians with a deviation of `SPREAD_BINS`, truncated at the histogram's ends.
        """
        width = SPREAD_BINS * (self.edges[1] - self.edges[0])
        within = (self.truth_mm(position) - self.corner_mm) / self.span_mm - 0.5
        below = torch.special.ndtr((self.edges - within[:, :, None]) / width)
        share: Tensor = below[:, :, 1:] - below[:, :, :-1]
        return share / share.sum(dim=2, keepdim=True)

    def loss(self, batch: Batch) -> Tensor:
        """Return position cross-entropy plus quantile loss of sigma plus finger cross-entropy.

        The quantile loss is least if `WITHIN_SIGMA` of the errors are below sigma (Koenker and Bassett 1978). Unlike a
        Gaussian likelihood, it ignores the size of the few errors of touches in a wrong lobe.
        """
        features, position, noise = batch
        n = len(position)
        votes, log_error, logit = self.raw(features)
        votes = votes[:n]
        place = -(self.targets(position) * votes.log_softmax(dim=2)).sum(dim=2).mean()
        error_mm = (self.position_mm(votes.detach()) - self.truth_mm(position)).abs()
        excess = (error_mm + 1e-3).log() - self.log_sigma(log_error[:n], noise)
        sigma = torch.maximum(WITHIN_SIGMA * excess, (WITHIN_SIGMA - 1) * excess).mean()
        truth = (torch.arange(len(features)) < n).float()[:, None]
        return place + sigma + FINGER_SHARE * nn.functional.binary_cross_entropy_with_logits(logit, truth)


class PaperNetwork(Network):
    """The paper's regression network, trained on the squared error of x and y.

    It estimates no error and no confidence: sigma is one number, set after training, and the confidence is 1.
    """

    outputs = ("position_mm", "sigma_mm", "confidence")
    size_mm: Tensor
    sigma_mm: Tensor

    def __init__(self, inputs: int, size_mm: tuple[float, float], widths: tuple[int, ...] = TRUNK) -> None:
        super().__init__(inputs, widths, DROPOUT)
        self.head = nn.Linear(widths[-1], 2)
        self.register_buffer("size_mm", torch.tensor(size_mm))
        self.register_buffer("sigma_mm", torch.ones(1, 1))

    def raw(self, features: Tensor) -> Tensor:
        """Return the position relative to the plate's centre, in units of its size, shape (n, 2)."""
        position: Tensor = self.head(self.last(self.trunk(features)))
        return position

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return position in mm (n, 2), sigma in mm (n, 1), and confidence (n, 1)."""
        position_mm = self.estimate_mm(features)
        same = torch.zeros_like(position_mm[:, :1])
        return position_mm, same + self.sigma_mm, same + 1.0

    def estimate_mm(self, features: Tensor) -> Tensor:
        """Return positions (n, 2), mm."""
        return (self.raw(features).clamp(-0.5, 0.5) + 0.5) * self.size_mm

    def loss(self, batch: Batch) -> Tensor:
        """Return the mean squared error, in units of the plate's size."""
        return nn.functional.mse_loss(self.raw(batch.features), batch.position)
