from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.lab.plates import other_plate
from touchd.lab.plates.cases import ACRYLIC, GLASS
from touchd.lab.plates.disc_functions import DiscFunctions
from touchd.lab.plates.other_plate import other_modes
from touchd.twin.physics.material import ElasticPlate, Material
from touchd.twin.physics.transducer import Layout

DISC = DiscFunctions(0.02, 0.03, 3e-3, 7e-3)


def _at(radius_m: float, angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return DISC.at(np.array([0.02 + radius_m * np.cos(angle)]), np.array([0.03 + radius_m * np.sin(angle)]))


@given(st.floats(1e-4, 6.9e-3).filter(lambda r: abs(r - 3e-3) > 1e-5), st.floats(0, 2 * np.pi))
def test_slopes(radius_m: float, angle: float) -> None:
    """The derivatives are those that differences of the functions have."""
    step = 1e-8
    x, y = 0.02 + radius_m * np.cos(angle), 0.03 + radius_m * np.sin(angle)
    _, along_x, along_y = _at(radius_m, angle)
    for slope, (dx, dy) in ((along_x, (step, 0.0)), (along_y, (0.0, step))):
        up, _, _ = DISC.at(np.array([x + dx]), np.array([y + dy]))
        down, _, _ = DISC.at(np.array([x - dx]), np.array([y - dy]))
        np.testing.assert_allclose((up - down) / (2 * step), slope, atol=1e-4 * np.abs(slope).max() + 0.05)


@given(st.sampled_from([3e-3, 7e-3]), st.floats(0, 2 * np.pi))
def test_continuous(radius_m: float, angle: float) -> None:
    """No function jumps at the rim or at its reach, and none goes beyond."""
    inside, outside = (_at(radius_m * (1 + sign * 1e-9), angle)[0] for sign in (-1, 1))
    np.testing.assert_allclose(inside, outside, atol=1e-6)
    for part in _at(7.1e-3, angle):
        assert not part.any()


def test_the_rule_integrates_products() -> None:
    """Mass and stiffness between any two functions are as in a rule of 40 rings and 64 angles."""
    node, weight = np.polynomial.legendre.leggauss(40)
    angle = 2 * np.pi * np.arange(64) / 64
    inner, outer = (node + 1) / 2 * 3e-3, 3e-3 + (node + 1) / 2 * 4e-3
    r = np.concatenate([inner, outer])
    area = np.repeat(np.concatenate([weight / 2 * 3e-3, weight / 2 * 4e-3]) * r * 2 * np.pi / 64, 64)
    fine = DISC.at((0.02 + np.outer(r, np.cos(angle))).ravel(), (0.03 + np.outer(r, np.sin(angle))).ravel())
    x, y, coarse = DISC.rule()
    for few, many in zip(DISC.at(x, y), fine, strict=True):
        exact = (many * area) @ many.T
        np.testing.assert_allclose((few * coarse) @ few.T, exact, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize(("elastic", "loss", "scale"), [(GLASS, 6e-3, 1.0), (ACRYLIC, 0.03, 0.7)])
def test_more_modes_change_nothing(
    elastic: Material, loss: float, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What discs hear of each other has converged: half as many modes again change a thousandth of its energy."""
    plate = ElasticPlate(width_mm=50 * scale, height_mm=40 * scale, thickness_mm=5, elastic=elastic)
    emitter_mm, *receivers_mm = ((scale * x, scale * y) for x, y in ((12, 20), (38, 9), (36, 29)))
    layout = Layout(emitter_mm=emitter_mm, receivers_mm=tuple(receivers_mm))
    nu = 2 * np.pi * np.linspace(20e3, 60e3, 100)
    monkeypatch.setattr(other_plate, "remember", lambda _name, _key, compute: compute())

    def heard() -> np.ndarray:
        modes = other_modes(plate, layout, [], 60e3)
        receptance = 1 / (modes.omega_rad_s[:, None] ** 2 * (1 + 1j * loss) - nu**2)
        return np.asarray((modes.discs[:, :1] * modes.discs[:, 1:]).T @ receptance)

    few = heard()
    monkeypatch.setattr(other_plate, "BASIS", 1.5 * other_plate.BASIS)
    many = heard()
    assert (np.abs(few - many) ** 2).sum() < 1e-3 * (np.abs(many) ** 2).sum()
