"""Pads, tape, clamps and a bonded pane change a plate as mechanics says, without a source of energy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics import legendre
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.material import stiffness_of
from touchd.twin.physics.mounting import EDGES, Attachment, Mounting, Support, attach, mounted_modes
from touchd.twin.physics.plate import solve
from touchd.twin.physics.response import Response
from touchd.twin.physics.transducer import LoadedModes, default_layout, load, loaded_modes

PLATE = Plate(width_mm=90, height_mm=80, thickness_mm=5, material="glass")
LAYOUT = default_layout(PLATE)
LOSS = 5e-3
MIDDLE_HZ = 75e3
EVERYWHERE = {"x_mm": (0.0, 90.0), "y_mm": (0.0, 80.0)}
ALL_KINDS = Mounting(left="pads", right="tape", top="clamped", pane=True)


@pytest.fixture(scope="module")
def free() -> LoadedModes:
    return loaded_modes(PLATE, LAYOUT)


@pytest.fixture(scope="module")
def mounted(free: LoadedModes) -> LoadedModes:
    return attach(free, PLATE, ALL_KINDS.on(PLATE), LOSS, MIDDLE_HZ)


@pytest.fixture(scope="module")
def without_discs() -> LoadedModes:
    return load(solve(PLATE, (24, 24), 60e3), PLATE, LAYOUT.model_copy(update={"mass_g": 0.0}))


def whole(modes: LoadedModes, **constants: float) -> NDArray[np.complex128]:
    """Squared frequencies of a plate without loss that is supported everywhere."""
    patch = Attachment(**EVERYWHERE, support=Support(**constants))
    return np.asarray(attach(modes, PLATE, (patch,), 0.0, MIDDLE_HZ).omega_rad_s ** 2)


def test_springs_everywhere_carry_the_plate(without_discs: LoadedModes) -> None:
    """A rigid plate on springs swings up and down at the root of stiffness over mass."""
    stiffness = 1e9
    squared = whole(without_discs, stiffness_n_m3=stiffness)
    assert np.abs(squared / (stiffness / stiffness_of(PLATE).mass) - 1).min() < 1e-6
    assert np.abs(squared.imag).max() < 1e-9 * squared.real.max()


def test_a_pane_lowers_all_frequencies_by_its_mass(without_discs: LoadedModes) -> None:
    """Twice the mass lowers the first mode's squared frequency by half, but for rotary inertia."""
    squared = whole(without_discs, mass_kg_m2=stiffness_of(PLATE).mass)
    assert squared.real[3:8] / without_discs.omega_rad_s[3:8] ** 2 == pytest.approx(0.5, rel=0.02)


def test_a_dashpot_damps_at_its_rate(without_discs: LoadedModes) -> None:
    """Dashpots everywhere widen each mode in the band by c over the mass."""
    dashpot = 1e4
    squared = whole(without_discs, dashpot_n_s_m3=dashpot)
    band = (squared.real > (2 * np.pi * 50e3) ** 2) & (squared.real < (2 * np.pi * 60e3) ** 2)
    width = squared.imag[band] / np.sqrt(squared.real[band])
    assert width == pytest.approx(dashpot / stiffness_of(PLATE).mass, rel=0.15)


def test_modes_solve_the_equation_of_motion(free: LoadedModes, mounted: LoadedModes) -> None:
    """The sum over complex modes is the solution for a force at one frequency, dashpots exact at the band's middle."""
    nu = 2 * np.pi * MIDDLE_HZ
    dynamic = np.diag(free.omega_rad_s**2 * (1 + 1j * LOSS) - nu**2)
    points, weights = np.polynomial.legendre.leggauss(30)
    for attachment in ALL_KINDS.on(PLATE):
        if attachment.round:
            continue
        at = [np.mean(low_high) + points * np.diff(low_high) / 2 for low_high in (attachment.x_mm, attachment.y_mm)]
        x, y = (grid.ravel() for grid in np.meshgrid(*at))
        area = (
            np.multiply.outer(weights, weights).ravel() * np.diff(attachment.x_mm) * np.diff(attachment.y_mm) * 2.5e-7
        )
        under = shapes(free, x, y)
        s = attachment.support
        per_area = s.stiffness_n_m3 * (1 + 1j * s.loss) + 1j * nu * s.dashpot_n_s_m3 - nu**2 * s.mass_kg_m2
        dynamic = dynamic + per_area * (under * area) @ under.T
    pads = [a for a in ALL_KINDS.on(PLATE) if a.round]
    for pad in pads:  # a pad is far smaller than the wave: its middle stands for it
        under = shapes(free, np.array([np.mean(pad.x_mm)]), np.array([np.mean(pad.y_mm)]))
        s = pad.support
        per_area = s.stiffness_n_m3 * (1 + 1j * s.loss) + 1j * nu * s.dashpot_n_s_m3
        dynamic = dynamic + per_area * np.pi * 16e-6 * under @ under.T
    expected = free.discs[:, 1:].T @ np.linalg.solve(dynamic, free.discs[:, 0])
    found = Response(PLATE, mounted, [nu], 0.0).untouched()[:, 0]
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()


