"""Waves in the plate have the speeds of the exact theory."""

from __future__ import annotations

import numpy as np

from tests.flexural_waves import group_velocity, lamb_phase_velocity, mindlin_phase_velocity
from touchd.frame import Plate
from touchd.twin.physics.material import stiffness_of

HZ = [50e3, 75e3, 100e3]


def test_phase_velocities_are_rayleighs_and_lambs(glass: Plate) -> None:
    np.testing.assert_allclose(lamb_phase_velocity(glass, HZ), [1463.6, 1730.0, 1931.4], atol=0.06)


def test_group_velocities_are_rayleighs_and_lambs(glass: Plate) -> None:
    np.testing.assert_allclose(group_velocity(lamb_phase_velocity, glass, HZ), [2554, 2865, 3058], atol=0.6)


def test_mindlins_plate_is_within_a_thousandth_in_phase_and_two_in_group(glass: Plate) -> None:
    assert np.abs(mindlin_phase_velocity(glass, HZ) / lamb_phase_velocity(glass, HZ) - 1).max() < 6e-4
    mindlin, lamb = (group_velocity(phase, glass, HZ) for phase in (mindlin_phase_velocity, lamb_phase_velocity))
    assert np.abs(mindlin / lamb - 1).max() < 2e-3


def test_kirchhoffs_plate_would_be_8_to_16_percent_off(glass: Plate) -> None:
    s = stiffness_of(glass)
    kirchhoff = (s.bending / s.mass) ** 0.25 * np.sqrt(2 * np.pi * np.array(HZ))
    off = kirchhoff / lamb_phase_velocity(glass, HZ) - 1
    assert np.all((off > 0.075) & (off < 0.165))
