"""The model's fit is told from the touches alone."""

from __future__ import annotations

import pytest

from tests.unit.localization.rig import Rig
from touchd.localization.model_fit import LEAST, WORN, ModelFit


def fit_of(rig: Rig, wrong: float) -> float | None:
    """Touch all over the plate, with a share of the signal that no finger makes."""
    for k in range(LEAST):
        for _ in range(6):
            finger, other = rig.residual((25 + 9 * k, 20 + 6 * k, 1)), rig.residual((100 - 9 * k, 20 + 5 * k, 1))
            rig.see(finger + wrong * other[::-1], (25 + 9 * k, 20 + 6 * k))
        rig.lift()
    found: float | None = rig.localizer.model_fit
    return found


def test_right_model() -> None:
    """Touches that the model explains leave next to nothing."""
    assert fit_of(Rig(), 0.0) == pytest.approx(1.0, abs=0.003)


def test_wrong_model() -> None:
    """Touches that the model explains badly tell it, whether they are placed or not."""
    for wrong in (0.3, 2.0):
        fit = fit_of(Rig(), wrong)
        assert fit is not None
        assert fit < 1 - WORN, wrong


def test_few_touches() -> None:
    """Too few touches tell nothing, and a palm among many changes nothing."""
    fit = ModelFit()
    for k in range(3 * LEAST):
        assert (fit.value is None) is (k < LEAST)
        fit.add(0.6 if k % 5 == 4 else 0.005, 1.0, 1e-6)
        fit.end_touch()
    assert fit.value == pytest.approx(0.995)


def test_faint_touches() -> None:
    """Faint touches, which noise judges, count for nothing; nor does a frame without a touch."""
    fit = ModelFit()
    for _ in range(2 * LEAST):
        fit.add(0.5, 1.0, 0.6)
        fit.end_touch()
    assert fit.value is None
