"""Contacts are placed by a fit that knows how the model errs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.fields import COUNTS, Field, in_double, look_up, make_atlas
from tests.unit.localization.test_contact_model import as_bins, contact, contact_model
from touchd.localization.atlas import Atlas
from touchd.localization.fit import Bins, Fit, finish
from touchd.localization.weighted_fit import OWN, POWER, TISSUE, Place, WeightedFit

ATLAS = in_double(make_atlas(Field()))
KNOWN = replace(ATLAS, error=np.zeros_like(ATLAS.error))
CHANNELS = ATLAS.description.acquisition.channels
VARIANCE = 1e-6 * COUNTS**2
FACE = (1.5 * np.exp(0.4j), 1.2 * np.exp(0.4j), 0.2)
INSIDE = st.tuples(st.floats(15, 105), st.floats(15, 75))
MODEL, WEIGHTED = contact_model(ATLAS), WeightedFit(ATLAS)
Complex = NDArray[np.complex128]


def fitted(bins: Bins, at: tuple[float, float], variance: float = VARIANCE) -> Fit:
    return finish(MODEL.pieces(bins, [at], variance, 6))


def one_place(model: WeightedFit, bins: Bins, fit: Fit) -> Place:
    (place,), _ = model.place(bins, fit, VARIANCE)
    return place


def noise(seed: int, size: int) -> Complex:
    rng = np.random.default_rng(seed)
    return np.asarray(math.sqrt(VARIANCE) * (rng.standard_normal(size) + 1j * rng.standard_normal(size)))


@given(INSIDE, st.floats(-math.pi, math.pi))
@settings(max_examples=20)
def test_exact(at: tuple[float, float], phase: float) -> None:
    """A contact that the model says in full is placed where it is."""
    bins = as_bins(contact(*at, np.exp(1j * phase), FACE, ATLAS))
    place = one_place(WEIGHTED, bins, fitted(bins, at))
    assert math.dist(place[:2], at) < 0.02
    assert 0 < place.sigma_mm < 1


def circular(rng: np.random.Generator, *shape: int) -> Complex:
    return np.asarray((rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) / math.sqrt(2))


def test_model_error() -> None:
    """Where the model errs as stated, positions err by less than a third of the plain fit's, and as sigma says."""
    plain, weighted, sigmas = [], [], []
    rng = np.random.default_rng(5)
    model = WeightedFit(KNOWN)
    face = 2 * FACE[0], 2 * FACE[1], 0.0
    share = TISSUE * abs(face[0] + face[1]) ** POWER / 2**POWER
    for _ in range(100):
        at = float(rng.uniform(15, 105)), float(rng.uniform(15, 75))
        u = look_up(ATLAS, *at)[0].reshape(CHANNELS, -1)
        mean = np.sqrt(np.square(np.abs(u)).mean(axis=1, keepdims=True))
        own = np.abs(u) * circular(rng, *u.shape) + mean * circular(rng, *u.shape)
        missed = math.sqrt(share) * (u * circular(rng, u.shape[1]) + math.sqrt(OWN) * own)
        bins = as_bins(contact(*at, 1.0, face, ATLAS) + missed.ravel() + noise(int(rng.integers(1000)), missed.size))
        fit = fitted(bins, at)
        place = one_place(model, bins, fit)
        plain.append(math.dist(fit.positions_mm[0], at))
        weighted.append(np.subtract(place[:2], at))
        sigmas.append(place.sigma_mm)
    off = np.array(weighted)
    assert np.median(np.hypot(*off.T)) < np.median(plain) / 3
    within = np.abs(off) / np.array(sigmas)[:, None]
    assert (within < 1).mean() == pytest.approx(0.68, abs=0.12)
    assert (within < 2).mean() == pytest.approx(0.95, abs=0.05)


@given(INSIDE, st.integers(0, 2**31))
@settings(max_examples=20)
def test_precision(at: tuple[float, float], seed: int) -> None:
    """In float32 a noisy contact lies within 2 um of where float64 puts it."""
    values = contact(*at, 1.0, FACE, ATLAS)
    values = values + noise(seed, values.size)
    wide = as_bins(values)
    fit = fitted(wide, at)
    one = one_place(WEIGHTED, wide, fit)
    other = one_place(WeightedFit(make_atlas(Field())), as_bins(values, np.float32), fit)
    assert math.dist(one[:2], other[:2]) < 2e-3


@pytest.mark.parametrize("channel", range(CHANNELS))
def test_dead_channel(channel: int) -> None:
    """A channel that is left out says nothing: the field that it would have does not matter."""
    at = (60.0, 45.0)
    values = contact(*at, 1.0, FACE, ATLAS)
    mask = np.ones((CHANNELS, len(values) * 2 // CHANNELS))
    mask[channel] = 0
    bins = as_bins(values + noise(1, values.size))
    heard = Bins(bins.vector * mask.ravel(), mask.ravel(), bins.energy)
    fit = fitted(heard, at)
    place = one_place(WEIGHTED, heard, fit)
    assert math.dist(place[:2], at) < 0.5
    field = ATLAS.coefficients.reshape(*ATLAS.coefficients.shape[:2], CHANNELS, -1).copy()
    field[:, :, channel] *= 100
    other = replace(ATLAS, coefficients=field.reshape(ATLAS.coefficients.shape))
    np.testing.assert_allclose(place, one_place(WeightedFit(other), heard, fit), rtol=1e-9)


def atlas_of_zeros() -> Atlas:
    return replace(KNOWN, coefficients=np.zeros_like(ATLAS.coefficients))


@pytest.mark.parametrize("what", ["zeros", "no number", "no noise", "no strength"])
def test_degenerate(what: str) -> None:
    """Nothing that a frame may hold is an error: a place is one, or stays as it was fitted."""
    at = (60.0, 45.0)
    bins = as_bins(contact(*at, 1.0, FACE, ATLAS))
    fit, model, variance = fitted(bins, at), WEIGHTED, VARIANCE
    if what == "zeros":
        model = WeightedFit(atlas_of_zeros())
    elif what == "no number":
        bins.vector[3] = np.nan
    elif what == "no noise":
        model, variance = WeightedFit(KNOWN), 0.0
    else:
        fit = Fit(fit.positions_mm, [0j], [0.0], fit.fisher_information, fit.residual_energy, fit.shapes)
    places, misfit = model.place(bins, fit, variance)
    assert misfit >= 0 or what == "no number"
    assert places or what != "no noise"
    for place in places:
        assert math.dist(place[:2], at) < 1.5
        assert math.isfinite(place.sigma_mm)
