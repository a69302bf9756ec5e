"""Gauss-Newton on the atlas: the place, the strength and how well they are known, whatever the frame."""

from __future__ import annotations

import cmath
import math
from itertools import combinations, permutations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.fields import COUNTS, PLATE, Field, Finger, features_of, gauss_newton, look_up, make_atlas
from touchd.localization.gauss_newton import STILL_MM, Fit, Refiner
from touchd.localization.spline import Lookup

FIELD = Field()
ATLAS = make_atlas(FIELD)
INSIDE = st.tuples(st.floats(8, 112), st.floats(8, 82))
STRENGTH = st.builds(cmath.rect, st.floats(0.05, 5), st.floats(-math.pi, math.pi))
STEPS = 8
ROUNDING = 5e-5
"""Of an energy that is the difference of sums in float32: seen are 1.6e-5 in 1,500 fits, a hundredth of what matters
to the search."""
OF_FIRST_ORDER = 2e-3
"""What the last step does to the strength is reckoned to first order, not looked up."""


def holding(features: np.ndarray, mask: np.ndarray | None = None) -> Refiner:
    """A refiner that has taken in a frame."""
    refiner = Refiner(ATLAS)
    refiner.mask = None if mask is None else mask.astype(np.float32)
    refiner.frame[:] = features
    refiner.take()
    return refiner


