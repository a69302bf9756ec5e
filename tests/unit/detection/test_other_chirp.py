"""Another pane's chirp with a clock of its own is found, learned and taken out; nothing else is one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import DTypeLike, NDArray

from touchd.detection.clock_skew import LISTENED, LONGEST
from touchd.detection.other_chirp import OtherChirp
from touchd.frame import ACQUISITIONS, Acquisition

Floats = NDArray[np.float64]
USB = ACQUISITIONS["usb"]
NOISE = 5.0


class Skewed:
    """Frames of noise and of a wave in the chirp's band that comes later from frame to frame, by a part of a sample."""

    def __init__(self, acquisition: Acquisition, skew: float, level: float, seed: int = 0) -> None:
        self.rng, self.skew, (channels, self.samples) = np.random.default_rng(seed), skew, acquisition.shape
        points = self.samples if acquisition.is_whole_period else 8 * self.samples
        hz = np.fft.rfftfreq(points, 1 / acquisition.sample_rate_hz)
        low_hz, high_hz = acquisition.chirp.band_hz
        spectrum = self.rng.standard_normal((channels, len(hz))) + 1j * self.rng.standard_normal((channels, len(hz)))
        spectrum *= np.exp(-(((hz - (low_hz + high_hz) / 2) / (0.3 * (high_hz - low_hz))) ** 4))
        wave = np.fft.irfft(spectrum, points)
        self.spectrum = spectrum * level * NOISE / wave.std()
        self.turns = 2j * np.pi * hz / acquisition.sample_rate_hz

    def frame(self, number: int) -> Floats:
        wave = np.fft.irfft(self.spectrum * np.exp(self.turns * self.skew * number))
        white: Floats = NOISE * self.rng.standard_normal((len(wave), self.samples))
        return white + wave[:, : self.samples]


def run(other: OtherChirp, frames: Skewed, first: int, count: int, dtype: DTypeLike = np.float32) -> Floats:
    """Give frames of an untouched plate; return the energy that is left of each, over that of noise."""
    left = []
    for number in range(first, first + count):
        residual = frames.frame(number).astype(dtype)
        if other.known:
            other.remove(residual, number)
        energy = float(np.vdot(residual, residual))
        left.append(energy / (residual.size * NOISE**2))
        other.follow(residual, number, energy, touched=False)
    return np.array(left)


@pytest.mark.parametrize("name", ["usb", "audio-192", "audio-96"])
@pytest.mark.parametrize("skew", [0.02, -0.13])
def test_is_taken_out(name: str, skew: float) -> None:
    """Seven times as loud as noise, and fifty times its energy: all but a tenth of noise goes."""
    told: list[float] = []
    other = OtherChirp(ACQUISITIONS[name], on_found=told.append)
    frames = Skewed(ACQUISITIONS[name], skew, 7.0)
    assert run(other, frames, 0, 2 * LISTENED - 1).min() > 30
    assert other.known
    assert run(other, frames, 2 * LISTENED - 1, 501).max() < 1.5
    assert told == pytest.approx([skew / ACQUISITIONS[name].sample_rate_hz * 1e9], rel=0.03)
    assert run(other, frames, 2 * LISTENED + 500, 100).mean() < 1.1


@settings(max_examples=12)
@given(skew=st.floats(0.012, 0.19), back=st.booleans(), level=st.floats(1.5, 40), seed=st.integers(0, 2**16))
def test_any_skew_is_found(skew: float, back: bool, level: float, seed: int) -> None:
    skew = -skew if back else skew
    told: list[float] = []
    run(OtherChirp(USB, on_found=told.append), Skewed(USB, skew, level, seed), 0, 2 * LISTENED)
    assert [skew_ns * 1e-9 * USB.sample_rate_hz for skew_ns in told] == pytest.approx([skew], abs=1e-3)


class ToAndFro(Skewed):
    """Frames of noise and of a wave that grows and shrinks, and turns, over some frames: a finger that wanders."""

    def __init__(self, period: float, level: float, seed: int) -> None:
        super().__init__(USB, 0.0, level, seed)
        self.period = period

    def frame(self, number: int) -> Floats:
        wave = np.fft.irfft(self.spectrum * np.sin(2 * np.pi * number / self.period))
        white: Floats = NOISE * self.rng.standard_normal((len(wave), self.samples))
        return white + wave[:, : self.samples]


@settings(max_examples=12)
@given(period=st.floats(60, 1500), level=st.floats(1.5, 40), seed=st.integers(0, 2**16))
def test_what_comes_and_goes_at_one_place_is_no_skew(period: float, level: float, seed: int) -> None:
    """A finger that rested for 30 s, and is part of the baseline, wanders by a tenth of a millimetre."""
    told: list[float] = []
    run(OtherChirp(USB, on_found=told.append), ToAndFro(period, level, seed), 0, 2 * LONGEST)
    assert told == []


def test_float32_does_as_float64() -> None:
    single, double = (
        run(OtherChirp(USB, dtype), Skewed(USB, 0.04, 10.0), 0, 500, dtype)[-100:] for dtype in (np.float32, float)
    )
    np.testing.assert_allclose(single, double, rtol=1e-3)


