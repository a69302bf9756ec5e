"""Electronics add what they are told to, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.twin.electronics import Dead, Digitiser, Electronics, Tone
from touchd.twin.instrument import REFERENCE_C, Instrument

SILENT = Electronics(noise_db=np.inf)


def counts(instrument: Instrument, electronics: Electronics, n: int = 8, seed: int = 1) -> NDArray[np.float64]:
    reference = instrument.untouched([REFERENCE_C])
    digitiser = Digitiser(electronics, instrument.acquisition, reference[0], np.random.SeedSequence(seed))
    return digitiser.counts(np.repeat(reference, n, axis=0), np.arange(n) / 125.0).astype(float)


def decibels(change: NDArray[np.float64], signal: NDArray[np.float64]) -> float:
    return float(10 * np.log10((change**2).mean() / (signal**2).mean()))


def test_without_any_setting_counts_are_the_rounded_signal_at_60_percent(instrument: Instrument) -> None:
    plain = counts(instrument, SILENT)
    assert np.abs(plain).max() == round(0.6 * 32768)
    np.testing.assert_allclose(plain[0], instrument.untouched([REFERENCE_C])[0] * 0.6 * 32768, atol=0.5001)


def test_noise_lies_60_db_below_the_signal(instrument: Instrument) -> None:
    plain = counts(instrument, SILENT, 64)
    assert decibels(counts(instrument, Electronics(), 64) - plain, plain) == pytest.approx(-60, abs=0.1)


@pytest.mark.parametrize(("gain", "level_db"), [(1.01, -46), (1.05, -32), (1.10, -26)])
def test_one_channels_gain_changes_the_signal_as_much_as_stated(
    instrument: Instrument, gain: float, level_db: float
) -> None:
    plain = counts(instrument, SILENT, 1)
    # The channels are not equally loud: over all four in turn the change is that of an even share.
    power = 0.0
    for channel in range(4):
        gains = tuple(gain if i == channel else 1.0 for i in range(4))
        power += float(((counts(instrument, SILENT._replace(gains=gains), 1) - plain) ** 2).mean()) / 4
    assert 10 * np.log10(power / (plain**2).mean()) == pytest.approx(level_db, abs=0.3)


def test_a_gain_drifts_with_time(instrument: Instrument) -> None:
    drift = counts(instrument, SILENT._replace(gain_drift_per_s=(0.1, 0, 0, 0)), 101)
    assert np.abs(drift[100, 0]).max() / np.abs(drift[0, 0]).max() == pytest.approx(1 + 0.1 * 100 / 125, rel=1e-3)
    np.testing.assert_array_equal(drift[100, 1:], drift[0, 1:])


def test_a_tone_has_its_level_and_is_not_locked_to_the_chirp(instrument: Instrument) -> None:
    plain = counts(instrument, SILENT, 64)
    tone = counts(instrument, SILENT._replace(tones=(Tone(62_347.0, -30.0, 0.1),)), 64) - plain
    np.testing.assert_array_equal(tone[:12], 0)
    assert decibels(tone[13:], plain) == pytest.approx(-30, abs=0.3)
    assert decibels(tone[13:].mean(axis=0), plain) < -40


def test_too_much_gain_clips_at_full_scale(instrument: Instrument) -> None:
    loud = counts(instrument, SILENT._replace(peak=1.5))
    assert loud.max() <= 32767
    assert loud.min() >= -32768
    assert (np.abs(loud) >= 32767).any()


def test_a_dead_channel_hears_nothing_but_noise(instrument: Instrument) -> None:
    dead = counts(instrument, Electronics(dead=(Dead(2, 0.03),)))
    assert np.abs(dead[:4, 2]).max() > 1000
    assert 0 < np.abs(dead[4:, 2]).max() < 40


def test_an_image_repeats_with_each_chirp_at_its_level(instrument: Instrument) -> None:
    plain = counts(instrument, SILENT)
    image = counts(instrument, SILENT._replace(image_db=-15.0)) - plain
    assert decibels(image, plain) == pytest.approx(-15, abs=0.2)
    np.testing.assert_array_equal(image[0], image[5])


def test_settings_that_do_not_fit_the_channels_are_refused(instrument: Instrument) -> None:
    for bad in (
        Electronics(gains=(1.0, 2.0)), Electronics(dead=(Dead(4),)), Electronics(peak=-1.0),
        Electronics(jitter_s=-1e-9), Electronics(gain_drift_per_s=(0.1,)),
    ):  # fmt: skip
        with pytest.raises(SimulationError):
            counts(instrument, bad)