def of_atlas(fingers: list[Finger]) -> np.ndarray:
    """Features of fingers on the atlas itself, in float64."""
    bins = sum((z * look_up(ATLAS, x, y)[0] for x, y, z in fingers), np.zeros(ATLAS.size // 2, complex))
    return features_of(bins.reshape(4, -1))


@given(INSIDE)
@settings(deadline=None)
def test_the_field_and_its_gradient_are_those_of_the_formula_and_of_the_splines(at: tuple[float, float]) -> None:
    """To 1 % of their size of the formula, which the grid of 2.5 mm allows; to float32's rounding of the splines."""
    into = np.zeros((3, ATLAS.size), np.float32)
    at = Lookup(ATLAS, into).at(*at)
    mine = into[:, : ATLAS.size // 2] + 1j * into[:, ATLAS.size // 2 :]
    for part, exact, splines, size in zip(mine, FIELD.at(*at), look_up(ATLAS, *at), (1, 0.4, 0.4), strict=True):
        assert np.sqrt(np.mean(np.abs(part - exact.ravel()) ** 2)) < 0.01 * size * COUNTS
        np.testing.assert_allclose(part, splines, atol=1e-4 * COUNTS)


@given(INSIDE, STRENGTH, st.floats(0, 2 * math.pi), st.floats(0, 3))
@settings(deadline=None)
def test_from_within_3_mm_it_finds_the_place_and_the_strength(
    at: tuple[float, float], strength: complex, angle: float, off_mm: float
) -> None:
    start = at[0] + off_mm * math.cos(angle), at[1] + off_mm * math.sin(angle)
    fit = holding(FIELD.frame([(*at, strength)])).one(*start, STEPS)
    assert math.dist(fit.places_mm[0], at) < 0.02
    assert abs(fit.strengths[0] / strength - 1) < 0.005
    assert fit.left < 1e-3 * fit.energies[0]


@given(INSIDE, STRENGTH, st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=30)
def test_one_finger_in_noise_is_placed_as_float64_places_it(
    at: tuple[float, float], strength: complex, seed: int
) -> None:
    features = FIELD.frame([(*at, strength)], noise=0.02 * abs(strength) * COUNTS, seed=seed)
    fit = holding(features).one(*at, STEPS)
    places, strengths = gauss_newton(ATLAS, features.astype(np.float32), np.array([at]))
    assert math.dist(fit.places_mm[0], places[0]) < 1e-3
    assert abs(fit.strengths[0] / strengths[0] - 1) < OF_FIRST_ORDER


@given(INSIDE, STRENGTH, st.integers(0, 2**32 - 1))
@settings(deadline=None)
def test_several_of_one_finger_is_one(at: tuple[float, float], strength: complex, seed: int) -> None:
    refiner = holding(FIELD.frame([(*at, strength)], noise=0.02 * abs(strength) * COUNTS, seed=seed))
    one = refiner.one(*at, STEPS)
    a = one.information.copy()
    several = refiner.several([at], 3 * STEPS)
    assert math.dist(one.places_mm[0], several.places_mm[0]) < 1e-3
    assert several.strengths[0] == pytest.approx(one.strengths[0], rel=OF_FIRST_ORDER)
    assert several.energies[0] == pytest.approx(one.energies[0], rel=OF_FIRST_ORDER)
    assert several.left == pytest.approx(one.left, rel=1e-2, abs=ROUNDING * refiner.energy)
    np.testing.assert_allclose(several.information, a, atol=0.02 * a.max())


THREE: list[Finger] = [(30.0, 30.0, 1.0 + 0.2j), (85.0, 25.0, 0.6 - 0.1j), (60.0, 70.0, 1.5 + 0j)]


@given(st.permutations(range(3)), st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=20)
def test_several_fingers_are_placed_as_float64_places_them_in_any_order(order: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    features = FIELD.frame(THREE, noise=8.0, seed=seed)
    starts = np.array([(x, y) for x, y, _ in THREE]) + rng.uniform(-1, 1, (3, 2))
    fit = holding(features).several([(starts[k][0], starts[k][1]) for k in order], 20)
    places, strengths = gauss_newton(ATLAS, features.astype(np.float32), starts)
    np.testing.assert_allclose(fit.places_mm, places[order], atol=2e-3)
    np.testing.assert_allclose(fit.strengths, strengths[order], rtol=5e-3)


@given(st.lists(st.floats(0, 2 * math.pi), min_size=3, max_size=3))
@settings(deadline=None)
def test_a_joint_fit_that_ends_on_a_step_knows_what_that_does_to_the_strengths(angles: list[float]) -> None:
    off_mm, starts = 0.8 * STILL_MM, []
    for (x, y, _), angle in zip(THREE, angles, strict=True):
        starts.append((x + off_mm * math.cos(angle), y + off_mm * math.sin(angle)))
    fit = holding(FIELD.frame(THREE)).several(starts, 1, STILL_MM)
    for place, strength, (x, y, z) in zip(fit.places_mm, fit.strengths, THREE, strict=True):
        assert math.dist(place, (x, y)) < 0.02
        assert abs(strength / z - 1) < 0.005


def test_information_and_energies_go_with_the_fingers_in_any_order() -> None:
    refiner = holding(FIELD.frame(THREE, noise=8.0, seed=1))
    usual = refiner.several([(x, y) for x, y, _ in THREE], 20)
    for order in permutations(range(3)):
        fit = refiner.several([THREE[k][:2] for k in order], 20)
        pairs = np.array([(2 * k, 2 * k + 1) for k in order]).ravel()
        np.testing.assert_allclose(
            fit.information, usual.information[np.ix_(pairs, pairs)], atol=1e-3 * usual.information.max()
        )
        np.testing.assert_allclose(fit.energies, [usual.energies[k] for k in order], rtol=1e-3)


@given(st.lists(st.tuples(INSIDE, STRENGTH), min_size=1, max_size=4), st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=40)
def test_what_is_left_is_the_frame_less_the_model(
    fingers: list[tuple[tuple[float, float], complex]], seed: int
) -> None:
    assume(all(math.dist(a[0], b[0]) > 8 for a, b in combinations(fingers, 2)))
    features = FIELD.frame([(*at, z) for at, z in fingers], noise=50.0, seed=seed).astype(np.float32)
    refiner = holding(features)
    fit = refiner.several([at for at, _ in fingers], STEPS)
    left = features - of_atlas([(*at, z) for at, z in zip(fit.places_mm, fit.strengths, strict=True)])
    np.testing.assert_allclose(refiner.residual(fit), left, atol=1e-4 * np.abs(features).max())
    assert fit.left == pytest.approx(float(left @ left), rel=1e-3, abs=ROUNDING * refiner.energy)


@pytest.mark.parametrize("fingers", [THREE[:1], THREE], ids=["one", "three"])
def test_the_information_is_the_inverse_covariance(fingers: list[Finger]) -> None:
    """Errors weighed with it are chi-square: 2 numbers a finger and frame, within 4 deviations of their mean."""
    frames, noise = 300, 8.0
    exact, starts = of_atlas(fingers), [(x, y) for x, y, _ in fingers]
    white = noise * np.random.default_rng(5).standard_normal((frames, len(exact)))
    weighed = []
    for features in exact + white:
        refiner = holding(features)
        fit = refiner.one(*starts[0], STEPS) if len(fingers) == 1 else refiner.several(starts, STEPS)
        error = (np.array(fit.places_mm) - starts).ravel()
        weighed.append(error @ fit.information @ error / noise**2)
    degrees = 2 * len(fingers) * frames
    assert abs(float(np.sum(weighed)) - degrees) < 4 * math.sqrt(2 * degrees)


@given(INSIDE, STRENGTH, st.integers(0, 3), st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=40)
def test_what_a_masked_channel_holds_does_not_matter(
    at: tuple[float, float], strength: complex, dead: int, seed: int
) -> None:
    mask = np.ones((4, ATLAS.size // 4))
    mask[dead] = 0
    features = FIELD.frame([(*at, strength)], noise=1.0)
    other = np.where(mask.ravel() > 0, features, 1e5 * np.random.default_rng(seed).standard_normal(len(features)))
    one, its_one = (holding(data, mask.ravel()).one(*at, STEPS) for data in (features, other))
    several, its_several = (holding(data, mask.ravel()).several([at], STEPS) for data in (features, other))
    for fit, its in ((one, its_one), (several, its_several)):
        assert fit.places_mm == its.places_mm
        assert fit.strengths == its.strengths
        assert fit.left == its.left
        assert math.dist(fit.places_mm[0], at) < 3


ANYWHERE = st.floats(allow_nan=True, allow_infinity=True)


def check_sane(fit: Fit) -> None:
    for x_mm, y_mm in fit.places_mm:
        assert 0 <= x_mm <= PLATE.width_mm
        assert 0 <= y_mm <= PLATE.height_mm
    assert all(cmath.isfinite(z) for z in fit.strengths)
    assert all(math.isfinite(energy) and energy >= -1e-6 for energy in fit.energies)
    assert np.isfinite(fit.information).all()
    assert math.isfinite(fit.left)
    assert fit.left >= 0


@given(
    st.lists(st.tuples(ANYWHERE, ANYWHERE), min_size=1, max_size=5), st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 1e-20, 1e-6, 1.0, 1e3, 32768 * 250.0]), st.booleans(),
)  # fmt: skip
@settings(deadline=None)
def test_whatever_the_frame_and_the_start_the_fit_is_finite_and_on_the_plate(
    starts: list[tuple[float, float]], seed: int, size: float, finger: bool
) -> None:
    features = FIELD.frame([(60, 40, 1 / COUNTS)]) if finger else np.random.default_rng(seed).uniform(-1, 1, ATLAS.size)
    refiner = holding(size * features)
    check_sane(refiner.one(*starts[0], STEPS))
    check_sane(refiner.several(starts, STEPS))
    check_sane(refiner.several([starts[0]] * 3, STEPS))


def test_of_no_fingers_everything_is_left() -> None:
    refiner = holding(FIELD.frame(THREE))
    fit = refiner.several([], STEPS)
    assert (fit.places_mm, fit.strengths) == ([], [])
    assert fit.left == refiner.energy
    np.testing.assert_array_equal(refiner.residual(fit), refiner.frame)


@given(INSIDE, st.floats(0, 2 * math.pi))
@settings(deadline=None, max_examples=30)
def test_shift_foretells_how_far_a_small_step_takes_the_finger(at: tuple[float, float], angle: float) -> None:
    step_mm = 0.02 * np.array([math.cos(angle), math.sin(angle)])
    refiner = holding(of_atlas([(*at, 1 + 0j)]))
    fit = refiner.one(*at, STEPS)
    later = of_atlas([(at[0] + step_mm[0], at[1] + step_mm[1], 1.05 + 0.03j)])
    np.testing.assert_allclose(refiner.shift(fit) @ (later - refiner.frame), step_mm, atol=0.003)
