"""Contacts with a size and a shape are placed at their middle, as a float64 reference places them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.fields import COUNTS, Field, features_of, in_double, look_up, make_atlas
from touchd.localization.atlas import Atlas
from touchd.localization.contact_model import ContactModel, size_mm2
from touchd.localization.fit import Bins, finish, shapes_of, sigmas_mm
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.spline import ContactField

ATLAS = make_atlas(Field())


def contact_model(atlas: Atlas) -> ContactModel:
    return ContactModel(atlas, ContactField(atlas, np.zeros((3, atlas.size), atlas.coefficients.dtype)))


SINGLE, DOUBLE, SOLVER = contact_model(ATLAS), contact_model(in_double(ATLAS)), GaussNewton(in_double(ATLAS))
VARIANCE = 1e-6 * COUNTS**2
INSIDE = st.tuples(st.floats(15, 105), st.floats(15, 75))
SHAPE = st.tuples(*[st.floats(-3, 3)] * 3)
H_MM = 0.02


def field(x_mm: float, y_mm: float, atlas: Atlas = ATLAS) -> NDArray[np.complex128]:
    return np.asarray(look_up(atlas, x_mm, y_mm)[0]).ravel()


def contact(
    x_mm: float, y_mm: float, z: complex, shape: Sequence[complex], atlas: Atlas = ATLAS
) -> NDArray[np.complex128]:
    """Bins of a contact, its second derivatives by differences of the tests' own look-up."""
    h = H_MM
    u, left, right, up, down, one, two, three, four = (
        field(x_mm + a * h, y_mm + b * h, atlas)
        for a, b in ((0, 0), (-1, 0), (1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
    )
    xy = (one - two - three + four) / (4 * h * h)
    xx, yy = (left - 2 * u + right) / h**2, (down - 2 * u + up) / h**2
    return np.asarray(z * (u + shape[0] * xx + shape[1] * yy + shape[2] * xy))


def as_bins(values: NDArray[np.complex128], dtype: type = np.float64) -> Bins:
    vector: NDArray[np.floating] = features_of(values.reshape(4, -1)).astype(dtype).ravel()
    return Bins(vector, None, float(vector @ vector))


@given(INSIDE, SHAPE, st.floats(0.5, 3), st.floats(-math.pi, math.pi), st.floats(0, 2 * math.pi))
@settings(max_examples=30)
def test_place_and_shape(
    at: tuple[float, float], shape: tuple[float, float, float], size: float, phase: float, way: float
) -> None:
    """From 0.5 mm away it finds the middle of a contact to 0.05 mm, and its second moments to a tenth."""
    z = size * np.exp(1j * phase)
    start = at[0] + 0.5 * math.cos(way), at[1] + 0.5 * math.sin(way)
    fit = finish(DOUBLE.pieces(as_bins(contact(*at, z, shape)), [start], VARIANCE, 8))
    assert math.dist(fit.positions_mm[0], at) < 0.05
    found = np.array(fit.shapes[0][1:]) / fit.amplitudes[0]
    np.testing.assert_allclose(found, shape, atol=0.4)


@given(INSIDE, SHAPE, st.integers(0, 2**31))
@settings(max_examples=30)
def test_precision(at: tuple[float, float], shape: tuple[float, float, float], seed: int) -> None:
    """In float32 a noisy contact lies within 2 um of where float64 puts it."""
    rng = np.random.default_rng(seed)
    values = contact(*at, 1.0, shape)
    values = values + math.sqrt(VARIANCE) * (rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape))
    one, other = (
        finish(model.pieces(as_bins(values, dtype), [at], VARIANCE, 6))
        for model, dtype in ((SINGLE, np.float32), (DOUBLE, np.float64))
    )
    assert math.dist(one.positions_mm[0], other.positions_mm[0]) < 2e-3
    assert one.residual_energy == pytest.approx(other.residual_energy, rel=1e-2, abs=1e-6 * float(abs(values @ values)))


def test_two() -> None:
    """Two contacts are fitted jointly: each is placed, and what both leave is what `residual` returns."""
    places = [(35.0, 40.0), (80.0, 50.0)]
    bins = as_bins(contact(*places[0], 1.0, (2.0, 1.0, 0.5)) + contact(*places[1], 0.7j, (1.0, 2.0, -0.5)))
    fit = finish(DOUBLE.pieces(bins, [(35.4, 39.7), (79.7, 50.4)], VARIANCE, 8))
    for found, place in zip(fit.positions_mm, places, strict=True):
        assert math.dist(found, place) < 0.05
    left = SOLVER.residual(bins, fit)
    # The last step is known to second order alone, as that of points.
    assert float(left @ left) == pytest.approx(fit.residual_energy, abs=5e-6 * bins.energy)
    assert fit.residual_energy < 1e-3 * bins.energy


@given(INSIDE, SHAPE, st.floats(-0.3, 0.3), st.floats(0, 2 * math.pi))
@settings(max_examples=30)
def test_known_shape(at: tuple[float, float], shape: tuple[float, float, float], slope: float, way: float) -> None:
    """A contact of known shape is placed as a point is: exactly, from its field and the slopes of that."""
    second = np.exp(0.2j) * np.array(shape)
    known = (slope * np.exp(-0.4j), *second.tolist())
    of_shape = contact(*at, 1.0, second) + known[0] * SOLVER._contact_field.band * field(*at)
    bins = as_bins((0.8 + 0.5j) * of_shape)
    start = at[0] + 0.5 * math.cos(way), at[1] + 0.5 * math.sin(way)
    for fit in (SOLVER.fit_one(bins, *start, 6, known), SOLVER.fit_several(bins, [start], 12, shapes=[known])):
        assert math.dist(fit.positions_mm[0], at) < 2e-3
        assert fit.residual_energy < 1e-5 * bins.energy
        np.testing.assert_allclose(shapes_of(fit)[0], known, atol=1e-12)


def test_coverage() -> None:
    """The standard errors of a noisy contact hold: 68 % of the errors per axis lie within one, 95 % within two."""
    rng = np.random.default_rng(4)
    ratios = []
    for _ in range(150):
        at = (float(rng.uniform(20, 100)), float(rng.uniform(20, 70)))
        values = contact(*at, 1.0, (1.5, 1.0, 0.3))
        noise = rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape)
        fit = finish(DOUBLE.pieces(as_bins(values + math.sqrt(VARIANCE) * noise), [at], VARIANCE, 6))
        sigma_mm = sigmas_mm(fit.fisher_information, VARIANCE)[0]
        ratios += [(found - true) / sigma_mm for found, true in zip(fit.positions_mm[0], at, strict=True)]
    within = [float(np.mean(np.abs(ratios) < k)) for k in (1, 2)]
    print(f"within one and two standard errors: {within}")
    assert within[0] == pytest.approx(0.68, abs=0.07)
    assert within[1] == pytest.approx(0.95, abs=0.04)


def test_faint() -> None:
    """Of a faint contact the prior holds the shape: its moments stay within what tissue has."""
    rng = np.random.default_rng(5)
    sizes = []
    for _ in range(50):
        values = contact(60.0, 45.0, 1.0, (0.0, 0.0, 0.0))
        noise = rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape)
        variance = 0.2 * float(np.mean(np.abs(values) ** 2))
        fit = finish(DOUBLE.pieces(as_bins(values + math.sqrt(variance) * noise), [(60.0, 45.0)], variance, 5))
        sizes.append(size_mm2(fit))
    assert np.median(sizes) < 8


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0])
def test_no_signal(bad: float) -> None:
    """Bins without a number, or without a signal, raise nothing and end on the plate."""
    with np.errstate(all="ignore"):
        bins = as_bins(np.full(ATLAS.size // 2, bad, complex), np.float32)
        fit = finish(SINGLE.pieces(bins, [(60.0, 45.0)], 1.0, 4))
    assert all(0 <= value <= 120 for value in fit.positions_mm[0])
