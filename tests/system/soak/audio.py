"""`python -m tests.system.soak.audio`: a million periods of an audio interface at full speed, with xruns and replugs.

Time is the card's own, and passes by samples. Each frame tells by its noise which period it was captured in.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from typing import NamedTuple

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ[_name] = "1"

import numpy as np  # noqa: E402 - after its threads are limited

from tests.audiocard import FakeCard, Floats, answers  # noqa: E402 - as above
from touchd.audio.capture import HighPass  # noqa: E402 - as above
from touchd.audio.card import CardXrun, Samples  # noqa: E402 - as above
from touchd.cli.demo import SESSION  # noqa: E402 - as above
from touchd.config.rigs import AudioSettings  # noqa: E402 - as above
from touchd.config.schema import DeviceSettings, LogSettings  # noqa: E402 - as above
from touchd.lab.arguments import within  # noqa: E402 - as above
from touchd.localization.model import Model, default_model_path  # noqa: E402 - as above
from touchd.recording.format import read  # noqa: E402 - as above
from touchd.service.log import configure  # noqa: E402 - as above
from touchd.sources.audio import AudioDaq  # noqa: E402 - as above
from touchd.sources.daq import DaqAbsent, DaqFrame, Waits  # noqa: E402 - as above
from touchd.sources.live import DaqSource  # noqa: E402 - as above

PERIOD, BANK = 2000, 61
SETTINGS = AudioSettings(sample_rate_hz=250_000, band_hz=(50e3, 100e3), chirp_s=1e-3)


class BankCard(FakeCard):
    """A card whose periods repeat after 61, computed once for what is played.

    Xruns and unplugging come by count, and so does the silence of the end.
    """

    def __init__(self, frames: np.ndarray, last_period: int, xrun_every: int, unplug_every: int) -> None:
        self._last_period, self._xrun_every, self._unplug_every = last_period, xrun_every, unplug_every
        super().__init__(read(SESSION).acquisition, answers(frames), PERIOD, block=PERIOD // 2)
        self.xruns = self.unplugs = self.periods = 0
        self.started_ns: int | None = None
        """The start that no frame has followed yet."""
        self._bank: dict[bytes, Floats] = {}

    def open(self) -> BankCard:
        if self.unplugged:
            self.unplugged = False
            raise DaqAbsent("unplugged")
        return self

    def start(self, loop: Floats) -> None:
        super().start(loop)
        self._bank.clear()
        self.started_ns = self.clock.ns

    def exchange(self, timeout_s: float) -> Samples | None:
        if self.periods // self._xrun_every > self.xruns:
            self.xruns += 1
            self.clock.ns += 37_000_000
            raise CardXrun("samples were lost")
        if self.periods // self._unplug_every > self.unplugs:
            self.unplugs += 1
            self.unplugged = True
        self.silent = self.periods >= self._last_period
        return super().exchange(timeout_s)

    def _one_period(self) -> np.ndarray:
        self._until -= 1
        if self._until == 0:
            self._loop = self._next_loop
        self.periods += 1
        key = self._loop.tobytes()[:4096]
        if key not in self._bank:
            number, until = self.period_number, self._until
            self.period_number, self._until = 0, 0
            self._bank[key] = np.stack([super(BankCard, self)._one_period() for _ in range(BANK)])
            self.period_number, self._until = number, until
        self.period_number += 1
        found: np.ndarray = self._bank[key][(self.period_number - 1) % BANK]
        return found


class TimedDaq(AudioDaq):
    """Tells how long a start takes to its first frame, at the card: the reader of the queue may be late."""

    longest_ns = 0

    def read(self, timeout_s: float) -> DaqFrame | None:
        frame = super().read(timeout_s)
        card = self._card
        assert isinstance(card, BankCard)
        if frame is not None and not frame.withheld and card.started_ns is not None:
            TimedDaq.longest_ns = max(TimedDaq.longest_ns, card.clock.ns - card.started_ns)
            card.started_ns = None
        return frame


class Result(NamedTuple):
    """What came of a run."""

    frames: int
    out_of_order: int
    """Frames that are not the period that their number says."""
    unaccounted: int
    """Numbers without a frame that no counter has."""
    withheld: int
    lost: int
    behind: int
    xruns: int
    unplugs: int
    first_frame_s: float
    """From the longest restart of the card to its first frame, s of the card's time."""
    seconds: float


def run(periods: int, xrun_every: int = 5003, unplug_every: int = 20_011) -> Result:
    """Read the frames of so many periods of the fake, with faults after so many, and account for each.

    Nothing is left to read then: with more on the way, the counters would be ahead of the frames.
    """
    session = read(SESSION)
    rng = np.random.default_rng(1)
    mean = session.frames[:40].mean(axis=0)
    TimedDaq.longest_ns = 0
    marks = rng.normal(0, 12, (BANK, *mean.shape))
    card = BankCard(np.rint(mean + marks).astype(np.int16), periods, xrun_every, unplug_every)
    model = Model(default_model_path())
    assert model.atlas is not None
    reference = model.atlas.baseline.astype(float)
    source = DaqSource(
        lambda: iter([lambda: TimedDaq(card.open(), SETTINGS, session.acquisition, reference, card.clock)]),
        DeviceSettings(queue_frames=200), session.acquisition, lambda _: None,
        waits=Waits(0.01, 1e-3, 2e-3), clock=card.clock, direct=False,
    )  # fmt: skip
    # What each period looks like once it is cut: the nearest says which one a frame is.
    whole = np.zeros((BANK, len(mean), PERIOD))
    whole[..., : mean.shape[1]] = mean + marks
    high_pass = HighPass(50e3, 250e3, *mean.shape)
    cut = np.stack([high_pass.around(one)[:, : mean.shape[1]] for one in whole])
    middle = cut.mean(axis=0)
    flat = (cut - middle).reshape(BANK, -1).astype(np.float32)
    half = np.square(flat).sum(axis=1) / 2
    frames = out_of_order = unaccounted = 0
    last: tuple[int, int] | None = None  # number and period of the last frame
    last_number = 0  # numbers count from 0 on
    away = True
    began = time.monotonic()
    states: set[str] = set()
    while "stalled" not in states:  # which comes behind the last frame
        frame = source.read(0.2)
        if frame is None:
            states = {change.state for change in source.changes()}
            away |= "lost" in states
            continue
        period = int(np.argmax(flat @ (frame.counts - middle).ravel().astype(np.float32) - half))
        if last is not None and frame.sequence == last[0] + 1 and not away:
            out_of_order += (period - last[1]) % BANK != 1
        away, last, last_number = False, (frame.sequence, period), frame.sequence
        frames += 1
    tally = source.tally
    withheld, lost, behind = sum(tally.withheld.values()), tally.lost, tally.behind
    source.close()
    unaccounted = last_number + 1 - frames - withheld - lost - behind
    return Result(
        frames, out_of_order, unaccounted, withheld, lost, behind, card.xruns, card.unplugs,
        TimedDaq.longest_ns / 1e9, time.monotonic() - began,
    )  # fmt: skip


def main() -> int:
    """Run, and print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--periods", type=within(int, 1), default=1_000_000)
    configure(LogSettings(level="error"))
    result = run(parser.parse_args().periods)
    for name, value in result._asdict().items():
        print(f"{name:14} {value}")
    return int(result.out_of_order > 0 or result.unaccounted != 0)


if __name__ == "__main__":
    sys.exit(main())
