"""The plate vibrates as theory and literature say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.physics import corners, in_plane, material
from touchd.twin.physics.legendre import derivative, disc_average, disc_moments, values
from touchd.twin.physics.material import ElasticPlate, Material, mindlin_wavenumber, stiffness_of
from touchd.twin.physics.plate import polynomials_for, solve

THIN = [13.468, 19.596, 24.270, 34.801, 34.801, 61.093, 61.093, 63.686, 69.265, 77.172, 105.46, 105.46]
UPPER_BOUNDS = [13.49, 19.79, 24.43, 35.02, 35.02]


@pytest.fixture
def thin(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Frequency parameters of a square plate a thousand times wider than thick, nu = 0.3."""
    monkeypatch.setitem(material.MATERIALS, "ideal", Material(1e11, 0.3, 1000.0))
    plate = Plate(width_mm=1000, height_mm=1000, thickness_mm=1, material="ideal")
    s = stiffness_of(plate)
    omega = solve(plate, (24, 24)).omega_rad_s[3:15]
    return [float(x) for x in omega * np.sqrt(s.mass / s.bending)]


def test_a_thin_free_square_plate_has_the_known_frequencies(thin: list[float]) -> None:
    np.testing.assert_allclose(thin, THIN, rtol=3e-4)


def test_no_frequency_lies_above_the_published_upper_bounds(thin: list[float]) -> None:
    assert all(0.985 * bound < x < bound for x, bound in zip(thin, UPPER_BOUNDS, strict=False))


FREE_CIRCLE = [5.2620, 5.2620, 9.0689, 12.2439, 12.2439, 20.5131, 20.5131, 21.5267, 21.5267]
"""Roots of the frequency equation for nu = 0.33 (Itao and Crandall, J. Appl. Mech. 46, 1979, for the first)."""


@pytest.mark.parametrize("count", [14, 20, 26])
def test_a_square_of_corners_alone_is_a_free_circular_plate(count: int) -> None:
    """With a radius of half the side the frequencies are those of theory, more polynomials leave them there."""
    disc = ElasticPlate(
        width_mm=1000, height_mm=1000, thickness_mm=1, elastic=Material(1e11, 0.33, 1000.0), corner_radius_mm=500
    )
    s = stiffness_of(disc)
    omega = np.sort(solve(disc, (count, count)).omega_rad_s)[3:12]
    np.testing.assert_allclose(omega * np.sqrt(s.mass / s.bending) * 0.5**2, FREE_CIRCLE, rtol=1e-4)


def test_a_disc_of_corners_alone_stretches_as_theory_says() -> None:
    """The lowest breathing mode in the plane has omega = 2.0489 c / a with c^2 = E / rho (1 - nu^2), for nu = 0.3."""
    disc = ElasticPlate(
        width_mm=1000, height_mm=1000, thickness_mm=1, elastic=Material(1e11, 0.3, 1000.0), corner_radius_mm=500
    )
    omega = np.concatenate([each.omega_rad_s for each in in_plane.solve_classes(disc, (20, 20))])
    breathing = 2.0489 * np.sqrt(1e11 / 1000 / (1 - 0.3**2)) / 0.5
    assert np.abs(omega / breathing - 1).min() < 1e-4


@given(radius_m=st.floats(1e-4, 0.08), across=st.integers(0, 3), along=st.integers(0, 3))
def test_what_lies_beyond_rounded_corners(radius_m: float, across: int, along: int) -> None:
    """Its integral of powers of the ways to both sides has a closed form, and so has what a larger radius takes."""
    size_m, counts = (0.2, 0.16), (12, 12)
    # Of the square to the corner, less of the quarter of a disc: u = 1 - x, Euler's beta function.
    exact = 1 / ((across + 1) * (along + 1)) - _quarter_disc(across, along)
    for rule, factor in ((corners.pieces, 1), (corners.arcs, across + along + 2)):
        points = rule(radius_m, size_m, counts)
        found = (points.weights * (points.x_m / radius_m) ** across * (points.y_m / radius_m) ** along).sum()
        assert found == pytest.approx(4 * (1 - corners.STAYS) * radius_m**2 * factor * exact, rel=1e-8)


