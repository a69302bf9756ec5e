"""An audio interface without hardware, at the seam of the library: a plate stands between playback and capture.

What is captured is what is played, filtered by the twin's response: period by period, since what is played is
periodic. The delay is drawn at each start, as whole samples and a fraction, and faults come on command.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from touchd.audio.card import CardAbsent, CardGone, CardXrun, Samples, loop_of, moved
from touchd.frame import Acquisition, Chirp

Floats = NDArray[np.float64]
Response = Callable[[int], Floats]
"""The frame that the plate answers a nominal chirp with in a period, (channels, samples), ADC counts."""


def answers(frames: NDArray[np.int16]) -> Response:
    """The frames of a recording, again and again."""
    return lambda number: frames[number % len(frames)].astype(float)


SMALL_PLATE = """
[plate]
width_mm = 110
height_mm = 90
thickness_mm = 5
material = "glass"

[discs]
diameter_mm = 6
emitter_mm = [20, 50]
receivers_mm = [[12, 12], [98, 18], [85, 78]]
"""
"""A PLATE.toml, of a pane with three receivers that is soon computed."""


class Clock:
    """Time that passes by samples alone."""

    def __init__(self) -> None:
        self.ns = 1_000_000_000

    def __call__(self) -> int:
        return self.ns


class FakeCard:
    """A card with a plate on it.

    Parameters
    ----------
    acquisition : Acquisition
    response : callable
        The plate's answer to a nominal chirp at `level_dbfs`, by number of the period.
    period : int
        Samples from chirp to chirp.
    """

    def __init__(
        self,
        acquisition: Acquisition,
        response: Response,
        period: int,
        *,
        level_dbfs: float = -6.0,
        seed: int = 0,
        clock: Clock | None = None,
        loopback: float = 0.0,
        block: int | None = None,
    ) -> None:
        self.name, self.rate_hz = "hw:CARD=Fake", round(acquisition.sample_rate_hz)
        self.inputs = acquisition.channels + bool(loopback)
        self.ahead = round(0.1 * self.rate_hz)
        self.order = list(range(self.inputs))
        self.gains = np.ones(self.inputs)
        self.delay = 0.0
        self.starts = self.period_number = 0
        self.xrun = self.unplugged = self.busy = self.silent = False
        self.silent_at_xrun = self.xruns_only = self.unplugged_at_play = False
        self.slip = 0
        self.behind_ns = 0
        """Captured already, and lost by an xrun: who reads it does not wait."""
        self.disturbance = 0.0
        self.lowpass_hz: float | None = None
        self.muted_s = 0.0
        """For how long after a start the output is silent, as converters that mute themselves are."""
        self.clock = clock or Clock()
        self._loopback = loopback
        self._a, self._response, self._period = acquisition, response, period
        chirp: Chirp = acquisition.chirp
        self._nominal = loop_of(chirp, acquisition.sample_rate_hz, period, level_dbfs)
        self._rng = np.random.default_rng(seed)
        self._block = block or max(self.rate_hz // 1000, 1)
        self._captured: NDArray[np.int16] = np.zeros((0, self.inputs), np.int16)

    def open(self) -> FakeCard:
        """What opening the card does."""
        if self.busy:
            raise CardAbsent(f"{self.name} is in use by another program")
        if self.unplugged:
            raise CardAbsent(f"there is no {self.name}")
        return self

    def start(self, loop: Floats) -> None:
        if self.unplugged:
            raise CardGone("No such device")
        self.starts += 1
        self.delay = float(self._rng.uniform(0, self._period))
        self._loop, self._next_loop, self._until = loop, loop, 0
        self._started = self.period_number
        self._captured = np.zeros((int(self.delay), self.inputs), np.int16)
        self.xrun = self.xruns_only

    def play(self, loop: Floats) -> None:
        if self.unplugged_at_play:
            raise CardGone("No such device")
        self._next_loop = loop
        self._until = self.ahead // self._period + 1  # periods of the old one, written already

    def exchange(self, timeout_s: float) -> Samples | None:
        if self.unplugged:
            raise CardGone("No such device")
        if self.xrun:
            self.xrun, self.behind_ns, self.silent = self.xruns_only, 0, self.silent_at_xrun
            self.clock.ns += 1_000_000
            raise CardXrun("samples were lost")
        if self.silent:
            self.clock.ns += round(timeout_s * 1e9)
            return None
        block_ns = round(1e9 * self._block / self.rate_hz)
        self.clock.ns += max(block_ns - self.behind_ns, 0)
        self.behind_ns = max(self.behind_ns - block_ns, 0)
        while len(self._captured) < self._block + self.slip:
            self._captured = np.concatenate([self._captured, self._one_period().T])
        self._captured = self._captured[self.slip :]
        self.slip = 0
        block, self._captured = self._captured[: self._block], self._captured[self._block :]
        return block

    def close(self) -> None:
        pass

    def _one_period(self) -> NDArray[np.int16]:
        self._until -= 1
        if self._until == 0:
            self._loop = self._next_loop
        frame = self._response(self.period_number)
        self.period_number += 1
        signal = np.zeros((self.inputs, self._period))
        signal[: len(frame), : frame.shape[1]] = frame
        if self._loopback:
            signal[-1] = self._nominal * self._loopback * 2**15
        # The played loop differs from the nominal one by a delay, a level and a filter.
        spectrum, nominal, played = (np.fft.rfft(x) for x in (signal, self._nominal, self._loop))
        ratio = np.where(np.abs(nominal) > 1e-9 * np.abs(nominal).max(), played / nominal, 0.0)
        if self.lowpass_hz is not None:
            ratio = ratio * (np.fft.rfftfreq(self._period, 1 / self.rate_hz) < self.lowpass_hz)
        heard = moved(np.fft.irfft(spectrum * ratio, self._period), self.delay % 1)
        if self.disturbance:
            heard = heard + self.disturbance * self._rng.standard_normal(heard.shape)
        heard = heard[self.order] * self.gains[:, None]
        if self.muted_s and self.period_number - self._started < self.muted_s * self.rate_hz / self._period:
            heard *= 0
        return np.asarray(np.clip(np.rint(heard), -(2**15), 2**15 - 1), np.int16)


class CableCard:
    """A card with a cable from its output to its second input: a filter, noise, harmonics and crosstalk."""

    def __init__(self, rate_hz: int = 48_000, *, inputs: int = 3, seed: int = 0) -> None:
        self.name, self.rate_hz, self.inputs, self.ahead = "hw:CARD=Fake", rate_hz, inputs, rate_hz // 10
        self.gains = np.array([0.001, 0.5, *[0.0] * (inputs - 2)])
        self.noise, self.third, self.fraction = 1e-4, 1e-3, 0.25
        self.lowpass_hz = 0.5 * rate_hz
        self.hum = self.offset = 0.0
        """Amplitude of 50 Hz, and a constant, in all inputs."""
        self.automatic = 0.0
        """The share of a change of level, in dB, that automatic gain takes back."""
        self.muted_s = 0.0
        """For how long after a start the output is silent, as converters that mute themselves are."""
        self.monitored, self.monitored_s = 0.0, 2e-3
        """Share of what the cable's input hears that direct monitoring adds to the output, and how much later."""
        self.apart_ppm = 0.0
        """How much faster than the input's clock the output's is."""
        self.xruns = 0
        self.true_rate_hz, self.seconds = float(rate_hz), 0.0
        self._rng = np.random.default_rng(seed)

    def start(self, loop: Floats) -> None:
        shaped = loop + self.third * loop**3
        shaped *= np.maximum(np.abs(shaped).max(), 1e-6) ** -self.automatic
        spectrum = np.fft.rfft(shaped) * (np.fft.rfftfreq(len(loop), 1 / self.rate_hz) < self.lowpass_hz)
        later = np.exp(-2j * np.pi * np.fft.rfftfreq(len(loop)) * round(self.monitored_s * self.rate_hz))
        spectrum = spectrum / (1 - self.gains[1] * self.monitored * later)
        self.delay = int(self._rng.integers(100, 2000)) + self.fraction
        self._heard = np.outer(self.gains, moved(np.fft.irfft(spectrum, len(loop)), self.delay))
        self._at = 0

    def play(self, loop: Floats) -> None:  # noqa: ARG002 - the protocol's
        raise AssertionError("a check starts the card for each loop: it has no chirp to move")

    def exchange(self, timeout_s: float) -> Samples | None:  # noqa: ARG002 - it never waits
        if self.xruns:
            self.xruns -= 1
            raise CardXrun("samples were lost")
        block = self.rate_hz // 100
        self.seconds += block / self.true_rate_hz
        at = (self._at + np.arange(block)) % self._heard.shape[1]
        if self.apart_ppm:
            self._heard = moved(self._heard, -1e-6 * self.apart_ppm * block)
        played = 0.0 if self._at < self.muted_s * self.rate_hz else 1.0
        self._at += block
        signal = (
            self.offset + played * self._heard[:, at].T + self.noise * self._rng.standard_normal((block, self.inputs))
        )
        signal += self.hum * np.sin(100 * np.pi / self.rate_hz * (self._at + np.arange(block)))[:, None]
        return np.asarray(np.clip(np.rint(signal * 2**15), -(2**15), 2**15 - 1), np.int16)

    def close(self) -> None:
        pass
