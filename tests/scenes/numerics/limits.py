"""Frames at the limits of what an ADC can say, made from a scene: what is done to them, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from math import hypot, isfinite

import numpy as np
from numpy.typing import NDArray

from tests.scenes.numerics.watch import Run, run
from tests.scenes.stages import frames_of
from touchd.config.schema import Settings
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_scene

Counts = NDArray[np.int16]
Change = Callable[[NDArray[np.float64], np.random.Generator], NDArray[np.float64]]
"""Takes frames as floats, (n, channels, samples), and returns what the ADC is given instead; it rounds and clips."""

FULL = 32767.0
FAR_MM = 5.0
"""A published contact farther than this from every finger is wrong."""
FAR_SIGMAS = 5.0
LINGERS = 3
"""Frames in which a finger that has lifted may still be reported: two for the tracker's release, one to say so."""


@dataclass(frozen=True, slots=True)
class Case:
    """One thing done to the frames."""

    group: str
    name: str
    change: Change


@dataclass(slots=True)
class Verdict:
    """What came of a run, counted over published contacts (those that come up are not counted)."""

    published: int = 0
    not_finite: int = 0
    outside: int = 0
    wrong: int = 0
    """Farther than 5 mm from every finger, or published where there is none."""
    unsure: int = 0
    """Within 5 mm of a finger, but farther from it along x or y than 5 sigma."""
    fingers: int = 0
    """Touches there were."""
    found: int = 0
    """Of them, those with a contact within 5 mm."""
    worst_mm: float = 0.0

    def __add__(self, other: Verdict) -> Verdict:
        names = ("published", "not_finite", "outside", "wrong", "unsure", "fingers", "found")
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return Verdict(**sums, worst_mm=max(self.worst_mm, other.worst_mm))


