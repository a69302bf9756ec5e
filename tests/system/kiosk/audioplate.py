"""A plate between playback and capture of the kernel's loopback card, in the virtual machine.

`python audioplate.py RESPONSES.npz`: it convolves what is played with the plate's response, under the fingers that a
line of standard input names: `touch 3` for those of the third response, `way 3 40` for a movement from the third one to
the fortieth, `release`. Each time that nothing is played it draws another delay. It ends when the card goes.
"""

from __future__ import annotations

import select
import sys

import alsaaudio
import numpy as np

DEVICE = "hw:CARD=Loopback,DEV=1"
BLOCK = 960
"""Samples convolved at once; a movement goes from one response to the next in as many."""
BUFFER_S = 0.5
MOST_DELAY = 192
NOISE = 1 << 16
AHEAD = 2 * BLOCK
"""How much is answered before it is needed: the daemon listens 0.08 s after it began to play."""


def stream(kind: int, channels: int, rate_hz: int) -> alsaaudio.PCM:
    return alsaaudio.PCM(
        kind, alsaaudio.PCM_NORMAL, device=DEVICE, channels=channels, rate=rate_hz,
        format=alsaaudio.PCM_FORMAT_S32_LE, periodsize=BLOCK // 4, periods=round(4 * BUFFER_S * rate_hz / BLOCK),
    )  # fmt: skip


def asked(line: str) -> tuple[int, int]:
    """The responses of the first and the last place that a command names."""
    words = line.split()
    if words[:1] not in (["touch"], ["way"]):
        return 0, 0
    return int(words[1]), int(words[-1])


def main(path: str) -> None:
    with np.load(path) as file:
        responses, rate_hz, noise = file["responses"], int(file["rate_hz"]), float(file["noise"])
    taps, channels = responses.shape[2], responses.shape[1]
    size = 1 << (BLOCK + taps + MOST_DELAY - 1).bit_length()
    spectra = np.fft.rfft(responses, size)
    drawn = noise * 2.0**16 * np.random.default_rng(0).standard_normal((channels, NOISE))
    tail = np.zeros((channels, size))
    at, end = 0, 0
    captured = b""
    played = stream(alsaaudio.PCM_PLAYBACK, channels, rate_hz)
    heard = stream(alsaaudio.PCM_CAPTURE, 2, rate_hz)
    silence = np.zeros((AHEAD, channels), "<i4").tobytes()
    draw, quiet = np.random.default_rng(), False
    turns = -2j * np.pi * np.fft.rfftfreq(size)
    delay = np.ones_like(turns)
    played.write(silence)
    print("plate", flush=True)
    while True:
        length, data = heard.read()
        if length < 0:
            print("late", flush=True)
            continue
        captured += data
        if len(captured) < BLOCK * 8:
            continue
        block = np.frombuffer(captured[: BLOCK * 8], "<i4").reshape(-1, 2)[:, 0]
        captured = captured[BLOCK * 8 :]
        at += (end > at) - (end < at)
        if select.select([sys.stdin], [], [], 0)[0] and (line := sys.stdin.readline()):
            at, end = asked(line)
        if not block.any() and not quiet:
            delay = np.exp(turns * draw.uniform(0.0, MOST_DELAY))
        quiet = not block.any()
        tail[:, :-BLOCK] = tail[:, BLOCK:]
        tail[:, -BLOCK:] = 0
        tail += np.fft.irfft(np.fft.rfft(block, size) * delay * spectra[at], size)
        noise_at = int(draw.integers(NOISE - BLOCK))  # frames that repeat are those of a card that hangs
        answer = tail[:, :BLOCK] + drawn[:, noise_at : noise_at + BLOCK]
        counts = np.clip(np.rint(answer), -(2**31), 2**31 - 1).astype("<i4")
        if played.write(counts.T.tobytes()) < 0:  # the processor was too slow: begin again, with another delay
            print("dry", flush=True)
            played.write(silence)


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except alsaaudio.ALSAAudioError as error:
        print(error, flush=True)
