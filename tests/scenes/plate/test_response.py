"""What contacts change is exact, and waves keep the laws that waves keep."""

from __future__ import annotations

import numpy as np
import pytest

from tests.flexural_waves import group_velocity, mindlin_phase_velocity
from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.instrument import Instrument
from touchd.twin.physics import legendre
from touchd.twin.physics.finger import Contact, impedance, patches
from touchd.twin.physics.material import mindlin_wavenumber, stiffness_of
from touchd.twin.physics.plate import Modes, size_m
from touchd.twin.physics.response import Response
from touchd.twin.physics.transducer import LoadedModes, default_layout, load

NU = 2 * np.pi * np.array([20e3, 51.3e3, 77.7e3, 98e3, 120e3]) - 3000j
THREE = [
    Contact(50.0, 60.0, 20.0, "silicone"), Contact(66.0, 60.0, 70.0, "human"), Contact(150.0, 90.0, 18.0, "drop"),
]  # fmt: skip


@pytest.fixture(scope="module")
def response(glass: Plate, loaded: LoadedModes) -> Response:
    return Response(glass, loaded, NU, 5e-3)


def test_three_contacts(response: Response) -> None:
    """Three contacts change what a direct solution of all modes says."""
    modes = response.modes
    x, y, area = np.array([c[:3] for c in THREE]).T
    shape = response.shape_at(x, y, area)
    change = response.change([THREE], np.ones(1))[0]
    for f, nu in enumerate(NU):
        plain = np.diag(modes.omega_rad_s**2 * (1 + 5e-3j) - nu**2)
        z = [1j * nu * complex(impedance(c.kind, nu, c.area_mm2)) for c in THREE]
        touched = plain + (shape * z) @ shape.T
        untouched = np.linalg.solve(plain, modes.discs[:, 0])
        direct = modes.discs[:, 1:].T @ (np.linalg.solve(touched, modes.discs[:, 0]) - untouched)
        np.testing.assert_allclose(change[:, f], direct, rtol=1e-7, atol=1e-9 * np.abs(direct).max())


def test_one_contact(response: Response) -> None:
    """One contact goes the short way to the same result."""
    absent = Contact(120.0, 30.0, 1e-9, "silicone")
    alone = response.change([[THREE[0]]], np.ones(1))
    beside_nothing = response.change([[THREE[0], absent]], np.ones(1))
    np.testing.assert_allclose(alone, beside_nothing, rtol=1e-6)


