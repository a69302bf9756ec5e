"""The default plate's modes: as many as stated, converged, orthogonal, and those that are kept on disk."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from touchd.frame import Plate
from touchd.twin.physics.material import stiffness_of
from touchd.twin.physics.plate import Modes, solve
from touchd.twin.physics.transducer import LoadedModes, default_layout, loaded_modes


def test_frequencies(bare: Modes) -> None:
    """The plate has three rigid motions and the stated frequencies."""
    np.testing.assert_array_equal(bare.omega_rad_s[:3], 0)
    np.testing.assert_allclose(
        bare.omega_rad_s[3:9] / (2 * np.pi), [441.1, 642.6, 755.2, 1123.6, 1123.6, 1930.2], atol=0.06
    )


@pytest.mark.parametrize(("below_hz", "count"), [(50e3, 172), (100e3, 377)])
def test_count(bare: Modes, below_hz: float, count: int) -> None:
    """The plate has the stated number of modes."""
    assert (bare.omega_rad_s / (2 * np.pi) < below_hz).sum() == count


def test_converged(glass: Plate, bare: Modes) -> None:
    """48 polynomials have converged at 100 kHz."""
    finer = solve(glass, (52, 52), 100e3).omega_rad_s[3:377]
    assert np.abs(bare.omega_rad_s[3:377] / finer - 1).max() < 1e-6


def test_orthogonal(glass: Plate, bare: Modes) -> None:
    """The modes are orthogonal with unit mass."""
    s = stiffness_of(glass)
    w, x, y = (field[:200].reshape(200, -1) for field in bare[1:])
    mass = s.mass * w @ w.T + s.rotary * (x @ x.T + y @ y.T)
    np.testing.assert_allclose(mass, np.eye(200), atol=1e-10)


def test_kept(glass: Plate, loaded: LoadedModes) -> None:
    """The modes on disk, which all other scenes use, respond as those that are solved today.

    Of two modes of nearly one frequency each solver may take any mixture: their response together says the same.
    """
    kept = loaded_modes(glass, default_layout(glass))
    np.testing.assert_allclose(kept.omega_rad_s, loaded.omega_rad_s, rtol=1e-9)
    one, other = (receptance(modes) for modes in (kept, loaded))
    np.testing.assert_allclose(one, other, atol=1e-7 * np.abs(other).max())


def receptance(modes: LoadedModes) -> NDArray[np.complexfloating]:
    """Rotation at each disc for a moment at each, in the band at a loss of 0.005, shape (frequencies, discs, discs)."""
    nu = 2 * np.pi * np.linspace(50e3, 100e3, 51)
    of_modes = 1 / (modes.omega_rad_s**2 * (1 + 5e-3j) - nu[:, None] ** 2)
    return np.asarray(np.einsum("fk,ki,kj->fij", of_modes, modes.discs, modes.discs))
