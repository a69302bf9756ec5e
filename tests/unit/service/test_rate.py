"""The frame rate follows the plate: few frames while it is untouched, all as soon as it is not."""

from __future__ import annotations

import pytest

from touchd.config.schema import DeviceSettings
from touchd.frame import ACQUISITIONS
from touchd.outcome import Outcome
from touchd.service.rate import QUIET_NS, SCREEN_OFF_HZ, ScanRate
from touchd.sources.source import Source

OFF = Outcome.SCREEN_OFF
BEGIN_NS = 10**12


class Adjustable:
    """A source that keeps the rates it is asked for."""

    def __init__(self) -> None:
        self.asked: list[int] = []
        self.answers = True

    def set_rate(self, rate_hz: int) -> bool:
        self.asked.append(rate_hz)
        return self.answers


def made(source: object, **settings: int) -> ScanRate:
    rate = ScanRate(source, DeviceSettings(**settings))  # type: ignore[arg-type]
    rate.touched(BEGIN_NS, Outcome.LEARNING)
    return rate


def test_untouched() -> None:
    """After half a second without a touch the rate falls, and is asked for once."""
    source = Adjustable()
    rate = made(source)
    for after_ns in (0, QUIET_NS - 1):
        rate.tick(BEGIN_NS + after_ns)
    assert source.asked == []
    for after_ns in (QUIET_NS, QUIET_NS + 1):
        rate.tick(BEGIN_NS + after_ns)
    assert source.asked == [50]


@pytest.mark.parametrize("outcome", [one for one in Outcome if one not in (Outcome.UNTOUCHED, OFF)])
def test_first_touch(outcome: Outcome) -> None:
    """The first frame that opens the gate brings all frames, whatever is found in it."""
    source = Adjustable()
    rate = made(source)
    rate.tick(BEGIN_NS + QUIET_NS)
    rate.touched(BEGIN_NS + QUIET_NS + 1, outcome)
    rate.tick(BEGIN_NS + QUIET_NS + 2)
    assert source.asked == [50, 125]


def test_screen() -> None:
    """With the screen off few frames keep the baseline; switching it on brings all of them at once."""
    source = Adjustable()
    rate = made(source)
    rate.touched(BEGIN_NS, OFF)
    rate.tick(BEGIN_NS)
    assert source.asked == [SCREEN_OFF_HZ]
    rate.wake()
    rate.tick(BEGIN_NS + 1)
    assert source.asked == [SCREEN_OFF_HZ, 125]


def test_listener() -> None:
    """A program that records gets all frames, of an untouched plate and with the screen off too."""
    source = Adjustable()
    rate = made(source)
    rate.tick(BEGIN_NS + QUIET_NS)
    rate.wanted = True
    rate.tick(BEGIN_NS + 2 * QUIET_NS)
    rate.touched(BEGIN_NS + 2 * QUIET_NS, OFF)
    assert source.asked == [50, 125]


def test_limits() -> None:
    """No rate is above the full one."""
    source = Adjustable()
    rate = made(source, rate_hz=8)
    rate.tick(BEGIN_NS + QUIET_NS)
    rate.touched(BEGIN_NS + QUIET_NS, OFF)
    assert source.asked == []


def test_clock_back() -> None:
    """A clock that steps back does not keep the rate up."""
    source = Adjustable()
    rate = made(source)
    rate.tick(BEGIN_NS - QUIET_NS)
    assert source.asked == [50]


def test_one_rate() -> None:
    """A source that has one rate keeps it."""

    class Fixed(Source):
        acquisition = ACQUISITIONS["usb"]

        def read(self, timeout_s: float) -> None: ...

        def close(self) -> None: ...

    rate = made(Fixed())
    rate.tick(BEGIN_NS + QUIET_NS)
    rate.wake()


def test_no_answer() -> None:
    """A device that did not answer is asked again 5 s later, and no more once it has."""
    source = Adjustable()
    rate = made(source)
    rate.tick(BEGIN_NS + QUIET_NS)
    source.answers, now_ns = False, BEGIN_NS + 2 * QUIET_NS
    rate.touched(now_ns, Outcome.TOUCHED)
    for after_s in (1, 4.9, 5):
        rate.touched(now_ns + round(after_s * 1e9), Outcome.TOUCHED)
        rate.tick(now_ns + round(after_s * 1e9))
    assert source.asked == [50, 125, 125]
    source.answers = True
    for after_s in (9.9, 10, 15, 20):
        rate.touched(now_ns + round(after_s * 1e9), Outcome.TOUCHED)
        rate.tick(now_ns + round(after_s * 1e9))
    assert source.asked == [50, 125, 125, 125]
