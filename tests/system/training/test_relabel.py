"""The noise of labels is found while the field is learned."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.training.waves import Waves, touch
from touchd.training.field.learn import learn_thoroughly
from touchd.training.field.regression import Touches

K = np.linspace(0.2, 0.3, 5)


@pytest.mark.parametrize("noise_mm", [0.0, 0.3])
def test_label_noise(noise_mm: float) -> None:
    """A field is learned from labels that are off, and their noise is found."""
    waves = Waves(K, 4, 7)
    touches, _ = touch(waves, 350, 45.0, 8)
    off_mm = noise_mm * np.random.default_rng(9).normal(size=touches.position_mm.shape)
    learned = learn_thoroughly(Touches(touches.position_mm + off_mm, touches.values, touches.noise), K)
    assert learned.label_noise_mm == pytest.approx(noise_mm, abs=0.05)
