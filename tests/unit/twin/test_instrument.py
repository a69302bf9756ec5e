"""Touches and disturbances have the size that they should have."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from numpy.typing import NDArray

from touchd.errors import SimulationError
from touchd.frame import Acquisition, Chirp, Plate
from touchd.twin import instrument as instrument_module
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.transducer import default_layout

Floats = NDArray[np.float64]
TOUCH = Contact(70.0, 50.0, 20.0, "silicone")


def decibels(change: Floats, signal: Floats) -> Floats:
    """RMS of each frame's change against the signal's."""
    return np.asarray(10 * np.log10((change**2).mean(axis=(-2, -1)) / (signal**2).mean()))


def level_of(instrument: Instrument, kind: str, area_mm2: float, margin_mm: float = 10.0, n: int = 100) -> Floats:
    places = np.random.default_rng(7).uniform(margin_mm, 200 - margin_mm, (n, 2))
    touches = [[Contact(x, y, area_mm2, kind)] for x, y in places]
    change = instrument.change(touches, np.full(n, REFERENCE_C))
    return decibels(change, instrument.untouched([REFERENCE_C]))


@pytest.mark.parametrize(("area_mm2", "median_db"), [(12, -42.4), (16, -39.0), (20, -36.3)])
def test_a_silicone_finger_changes_the_signal_by_a_hundredth(
    instrument: Instrument, area_mm2: float, median_db: float
) -> None:
    level = level_of(instrument, "silicone", area_mm2)
    assert -48 < np.median(level) < -36
    assert np.median(level) == pytest.approx(median_db, abs=0.7)


@pytest.mark.parametrize(("area_mm2", "median_db"), [(40, -29.4), (80, -23.9)])
def test_a_human_finger_changes_it_by_some_hundredths(
    instrument: Instrument, area_mm2: float, median_db: float
) -> None:
    level = level_of(instrument, "human", area_mm2)
    assert -38 < np.median(level) < -23
    assert np.median(level) == pytest.approx(median_db, abs=0.7)


def test_a_palm_changes_it_by_a_quarter(instrument: Instrument) -> None:
    assert np.median(level_of(instrument, "palm", 90.0, 45.0, 12)) == pytest.approx(-11, abs=1)


def test_a_drop_of_29_mg_changes_it_by_a_hundredth(instrument: Instrument) -> None:
    assert -45 < np.median(level_of(instrument, "drop", 18.1)) < -38


@pytest.mark.parametrize(("stretch", "level_db"), [(1e-5, -58), (5e-5, -44), (1e-4, -38), (5e-4, -24)])
def test_temperature_changes_the_signal_as_much_as_stated(
    instrument: Instrument, stretch: float, level_db: float
) -> None:
    cold, reference = instrument.untouched([REFERENCE_C - stretch / 4.5e-5, REFERENCE_C])
    assert decibels(cold - reference, reference) == pytest.approx(level_db, abs=0.6)


@pytest.mark.parametrize(("late_s", "level_db"), [(1e-9, -67), (1e-8, -47), (1e-7, -27)])
def test_a_late_trigger_changes_the_signal_as_much_as_stated(
    instrument: Instrument, late_s: float, level_db: float
) -> None:
    late, reference = instrument.untouched([REFERENCE_C] * 2, [late_s, 0])
    assert decibels(late - reference, reference) == pytest.approx(level_db, abs=0.6)


def test_a_signal_at_any_temperature_is_that_of_a_plate_whose_modes_have_moved(
    instrument: Instrument, glass: Plate, monkeypatch: pytest.MonkeyPatch
) -> None:
    warmer_c = REFERENCE_C + 3.0
    modes = instrument.response.modes
    moved = modes._replace(omega_rad_s=modes.omega_rad_s * float(instrument.scale(warmer_c)))
    monkeypatch.setattr(instrument_module, "loaded_modes", lambda *_: moved)
    warm = Instrument(glass)
    for found, expected in (
        (instrument.untouched([warmer_c]), warm.untouched([REFERENCE_C])),
        (instrument.change([[TOUCH]], [warmer_c]), warm.change([[TOUCH]], [REFERENCE_C])),
    ):
        # Each is in units of its own largest value.
        factor = (found * expected).sum() / (expected**2).sum()
        assert factor == pytest.approx(1, abs=0.01)
        assert decibels(found - factor * expected, found)[0] < -100


def test_a_late_trigger_shifts_the_signal_in_time(instrument: Instrument) -> None:
    one_sample_s = 1 / instrument.acquisition.sample_rate_hz
    quarter = instrument.untouched([REFERENCE_C], [one_sample_s / 4])[0]
    steps = np.fft.rfftfreq(250, one_sample_s)
    plain = instrument.untouched([REFERENCE_C])[0]
    window = np.hanning(250) ** 4
    shifted = np.fft.irfft(np.fft.rfft(plain * window) * np.exp(2j * np.pi * steps * one_sample_s / 4), 250)
    middle = slice(80, 170)
    np.testing.assert_allclose((quarter * window)[:, middle], shifted[:, middle], atol=0.02)


def test_what_rings_on_does_not_wrap_into_the_frame(glass: Plate, instrument: Instrument) -> None:
    longer = Acquisition(channels=4, samples=1000, sample_rate_hz=250e3)
    long = Instrument(glass, acquisition=longer)
    for found, expected in (
        (instrument.untouched([REFERENCE_C]), long.untouched([REFERENCE_C])[..., :250]),
        (instrument.change([[TOUCH]], [REFERENCE_C]), long.change([[TOUCH]], [REFERENCE_C])[..., :250]),
    ):
        factor = (found * expected).sum() / (expected**2).sum()
        assert decibels(found - factor * expected, found)[0] < -90


def test_the_untouched_plate_peaks_at_one(instrument: Instrument) -> None:
    assert np.abs(instrument.untouched([REFERENCE_C])).max() == pytest.approx(1)


def test_the_chirps_spectrum_is_the_sum_of_its_samples() -> None:
    description = Acquisition(channels=4, samples=250, sample_rate_hz=250e3).chirp
    omega = 2 * np.pi * np.array([40e3, 75e3, 99e3]) - 2000j
    step = 1 / 500e3 / 64
    t = (np.arange(500 * 64) + 0.5) * step
    held = np.repeat(description.waveform(), 64)
    numeric = (held * np.exp(-1j * omega[:, None] * t)).sum(axis=1) * step
    assert np.abs(description.spectrum(omega) / numeric - 1).max() < 1e-3


@pytest.mark.parametrize("samples", [1, 2, 96, 511, 2000])
def test_a_long_chirps_spectrum(samples: int) -> None:
    """It is the plain sum to 1e-9, and takes no table of all frequencies by all samples."""
    chirp = Chirp(start_hz=15e3, stop_hz=44e3, duration_s=samples / 96e3, dac_rate_hz=96e3)
    omega = 2 * np.pi * np.linspace(1.0, 55e3, 2 * samples) - 300j
    turn = np.exp(-1j * np.outer(omega, np.arange(samples)) / 96e3)
    plain = (1 - np.exp(-1j * omega / 96e3)) / (1j * omega) * (turn @ chirp.waveform())
    tracemalloc.start()
    found = chirp.spectrum(omega)
    most_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.abs(found - plain).max() <= 1e-9 * np.abs(plain).max()
    assert most_bytes < turn.nbytes / 4 + 1e6


def test_no_mirror_image_of_the_layout_is_the_layout(glass: Plate) -> None:
    layout = default_layout(glass)
    centred = layout.centres_mm - 100
    turns = [np.array([[a, 0], [0, b]]) for a in (1, -1) for b in (1, -1)]
    turns += [turn[::-1] for turn in turns]
    for turn in turns[1:]:
        image = centred @ turn
        assert max(np.abs(centred - place).sum(axis=1).min() for place in image) > 4


def test_mirrored_touches_do_not_look_alike(instrument: Instrument) -> None:
    x, y = 60.0, 130.0
    places = [(x, y), (200 - x, y), (x, 200 - y), (200 - x, 200 - y), (y, x), (200 - y, 200 - x)]
    change = instrument.change([[Contact(a, b, 20.0, "silicone")] for a, b in places], [REFERENCE_C] * 6)
    flat = change.reshape(6, -1)
    likeness = np.abs(np.corrcoef(flat))[np.triu_indices(6, 1)]
    assert likeness.max() < 0.6


def test_touches_do_not_depend_on_their_company(instrument: Instrument) -> None:
    two = [TOUCH, Contact(120.0, 50.0, 60.0, "human")]
    mixed = instrument.change([[TOUCH], [], two, [two[1]]], [REFERENCE_C] * 4)
    alone = instrument.change([two], [REFERENCE_C])
    np.testing.assert_array_equal(mixed[1], 0)
    np.testing.assert_allclose(mixed[2], alone[0], atol=1e-12)


def test_impossible_instruments_are_refused(glass: Plate, instrument: Instrument) -> None:
    three = Acquisition(channels=3, samples=250, sample_rate_hz=250e3)
    with pytest.raises(SimulationError, match="3 channels"):
        Instrument(glass, acquisition=three)
    with pytest.raises(SimulationError, match="longer than the frame"):
        Instrument(glass, acquisition=Acquisition(channels=4, samples=100, sample_rate_hz=250e3))
    with pytest.raises(SimulationError, match="edge"):
        Instrument(glass, layout=default_layout(glass).model_copy(update={"emitter_mm": (1.0, 50.0)}))
    with pytest.raises(SimulationError, match="temperature"):
        instrument.untouched([REFERENCE_C + 40])


@pytest.mark.parametrize("warmer_k", [0.0, 5.0])
def test_steady_state(warmer_k: float) -> None:
    """A frame in steady state is the sum of what all earlier chirps still ring, at any temperature."""
    plate, period, periods = Plate(width_mm=90, height_mm=80, thickness_mm=5), 100, 12
    once = Chirp(start_hz=30e3, stop_hz=60e3, duration_s=4e-4)
    again = once.model_copy(update={"period_s": period / 250e3})
    geometry = Acquisition(channels=4, samples=period, sample_rate_hz=250e3, chirp=again)
    alone = geometry.model_copy(update={"samples": periods * period, "chirp": once})
    heard = []
    for acquisition in (geometry, alone):
        one = Instrument(plate, acquisition=acquisition, loss=0.05)
        at = [REFERENCE_C + warmer_k]
        heard.append(
            one.peak * np.stack([one.untouched(at)[0], one.change([[Contact(40, 30, 20, "silicone")]], at)[0]])
        )
    summed = heard[1].reshape(2, 4, periods, period).sum(axis=2)
    for steady, true in zip(heard[0], summed, strict=True):
        # Of the first modes, far below the band, something rings for longer than is summed.
        assert np.abs(steady - true).max() < 5e-3 * np.abs(true).max()