def shapes(modes: LoadedModes, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Deflection of each mode at points, (n, p)."""
    _, nx, ny = modes.w.shape
    at_x, at_y = legendre.values(x_mm * 1e-3, 0.09, nx), legendre.values(y_mm * 1e-3, 0.08, ny)
    return np.asarray(np.einsum("kij,pi,pj->kp", modes.w, at_x, at_y, optimize=True))


def test_no_mode_grows(mounted: LoadedModes) -> None:
    """Every mode decays: no attachment is a source."""
    assert (mounted.omega_rad_s**2).imag.min() >= 0


def test_passive(mounted: LoadedModes) -> None:
    """A force at any point and frequency does work on the plate, never the reverse."""
    rng = np.random.default_rng(1)
    nu = 2 * np.pi * np.linspace(20e3, 120e3, 400)
    response = Response(PLATE, mounted, nu, 0.0)
    shape = response.shape_at(rng.uniform(5, 85, 40), rng.uniform(5, 75, 40), np.full(40, 12.0))
    receptance = response.receptance(shape, shape)
    assert receptance.imag.max() < 0


def test_reciprocal(free: LoadedModes, mounted: LoadedModes) -> None:
    """Swapping emitter and receiver changes nothing: the modes span symmetric matrices."""
    swapped = attach(free._replace(discs=free.discs[:, [1, 0, 2, 3, 4]]), PLATE, ALL_KINDS.on(PLATE), LOSS, MIDDLE_HZ)
    nu = 2 * np.pi * np.array([50e3, 75e3, 100e3])
    one, other = (Response(PLATE, modes, nu, 0.0) for modes in (mounted, swapped))
    assert one.untouched()[0] == pytest.approx(other.untouched()[0], rel=1e-6)


def test_nothing_attached_changes_nothing() -> None:
    """Complex modes of a plate with an attachment of nothing give the free plate's signals and touches."""
    nothing = Mounting(attachments=(Attachment(x_mm=(0, 1), y_mm=(0, 1)),))
    free, held = Instrument(PLATE), Instrument(PLATE, mounting=nothing)
    assert held.untouched([REFERENCE_C]) == pytest.approx(free.untouched([REFERENCE_C]), abs=1e-9)
    touch = [[Contact(40.0, 30.0, 60.0, "fingertip", 1.3, 0.4)]]
    assert held.change(touch, [REFERENCE_C]) == pytest.approx(free.change(touch, [REFERENCE_C]), abs=1e-9)


@pytest.mark.parametrize(
    ("mounting", "low_db", "high_db"),
    [
        (Mounting(left="pads", right="pads", top="pads", bottom="pads"), -26, -14),
        (Mounting(left="tape"), -18, -6),
        (Mounting(left="clamped"), -6, 4),
        (Mounting(pane=True), -6, 4),
    ],
)
def test_size(mounting: Mounting, low_db: float, high_db: float) -> None:
    """Each attachment changes the untouched signal by as much as stated, in dB of its RMS."""
    free, held = Instrument(PLATE), Instrument(PLATE, mounting=mounting)
    before, after = (one.untouched([REFERENCE_C]) * one.peak for one in (free, held))
    change_db = 10 * np.log10(np.square(after - before).mean() / np.square(before).mean())
    assert low_db < change_db < high_db


def test_a_clamp_is_converged(free: LoadedModes) -> None:
    """Half of the modes above the band change a clamped plate by little: the basis carries the stiffest attachment."""
    clamp = Mounting(left="clamped").on(PLATE)
    fewer = free.omega_rad_s < 2 * np.pi * 200e3
    few = LoadedModes(free.omega_rad_s[fewer], free.w[fewer], free.discs[fewer])
    nu = 2 * np.pi * np.linspace(50e3, 100e3, 101)
    all_modes, some = (
        Response(PLATE, attach(m, PLATE, clamp, LOSS, MIDDLE_HZ), nu, 0.0).untouched() for m in (free, few)
    )
    assert np.square(np.abs(all_modes - some)).sum() < 0.03 * np.square(np.abs(all_modes)).sum()


def test_sides() -> None:
    """Each side is where its name says: y points down, from the top."""
    for side, x_mm, y_mm in (("left", 3.0, 40.0), ("right", 87.0, 40.0), ("top", 45.0, 3.0), ("bottom", 45.0, 77.0)):
        (patch,) = Mounting(**{side: "tape"}).on(PLATE)
        assert patch.x_mm[0] <= x_mm <= patch.x_mm[1]
        assert patch.y_mm[0] <= y_mm <= patch.y_mm[1]
        assert patch.support == EDGES["tape"]


def test_beyond_the_edge() -> None:
    """An attachment that is not on the plate is refused, with its place."""
    beyond = Mounting(attachments=(Attachment(x_mm=(80, 95), y_mm=(0, 5)),))
    with pytest.raises(SimulationError, match="80 to 95 mm of 90 mm"):
        mounted_modes(PLATE, LAYOUT, beyond, LOSS)