def touches_of(truth_mm: NDArray[np.floating]) -> list[tuple[int, int, int]]:
    """Each touch of a recording's truth (n, k, 2): its column, its first frame, and the one after its last."""
    found = []
    for column in range(truth_mm.shape[1]):
        on = np.isfinite(truth_mm[:, column, 0]).astype(int)
        edges = np.flatnonzero(np.diff(on, prepend=0, append=0))
        found += [(column, int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]
    return found


def judge(recording: Recording, result: Run) -> Verdict:
    """What a run published, beside the truth."""
    truth = recording.contacts_mm
    assert truth is not None
    plate = recording.meta.plate
    row = {number: i for i, number in enumerate(recording.sequence.tolist())}
    touches = touches_of(truth)
    verdict, seen = Verdict(fingers=len(touches)), set()
    for event in result.touches:
        i = row[event.frame]
        near = [
            (t, truth[min(i, t[2] - 1), t[0]]) for t in touches if t[1] <= i < t[2] + LINGERS
        ]  # fmt: skip
        for contact in event.contacts:
            if contact.phase == "up":
                continue
            verdict.published += 1
            numbers = (contact.x_mm, contact.y_mm, contact.sigma_mm, contact.confidence, contact.force)
            if not all(isfinite(value) for value in (*numbers, contact.vx_mm_s, contact.vy_mm_s)):
                verdict.not_finite += 1
                continue
            verdict.outside += not (0 <= contact.x_mm <= plate.width_mm and 0 <= contact.y_mm <= plate.height_mm)
            off = [(hypot(contact.x_mm - x, contact.y_mm - y), t, x, y) for t, (x, y) in near]
            if not off or min(off)[0] > FAR_MM:
                verdict.wrong += 1
                verdict.worst_mm = max(verdict.worst_mm, min(off)[0] if off else np.inf)
                continue
            distance_mm, touch, x, y = min(off)
            verdict.worst_mm = max(verdict.worst_mm, distance_mm)
            seen.add(touch)
            farthest = max(abs(contact.x_mm - x), abs(contact.y_mm - y))
            verdict.unsure += bool(farthest > FAR_SIGMAS * contact.sigma_mm)
    verdict.found = len(seen)
    return verdict


def changed(recording: Recording, case: Case, *, since: int = 0, seed: int = 0) -> Recording:
    """A recording with the change done to it from a frame on."""
    wide = recording.frames[since:].astype(np.float64)
    given = case.change(wide, np.random.default_rng([seed, 0x11917]))
    counts = np.clip(np.rint(given), -FULL - 1, FULL).astype(np.int16)
    return replace(recording, frames=np.concatenate([recording.frames[:since], counts]))


def tried(
    recording: Recording, case: Case, *, since: int = 0, seed: int = 0, model: Model | None = None,
    settings: Settings | None = None,
) -> Verdict:  # fmt: skip
    """What came of a case."""
    made = changed(recording, case, since=since, seed=seed)
    return judge(made, run(frames_of(made), model=model, settings=settings))


def moments(recording: Recording) -> dict[str, int]:
    """The frames from which on something is done: the first, one amid a pause, and one amid the touch after it."""
    truth = recording.contacts_mm
    assert truth is not None
    touches = touches_of(truth)
    half = len(touches) // 2
    (_, _, before), (_, start, stop) = touches[half - 1], touches[half]
    return {"from the start": 0, "in a pause": (before + start) // 2, "under a finger": (start + stop) // 2}


def image(level_db: float, seed: int, instrument: Instrument) -> Verdict:
    """What came of taps with the chirp's image, so many dB against the signal, in all frames."""
    electronics = Electronics(image_db=level_db)
    recording = simulate_scene("tap", seed=seed, instrument=instrument, electronics=electronics)
    return judge(recording, run(frames_of(recording)))


# -- the cases ----------------------------------------------------------------------------------------------------


def _only(channel: int, change: Change) -> Change:
    def apply(x: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        x = x.copy()
        x[:, channel : channel + 1] = change(x[:, channel : channel + 1], rng)
        return x

    return apply


def _swap(one: int, other: int) -> Change:
    def apply(x: NDArray[np.float64], _rng: np.random.Generator) -> NDArray[np.float64]:
        x = x.copy()
        x[:, [one, other]] = x[:, [other, one]]
        return x

    return apply


def _clipped(share: float) -> Change:
    """Amplified until so many of the samples lie beyond full scale."""

    def apply(x: NDArray[np.float64], _rng: np.random.Generator) -> NDArray[np.float64]:
        reached = np.quantile(np.abs(x[:32]), 1 - share)
        return np.asarray(x * (FULL / reached if reached > 0 else 1.0))  # nothing is not amplified

    return apply


def _tone(frequency_hz: float, level_db: float, rate_hz: float = 250e3) -> Change:
    """A sine from elsewhere, its phase free from frame to frame, so many dB against the signal."""

    def apply(x: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        amplitude = np.sqrt(2) * np.sqrt(np.mean(x[:8] ** 2)) * 10 ** (level_db / 20)
        phase = rng.uniform(0, 2 * np.pi, (len(x), 1, 1))
        return np.asarray(x + amplitude * np.sin(2 * np.pi * frequency_hz * np.arange(x.shape[2]) / rate_hz + phase))

    return apply


def _bursts(share: float, level_db: float, channels: slice) -> Change:
    """White noise for some 50 ms now and then, in so large a share of all frames."""

    def apply(x: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        x, rms = x.copy(), np.sqrt(np.mean(x[:8] ** 2))
        starts = np.flatnonzero(rng.uniform(size=len(x)) < share / 6)
        for start in starts:
            part = x[start : start + int(rng.integers(1, 12)), channels]
            part += rms * 10 ** (level_db / 20) * rng.standard_normal(part.shape)
        return x

    return apply


def _noise(level_db: float) -> Change:
    def apply(x: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        return np.asarray(x + np.sqrt(np.mean(x[:8] ** 2)) * 10 ** (-level_db / 20) * rng.standard_normal(x.shape))

    return apply


CHANNELS = range(4)


def cases() -> Iterator[Case]:
    """All cases but the tones, of which there are many."""

    def of(group: str, name: str, change: Change) -> Case:
        return Case(group, name, change)

    yield of("all frames alike", "zeros", lambda x, _: 0 * x)
    yield of("all frames alike", "one LSB, at random", lambda x, rng: rng.integers(0, 2, x.shape).astype(float))
    yield of("all frames alike", "positive full scale", lambda x, _: 0 * x + FULL)
    yield of("all frames alike", "negative full scale", lambda x, _: 0 * x - FULL - 1)
    yield of("all frames alike", "full-scale noise", lambda x, rng: rng.uniform(-FULL - 1, FULL, x.shape))
    yield of("frozen", "the first frame again and again", lambda x, _: np.repeat(x[:1], len(x), axis=0))
    for percent in (1, 2, 5, 10, 20, 50):
        yield of("clipped", f"{percent} % of the samples", _clipped(percent / 100))
    for percent in (1, 10, 50, 100):
        yield of("offset", f"{percent} % of full scale", lambda x, _, p=percent: x + FULL * p / 100)  # type: ignore[misc]  # its own p
    for scale in (1e-4, 1e-3, 1e-2, 0.1, 0.5, 2.0, 10.0, 1e3):
        yield of("scale", f"x {scale:g}", lambda x, _, s=scale: s * x)  # type: ignore[misc]  # its own s
    for r in CHANNELS:
        yield of("one channel dead", f"channel {r}", _only(r, lambda x, _: 0 * x))
        yield of("one channel stuck", f"channel {r} at half scale", _only(r, lambda x, _: 0 * x + FULL / 2))
        yield of("one channel stuck", f"channel {r} at full scale", _only(r, lambda x, _: 0 * x + FULL))
        yield of("one channel frozen", f"channel {r} repeats", _only(r, lambda x, _: np.repeat(x[:1], len(x), axis=0)))
        yield of("one channel inverted", f"channel {r}", _only(r, lambda x, _: -x))
        yield of("one channel at twice the gain", f"channel {r}", _only(r, lambda x, _: 2 * x))
        yield of("one channel at twice the gain", f"channel {r}, at half", _only(r, lambda x, _: x / 2))
    for one in CHANNELS:
        for other in range(one + 1, 4):
            yield of("two channels swapped", f"{one} and {other}", _swap(one, other))
    for level_db in (-40, -20, 0):
        yield of("bursts", f"5 % of frames, {level_db} dB", _bursts(0.05, level_db, slice(None)))
        yield of("bursts", f"5 % of frames, {level_db} dB, one channel", _bursts(0.05, level_db, slice(1, 2)))
    for level_db in range(80, -1, -10):
        yield of("signal to noise", f"{level_db} dB", _noise(level_db))


def tones(level_db: float, step_hz: float = 1e3, first_hz: float = 500.0) -> Iterator[Case]:
    """A tone at each of many frequencies up to half the sample rate."""
    for frequency_hz in np.arange(first_hz, 125e3, step_hz).tolist():
        yield Case(f"a tone at {level_db:g} dB", f"{frequency_hz / 1e3:g} kHz", _tone(frequency_hz, level_db))