def _quarter_disc(across: int, along: int) -> float:
    """The integral of (1 - u)^across (1 - v)^along over the quarter of the unit disc."""
    return sum(
        math.comb(across, i) * math.comb(along, k) * (-1.0) ** (i + k)
        * math.gamma((i + 1) / 2) * math.gamma((k + 1) / 2) / math.gamma((i + k + 4) / 2) / 4
        for i in range(across + 1)
        for k in range(along + 1)
    )  # fmt: skip


lengths = st.floats(1.0, 300.0)


@given(
    size=st.tuples(lengths, lengths),
    share=st.floats(0, 0.5),
    away=st.tuples(*[st.floats(-1.5, 1.5)] * 2),
    margin_share=st.floats(0, 0.4),
)
def test_places_beyond_the_edge_are_moved_onto_the_plate(
    size: tuple[float, float], share: float, away: tuple[float, float], margin_share: float
) -> None:
    """Those on the plate stay; the others come to lie at the margin, and no place is nearer to the edge than that."""
    sides, radius, margin = np.array(size), share * min(size), margin_share * min(size)
    place = (sides / 2 * (1 + np.array(away)))[None]
    moved, way = corners.inside(place, sides, radius, margin)
    again, same = corners.inside(moved, sides, radius, margin)
    assert np.all(moved >= margin - 1e-9 * sides)
    assert np.all(moved <= sides - margin + 1e-9 * sides)
    np.testing.assert_allclose(again, moved, atol=1e-9 * max(size))
    np.testing.assert_allclose(same, way, atol=1e-9 * max(size))
    if way[0] > 1e-9 * max(size):
        np.testing.assert_allclose(moved, place, atol=1e-12 * max(size))
    from_arcs = np.abs(moved[0] - sides / 2) - (sides / 2 - max(radius, margin))
    if np.all(from_arcs > 0):
        assert np.hypot(*from_arcs) <= max(radius - margin, 0.0) + 1e-9 * max(size)


def test_a_plate_turned_by_90_degrees_sounds_the_same() -> None:
    upright = solve(Plate(width_mm=100, height_mm=60, thickness_mm=4, material="aluminium"), (16, 12))
    turned = solve(Plate(width_mm=60, height_mm=100, thickness_mm=4, material="aluminium"), (12, 16))
    np.testing.assert_allclose(upright.omega_rad_s, turned.omega_rad_s, rtol=1e-9)


def test_a_stiffer_material_moves_all_modes_by_one_factor(monkeypatch: pytest.MonkeyPatch) -> None:
    plate = Plate(width_mm=100, height_mm=60, thickness_mm=4)
    before = solve(plate, (12, 12)).omega_rad_s
    soft = material.MATERIALS["glass"]
    monkeypatch.setitem(material.MATERIALS, "glass", soft._replace(E_pa=soft.E_pa * 1.21))
    np.testing.assert_allclose(solve(plate, (12, 12)).omega_rad_s, 1.1 * before, rtol=1e-9)


@given(orthotropy=st.floats(0.8, 1.25))
def test_a_thin_rolled_sheet_is_an_isotropic_one_stretched(orthotropy: float) -> None:
    """Coordinates scaled along one side turn one's energies into the other's, edges included."""
    isotropic = Material(1e11, 0.3, 1000.0)
    rolled = isotropic._replace(orthotropy=orthotropy)
    narrower = 1000 * orthotropy**-0.25
    other = isotropic._replace(E_pa=1e11 / orthotropy**0.5)
    found, expected = (
        solve(ElasticPlate(width_mm=width, height_mm=800, thickness_mm=1, elastic=elastic), (14, 14)).omega_rad_s[3:15]
        for width, elastic in ((1000, rolled), (narrower, other))
    )
    np.testing.assert_allclose(found, expected, rtol=2e-4)


