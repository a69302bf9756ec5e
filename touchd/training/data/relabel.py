"""Correct label errors of a training set: a robot or a hand places touches imprecisely.

Each touch is located with the field of all others, independently of its own label. The corrected position lies between
label and estimate, weighted by their variances. Label errors are modelled as normal, with a common deviation estimated
from all touches.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from touchd.training.field.leave_one_out import Displaced
from touchd.training.field.regression import Floats

LEAST_MM = 0.05
"""Label errors below this deviation are not corrected: the field's own error is of that size."""
MOST_MM = 1.5
"""A touch located farther from its label keeps the label: wrong valley, or wrong label."""


def label_noise_mm(displaced: Displaced) -> float:
    """Estimate the label error's deviation per axis by maximum likelihood, mm."""
    near = np.linalg.norm(displaced.by_mm, axis=1) < MOST_MM
    by_mm, covariance = displaced.by_mm[near], displaced.covariance[near]
    if len(by_mm) < 3:
        return 0.0

    def surprise(deviation_mm: float) -> float:
        total = covariance + deviation_mm**2 * np.eye(2)
        solved = np.linalg.solve(total, by_mm[:, :, None])[:, :, 0]
        return float((np.log(np.linalg.det(total)) + np.einsum("ni,ni->n", by_mm, solved)).mean())

    return float(minimize_scalar(surprise, bounds=(1e-4, MOST_MM), method="bounded").x)


def replaced(label_mm: Floats, position_mm: Floats, displaced: Displaced, noise_mm: float) -> Floats:
    """Return the most probable positions (n, 2), given labels and displacements.

    Parameters
    ----------
    label_mm : array, shape (n, 2)
        Recorded positions.
    position_mm : array, shape (n, 2)
        Positions for which `displaced` was computed.
    displaced : Displaced
    noise_mm : float
        Deviation of the label error per axis.
    """
    off_mm = position_mm + displaced.by_mm - label_mm
    prior = noise_mm**2 * np.eye(2)
    moved = (prior @ np.linalg.solve(displaced.covariance + prior, off_mm[:, :, None]))[:, :, 0]
    far = np.linalg.norm(off_mm, axis=1) > max(MOST_MM, 4 * noise_mm)
    return np.where(far[:, None], label_mm, label_mm + moved)
