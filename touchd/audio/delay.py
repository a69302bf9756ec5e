"""Find the delay from playback to capture: another one after each start, an unknown number of samples and a fraction.

By the first of these that exists: a cable from an output to an input, the untouched response that the model was made
from, or the first sound that arrives, to some 50 microseconds.
"""

from __future__ import annotations

from contextlib import suppress
from itertools import permutations
from typing import NamedTuple

import numpy as np

from touchd.audio.card import Floats, moved
from touchd.frame import Chirp

GOOD = 0.5
"""Share of the captured energy that the reference explains at the right delay, at least: a wrong one explains less."""
AMBIGUOUS = 0.9
"""A second delay that explains this share of what the best does makes both doubtful."""
SWAPPED = 1.3
"""Another order of the channels is told where it explains this many times as much."""
SILENT = 1e-8
"""Energy relative to full scale, a sample: -80 dB, below which nothing is heard."""
_FINER = 4  # the correlation is sampled this many times as finely as the signal
_ROUNDS = 6
_CONVERGED = 1e-7
"""Change of delay and stretch that ends them: the card plays on meanwhile, from a buffer of 0.1 s."""
_STEPS = 8  # of a stretch, each to first order
_MOST_STRETCH = 4e-3
_MOST_PERMUTED = 5
_BY_CHANCE = 0.25
"""Share of the captured energy that another plate's reference does not reach, in any order."""
_PARTS = 16  # of the chirp's band, for a stretch
_LEAD = 0.1  # of a period: how early an answer may come, in steady state
_PLATE = (
    "nothing is heard: check the output's cable, knob and mute (alsamixer), the discs' cables, and audio.level_dbfs",
    "what is heard is not the plate that the model was made for (that explains {:.0%}): check the cables; is another "
    "program playing? Else stop touchd, and calibrate again with --audio",
)
_CABLE = (
    "nothing is heard at the loopback input: check its cable, its gain, and audio.loopback",
    "the loopback input hears something else than what is played (that explains {:.0%}): check its cable and "
    "audio.loopback; is another program playing?",
)
"""What is said of silence, and of something else."""
_UNLIKE_ITSELF = 0.05


class Doubtful(Exception):
    """No delay is certain; the text says why, for a person."""


class _Emission:
    """When the chirp emits what: the plate's response to each part of its band is stretched about that."""

    def __init__(self, chirp: Chirp, rate_hz: float, period: int) -> None:
        share = (np.fft.rfftfreq(period, 1 / rate_hz) - chirp.start_hz) / (chirp.stop_hz - chirp.start_hz)
        part = np.clip((share * _PARTS).astype(int), 0, _PARTS - 1)
        self._masks = np.arange(_PARTS)[:, None] == part  # (parts, frequencies)
        emitted = (np.arange(_PARTS) + 0.5) / _PARTS * chirp.duration_s * rate_hz
        later = np.arange(period) - emitted[:, None]
        if chirp.period_s is not None:  # what comes before the chirp's own answer is the ringing of the one before
            later = (later + _LEAD * period) % period - _LEAD * period
        self._later = later

    def bend(self, signal: Floats) -> Floats:
        """Return the derivative by a stretch of the plate's response, see `touchd.localization.drift`."""
        slope = np.fft.rfft(_slope(signal))
        parts = np.fft.irfft(slope[:, None] * self._masks, signal.shape[1])  # (channels, parts, period)
        return np.asarray(np.einsum("ps,cps->cs", self._later, parts))


class Delay(NamedTuple):
    """Where a period's frame begins, and how well it fits."""

    samples: float
    """0 up to a period."""
    explained: float
    """Share of the energy that the reference explains."""
    channels: Floats
    """Correlation of each channel with its reference, -1..1."""


def by_loopback(captured: Floats, loop: Floats) -> Delay:
    """Return the delay of a cable's signal, (period,), by the loop that was played; the cable may invert it."""
    upright, inverted = explained(np.stack([captured, -captured]), loop[None]).max(axis=(1, 2))
    return _find(captured[None] * (1 if upright >= inverted else -1), loop[None], None, _CABLE)


def check_discs(captured: Floats, reference: Floats | None) -> None:
    """Raise Doubtful if no disc is heard, or if cables are swapped since the reference; shapes as in `by_reference`."""
    _check_heard(captured, _PLATE[0])
    if reference is not None:
        _check_order(explained(captured, _whole(reference, captured.shape[1])), float(np.square(captured).sum()))


def by_reference(captured: Floats, reference: Floats, chirp: Chirp, rate_hz: float) -> Delay:
    """Return the delay of the plate's response by that which the model was made from.

    `captured`, (channels, period), is the mean of some periods, ADC counts; `reference`, (channels, samples), has the
    chirp's start at sample 0. Gains and the plate's temperature may be others, and all channels inverted.

    Raises Doubtful if nothing is heard, the plate is another, channels are swapped, or two delays fit as well.
    """
    emission = _Emission(chirp, rate_hz, captured.shape[1])
    try:
        return _find(captured, reference, emission, _PLATE)
    except Doubtful as doubt:
        with suppress(Doubtful):
            return _find(-captured, reference, emission, _PLATE)
        raise doubt from None


