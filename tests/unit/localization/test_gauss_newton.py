"""Gauss-Newton on the atlas: position, amplitude and their errors are those of float64 references."""

from __future__ import annotations

import cmath
import math
from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.fields import (
    COUNTS,
    PLATE,
    Field,
    Finger,
    bins_of,
    features_of,
    gauss_newton,
    in_double,
    look_up,
    make_atlas,
)
from touchd.localization.fit import Fit, sigmas_mm
from touchd.localization.gauss_newton import STILL_MM, GaussNewton
from touchd.localization.spline_weights import PER_CELL

FIELD = Field()
ATLAS = make_atlas(FIELD)
SINGLE, DOUBLE = GaussNewton(ATLAS), GaussNewton(in_double(ATLAS))
INSIDE = st.tuples(st.floats(8, 112), st.floats(8, 82))
AMPLITUDE = st.builds(cmath.rect, st.floats(0.05, 5), st.floats(-math.pi, math.pi))
SEEDS = st.integers(0, 2**32 - 1)
STEPS = 8
ROUNDING = 5e-5
"""Of an energy that is the difference of sums in float32: seen are 1.6e-5 in 1,500 fits, a hundredth of what matters
to the search."""
OF_FIRST_ORDER = 2e-3
"""The last step changes the amplitude by its first order."""
THREE: list[Finger] = [(30.0, 30.0, 1.0 + 0.2j), (85.0, 25.0, 0.6 - 0.1j), (60.0, 70.0, 1.5 + 0j)]
PLACES = [finger[:2] for finger in THREE]


