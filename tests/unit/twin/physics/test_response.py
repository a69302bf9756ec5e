"""What is computed at few frequencies and interpolated is what a sum over all modes at each frequency is."""

from __future__ import annotations

import numpy as np

from touchd.twin.instrument import Instrument
from touchd.twin.physics.finger import Contact, impedance


def test_far_modes(small: Instrument) -> None:
    """Modes far above all frequencies answer as each does, to 1e-11."""
    response = small.response
    modes, nu = response.modes, response.nu_rad_s
    shape = response.shape_at(np.array([30.0, 52.0]), np.array([25.0, 44.0]), np.array([14.0, 60.0]))
    H = 1 / (modes.omega_rad_s**2 * (1 + 1j * np.asarray(response.loss)) - nu[:, None] ** 2)
    direct = H @ shape**2
    assert np.abs(response.receptance(shape, shape) / direct - 1).max() < 1e-11


def test_impedances(small: Instrument) -> None:
    """A finger, a palm's patch and a drop change the response as their impedance at each frequency says, to 1e-11."""
    response, scale = small.response, 1.0007
    nu = response.nu_rad_s
    for contact in (Contact(30, 25, 14, "silicone"), Contact(30, 25, 140, "human"), Contact(30, 25, 18, "drop")):
        shape = response.shape_at(*np.array([[contact.x_mm], [contact.y_mm], [contact.area_mm2]]))
        z = 1j * nu / scale * impedance(contact.kind, scale * nu, contact.area_mm2)
        strength = z / (1 + z * response.receptance(shape, shape)[:, 0])
        to_discs = response.receptance(shape, response.modes.discs)
        direct = -strength * to_discs[:, 0] * to_discs[:, 1:].T / scale**2
        found = response.change([[contact]], np.array([scale]))[0]
        assert np.abs(found - direct).max() < 1e-11 * np.abs(direct).max()