def test_discs(glass: Plate, bare: Modes) -> None:
    """Discs built into the modes are discs added afterwards."""
    layout = default_layout(glass)
    few = Modes(*(field[:500] for field in bare))
    with_mass = Response(glass, load(few, glass, layout), NU, 0.0)
    without = Response(glass, load(few, glass, layout.model_copy(update={"mass_g": 0.0})), NU, 0.0)
    centres = layout.centres_mm
    under = legendre.disc_average(centres * 1e-3, np.full(5, 3e-3), size_m(glass), (48, 48)).reshape(5, -1)
    shape = without.modes.w.reshape(500, -1) @ under.T
    to_discs = without.receptance(shape[..., None], without.modes.discs[:, None, :])
    between = without.receptance(shape[..., None], shape[:, None, :])
    force = 0.43e-3 * NU[:, None, None] ** 2
    strength = np.linalg.solve(np.eye(5) - force * between, force * to_discs[..., :1])
    expected = without.untouched().T + (strength * to_discs[..., 1:]).sum(axis=1)
    np.testing.assert_allclose(with_mass.untouched().T, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def test_reciprocity(glass: Plate, bare: Modes) -> None:
    """Swapping emitter and receiver changes nothing."""
    layout = default_layout(glass)
    first, *others = layout.receivers_mm
    swapped = layout.model_copy(update={"emitter_mm": first, "receivers_mm": (layout.emitter_mm, *others)})
    few = Modes(*(field[:500] for field in bare))
    there, back = (Response(glass, load(few, glass, x), NU, 5e-3) for x in (layout, swapped))
    np.testing.assert_allclose(there.untouched()[0], back.untouched()[0], rtol=1e-7)
    touch = there.change([THREE], np.ones(1))[0, 0], back.change([THREE], np.ones(1))[0, 0]
    np.testing.assert_allclose(touch[0], touch[1], rtol=1e-7)


@pytest.mark.parametrize("span", [0.0, 1e-7, 1e-3])
def test_palm(response: Response, span: float) -> None:
    """A palm at rest changes what it would in each frame alone.

    It is computed at a few temperatures only, and once for the frames in which it is the same.
    """
    rest, lighter = (patches(Contact(90.0, 100.0, area, "palm")) for area in (90.0, 88.0))
    touches = [lighter, *[rest] * 20, lighter]
    scale = 1 + span * np.linspace(-1, 0.7, len(touches)) ** 3
    together = response.change(touches, scale)
    for touch, s, change in zip(touches, scale, together, strict=True):
        alone = response.change([touch], np.array([s]))[0]
        np.testing.assert_allclose(change, alone, rtol=0, atol=1e-10 * np.abs(alone).max())


def test_far_contacts(instrument: Instrument) -> None:
    """Two far contacts are nearly the sum of each."""
    one, two = Contact(40.0, 60.0, 15.0, "silicone"), Contact(160.0, 130.0, 15.0, "silicone")
    both, first, second = instrument.change([[one, two], [one], [two]], [22.0] * 3)
    rest = both - first - second
    assert 0 < np.linalg.norm(rest) < 0.06 * np.linalg.norm(both)


def test_conductance(glass: Plate, loaded: LoadedModes) -> None:
    """On average the plate resists a point as an infinite one does."""
    f_hz = np.linspace(50e3, 100e3, 101)
    response = Response(glass, loaded, 2 * np.pi * f_hz - 6000j, 5e-3)
    rng = np.random.default_rng(3)
    x, y = rng.uniform(40, 160, (2, 200))
    shape = response.shape_at(x, y, np.full(200, 0.5))
    conductance = (1j * response.nu_rad_s[:, None] * response.receptance(shape, shape)).real.mean()
    # pi n(omega) / 2 M, with the part of the kinetic energy that is not rotation.
    w, s = 2 * np.pi * f_hz, stiffness_of(glass)
    k = mindlin_wavenumber(glass, f_hz)
    rotation = s.rotary / s.mass * ((s.shear * k**2 - s.mass * w**2) / (s.shear * k)) ** 2
    infinite = (k / (4 * group_velocity(mindlin_phase_velocity, glass, f_hz) * s.mass) / (1 + rotation)).mean()
    assert conductance == pytest.approx(infinite, rel=0.05)


def test_causality(glass: Plate, loaded: LoadedModes) -> None:
    """Nothing arrives before the fastest wave."""
    record_s, rate_hz, decay = 2e-3, 500e3, 13 / 2e-3
    nu = 2 * np.pi * np.arange(501) / record_s - 1j * decay
    response = Response(glass, loaded, nu, 5e-3)
    # A burst at 75 kHz, of 4 kHz standard deviation: 40 us in time, at 300 us.
    at_s, sigma_s = 300e-6, 1 / (2 * np.pi * 4e3)
    burst = np.exp(-0.5 * ((nu - 2 * np.pi * 75e3) * sigma_s) ** 2 - 1j * nu * at_s)
    t = np.arange(1000) / rate_hz
    heard = np.fft.irfft(response.untouched() * burst, 1000) * np.exp(decay * t)
    layout = default_layout(glass)
    fastest = float(group_velocity(mindlin_phase_velocity, glass, np.linspace(50e3, 100e3, 51)).max())
    for receiver, wave in zip(layout.receivers_mm, heard, strict=True):
        distance_m = np.hypot(*(np.array(receiver) - layout.emitter_mm)) * 1e-3
        before = t < at_s + distance_m / fastest - 4.5 * sigma_s
        after = (t > at_s) & (t < 1e-3)
        assert before.sum() > 50
        assert np.abs(wave[before]).max() < 1e-3 * np.abs(wave[after]).max()


def test_energy(glass: Plate, loaded: LoadedModes) -> None:
    """Without loss and finger a ring-down keeps its energy."""
    record_s, decay = 4e-3, 13 / 4e-3
    nu = 2 * np.pi * np.arange(501) / record_s - 1j * decay
    few = LoadedModes(loaded.omega_rad_s[3:400], loaded.w[3:400], loaded.discs[3:400])
    response = Response(glass, few, nu, 0.0)
    burst = np.exp(-0.5 * ((nu / (2 * np.pi) - 75e3) / 8e3) ** 2 - 1j * nu * 300e-6)
    q = response.receptance(np.eye(397), few.discs[:, :1]).T * burst
    undamp = np.exp(decay * np.arange(1000) * record_s / 1000)
    place, speed = (np.fft.irfft(x, 1000) * undamp for x in (q, q * 1j * nu))
    energy = (speed**2 + (few.omega_rad_s[:, None] * place) ** 2).sum(axis=0)[200:800]
    assert np.ptp(energy) < 1e-4 * energy.mean()


def test_over_the_edge(response: Response) -> None:
    """A contact over the edge is refused."""
    with pytest.raises(SimulationError, match="edge"):
        response.change([[Contact(199.0, 50.0, 20.0, "silicone")]], np.ones(1))
