"""Whether a frame tells where a wide finger has landed: shapes elsewhere are rivals of its own, points are not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.unit.localization.rig import ATLAS, Rig
from tests.unit.localization.test_contact_model import as_bins, contact
from touchd.localization.fit import Bins, Fit

FACE = (7 * np.exp(0.4j), 7 * np.exp(0.4j), 0)
"""Of a face as wide as the wave: points leave half of its energy."""
UNKNOWN = 0.06
"""Share of its energy that the field misses."""
PLACES_MM = [tuple(place) for place in np.random.default_rng(0).uniform((15, 15), (105, 75), (40, 2)).tolist()]


@pytest.fixture(scope="module")
def rig() -> Rig:
    made = Rig()
    made.lift(20)
    return made


def wide(at_mm: tuple[float, float], seed: int) -> Bins:
    rng = np.random.default_rng(seed)
    values = contact(*at_mm, 2.0, FACE, ATLAS)
    errors = rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape)
    errors *= math.sqrt(UNKNOWN) * np.linalg.norm(values) / np.linalg.norm(errors)
    return as_bins(np.asarray(values + errors), np.float32)


def begun(rig: Rig, bins: Bins, start_mm: tuple[float, float]) -> tuple[Fit, bool]:
    """What is fitted from a start, and whether it may be elsewhere."""
    landing, noise = rig.localizer._landing, rig.localizer._noise
    fit = rig.localizer._solver.fit_one(bins, *start_mm, 5)
    fit = rig.localizer._solver.with_shapes(bins, fit, noise.noise_energy)
    signal = bins.energy - noise.noise_energy
    return fit, landing.is_implausible(bins, fit, signal, noise.excess(fit.residual_energy, signal))


def test_wide_face(rig: Rig) -> None:
    """What is fitted from nearby, and is right, is placed."""
    right = refused = 0
    for seed, (x, y) in enumerate(PLACES_MM):
        fit, ambiguous = begun(rig, wide((x, y), seed), (x + 0.7, y - 0.7))
        if math.dist(fit.positions_mm[0], (x, y)) < 1.5:
            right, refused = right + 1, refused + ambiguous
    assert right > 30
    assert refused <= 1


def test_wrong_valley(rig: Rig) -> None:
    """Landing refuses a fit a decimetre away, with any shape."""
    wrong = refused = 0
    for seed, (x, y) in enumerate(PLACES_MM):
        fit, ambiguous = begun(rig, wide((x, y), seed), (120 - x, 90 - y))
        if math.dist(fit.positions_mm[0], (x, y)) > 7:
            wrong, refused = wrong + 1, refused + ambiguous
    assert wrong > 20
    assert refused == wrong
