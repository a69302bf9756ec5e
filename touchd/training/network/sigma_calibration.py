"""A network's standard errors made honest: measured on touches that it never saw, and scaled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from touchd.training.data.augment import Augmenter
from touchd.training.field.error_scale import MOST, WITHIN
from touchd.training.field.regression import Floats
from touchd.training.network.network import Regression

LOUDER = (0.2, 0.6)
"""Noise over the median touch, by the norms of the features, at which the standard error is made right beside the
touches' own: on the reference plate 50 and 40 dB below the untouched signal."""


@dataclass(frozen=True, slots=True)
class Told:
    """Touches at one level of noise, and what a network says of them: all of shape (n, 1) but the first."""

    error_mm: Floats
    """Absolute, shape (n, 2)."""
    sigma_mm: Floats
    """Predicted, without noise."""
    noise_mm: Floats
    """Predicted, of the noise that there is."""

    def quantile(self, sigma_scale: float, noise_scale: float) -> float:
        """Return how many predicted standard errors hold 68 % of the errors of either axis."""
        predicted_mm = np.hypot(sigma_scale * self.sigma_mm, noise_scale * self.noise_mm)
        return float(np.quantile(self.error_mm / predicted_mm, WITHIN))


def make_honest(network: Regression, augmenter: Augmenter, residual: Tensor, position: Tensor) -> None:
    """Scale a network's sigma and its error of noise such that 68 % of the errors are within sigma.

    In training it was shown more kinds of disturbance than most plates know, and is cautious without them. So two
    scales are found on touches that it was not trained on: with their own noise and with louder, half of them as
    another finger would have given them. By the quantile: a few touches in a wrong lobe do not count.

    Parameters
    ----------
    network : Regression
        That tells the error of noise apart.
    augmenter : Augmenter
        Knows the noise of the recording.
    residual : tensor of shape (n, inputs)
        Of recorded touches.
    position : tensor of shape (n, 2)
        In plate sizes from the centre.
    """
    own = augmenter.own_noise(residual)
    levels = [1.0, *(louder / own for louder in LOUDER if 0 < own < louder / 1.1)]
    told = [_told(network, *augmenter.held_out(residual, level), position) for level in levels]

    def cost(logs: NDArray[np.float64]) -> float:
        scales = np.exp(np.clip(logs, -np.log(MOST), np.log(MOST)))
        return float(np.square(np.log([said.quantile(*scales) for said in told])).sum())

    found = minimize(cost, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-7})
    with torch.no_grad():
        network.log_error.bias.add_(torch.from_numpy(np.clip(found.x, -np.log(MOST), np.log(MOST))))


def _told(network: Regression, features: Tensor, noise: Tensor, position: Tensor) -> Told:
    with torch.inference_mode():
        place_mm, sigma_mm, _, noise_mm = network.eval()(features)
        error_mm = (place_mm - network.truth_mm(position)).abs()
    return Told(error_mm.double().numpy(), sigma_mm.double().numpy(), (noise_mm * noise).double().numpy())
