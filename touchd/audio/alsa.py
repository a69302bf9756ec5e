"""An ALSA card, by pyalsaaudio: this module alone imports it (extra `audio`).

Why not PortAudio (`sounddevice`): its blocking streams have four periods and no more, so blocks of 1 ms leave 3 ms
before samples are lost; it lists cards once, when it is imported, opens each of them for that, and names them by a
number that changes; after an xrun it restarts. pyalsaaudio takes `hw:CARD=NAME`, which never resamples,
blocks of 1 ms and buffers of 0.5 s, reports each xrun by a return value, and waits on file descriptors. It does not
link playback and capture: their delay differs from start to start, and has to be found after each in any case.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import select
from pathlib import Path
from typing import Any

import alsaaudio
import numpy as np
from numpy.typing import NDArray

from touchd.audio.capture import LOWER_RATES_HZ
from touchd.audio.card import CardAbsent, CardGone, CardXrun, Floats, Samples

CARDS = Path("/proc/asound")
"""Has an entry for each card by its name, also for those that this user may not open."""
BLOCK_S = 1e-3
"""Samples are read in blocks of this: what it adds to the latency, at most."""
AHEAD_S = 0.1
"""Playback is written this long before it is heard, so that a busy computer misses nothing; it adds no latency."""
_CAPTURE_S = 0.5
_BYTES = {
    alsaaudio.PCM_FORMAT_S32_LE: 4,
    alsaaudio.PCM_FORMAT_S24_3LE: 3,
    alsaaudio.PCM_FORMAT_S16_LE: 2,
}
"""Formats with the most significant bits first in order of preference, and bytes of a sample."""
# ALSA's library prints lines of its own each time that it opens no card. `labs` prints none, and is no code of Python,
# which a thread may outlive.
_LIBRARY = ctypes.CDLL(alsaaudio.__file__)
_LIBRARY.snd_lib_error_set_handler(_LIBRARY.labs)


class AlsaCard:
    """An open ALSA card with at least so many `inputs`.

    `name` is as `arecord -L` lists it: `hw:CARD=...` does not resample. Raises CardAbsent if there is no such card,
    another program uses it, or it lacks rate or inputs.
    """

    def __init__(self, name: str, rate_hz: int, inputs: int) -> None:
        self.name, self.rate_hz = name, rate_hz
        self._capture: Any = None
        self._playback: Any = None
        try:
            self._capture = self._open(alsaaudio.PCM_CAPTURE, inputs, _CAPTURE_S)
            self._playback = self._open(alsaaudio.PCM_PLAYBACK, 2, AHEAD_S)
            self._poll = select.poll()
            for descriptor, events in self._capture.polldescriptors():
                self._poll.register(descriptor, events)
        except alsaaudio.ALSAAudioError as error:
            self.close()
            raise CardAbsent(_explain(str(error), name)) from error
        except CardAbsent:
            self.close()
            raise
        captured, played = self._capture.info(), self._playback.info()
        self._inputs: int = captured["channels"]
        # Where playback takes its clock from the capture, the kernel makes both buffers equally long.
        self._filled = min(played["buffer_size"], max(round(AHEAD_S * rate_hz), 2 * played["period_size"]))
        self.ahead: int = self._filled + captured["period_size"]
        self._bytes = _BYTES[captured["format"]]
        self._outputs, self._out_bytes = played["channels"], _BYTES[played["format"]]
        self._frame_bytes = self._outputs * self._out_bytes

    def start(self, loop: Floats) -> None:
        """Write ahead, which starts the playback, then capture."""
        try:
            self._capture.drop()
            self._playback.drop()
            self._next, self._owed = 0, self._filled
            self.play(loop)
            self._top_up()
            self._capture.read()  # nothing yet: this starts it
        except (alsaaudio.ALSAAudioError, CardXrun) as error:
            raise CardGone(_explain(str(error), self.name)) from error

    def play(self, loop: Floats) -> None:
        """Write another loop from now on."""
        self._period = len(loop)
        times = -(-(self._owed_at_most + self._period) // self._period)
        self._loop = memoryview(_pack(np.tile(loop, times), self._outputs, self._out_bytes))

    def exchange(self, timeout_s: float) -> Samples | None:
        """Return the next block, and write as much."""
        if not self._poll.poll(round(1000 * timeout_s)):
            return None
        try:
            length, data = self._capture.read()
            if length < 0:
                raise CardXrun("samples were lost: this computer was too late to read them")
            self._owed += length
            self._top_up()
        except alsaaudio.ALSAAudioError as error:
            raise CardGone(_explain(str(error), self.name)) from error
        return _upper(data, length, self._inputs, self._bytes) if length else None

    def close(self) -> None:
        """Close both streams."""
        for stream in (self._capture, self._playback):
            if stream is not None:
                with contextlib.suppress(alsaaudio.ALSAAudioError):
                    stream.close()
        self._capture = self._playback = None

    @property
    def _owed_at_most(self) -> int:
        return round(2 * AHEAD_S * self.rate_hz)

    def _top_up(self) -> None:
        """Write what was captured since, as far as there is room."""
        while self._owed:
            count = min(self._owed, self._owed_at_most)
            begin = self._next * self._frame_bytes
            written = self._playback.write(self._loop[begin : begin + count * self._frame_bytes])
            if written < 0:
                raise CardXrun("the playback ran dry: this computer was too late to write it")
            if not written:
                return
            self._owed -= written
            self._next = (self._next + written) % self._period

    def _open(self, kind: int, channels: int, buffer_s: float) -> Any:
        """Return an open stream with at least so many channels, in the first format that the card has."""
        block = round(BLOCK_S * self.rate_hz)
        fits = _fit(self.name, kind, self.rate_hz, channels)
        for sample, count in fits:
            try:
                stream = alsaaudio.PCM(
                    type=kind, mode=alsaaudio.PCM_NONBLOCK, device=self.name, rate=self.rate_hz, channels=count,
                    format=sample, periodsize=block, periods=round(buffer_s * self.rate_hz / block),
                )  # fmt: skip
                break
            except alsaaudio.ALSAAudioError as error:  # 24 bits may be too many for a USB port, 16 not
                if "No space left" not in str(error) or sample == fits[-1][0]:
                    raise
        info = stream.info()  # what it cannot set it leaves as it is
        got = info["format"], info["channels"], info["rate"]
        if got != (sample, count, self.rate_hz):
            stream.close()
            raise CardAbsent(f"{self.name} takes {got[2]} samples a second and {got[1]} channels, not as it said")
        return stream


def _fit(name: str, kind: int, rate_hz: int, channels: int) -> list[tuple[int, int]]:
    """Return the formats that a card takes at a sample rate, each with its fewest channels from so many on.

    A card has the numbers of channels of its modes alone, such as 10 and 18, each at some rates. pyalsaaudio asks for
    one number and takes the least if there is no such mode; it leaks where no stream opens, and a card may be away for
    weeks. Raises CardAbsent, and says what the card takes instead.
    """
    stream, params, found, most = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_uint(), 0
    error = _LIBRARY.snd_pcm_open(ctypes.byref(stream), os.fsencode(name), kind, alsaaudio.PCM_NONBLOCK)
    if error < 0:
        raise CardAbsent(_explain(os.strerror(-error), name, opening=True))

    def takes(sample: int, at_hz: int) -> bool:
        """Narrow all settings to a format and a rate; return whether any are left."""
        return bool(
            _LIBRARY.snd_pcm_hw_params_any(stream, params) >= 0
            and _LIBRARY.snd_pcm_hw_params_set_format(stream, params, sample) >= 0
            and _LIBRARY.snd_pcm_hw_params_set_rate(stream, params, at_hz, 0) >= 0
        )

    fits = []
    try:
        _LIBRARY.snd_pcm_hw_params_malloc(ctypes.byref(params))
        for sample in _BYTES:
            if takes(sample, rate_hz):
                found.value = channels
                if _LIBRARY.snd_pcm_hw_params_set_channels_min(stream, params, ctypes.byref(found)) >= 0:
                    _LIBRARY.snd_pcm_hw_params_get_channels_min(params, ctypes.byref(found))
                    fits.append((sample, found.value))
                    continue
                _LIBRARY.snd_pcm_hw_params_get_channels_max(params, ctypes.byref(found))
                most = max(most, found.value)
        if fits:
            return fits
        rates = [str(at_hz) for at_hz in LOWER_RATES_HZ if any(takes(sample, at_hz) for sample in _BYTES)]
    finally:
        _LIBRARY.snd_pcm_hw_params_free(params)
        _LIBRARY.snd_pcm_close(stream)
    if most:
        raise CardAbsent(f"{name} has {most} channels at {rate_hz} samples a second, not {channels}")
    if not rates:
        raise CardAbsent(f"{name} has no format of whole numbers: write plughw: for hw:, which converts")
    raise CardAbsent(
        f"{name} takes {', '.join(rates)} samples a second, not {rate_hz}: set another audio.sample_rate_hz, and "
        "audio.band_hz below half of it"
    )


def _upper(data: bytes, length: int, channels: int, width: int) -> Samples:
    """Return the upper 16 bits of interleaved little-endian samples, a view of shape (length, channels)."""
    return np.ndarray((length, channels), "<i2", data, width - 2, (channels * width, width))


def _pack(loop: Floats, channels: int, width: int) -> bytes:
    """Return a loop as interleaved little-endian samples of this many bytes, the same in all channels."""
    top = 2.0 ** (8 * width - 1)
    counts: NDArray[np.int64] = np.clip(np.rint(loop * top), -top, top - 1).astype("<i8")
    octets = counts.view(np.uint8).reshape(-1, 8)[:, :width]
    return np.repeat(octets[:, None, :], channels, axis=1).tobytes()


def _explain(text: str, name: str, *, opening: bool = False) -> str:
    """Return what ALSA says, of a card that it is `opening` or has open, with what it means."""
    if "busy" in text:
        return f"{name} is in use by another program: end it, or take the card away from the sound server"
    if "No such device or address" in text and not opening:  # so the kernel's driver says it
        return f"{name} has no valid clock: set its clock to internal, or connect what it is to follow"
    if "No space left" in text:  # of the bus, not of a disk
        return f"{name} gets too little of its USB port: use another one, no hub, or a lower audio.sample_rate_hz"
    named = re.search(r"CARD=([^,]+)", name)
    # There, but not for this user.
    hidden = "No such" in text and named and named[1] not in alsaaudio.cards() and (CARDS / named[1]).exists()
    if hidden or "Permission denied" in text:
        return f"{name} is there, but may not be opened: join the group audio; a service needs audio.conf"
    # No such file, or device; a number that no card has, for ALSA knows 32, is an invalid argument.
    if "No such" in text or (opening and "Invalid argument" in text and re.match(r"(plug)?hw:", name)):
        there = ", ".join(f"hw:CARD={card}" for card in _cards())
        return f"there is no {name}: plug it in" + (
            f", or name a card that is there: {there}" if there else "; no card is"
        )
    return text if name in text else f"{text} ({name})"


def _cards() -> list[str]:
    """Return the names of all cards, also of those that this user may not open; none without ALSA in the kernel."""
    with contextlib.suppress(OSError):
        return sorted(entry.name for entry in CARDS.iterdir() if entry.is_symlink())
    return []
