"""The speed of the plate's waves, where nobody knows its material, is heard in the touches."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.training.waves import Waves, touch
from touchd.evaluation.dataset import Dataset
from touchd.training.field.dispersion import dispersion_of, fit_wavenumber, frequencies
from touchd.training.field.regression import touches_of

F_HZ = np.linspace(50e3, 100e3, 15)


@pytest.mark.parametrize(("power", "middle_per_mm"), [(0.5, 0.2), (0.6, 0.35), (0.9, 0.28)])
def test_a_power_law_is_found_within_a_few_percent(power: float, middle_per_mm: float) -> None:
    true = middle_per_mm * (F_HZ / np.sqrt(F_HZ[0] * F_HZ[-1])) ** power
    touches, _ = touch(Waves(true, 4, 1), 320, 40.0, 2)
    np.testing.assert_allclose(fit_wavenumber(F_HZ, touches), true, rtol=0.06)


def test_on_the_twins_glass_it_is_the_glass_own(dataset: Dataset) -> None:
    """From 300 touches of a part of the plate."""
    touches = touches_of(dataset, np.arange(300))
    found = fit_wavenumber(frequencies(dataset), touches)
    known = dispersion_of(dataset, touches)
    heard = slice(0, 36)  # beyond, these touches are noise
    np.testing.assert_allclose(found[heard], known[heard], rtol=0.08)
