"""Electronics add what they are told to, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.twin.electronics import Dead, Digitiser, Electronics, Impulses, Ripple, Tone, rippled
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


def test_a_tone_through_a_finger(instrument: Instrument) -> None:
    """A tone that a finger couples in is heard while one is on the plate, at its level, and not before."""
    reference = instrument.untouched([REFERENCE_C])
    through = SILENT._replace(tones=(Tone(62_347.0, -50.0, finger=True),))
    digitiser = Digitiser(through, instrument.acquisition, reference[0], np.random.SeedSequence(1))
    touched = np.arange(64) >= 32
    found = digitiser.counts(np.repeat(reference, 64, axis=0), np.arange(64) / 125.0, touched).astype(float)
    plain = counts(instrument, SILENT, 64)
    np.testing.assert_array_equal(found[:32], plain[:32])
    assert decibels(found[32:] - plain[32:], plain) == pytest.approx(-50, abs=0.3)


def test_impulses(instrument: Instrument) -> None:
    """Impulses hit their share of the frames, a few samples in a row of all channels at once, at their level."""
    plain = counts(instrument, SILENT, 400)
    change = counts(instrument, SILENT._replace(impulses=Impulses(0.2, -10.0, 4)), 400) - plain
    hit = change.any(axis=(1, 2))
    assert 50 < hit.sum() < 115
    spread = [np.flatnonzero(frame.any(axis=0)) for frame in change[hit]]
    assert max(at[-1] - at[0] + 1 for at in spread) == 4
    samples = np.concatenate([frame[:, at].ravel() for frame, at in zip(change[hit], spread, strict=True)])
    assert 10 * np.log10(np.mean(samples**2) / np.mean(plain**2)) == pytest.approx(-10, abs=0.7)


def test_crosstalk(instrument: Instrument) -> None:
    """Each channel hears its neighbours at the stated level, linearly."""
    plain = counts(instrument, SILENT, 1)[0]
    change = counts(instrument, SILENT._replace(crosstalk_db=-40.0), 1)[0] - plain
    np.testing.assert_allclose(change[0], 0.01 * plain[1], atol=1.01)
    np.testing.assert_allclose(change[1], 0.01 * (plain[0] + plain[2]), atol=1.01)


def test_nonlinearity(instrument: Instrument) -> None:
    """The converter is off by its integral nonlinearity at most, and by nothing at 0 and full scale."""
    plain = counts(instrument, SILENT, 1)
    change = counts(instrument, SILENT._replace(inl_lsb=8.0), 1) - plain
    assert 7 <= np.abs(change).max() <= 9
    assert np.abs(change[np.abs(plain) < 200]).max() <= 1
    assert decibels(change, plain) == pytest.approx(-61, abs=3)


def test_too_much_gain_clips_at_full_scale(instrument: Instrument) -> None:
    loud = counts(instrument, SILENT._replace(peak=1.5))
    assert loud.max() <= 32767
    assert loud.min() >= -32768
    assert (np.abs(loud) >= 32767).any()


def test_a_dead_channel_hears_nothing_but_noise(instrument: Instrument) -> None:
    dead = counts(instrument, Electronics(dead=(Dead(2, 0.03),)))
    assert np.abs(dead[:4, 2]).max() > 1000
    assert 0 < np.abs(dead[4:, 2]).max() < 40


@pytest.mark.parametrize("hz", [0.0, 100.0])
def test_a_ripple_has_its_share(hz: float, instrument: Instrument) -> None:
    """Of the level, from frame to frame; by the mains it slopes along the chirp, too."""
    signal, time_s = np.repeat(instrument.untouched([REFERENCE_C]), 400, axis=0), np.arange(400) / 123.4
    ripple = Ripple(0.01, hz)
    found = rippled(signal, time_s, np.zeros(1), instrument.acquisition, ripple, 5)
    level = np.einsum("nrs,nrs->n", found, signal) / np.einsum("nrs,nrs->n", signal, signal) - 1
    assert level.std() == pytest.approx(0.01, rel=0.1)
    rest = np.linalg.norm(found - (1 + level)[:, None, None] * signal) / np.linalg.norm(signal)
    assert rest == pytest.approx(0.0, abs=1e-12) if not hz else 5e-4 < rest < 4e-3
    later = rippled(signal[:9], time_s[50:59], np.zeros(1), instrument.acquisition, ripple, 5)
    np.testing.assert_allclose(later, found[50:59], atol=1e-12)


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