def test_while_the_plate_is_learned() -> None:
    """Beside a signal a hundred times as loud, which stays."""
    other, frames = OtherChirp(USB), Skewed(USB, 0.04, 7.0)
    signal = 500 * NOISE * np.sin(np.arange(250) * np.arange(4)[:, None])
    taken = [other.take_out(np.rint(frames.frame(n) + signal).astype(np.int16), n) for n in range(700)]
    late = np.array(taken[-64:], float)
    assert (late - late.mean(axis=0)).std() == pytest.approx(NOISE, rel=0.1)


def test_while_the_plate_is_learned_again() -> None:
    """Another signal stands now; frames in which a finger lies on the plate are left out."""
    other, frames = OtherChirp(USB), Skewed(USB, 0.04, 7.0)
    run(other, frames, 0, 400)
    other.begin()
    signal = 300 * NOISE * np.cos(np.arange(250) * np.arange(4)[:, None])
    finger = 20 * NOISE * np.sin(np.arange(250) / 3)
    taken = []
    for number in range(400, 500):
        counts = np.rint(frames.frame(number) + signal + finger * (430 <= number < 450)).astype(np.int16)
        taken.append(other.take_out(counts, number))
    assert [n for n, frame in enumerate(taken) if frame is None] == list(range(30, 50))
    kept = np.array([frame for frame in taken if frame is not None], float)
    assert (kept - kept.mean(axis=0)).std() == pytest.approx(NOISE, rel=0.1)


def test_lost_frames_change_nothing() -> None:
    other, frames = OtherChirp(USB), Skewed(USB, 0.05, 7.0)
    run(other, frames, 0, 800)
    assert run(other, frames, 831, 20).mean() < 1.3


def test_begun_anew_at_another_time() -> None:
    """Another pane that was switched off and on: its wave is learned again, though frames seem touched."""
    other, frames = OtherChirp(USB), Skewed(USB, 0.04, 7.0)
    run(other, frames, 0, 700)
    frames.spectrum = frames.spectrum * np.exp(1j * np.random.default_rng(5).uniform(0, 6, frames.spectrum.shape[-1]))
    left = []
    for number in range(700, 1800):
        residual = frames.frame(number).astype(np.float32)
        other.remove(residual, number)
        energy = float(np.vdot(residual, residual))
        left.append(energy / (residual.size * NOISE**2))
        other.follow(residual, number, energy, touched=left[-1] > 1.3)
    assert min(left[:10]) > 10
    assert np.mean(left[-100:]) < 1.1


def test_at_another_frame_rate_it_is_looked_for_again() -> None:
    other, slow = OtherChirp(USB), Skewed(USB, 0.04, 7.0)
    run(other, slow, 0, 400)
    other.restart()
    assert (other.known, other.listens) == (False, True)
    fast = Skewed(USB, 0.016, 7.0, seed=1)
    run(other, fast, 400, 2 * LISTENED)
    assert other.known
    assert run(other, fast, 400 + 2 * LISTENED, 100).max() < 1.5


def test_an_end_is_noticed() -> None:
    other, frames = OtherChirp(USB), Skewed(USB, 0.04, 7.0)
    run(other, frames, 0, 600)
    assert other.known
    frames.spectrum = 0 * frames.spectrum
    run(other, frames, 600, 4 * LONGEST)
    assert not other.known


def _stands(frames: Skewed, n: int) -> Floats:
    return frames.frame(0) * (1 - n / 2000)


def _slope(frames: Skewed) -> Floats:
    return np.asarray(np.gradient(frames.frame(0), axis=1))


def _drifts(frames: Skewed, n: int) -> Floats:
    return frames.frame(0) + n / 300 * _slope(frames)


def _jitters(frames: Skewed, _n: int) -> Floats:
    return frames.frame(0) + frames.rng.standard_normal() * _slope(frames)


def _tone(frames: Skewed, n: int) -> Floats:
    wave = np.sin(2 * np.pi * 73.2e3 * (np.arange(frames.samples) / 250e3 + 8e-3 * n))
    return np.asarray(0 * frames.frame(0) + 50 * wave)


def _hum(frames: Skewed, n: int) -> Floats:
    wave = np.sin(2 * np.pi * 60.0 * (np.arange(frames.samples) / 250e3 + 8e-3 * n))
    return np.asarray(0 * frames.frame(0) + 5000 * wave)


def _noise(frames: Skewed, _n: int) -> Floats:
    return 0 * frames.frame(0)


@pytest.mark.parametrize("changes", [_noise, _stands, _drifts, _jitters, _tone, _hum])
def test_nothing_else_is_another_chirp(changes: Callable[[Skewed, int], Floats]) -> None:
    other, frames = OtherChirp(USB), Skewed(USB, 0.0, 20.0)
    noise = np.random.default_rng(3)
    for number in range(4 * LONGEST):
        residual = changes(frames, number) + NOISE * noise.standard_normal(USB.shape)
        other.follow(residual.astype(np.float32), number, 0.0, touched=True)
        assert not other.known


def test_frames_too_short_to_tell() -> None:
    acquisition = Acquisition(channels=1, samples=16, sample_rate_hz=250e3)
    other = OtherChirp(acquisition)
    assert not other.listens
    frame = np.arange(16, dtype=np.int16)[None]
    for number in range(300):
        np.testing.assert_array_equal(other.take_out(frame, number), frame)
        other.follow(frame.astype(np.float32), number, 1.0, touched=False)
    assert not other.known
