"""A compliant contact is a passive, reciprocal patchwork that agrees with the rigid disc where it must."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.twin.instrument import Instrument
from touchd.twin.physics.contact import face_of, impedance_of, size_of
from touchd.twin.physics.finger import Contact, piston, tissue_of
from touchd.twin.simulate import DEFAULT_PLATE

OMEGA_RAD_S = (2 * np.pi * np.linspace(20e3, 120e3, 9)).astype(np.complex128)
KINDS = [("robot", 14.0), ("glove", 4.0), ("child", 40.0), ("fingertip", 60.0), ("thumb", 130.0)]


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    return Instrument(DEFAULT_PLATE)


@pytest.mark.parametrize(("kind", "area_mm2"), KINDS)
def test_piston(kind: str, area_mm2: float) -> None:
    """Moved as one, the patchwork has the radiation impedance of a piston of its area, to 3 %."""
    contact = Contact(100.0, 100.0, area_mm2, kind)
    together = impedance_of(contact, OMEGA_RAD_S)[:, 0, 0] * len(face_of(contact).centres_mm)
    assert np.abs(together / piston(OMEGA_RAD_S, area_mm2, tissue_of(kind)) - 1).max() < 0.03


@pytest.mark.parametrize(("kind", "area_mm2"), KINDS)
@pytest.mark.parametrize("ratio", [1.0, 1.5])
def test_passive(kind: str, area_mm2: float, ratio: float) -> None:
    """It is reciprocal, and takes energy from every motion."""
    contact = Contact(100.0, 100.0, area_mm2, kind, ratio, 0.7)
    z = impedance_of(contact, OMEGA_RAD_S)
    assert z.shape == (len(OMEGA_RAD_S), size_of(contact), size_of(contact))
    np.testing.assert_allclose(z, z.transpose(0, 2, 1), atol=1e-9 * np.abs(z).max())
    assert np.linalg.eigvalsh(z.real).min() > -1e-7 * np.abs(z).max()


def test_small(instrument: Instrument) -> None:
    """A contact that is small against the wave cannot tell a compliant face from a rigid one."""
    soft, hard = (
        instrument.change([[Contact(70.0, 60.0, 3.0, kind)]], np.array([22.0]))[0] for kind in ("fingertip", "human")
    )
    assert np.linalg.norm(soft - hard) < 0.06 * np.linalg.norm(hard)
    assert (soft * hard).sum() > 0.9999 * np.linalg.norm(soft) * np.linalg.norm(hard)


def test_large(instrument: Instrument) -> None:
    """A fingertip is not a point: what a point cannot explain of it is percents of its energy."""
    soft, hard = (
        instrument.change([[Contact(70.0, 60.0, 100.0, kind, 1.4)]], np.array([22.0]))[0]
        for kind in ("fingertip", "human")
    )
    alike = (soft * hard).sum() / (np.linalg.norm(soft) * np.linalg.norm(hard))
    assert 0.5 < alike < 0.98


@pytest.mark.parametrize(("kind", "area_mm2"), KINDS)
def test_round(instrument: Instrument, kind: str, area_mm2: float) -> None:
    """Turning a round contact changes nothing but by the patchwork's own grain, 1 % of the touch."""
    one, other = (
        instrument.change([[Contact(70.0, 60.0, area_mm2, kind, 1.0, angle)]], np.array([22.0]))[0]
        for angle in (0.0, np.pi / 6)
    )
    assert np.linalg.norm(one - other) < 0.01 * np.linalg.norm(one)


@pytest.mark.parametrize("angle_rad", [0.0, 0.4])
def test_half_turn(instrument: Instrument, angle_rad: float) -> None:
    """An ellipse that is turned by half a turn is the same ellipse; by a quarter it is another."""
    ways = [
        instrument.change([[Contact(70.0, 60.0, 90.0, "fingertip", 1.4, angle_rad + turn)]], np.array([22.0]))[0]
        for turn in (0.0, np.pi, np.pi / 2)
    ]
    np.testing.assert_allclose(ways[0], ways[1], atol=1e-9 * np.abs(ways[0]).max())
    assert np.linalg.norm(ways[0] - ways[2]) > 0.05 * np.linalg.norm(ways[0])


def test_together(instrument: Instrument) -> None:
    """Touches of several kinds in one call change what each changes alone, and a second finger far away scatters."""
    touches = [
        [Contact(70.0, 60.0, 60.0, "fingertip", 1.3)],
        [Contact(70.0, 60.0, 60.0, "fingertip", 1.3), Contact(150.0, 150.0, 14.0, "silicone")],
        [],
        [Contact(150.0, 150.0, 14.0, "silicone")],
    ]
    warm = np.array([22.0, 23.0, 22.0, 21.0])
    every = instrument.change(touches, warm)
    for k, touch in enumerate(touches):
        np.testing.assert_allclose(every[k], instrument.change([touch], warm[k : k + 1])[0], atol=1e-12)
    assert not every[2].any()
