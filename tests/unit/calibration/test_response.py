from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from touchd.calibration.disc_response import DiscResponse
from touchd.calibration.loads import (
    KINDS,
    SCATTERER,
    STARTS,
    Discs,
    Edges,
    Guess,
    Loss,
    attachments,
    lines_along,
    start_of,
)
from touchd.calibration.reduced_plate import IN_PLANE, SHAPE_NAMES, ReducedPlate, Shape, shape_of
from touchd.twin.physics import in_plane
from touchd.twin.physics.material import MATERIALS, ElasticPlate, Material
from touchd.twin.physics.mounting import attach
from touchd.twin.physics.plate import Modes, solve
from touchd.twin.physics.response import Response
from touchd.twin.physics.transducer import Layout, Scatterer, load

Complex = NDArray[np.complex128]

GLASS = MATERIALS["glass"]
PLATE = ElasticPlate(width_mm=70, height_mm=60, thickness_mm=5, elastic=GLASS)
NU: Complex = np.asarray(2 * np.pi * np.linspace(40e3, 105e3, 40) - 6500j, np.complex128)
PLACES_MM = np.array([[15.0, 40.0], [10.0, 11.0], [58.0, 12.0]])
BEADS_MM, BEADS_G = np.array([[4.0, 1.0], [-3.0, 2.0], [0.0, -5.0]]), np.array([0.06, 0.03, 0.05])
HOLE = Scatterer(at_mm=(42, 34), diameter_mm=10, mass_g=-3e-4 * GLASS.rho_kg_m3, stiffness_n_m=-0.5e-7 * GLASS.E_pa)
MASS_KG, STIFFNESS_N_M, LEVER_MM = 0.43e-3, np.array([9000.0, 6000.0, 11000.0]), 3.5
LOSS = Loss(5e-3, 0.3, 2 * np.pi * 75e3)
DISCS = Discs(
    PLACES_MM * 1e-3, 3e-3, MASS_KG / GLASS.rho_kg_m3, STIFFNESS_N_M / GLASS.E_pa, (LEVER_MM**2 + 1.5**2) * 1e-6,
    BEADS_MM * 1e-3, BEADS_G * 1e-3 / GLASS.rho_kg_m3, np.array([[42e-3, 34e-3, 5e-3, -3e-7, -0.5e-7]]),
    150.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def plate() -> ReducedPlate:
    return ReducedPlate(PLATE, 100e3)


EDGES = Edges(
    {"left": "tape", "bottom": "clamped"},
    {"left stiffness": 0.02, "left damping": 0.05, "left mass": 0.04,
     "bottom stiffness": 0.8, "bottom damping": 0.1, "bottom mass": 0.05},
    2 * np.pi * 75e3,
)  # fmt: skip


def near(plate: ReducedPlate) -> Shape:
    """A plate beside the reference."""
    s = plate.reference
    return s._replace(h=1.003 * s.h, width=1.002 * s.width, speed2=1.01 * s.speed2)


def every_mode(plate: ReducedPlate) -> Modes:
    """The plate's modes without discs, those in its plane with them."""
    others = in_plane.solve(PLATE, 100e3, plate.counts, IN_PLANE * 100e3)
    return Modes(*map(np.concatenate, zip(solve(PLATE, plate.counts, 300e3), others, strict=True)))


@pytest.mark.parametrize(("lever_mm", "spread"), [(LEVER_MM, 1.0), (0.0, 0.4), (0.0, 0.0)])
def test_it_is_the_twins(plate: ReducedPlate, lever_mm: float, spread: float) -> None:
    """The response between the discs is the twin's, with stiffnesses and masses spread or in the centre."""
    layout = Layout(
        emitter_mm=(15, 40),
        receivers_mm=((10, 11), (58, 12)),
        mass_g=MASS_KG * 1e3,
        stiffnesses_n_m=tuple(STIFFNESS_N_M),
        lever_mm=lever_mm,
        spread=spread,
        beads_mm=((4.0, 1.0), (-3.0, 2.0), (0.0, -5.0)),
        beads_g=tuple(BEADS_G),
        scatterers=(HOLE,),
        stretch_per_mm=0.15,
    )
    modes = load(every_mode(plate), PLATE, layout)
    expected = Response(PLATE, modes, NU, LOSS.at(NU)).untouched()
    discs = DISCS._replace(gyration2_m2=1e-6 * lever_mm**2 + spread * DISCS.face_m2)
    found = DiscResponse(plate, Guess(plate.reference, discs, LOSS, EDGES), NU).untouched()
    found = found / (GLASS.rho_kg_m3 * 5e-3 * 70e-3 * 60e-3)  # per mass of the plate
    assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()


def test_another_plate_in_the_references_modes(plate: ReducedPlate) -> None:
    """Modes of a plate half a percent away are those of its own eigenproblem, to 5e-4."""
    other = ElasticPlate(
        width_mm=70.2, height_mm=59.9, thickness_mm=5.02, elastic=Material(73e9, 0.235, 2490.0, 1.02, 0.99)
    )
    found = plate.solve(shape_of(other)).omega2
    bending, others = solve(other, plate.counts, 105e3), in_plane.solve(other, 100e3, plate.counts, 105e3)
    for which, exact in ((~plate.in_plane, bending), (plate.in_plane, others)):
        own, expected = np.sqrt(np.sort(found[which])), np.sort(exact.omega_rad_s)
        np.testing.assert_allclose(own[3 : len(expected)], expected[3:], rtol=5e-4)


def test_what_is_bonded_on_the_pane(plate: ReducedPlate) -> None:
    """Waves in the plane alone are faster by the root of their stiffness."""
    plain, other = (plate.solve(plate.reference._replace(plane=plane)).omega2 for plane in (1.0, 1.21))
    np.testing.assert_allclose(other, np.where(plate.in_plane, 1.21, 1.0) * plain, rtol=1e-6, atol=1e-3 * plain.mean())


def test_held_edges_are_the_twins(plate: ReducedPlate) -> None:
    """With tape and a clamp the response is that of the twin's modes with the same strips attached."""
    layout = Layout(emitter_mm=(15, 40), receivers_mm=((10, 11), (58, 12)), mass_g=MASS_KG * 1e3, spread=1)
    modes = attach(load(solve(PLATE, plate.counts, 300e3), PLATE, layout), PLATE, attachments(EDGES, PLATE), 0.0, 75e3)
    expected = Response(PLATE, modes, NU, LOSS.at(NU)).untouched()
    discs = DISCS._replace(
        stiffness_m3=np.zeros(3),
        gyration2_m2=DISCS.face_m2,
        beads_kg_m3=np.zeros(3),
        scatterers=np.zeros((0, 5)),
        stretch_per_m=0.0,
    )
    guess = Guess(plate.reference, discs, LOSS, EDGES)
    found = DiscResponse(plate, guess, NU, lines_along(plate, EDGES.kinds)).untouched()
    free = DiscResponse(plate, guess, NU).untouched()
    mass = GLASS.rho_kg_m3 * 5e-3 * 70e-3 * 60e-3
    assert np.abs(found / mass - expected).max() < 5e-3 * np.abs(expected).max()
    assert np.abs(free / mass - expected).max() > 0.3 * np.abs(expected).max()


@pytest.mark.parametrize("orientation", [0, 1, 2, 3])
def test_a_turned_plate(plate: ReducedPlate, orientation: int) -> None:
    """Discs and held edges mirrored together sound the same."""
    size_m = np.array([plate.reference.width, plate.reference.height])
    flipped = np.array([bool(orientation & 1), bool(orientation & 2)])
    centres_m = np.where(flipped, size_m - DISCS.centres_m, DISCS.centres_m)
    scatterers = DISCS.scatterers.copy()
    scatterers[:, :2] = np.where(flipped, size_m - scatterers[:, :2], scatterers[:, :2])
    beads_m = np.where(flipped, -1, 1) * DISCS.beads_m
    other = DISCS._replace(centres_m=centres_m, beads_m=beads_m, scatterers=scatterers)
    found = []
    for discs, edges in ((DISCS, EDGES), (other, EDGES.turned_back(orientation))):
        guess = Guess(plate.reference, discs, LOSS, edges)
        found.append(DiscResponse(plate, guess, NU, lines_along(plate, edges.kinds)).untouched())
    np.testing.assert_allclose(found[1], found[0], atol=1e-6 * np.abs(found[0]).max())


def test_edges_of_a_drawing_that_is_turned() -> None:
    """What was said of a side is true of the one that it is: x and y exchanged, the drawing's left edge is the top."""
    drawn = EDGES._replace(kinds={"left": "tape"}, values={"left damping": 0.04})
    sides = [next(iter(drawn.turned_back(orientation).kinds)) for orientation in range(8)]
    assert sides == ["left", "right", "left", "right", "top", "bottom", "top", "bottom"]
    assert drawn.turned_back(4).values == {"top damping": 0.04}


def differences(plate: ReducedPlate, name: str, of: Discs = DISCS) -> Complex:
    """The derivative by central differences."""
    s = near(plate)

    lines = lines_along(plate, EDGES.kinds)

    def response(shape: Shape = s, discs: Discs = of, loss: Loss = LOSS, edges: Edges = EDGES) -> Complex:
        return DiscResponse(plate, Guess(shape, discs, loss, edges), NU, lines).untouched()

    def central(at: Callable[[float], Complex], step: float) -> Complex:
        return np.asarray((at(step) - at(-step)) / (2 * step))

    if name in SHAPE_NAMES:
        value = getattr(s, name)
        return central(lambda d: response(s._replace(**{name: value + d})), 1e-5 * value)
    if name == "loss":
        return central(lambda d: response(loss=LOSS._replace(factor=LOSS.factor * np.exp(d))), 1e-3)
    if name == "slope":
        return central(lambda d: response(loss=LOSS._replace(slope=LOSS.slope + d)), 1e-3)
    if name in EDGES.values:
        value = EDGES.values[name]
        return central(lambda d: response(edges=EDGES._replace(values=EDGES.values | {name: value + d})), 1e-4)
    field = {"mass": "mass_kg_m3", "stiffness": "stiffness_m3", "radius": "radius_m", "gyration2": "gyration2_m2"}.get(
        name
    )
    if name == "stretch":
        return central(lambda d: response(discs=of._replace(stretch_per_m=of.stretch_per_m + d)), 0.1)
    if field:
        value = getattr(of, field)
        return central(lambda d: response(discs=of._replace(**{field: value + d})), 1e-4 * float(np.max(value)))
    if name.startswith(("bead mass", "stiffness")):
        what = "beads_kg_m3" if name.startswith("bead") else "stiffness_m3"
        unit = np.eye(3)[int(name[-1])]
        return central(lambda d: response(discs=of._replace(**{what: getattr(of, what) + d * unit})), 1e-11)
    if name.startswith("scatterer"):
        unit = np.zeros((1, 5))
        unit[0, SCATTERER.index(name.split()[1])] = 1.0
        step = 1e-11 if "mass" in name or "stiff" in name else 1e-6
        return central(lambda d: response(discs=of._replace(scatterers=of.scatterers + d * unit)), step)
    unit = np.zeros((3, 2))
    unit[int(name[-1]), "xy".index(name[-2])] = 1.0
    what = "beads_m" if name.startswith("bead") else "centres_m"
    return central(lambda d: response(discs=DISCS._replace(**{what: getattr(DISCS, what) + d * unit})), 1e-6)


NAMES = (*SHAPE_NAMES[:-1], "loss", "slope", "mass", "stiffness", "gyration2", "radius", "stretch",
         "x0", "y0", "x1", "y1", "x2", "y2", "bead x0", "bead y1", "bead x2", "bead mass 0",
         "bead mass 2", "stiffness 1",
         *(f"scatterer {name} 0" for name in SCATTERER), *EDGES.values)  # fmt: skip


@pytest.fixture(scope="module")
def rounded() -> ReducedPlate:
    return ReducedPlate(PLATE.model_copy(update={"corner_radius_mm": 7.0}), 100e3)


@pytest.mark.parametrize("name", ["corner", "h", "nu", "width"])
def test_derivatives_with_rounded_corners(rounded: ReducedPlate, name: str) -> None:
    """They hold for a plate with rounded corners, beside its reference's radius."""
    shape = near(rounded)._replace(corner=6.8e-3)
    found = DiscResponse(rounded, Guess(shape, DISCS, LOSS, EDGES), NU).slopes({name})[name]
    value = getattr(shape, name)
    ends = [shape._replace(**{name: value * (1 + by)}) for by in (1e-5, -1e-5)]
    above, below = (DiscResponse(rounded, Guess(end, DISCS, LOSS, EDGES), NU).untouched() for end in ends)
    expected = (above - below) / (2e-5 * value)
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize("radius_mm", [6.8, 7.0, 7.2])
def test_other_rounded_corners_in_the_references_modes(rounded: ReducedPlate, radius_mm: float) -> None:
    """Modes of a plate with corners 0.2 mm rounder are those of its own eigenproblem, to 2e-4."""
    other = PLATE.model_copy(update={"corner_radius_mm": radius_mm})
    found = rounded.solve(shape_of(other)).omega2
    bending, others = solve(other, rounded.counts, 105e3), in_plane.solve(other, 100e3, rounded.counts, 105e3)
    for which, exact in ((~rounded.in_plane, bending), (rounded.in_plane, others)):
        own, expected = np.sqrt(np.sort(found[which])), np.sort(exact.omega_rad_s)
        np.testing.assert_allclose(own[3 : len(expected)], expected[3:], rtol=2e-4)


@pytest.mark.parametrize("name", NAMES)
def test_derivatives(plate: ReducedPlate, name: str) -> None:
    """Each analytic derivative is that of central differences."""
    lines, guess = lines_along(plate, EDGES.kinds), Guess(near(plate), DISCS, LOSS, EDGES)
    found = DiscResponse(plate, guess, NU, lines).slopes({name})[name]
    expected = differences(plate, name)
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize("name", ["mass", "gyration2", "radius", "h"])
def test_derivatives_of_discs_of_little_gyration(plate: ReducedPlate, name: str) -> None:
    """They hold for masses that are less than evenly spread."""
    of = DISCS._replace(gyration2_m2=0.4 * DISCS.face_m2)
    lines, guess = lines_along(plate, EDGES.kinds), Guess(near(plate), of, LOSS, EDGES)
    found = DiscResponse(plate, guess, NU, lines).slopes({name})[name]
    expected = differences(plate, name, of)
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


def test_any_two_discs(plate: ReducedPlate) -> None:
    """The way between two discs sounds alike in both directions, and from the emitter it is the response."""
    response = DiscResponse(plate, Guess(plate.reference, DISCS, LOSS, EDGES), NU)
    between = response.between()
    np.testing.assert_allclose(between, between.transpose(1, 0, 2), atol=1e-9 * np.abs(between).max())
    np.testing.assert_array_equal(between[0, 1:], response.untouched())


@pytest.mark.parametrize("kind", STARTS)
@given(middle_hz=st.floats(1e3, 1e6))
def test_a_held_edge_begins_alike_in_any_band(kind: str, middle_hz: float) -> None:
    """A clamp is as stiff for low frequencies as for high ones; counted in the plate's inertia there it is not."""

    def supports(middle_hz: float) -> list[float]:
        values = dict(zip((f"left {each}" for each in KINDS), start_of(kind, middle_hz).values, strict=True))
        edges = Edges({"left": kind}, values, 2 * np.pi * middle_hz)
        return [
            value
            for each in attachments(edges, PLATE)
            for value in (each.support.stiffness_n_m3, each.support.dashpot_n_s_m3, each.support.mass_kg_m2)
        ]

    assert supports(middle_hz) == pytest.approx(supports(75e3), rel=1e-9)
    assert start_of(kind, 75e3) == STARTS[kind]
