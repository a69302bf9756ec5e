"""Calibrate a network's standard errors on touches outside its training part."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from touchd.training.data.augment import Augmenter
from touchd.training.field.error_scale import fit_scales
from touchd.training.field.regression import Floats
from touchd.training.network.network import PositionNetwork

LOUDER = (0.2, 0.6)
"""Noise relative to the median touch, by feature norms, at which sigma is calibrated beside the touches' own noise. On
the reference plate this is 50 and 40 dB below the untouched signal."""


def calibrate_sigma(network: PositionNetwork, augmenter: Augmenter, residual: Tensor, position: Tensor) -> None:
    """Scale a network's two sigma outputs so that 68 % of the errors per axis lie within sigma.

    Training shows the network more disturbances than most plates have, so its sigma is too large. The two scales are
    fitted on held-out touches, at their own noise and at higher noise, half of them with another finger's amplitude:
    residuals (n, inputs) at positions (n, 2) relative to the plate's centre, in units of its size.
    """
    own = augmenter.own_noise(residual)
    levels = [1.0, *(louder / own for louder in LOUDER if 0 < own < louder / 1.1)]
    predictions = [_predict(network, *augmenter.held_out(residual, level), position) for level in levels]
    error_mm, sigma_mm, noise_mm = predictions[-1]
    # Relative to the errors, so that the search does not depend on what the outputs were before.
    units = [np.median(error_mm) / (np.median(part) or 1.0) for part in (sigma_mm, noise_mm)]

    def ratios(sigma_scale: float, noise_scale: float) -> list[Floats]:
        a, b = sigma_scale * units[0], noise_scale * units[1]
        return [error_mm / np.hypot(a * sigma_mm, b * noise_mm) for error_mm, sigma_mm, noise_mm in predictions]

    scales = np.array(fit_scales(ratios)) * units
    with torch.no_grad():
        network.log_error.bias.add_(torch.from_numpy(np.log(scales)))


def _predict(network: PositionNetwork, features: Tensor, noise: Tensor, position: Tensor) -> tuple[Floats, ...]:
    """Return the absolute error per axis (n, 2), and sigma (n, 1) without noise and due to the noise present, mm."""
    with torch.inference_mode():
        position_mm, sigma_mm, _, noise_mm = network.eval()(features)
        error_mm = (position_mm - network.truth_mm(position)).abs()
    return tuple(part.double().numpy() for part in (error_mm, sigma_mm, noise_mm * noise))