def of_atlas(fingers: list[Finger]) -> np.ndarray:
    """Features of fingers on the atlas itself, in float64."""
    bins = sum((z * look_up(ATLAS, x, y)[0] for x, y, z in fingers), np.zeros(ATLAS.size // 2, complex))
    return features_of(bins.reshape(4, -1))


@given(INSIDE)
def test_atlas(at: tuple[float, float]) -> None:
    """The tests' atlas is the tests' formula, to the 1 % that a grid of 2.5 mm allows."""
    for splines, exact, size in zip(look_up(ATLAS, *at), FIELD.at(*at), (1, 0.4, 0.4), strict=True):
        assert np.sqrt(np.mean(np.abs(splines - exact.ravel()) ** 2)) < 0.01 * size * COUNTS


@given(INSIDE, AMPLITUDE, st.floats(0, 2 * math.pi), st.floats(0, 3))
def test_reach(at: tuple[float, float], amplitude: complex, angle: float, off_mm: float) -> None:
    """From within 3 mm a fit finds position and amplitude."""
    start = at[0] + off_mm * math.cos(angle), at[1] + off_mm * math.sin(angle)
    fit = SINGLE.fit_one(bins_of(FIELD.frame([(*at, amplitude)])), *start, STEPS)
    assert math.dist(fit.positions_mm[0], at) < 0.02
    assert abs(fit.amplitudes[0] / amplitude - 1) < 0.005
    assert fit.residual_energy < 1e-3 * fit.energies[0]


@given(INSIDE, AMPLITUDE, SEEDS)
@settings(max_examples=30)
def test_one_finger(at: tuple[float, float], amplitude: complex, seed: int) -> None:
    """One finger in noise is placed as the reference places it, and rounding moves it by less than 0.1 um."""
    features = FIELD.frame([(*at, amplitude)], noise=0.02 * abs(amplitude) * COUNTS, seed=seed).astype(np.float32)
    positions, amplitudes = gauss_newton(ATLAS, features, np.array([at]))
    single = SINGLE.fit_one(bins_of(features), *at, STEPS)
    double = DOUBLE.fit_one(bins_of(features, dtype=np.float64), *at, STEPS)
    for fit in (single, double):
        assert math.dist(fit.positions_mm[0], positions[0]) < 1e-3
        assert abs(fit.amplitudes[0] / amplitudes[0] - 1) < OF_FIRST_ORDER
    assert math.dist(single.positions_mm[0], double.positions_mm[0]) < 1e-4


@given(INSIDE, AMPLITUDE, SEEDS)
def test_one_of_several(at: tuple[float, float], amplitude: complex, seed: int) -> None:
    """The fit of several fingers fits one as the fit of one does."""
    bins = bins_of(FIELD.frame([(*at, amplitude)], noise=0.02 * abs(amplitude) * COUNTS, seed=seed))
    one, several = SINGLE.fit_one(bins, *at, STEPS), SINGLE.fit_several(bins, [at], 3 * STEPS)
    assert math.dist(one.positions_mm[0], several.positions_mm[0]) < 1e-3
    assert several.amplitudes[0] == pytest.approx(one.amplitudes[0], rel=OF_FIRST_ORDER)
    assert several.energies[0] == pytest.approx(one.energies[0], rel=OF_FIRST_ORDER)
    assert several.residual_energy == pytest.approx(one.residual_energy, rel=1e-2, abs=ROUNDING * bins.energy)
    information = np.array(one.fisher_information)
    np.testing.assert_allclose(several.fisher_information, information, atol=0.02 * information.max())


@given(st.permutations(range(3)), SEEDS)
@settings(max_examples=20)
def test_several_fingers(order: list[int], seed: int) -> None:
    """Several fingers are placed in any order as the reference places them, in float64 to 20 nm.

    It ends a micrometre before the last step. They differ by what keeps the system of two merged fingers regular, a
    millionth of its trace.
    """
    features = FIELD.frame(THREE, noise=8.0, seed=seed).astype(np.float32)
    starts = np.array(PLACES) + np.random.default_rng(seed).uniform(-1, 1, (3, 2))
    positions, amplitudes = gauss_newton(ATLAS, features, starts)
    for solver, dtype, still_mm, within_mm, share in (
        (SINGLE, np.float32, STILL_MM / 10, 2e-3, 5e-3), (DOUBLE, np.float64, 1e-3, 2e-5, 1e-5)
    ):  # fmt: skip
        fit = solver.fit_several(bins_of(features, dtype=dtype), [tuple(starts[k]) for k in order], 40, still_mm)
        np.testing.assert_allclose(fit.positions_mm, positions[order], atol=within_mm)
        np.testing.assert_allclose(fit.amplitudes, amplitudes[order], rtol=share)


@given(st.lists(st.floats(0, 2 * math.pi), min_size=3, max_size=3))
def test_last_step(angles: list[float]) -> None:
    """A joint fit that ends on a step knows what the step does to the amplitudes."""
    off_mm = 0.8 * STILL_MM
    starts = [(x + off_mm * math.cos(a), y + off_mm * math.sin(a)) for (x, y), a in zip(PLACES, angles, strict=True)]
    fit = SINGLE.fit_several(bins_of(FIELD.frame(THREE)), starts, 1, STILL_MM)
    for position, amplitude, (x, y, z) in zip(fit.positions_mm, fit.amplitudes, THREE, strict=True):
        assert math.dist(position, (x, y)) < 0.02
        assert abs(amplitude / z - 1) < 0.005


def test_order() -> None:
    """Information and energies go with the fingers in any order."""
    bins = bins_of(FIELD.frame(THREE, noise=8.0, seed=1))
    usual = SINGLE.fit_several(bins, PLACES, 20)
    information = np.array(usual.fisher_information)
    for order in permutations(range(3)):
        fit = SINGLE.fit_several(bins, [PLACES[k] for k in order], 20)
        pairs = np.array([(2 * k, 2 * k + 1) for k in order]).ravel()
        np.testing.assert_allclose(
            fit.fisher_information, information[np.ix_(pairs, pairs)], atol=1e-3 * information.max()
        )
        np.testing.assert_allclose(fit.energies, [usual.energies[k] for k in order], rtol=1e-3)


def on_raster(position_mm: tuple[float, float]) -> tuple[float, float]:
    """The spline's raster point nearest to a position."""
    d = ATLAS.description
    unit_mm = d.step_mm / PER_CELL
    (x0_mm, y0_mm), (x_mm, y_mm) = d.origin_mm, position_mm
    return x0_mm + round((x_mm - x0_mm) / unit_mm) * unit_mm, y0_mm + round((y_mm - y0_mm) / unit_mm) * unit_mm


@given(st.lists(st.tuples(INSIDE, AMPLITUDE), min_size=1, max_size=4), SEEDS)
def test_residual(fingers: list[tuple[tuple[float, float], complex]], seed: int) -> None:
    """The residual is the frame less the model, and `residual_energy` is its energy."""
    assume(all(math.dist(a[0], b[0]) > 8 for a, b in combinations(fingers, 2)))
    features = FIELD.frame([(*at, z) for at, z in fingers], noise=50.0, seed=seed).astype(np.float32)
    bins = bins_of(features)
    fit = SINGLE.fit_several(bins, [at for at, _ in fingers], STEPS)
    # The residual takes the field at the spline's raster point nearest to each position.
    at_raster = [on_raster(at) for at in fit.positions_mm]
    left = features - of_atlas([(*at, z) for at, z in zip(at_raster, fit.amplitudes, strict=True)])
    np.testing.assert_allclose(SINGLE.residual(bins, fit), left, atol=1e-4 * np.abs(features).max())
    assert fit.residual_energy == pytest.approx(float(left @ left), rel=1e-3, abs=ROUNDING * bins.energy)


@pytest.mark.parametrize("fingers", [THREE[:1], THREE], ids=["one", "three"])
def test_information(fingers: list[Finger]) -> None:
    """The information is the inverse covariance: errors weighed with it are chi-square, within 4 deviations."""
    frames, noise = 300, 8.0
    exact, starts = of_atlas(fingers), [finger[:2] for finger in fingers]
    white = noise * np.random.default_rng(5).standard_normal((frames, len(exact)))
    weighed = []
    for features in exact + white:
        bins = bins_of(features)
        one = len(fingers) == 1
        fit = SINGLE.fit_one(bins, *starts[0], STEPS) if one else SINGLE.fit_several(bins, starts, STEPS)
        error = (np.array(fit.positions_mm) - starts).ravel()
        weighed.append(error @ np.array(fit.fisher_information) @ error / noise**2)
    degrees = 2 * len(fingers) * frames
    assert abs(float(np.sum(weighed)) - degrees) < 4 * math.sqrt(2 * degrees)
    covariance = np.linalg.inv(np.array(fit.fisher_information)).diagonal().reshape(-1, 2)
    assert sigmas_mm(fit.fisher_information, noise**2) == pytest.approx(noise * np.sqrt(covariance.mean(axis=1)))


@given(INSIDE, AMPLITUDE, st.integers(0, 3), SEEDS)
def test_masked_channel(at: tuple[float, float], amplitude: complex, dead: int, seed: int) -> None:
    """A masked channel's field does not count, and the others place the finger."""
    mask = np.ones((4, ATLAS.size // 4))
    mask[dead] = 0
    bins = bins_of(FIELD.frame([(*at, amplitude)], noise=1.0, seed=seed), mask.ravel())
    for fit in (SINGLE.fit_one(bins, *at, STEPS), SINGLE.fit_several(bins, [at], STEPS)):
        assert math.dist(fit.positions_mm[0], at) < 3
        assert not SINGLE.residual(bins, fit).reshape(4, -1)[dead].any()


ANYWHERE = st.floats(allow_nan=True, allow_infinity=True)


def check_sane(fit: Fit) -> None:
    for x_mm, y_mm in fit.positions_mm:
        assert 0 <= x_mm <= PLATE.width_mm
        assert 0 <= y_mm <= PLATE.height_mm
    assert all(cmath.isfinite(z) for z in fit.amplitudes)
    assert all(math.isfinite(energy) and energy >= -1e-6 for energy in fit.energies)
    assert np.isfinite(fit.fisher_information).all()
    assert math.isfinite(fit.residual_energy)
    assert fit.residual_energy >= 0


@given(
    st.lists(st.tuples(ANYWHERE, ANYWHERE), min_size=1, max_size=5), SEEDS,
    st.sampled_from([0.0, 1e-20, 1e-6, 1.0, 1e3, 32768 * 250.0]), st.booleans(),
)  # fmt: skip
def test_any_frame(starts: list[tuple[float, float]], seed: int, size: float, finger: bool) -> None:
    """Of any frame and any start the fit is finite and on the plate."""
    features = FIELD.frame([(60, 40, 1 / COUNTS)]) if finger else np.random.default_rng(seed).uniform(-1, 1, ATLAS.size)
    bins = bins_of(size * features)
    check_sane(SINGLE.fit_one(bins, *starts[0], STEPS))
    check_sane(SINGLE.fit_several(bins, starts, STEPS))
    check_sane(SINGLE.fit_several(bins, [starts[0]] * 3, STEPS))


def test_no_fingers() -> None:
    """The fit of no fingers leaves everything."""
    bins = bins_of(FIELD.frame(THREE))
    fit = SINGLE.fit_several(bins, [], STEPS)
    assert (fit.positions_mm, fit.amplitudes, fit.residual_energy) == ([], [], bins.energy)
    np.testing.assert_array_equal(SINGLE.residual(bins, fit), bins.vector)


def test_no_frame_is_kept() -> None:
    """A fit depends on its bins alone, not on the frames before."""
    a, b = (bins_of(FIELD.frame(THREE[k : k + 1], noise=8.0, seed=k)) for k in (0, 1))
    first = GaussNewton(ATLAS).fit_one(a, *PLACES[0], STEPS)
    solver = GaussNewton(ATLAS)
    solver.fit_one(b, *PLACES[1], STEPS)
    solver.fit_several(b, PLACES, STEPS)
    assert solver.fit_one(a, *PLACES[0], STEPS) == first


@given(INSIDE, st.floats(0, 2 * math.pi))
@settings(max_examples=30)
def test_shift(at: tuple[float, float], angle: float) -> None:
    """`shift` predicts how far a small step takes the finger."""
    step_mm = 0.02 * np.array([math.cos(angle), math.sin(angle)])
    bins = bins_of(of_atlas([(*at, 1 + 0j)]))
    fit = SINGLE.fit_one(bins, *at, STEPS)
    later = of_atlas([(at[0] + step_mm[0], at[1] + step_mm[1], 1.05 + 0.03j)])
    np.testing.assert_allclose(SINGLE.shift(bins, fit)[0] @ (later - bins.vector), step_mm, atol=0.003)