@given(orthotropy=st.floats(0.8, 1.25), shear_ratio=st.floats(0.8, 1.2))
def test_a_strip_of_rolled_sheet_bends_twists_and_stretches_as_bars_do(orthotropy: float, shear_ratio: float) -> None:
    """Young's modulus along a narrow strip is in its bending and its sound, the shear modulus in its twist.

    Euler and Bernoulli's beam, Saint-Venant's torsion (0.63 h/b less at the edges) and a bar's half wave.
    """
    elastic = Material(1e11, 0.0, 1000.0, orthotropy, shear_ratio)
    long_m, wide_m, thick_m = 1.0, 0.02, 0.001
    strip = ElasticPlate(width_mm=1e3 * long_m, height_mm=1e3 * wide_m, thickness_mm=1e3 * thick_m, elastic=elastic)
    young, shear = 1e11 * orthotropy**0.5, shear_ratio * 0.5e11
    beam = 22.3733 * thick_m / long_m**2 * np.sqrt(young / 12 / 1000)
    twist = 2 * np.pi * thick_m / (long_m * wide_m) * np.sqrt(shear / 1000 * (1 - 0.63 * thick_m / wide_m))
    omega = solve(strip, (16, 8)).omega_rad_s
    assert np.abs(omega / beam - 1).min() < 2e-3
    assert np.abs(omega / twist - 1).min() < 5e-3
    lengthwise = np.pi / long_m * np.sqrt(young / 1000)
    others = np.concatenate([each.omega_rad_s for each in in_plane.solve_classes(strip, (16, 8))])
    assert np.abs(others / lengthwise - 1).min() < 1e-6


def test_polynomials_are_orthonormal_and_differentiate_exactly() -> None:
    node, weight = np.polynomial.legendre.leggauss(40)
    x = (node + 1) * 0.1
    p = values(x, 0.2, 20)
    np.testing.assert_allclose((p * weight[:, None] * 0.1).T @ p, np.eye(20), atol=1e-12)
    step = 1e-7
    slope = (values(x + step, 0.2, 20) - values(x - step, 0.2, 20)) / (2 * step)
    np.testing.assert_allclose(p @ derivative(0.2, 20), slope, rtol=1e-5, atol=1e-3)


def test_a_disc_average_is_the_mean_of_many_points() -> None:
    rng = np.random.default_rng(1)
    r, a = 0.004 * np.sqrt(rng.uniform(size=400_000)), rng.uniform(0, 2 * np.pi, 400_000)
    px, py = values(0.05 + r * np.cos(a), 0.2, 30), values(0.12 + r * np.sin(a), 0.2, 30)
    average = disc_average([[0.05, 0.12]], [0.004], (0.2, 0.2), (30, 30))[0]
    np.testing.assert_allclose(average, px.T @ py / len(r), atol=0.05 * np.abs(average).max() / 10)
    first, second = disc_moments([[0.05, 0.12]], [0.004], (0.2, 0.2), (30, 30))
    for found, along in ((first[0], np.cos(a)), (second[0], np.sin(a))):
        exact = (px * (2 * r * along / 0.004)[:, None]).T @ py / len(r)
        np.testing.assert_allclose(found, exact, atol=0.005 * np.abs(average).max())


def test_unknown_materials_are_refused_by_name() -> None:
    with pytest.raises(SimulationError, match="cheese"):
        solve(Plate(width_mm=100, height_mm=60, thickness_mm=4, material="cheese"), (8, 8))


def test_a_plate_of_too_many_wavelengths_is_refused() -> None:
    with pytest.raises(SimulationError, match="wavelengths"):
        polynomials_for(Plate(width_mm=2000, height_mm=1000, thickness_mm=2), 100e3)


def test_a_plate_of_23_wavelengths_is_simulated() -> None:
    """Soft plates of many wavelengths are within the limits, with enough polynomials and few to spare."""
    plate = ElasticPlate(width_mm=190, height_mm=140, thickness_mm=6, elastic=Material(3.25e9, 0.35, 1185.0))
    k = float(mindlin_wavenumber(plate, 100e3))
    assert k * 0.19 / (2 * np.pi) > 20
    counts = polynomials_for(plate, 100e3)
    for count, side_m in zip(counts, (0.19, 0.14), strict=True):
        assert k * side_m / 2 + 9 <= count <= k * side_m / 2 + 11
