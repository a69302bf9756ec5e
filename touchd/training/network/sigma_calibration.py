"""Calibrate a network's standard errors on touches outside its training part."""

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
from touchd.training.network.network import PositionNetwork

LOUDER = (0.2, 0.6)
"""Noise relative to the median touch, by feature norms, at which sigma is calibrated beside the touches' own noise. On
the reference plate this is 50 and 40 dB below the untouched signal."""
SIMPLEX_SIZES = (1.0, 0.3, 0.1)
"""Of the searches for the two scales, in their logarithms."""


@dataclass(frozen=True, slots=True)
class Predictions:
    """Errors and predicted standard errors of n touches at one noise level, shape (n, 1)."""

    error_mm: Floats
    """Absolute error per axis, shape (n, 2)."""
    sigma_mm: Floats
    """Predicted sigma without noise."""
    noise_mm: Floats
    """Predicted sigma due to the noise present."""

    def quantile(self, sigma_scale: float, noise_scale: float) -> float:
        """Return the 68 % quantile of the error per axis, in predicted standard errors."""
        predicted_mm = np.hypot(sigma_scale * self.sigma_mm, noise_scale * self.noise_mm)
        return float(np.quantile(self.error_mm / predicted_mm, WITHIN))


def calibrate_sigma(network: PositionNetwork, augmenter: Augmenter, residual: Tensor, position: Tensor) -> None:
    """Scale a network's two sigma outputs so that 68 % of the errors per axis lie within sigma.

    Training shows the network more disturbances than most plates have, so its sigma is too large. The two scales are
    fitted on held-out touches, at their own noise and at higher noise, half of them with another finger's amplitude.
    Quantiles ignore the few touches that land in a wrong lobe.

    Parameters
    ----------
    network : PositionNetwork
        Network with a separate noise output.
    augmenter : Augmenter
        Source of the recording's noise.
    residual : tensor of shape (n, inputs)
        Recorded touches.
    position : tensor of shape (n, 2)
        True positions, relative to the plate's centre, in units of its size.
    """
    own = augmenter.own_noise(residual)
    levels = [1.0, *(louder / own for louder in LOUDER if 0 < own < louder / 1.1)]
    predictions = [_predict(network, *augmenter.held_out(residual, level), position) for level in levels]

    def cost(logs: NDArray[np.float64]) -> float:
        scales = np.exp(np.clip(logs, -np.log(MOST), np.log(MOST)))
        return float(np.square(np.log([said.quantile(*scales) for said in predictions])).sum())

    best = minimize(cost, np.zeros(2), method="Nelder-Mead")
    # Quantiles of few touches make steps, on which a descent ends: search around the best again, and keep the best.
    for size in SIMPLEX_SIZES:
        simplex = best.x + size * np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
        found = minimize(cost, best.x, method="Nelder-Mead", options={"initial_simplex": simplex})
        best = min(best, found, key=lambda result: result.fun)
    with torch.no_grad():
        network.log_error.bias.add_(torch.from_numpy(np.clip(best.x, -np.log(MOST), np.log(MOST))))


def _predict(network: PositionNetwork, features: Tensor, noise: Tensor, position: Tensor) -> Predictions:
    with torch.inference_mode():
        position_mm, sigma_mm, _, noise_mm = network.eval()(features)
        error_mm = (position_mm - network.truth_mm(position)).abs()
    return Predictions(error_mm.double().numpy(), sigma_mm.double().numpy(), (noise_mm * noise).double().numpy())