def by_onset(captured: Floats, loop: Floats) -> Delay:
    """Return when the first sound arrives, by the envelope of the impulse responses, shape (channels, period)."""
    _check_heard(captured, _PLATE[0])
    played = np.fft.rfft(loop)
    power = np.abs(played) ** 2
    band = power > 0.1 * power.max()
    answer = np.where(band, np.fft.rfft(captured) / np.where(band, played, 1.0), 0.0)
    full = np.zeros((len(captured), len(loop)), complex)
    full[:, : answer.shape[1]] = answer
    envelope = (np.abs(np.fft.ifft(full)) ** 2).sum(axis=0)
    # Where most comes for what came just before: in steady state the last chirp's ringing never ends.
    wide = max(len(loop) // 16, 4)
    after = np.fft.irfft(np.fft.rfft(envelope) * np.conj(np.fft.rfft(np.ones(wide), len(loop))), len(loop))
    rise = after / np.maximum(np.roll(after, wide), 1e-6 * after.max())
    coarse = int(np.argmax(rise))
    near = np.roll(envelope, -coarse + wide // 2)[:wide]
    first = (coarse - wide // 2 + int(np.argmax(near > 0.1 * near.max()))) % len(loop)
    return Delay(float(first), 1.0, np.ones(len(captured)))


def _find(captured: Floats, reference: Floats, emission: _Emission | None, wrong: tuple[str, str]) -> Delay:
    _check_heard(captured, wrong[0])
    channels, period = captured.shape
    known = _whole(reference, period)
    table = explained(captured, known)
    own = table[range(channels), range(channels)].sum(axis=0)
    at = int(np.argmax(own))
    _check_order(table, float(np.square(captured).sum()))
    samples, share, alike = _refine(captured, known, reference.shape[1], at / _FINER, emission)
    if share < GOOD:
        raise Doubtful(wrong[1].format(share))
    # Beyond the main lobe, whose width is that of the reference's own correlation.
    itself = explained(known, known)[range(channels), range(channels)].sum(axis=0)
    apart = int(np.argmax(itself < 0.5 * itself[0]))
    others = slice(apart, len(own) - apart + 1)
    rival = np.roll(own, -at)[others].max(initial=0.0) / own[at]
    if rival > max(AMBIGUOUS, itself[others].max(initial=0.0) / itself[0] + _UNLIKE_ITSELF):
        raise Doubtful(
            "two delays between playback and capture fit equally well: use a wider band, or wire a loopback channel"
        )
    return Delay(samples % period, share, alike)


def explained(captured: Floats, known: Floats) -> Floats:
    """Return the energy of captured channel i that known channel j explains at each delay, shape (i, j, delays)."""
    spectra, conjugates = np.fft.rfft(captured), np.conj(np.fft.rfft(known))
    period = captured.shape[1]
    norm = np.maximum(np.square(known).sum(axis=1), 1e-30)
    cross = np.fft.irfft(spectra[:, None] * conjugates[None], _FINER * period) * _FINER
    return np.asarray(np.square(np.maximum(cross, 0.0)) / norm[None, :, None])


def _whole(reference: Floats, period: int) -> Floats:
    """Return a reference of shape (channels, samples) as a period."""
    return np.pad(reference, ((0, 0), (0, period - reference.shape[1])))


def _check_heard(captured: Floats, said: str) -> None:
    if np.square(captured).mean() < SILENT * 2.0**30:
        raise Doubtful(said)


def _check_order(table: Floats, energy: float) -> None:
    """Raise Doubtful if the channels, of this energy, fit another order much better than their own."""
    channels = len(table)
    if not 2 <= channels <= _MOST_PERMUTED:
        return
    orders = list(permutations(range(channels)))
    best = [max(table[range(channels), order].sum(axis=0).max(), 0.0) for order in orders]
    order = orders[int(np.argmax(best))]
    if max(best) > max(SWAPPED * best[0], _BY_CHANCE * energy):  # the first order is their own
        swapped = ", ".join(f"input of disc {order[i] + 1} where that of disc {i + 1} should be"
                            for i in range(channels) if order[i] != i)  # fmt: skip
        raise Doubtful(f"cables are swapped: the {swapped}; swap them back, or change audio.channels")


def _refine(
    captured: Floats, known: Floats, samples: int, delay: float, emission: _Emission | None
) -> tuple[float, float, Floats]:
    """Return delay, explained share and correlations of the channels, by Gauss-Newton."""
    stretch = 0.0
    gains = np.ones(len(known))
    for _ in range(_ROUNDS):
        aligned = moved(captured, -delay)[:, :samples]
        model = known
        for _ in range(_STEPS if stretch else 0):
            assert emission is not None  # else nothing is stretched
            model = model + stretch / _STEPS * emission.bend(model)
        slope = _slope(model)[:, :samples]
        bent = emission.bend(model)[:, :samples] if emission is not None else slope
        model = model[:, :samples]
        norm = np.maximum(np.square(model).sum(axis=1), 1e-30)
        gains = np.einsum("cs,cs->c", aligned, model) / norm
        # Without what a gain explains: the gains are solved for in passing.
        columns = [-gains[:, None] * slope] + ([gains[:, None] * bent] if emission is not None else [])
        free = [c - (np.einsum("cs,cs->c", c, model) / norm)[:, None] * model for c in columns]
        error = aligned - gains[:, None] * model
        system = np.stack([c.ravel() for c in free], axis=1)
        step = np.linalg.lstsq(system, error.ravel(), rcond=1e-9)[0]
        delay += float(np.clip(step[0], -0.5, 0.5))
        if emission is not None:
            stretch = float(np.clip(stretch + step[1], -_MOST_STRETCH, _MOST_STRETCH))
        if np.abs(step).max() < _CONVERGED:
            break
    share = 1 - float(np.square(error).sum() / max(np.square(aligned).sum(), 1e-30))
    size = np.sqrt(np.maximum(np.square(aligned).sum(axis=1) * norm, 1e-30))
    return delay, share, np.asarray(gains * norm / size)


def _slope(signal: Floats) -> Floats:
    """Return the derivative by time, per sample."""
    turns = 2j * np.pi * np.fft.rfftfreq(signal.shape[1])
    return np.asarray(np.fft.irfft(np.fft.rfft(signal) * turns, signal.shape[1]))
