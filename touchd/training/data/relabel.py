"""Where the touches of a training set really were: labels are no better than the robot, or the hand, that made them.

Each touch is placed by the field that all others tell, so that its own label has no say, and moved from its
label towards there by as much as either is known: a label's error is taken for normal, with a deviation that is
estimated from all of them.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from touchd.training.field.leave_one_out import Displaced
from touchd.training.field.regression import Floats

LEAST_MM = 0.05
"""Labels that are better than this are left as they are: the field's own errors begin to look like as much."""
MOST_MM = 1.5
"""A touch found farther from its label is left where it was: a wrong valley, or a wrong label."""


def label_noise_mm(displaced: Displaced) -> float:
    """Return the deviation per axis of the labels' errors under which such displacements are most likely."""
    near = np.linalg.norm(displaced.by_mm, axis=1) < MOST_MM
    by_mm, covariance = displaced.by_mm[near], displaced.covariance[near]
    if len(by_mm) < 3:
        return 0.0

    def surprise(deviation_mm: float) -> float:
        total = covariance + deviation_mm**2 * np.eye(2)
        solved = np.linalg.solve(total, by_mm[:, :, None])[:, :, 0]
        return float((np.log(np.linalg.det(total)) + np.einsum("ni,ni->n", by_mm, solved)).mean())

    return float(minimize_scalar(surprise, bounds=(1e-4, MOST_MM), method="bounded").x)


def replaced(label_mm: Floats, place_mm: Floats, displaced: Displaced, noise_mm: float) -> Floats:
    """Return the likeliest places (n, 2) of touches, given their labels and where the others' field sees them.

    Parameters
    ----------
    label_mm : array, shape (n, 2)
        As recorded.
    place_mm : array, shape (n, 2)
        As assumed when `displaced` was found.
    displaced : Displaced
    noise_mm : float
        Deviation of a label's error per axis.
    """
    off_mm = place_mm + displaced.by_mm - label_mm
    prior = noise_mm**2 * np.eye(2)
    moved = (prior @ np.linalg.solve(displaced.covariance + prior, off_mm[:, :, None]))[:, :, 0]
    far = np.linalg.norm(off_mm, axis=1) > max(MOST_MM, 4 * noise_mm)
    return np.where(far[:, None], label_mm, label_mm + moved)
