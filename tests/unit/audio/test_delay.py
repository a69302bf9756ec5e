"""The delay from playback to capture, found from the untouched response in steady state."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.audio.card import loop_of, moved
from touchd.audio.delay import Doubtful, by_onset, by_reference
from touchd.frame import ACQUISITIONS
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.simulate import DEFAULT_PLATE

A = ACQUISITIONS["audio-192"]
GAINS = np.array([[1.0], [0.5], [2.0], [1.3]])


@pytest.fixture(scope="module")
def plate() -> Instrument:
    return Instrument(DEFAULT_PLATE, acquisition=A)


@pytest.mark.parametrize(("warmer_k", "most"), [(0, 1e-4), (5, 0.02)])
def test_any_delay_any_gains(plate: Instrument, warmer_k: float, most: float) -> None:
    """Whole samples and fraction are found at other gains, and on a plate that is 5 K warmer than its model's."""
    reference = 1e4 * plate.untouched([REFERENCE_C])[0]
    heard = 1e4 * plate.untouched([REFERENCE_C + warmer_k])[0] * GAINS
    for delay in (0.3, 211.77, 767.4):
        noisy = moved(heard, delay) + np.random.default_rng(0).normal(0, 1, heard.shape)
        found = by_reference(noisy, reference, A.chirp, A.sample_rate_hz)
        assert (found.samples - delay + 384) % 768 - 384 == pytest.approx(0, abs=most)
        assert found.explained > 0.99


def test_two_delays_that_fit_are_refused(plate: Instrument) -> None:
    """What is heard twice, as where an interface mixes its input into its output, tells no delay."""
    reference = 1e4 * plate.untouched([REFERENCE_C])[0]
    heard = moved(reference, 211.8) + 0.98 * moved(reference, 500.3)
    with pytest.raises(Doubtful, match="two delays between playback and capture fit equally well"):
        by_reference(heard, reference, A.chirp, A.sample_rate_hz)


def test_the_first_sound(plate: Instrument) -> None:
    """Without a model the frame begins with what arrives first, to within 50 us, although the plate rings on."""
    heard = moved(1e4 * plate.untouched([REFERENCE_C])[0], 211.0)
    assert 0 <= by_onset(heard, loop_of(A.chirp, A.sample_rate_hz, 768, -6.0)).samples - 211 < 10
