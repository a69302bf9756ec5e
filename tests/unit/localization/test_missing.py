"""Where the shapes of some fingers make up for another one, that one is found, and no other."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from tests.fields import COUNTS, Field, make_atlas
from tests.unit.localization.test_contact_model import as_bins, contact
from touchd.localization.contact_model import TYPICAL
from touchd.localization.finger_count import FingerCount
from touchd.localization.fit import Bins, Fit, finish, no_fit
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.noise import NoiseModel
from touchd.localization.pursuit import Pursuit
from touchd.localization.spline import Position
from touchd.localization.weighted_fit import WeightedFit

ATLAS = make_atlas(Field())
SOLVER = GaussNewton(ATLAS)
FACE = (1.5 * np.exp(0.4j), 1.2 * np.exp(0.4j), 0.2)
PLACES_MM = [(30.0, 25.0), (85.0, 30.0), (60.0, 65.0)]
SIGMA = 1e-3 * COUNTS


def frame(places_mm: Sequence[Position], seed: int = 1) -> Bins:
    rng = np.random.default_rng(seed)
    values = np.sum([contact(*at, 1.0, FACE, ATLAS) for at in places_mm], axis=0)
    noise = rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape)
    return as_bins(np.asarray(values + SIGMA * noise, np.complex128), np.float32)


@pytest.fixture
def count() -> FingerCount:
    noise = NoiseModel(ATLAS)
    rng = np.random.default_rng(2)
    for _ in range(32):
        noise.update((SIGMA * rng.standard_normal(ATLAS.size)).astype(np.float32))
    noise.set_channels(np.ones(ATLAS.description.acquisition.channels, bool), np.zeros((0, ATLAS.size), np.float32))
    return FingerCount(SOLVER, Pursuit(ATLAS, SOLVER), noise, WeightedFit(ATLAS))


def fitted(bins: Bins, places_mm: Sequence[Position]) -> Fit:
    start = SOLVER.fit_several(bins, places_mm, 2, shapes=[TYPICAL] * len(places_mm))
    return SOLVER.fit_shapes(bins, start, 2 * SIGMA**2 * ATLAS.size, 4)


@pytest.mark.parametrize("lost", range(3))
def test_found(count: FingerCount, lost: int) -> None:
    """Of three fingers, the one that two lack."""
    bins = frame(PLACES_MM)
    known = [at for k, at in enumerate(PLACES_MM) if k != lost]
    two = SOLVER.fit_several(bins, known, 2, shapes=[TYPICAL] * 2)
    fit = finish(count.with_missing(bins, two))
    assert len(fit.positions_mm) == 3
    assert math.dist(fit.positions_mm[-1], PLACES_MM[lost]) < 0.5
    assert count.is_worth(bins, fit, two)


@pytest.mark.parametrize("seed", range(5))
def test_none(count: FingerCount, seed: int) -> None:
    """Where none is missing, none is found, and the fit stays as it is."""
    bins = frame(PLACES_MM[:2], seed)
    two = fitted(bins, PLACES_MM[:2])
    assert finish(count.with_missing(bins, two)) is two


def test_elsewhere(count: FingerCount) -> None:
    """One that was put where no finger is goes, and the one that is missing is found."""
    bins = frame(PLACES_MM)
    wrong = SOLVER.fit_several(bins, [*PLACES_MM[:2], (100.0, 60.0)], 1, shapes=[TYPICAL] * 3)
    fit = finish(count.with_missing(bins, wrong))
    assert len(fit.positions_mm) == 3
    assert all(min(math.dist(at, true) for true in PLACES_MM) < 0.5 for at in fit.positions_mm)


def test_not_asked(count: FingerCount) -> None:
    """Points, one finger and no finger are left as they are: their energy tells."""
    bins = frame(PLACES_MM)
    for fit in (no_fit(bins.energy), fitted(bins, PLACES_MM[:1]), SOLVER.fit_several(bins, PLACES_MM[:2], 2)):
        assert finish(count.with_missing(bins, fit)) is fit
        assert not count.is_worth(bins, fitted(bins, PLACES_MM), SOLVER.fit_several(bins, PLACES_MM[:2], 2))


def test_no_room(count: FingerCount) -> None:
    """Of two that are followed within one face, the fainter one goes."""
    bins = frame(PLACES_MM[:1])
    x, y = PLACES_MM[0]
    two = SOLVER.fit_several(bins, [(x, y), (x + 4.5, y)], 1, shapes=[TYPICAL] * 2)
    fit, dropped = count.prune(bins, two, bins.energy)
    assert dropped == [two.energies.index(min(two.energies))]
    assert math.dist(fit.positions_mm[0], PLACES_MM[0]) < 0.5
