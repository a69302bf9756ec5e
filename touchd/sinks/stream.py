"""What came over the bus, as one subscriber sees it: decoded; which repeats, what is lost, and what is stale."""

from __future__ import annotations

import math
import re
import time
from collections import Counter
from collections.abc import Callable
from datetime import datetime

import msgspec
from msgspec.structs import replace

from touchd.errors import BusError
from touchd.event import DECODERS, SILENCE_NS, TOPICS, VERSION, Event, HealthEvent, KeyEvent, PlateEvent, TouchEvent

_LONGEST_BYTES = 1 << 20
"""A spectrum has some ten thousand."""
_MOST = 1 << 63
_KNOWN = {topic.encode(): (topic, DECODERS[topic].decode) for topic in TOPICS}
_SHARED_NS = 1_000_000_000
"""The clocks of one computer agree this well about the time between its start and now."""
_SLOWEST_NS = 2_000_000_000
"""Of a touch's messages that come more seldom it is not waited longer for the next."""
_MOST_KEYS = 1000
"""No keypad has more."""
_DRIFT = 2e-4
"""Two computers' clocks drift apart by less than this."""


def decode_message(parts: list[bytes], address: str) -> Event | None:
    """Return the event of a message, or None if its topic is newer than this program.

    Raises BusError if the message is not one of the bus, and quotes nothing of it: a key press is secret.
    """
    known = _KNOWN.get(parts[0])
    if known is None:
        return None
    topic, decode = known
    if len(parts) != 2:
        raise BusError(
            f"a {topic} message of {len(parts)} parts instead of 2", address, "is it a touchd that publishes?"
        )
    if len(parts[1]) > _LONGEST_BYTES:
        raise BusError(f"a {topic} message of {len(parts[1])} bytes", address, "is it a touchd that publishes?")
    try:
        event: Event = decode(parts[1])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        problem = _problem(error)
        version = _version(parts[1])
    else:
        if event.v == VERSION and -_MOST < event.t_ns < _MOST and -_MOST < event.seq < _MOST:
            return event
        problem, version = "t_ns or seq: not as agreed", event.v
    if isinstance(version, int) and version != VERSION:
        raise BusError(
            f"a {topic} message of version {version}, and this program knows {VERSION}", address, "upgrade touchd here"
        )
    raise BusError(f"not a {topic} message ({problem})", address, "is it a touchd that publishes?")


def _problem(error: Exception) -> str:
    """Return which field is wrong; neither its value nor the error itself, which quotes it: a key press is secret."""
    if not isinstance(error, msgspec.ValidationError):
        return "payload: no JSON"
    said, at, where = str(error).rpartition(" - at `")
    if not at:  # of the whole payload
        said, where = where, ""
    expected = re.fullmatch(r"Expected `[a-z |]+`, got `[a-z]+`|Object missing required field `[a-z_]+`", said)
    return f"{where.rstrip('`').removeprefix('$.') or 'payload'}: {expected[0] if expected else 'not as agreed'}"


class _Versioned(msgspec.Struct):
    v: object = VERSION


def _version(payload: bytes) -> object:
    """Return the version that an undecodable payload claims, or the known one if it claims none."""
    try:
        return msgspec.json.decode(payload, type=_Versioned).v
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return VERSION


class Stream:
    """Follows one device.

    A message's age is its `t_ns` against CLOCK_MONOTONIC here, if both are the same clock: then `wall` less `t_ns` is
    the same there and here. For another computer it is the delay beyond the least one seen. Beyond `max_age_s` a
    message is stale. `lost` and `dropped` grow by the messages that never came, and by those that are stale, by topic.
    """

    def __init__(
        self,
        max_age_s: float,
        lost: Counter[str],
        dropped: Counter[str],
        clock: Callable[[], int] = time.monotonic_ns,
        wall_clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._max_age_ns = max_age_s * 1e9
        self._lost, self._dropped = lost, dropped
        self._clock, self._wall_clock = clock, wall_clock
        self._last: dict[str, tuple[int, int]] = {}
        self._touched: TouchEvent | None = None  # the last touch, if a finger is down by it
        self._touched_ns = self._pace_ns = 0
        self._down = False  # whether a finger was, by the last touch, though it may have been lifted for silence
        self._pressed: dict[str, KeyEvent] = {}
        self._released: set[str] = set()  # by silence
        self._epoch_ns: int | None = None
        self._shared = False
        self._least_ns = 0.0
        self._heard_ns = 0

    def take(self, event: Event) -> Event | None:
        """Return the event for the program, or None for a repeat or a stale one.

        A stale event that follows a touch returns that nothing is touched, without an `up`: the finger may have left
        long ago. A stale release of a key that was pressed is returned. `health` and `plate` are never stale.
        """
        last = self._last.get(event.type)
        now = (event.seq, event.t_ns)
        if now == last:
            return None
        self._last[event.type] = now
        # The bus never sends an older message again, so a counter that fell belongs to a restarted daemon.
        if last is not None and event.seq > last[0] + 1:
            self._lost[event.type] += event.seq - last[0] - 1
        follows = last is not None and event.seq == last[0] + 1 and event.t_ns >= last[1]
        if not self._is_stale(event, self._clock(), follows=follows):
            if isinstance(event, TouchEvent):
                if self._down:  # a touch goes on, at this pace
                    self._pace_ns = min(self._heard_ns - self._touched_ns, _SLOWEST_NS)
                self._down = any(contact.phase != "up" for contact in event.contacts)
                self._touched, self._touched_ns = event if self._down else None, self._heard_ns
            elif isinstance(event, KeyEvent) and not self._note(event):
                return None
            return event
        self._dropped[event.type] += 1
        if isinstance(event, TouchEvent) and self._touched is not None:
            self._touched = None
            return replace(event, contacts=[])
        if isinstance(event, KeyEvent) and event.phase == "release" and event.key in self._pressed:
            self._note(event)
            return event
        return None

    def lift_silent(self) -> Event | None:
        """Return a key's release, or that nothing is touched, once for each key and finger of a silent daemon.

        It is silent if no touch came for `SILENCE_NS`; of a slow daemon or replay, for three times as long as between
        the last two. Of a stream in which nothing is stale, nothing is lifted.
        """
        touched, silent_ns = self._touched, max(SILENCE_NS, 3 * self._pace_ns)
        if not (touched or self._pressed) or self._clock() - self._touched_ns < silent_ns:
            return None
        if self._max_age_ns == math.inf:
            return None
        if self._pressed:
            name, press = self._pressed.popitem()
            self._released.add(name)
            return replace(press, phase="release")
        self._touched = None
        return touched and replace(touched, contacts=[])

    def _note(self, event: KeyEvent) -> bool:
        """Follow which keys are pressed; return False for the release of a key that silence has released."""
        if event.phase == "release":
            self._pressed.pop(event.key, None)
            if event.key in self._released:
                self._released.discard(event.key)
                return False
        elif len(self._pressed) < _MOST_KEYS and len(self._released) < _MOST_KEYS:
            self._released.discard(event.key)
            self._pressed[event.key] = event
            self._touched_ns = self._heard_ns
        return True

    def _is_stale(self, event: Event, now_ns: int, *, follows: bool) -> bool:
        """Return whether an event is stale; `follows` says that it is the next one after the last of its topic."""
        delay_ns = now_ns - event.t_ns
        # Reading `wall` is slow: not for a message that follows the last one and is new by what is known.
        known = follows and delay_ns - self._least_ns <= self._max_age_ns
        epoch_ns = self._epoch_ns if known else _epoch_ns(event)
        if self._epoch_ns is None or epoch_ns is None or abs(epoch_ns - self._epoch_ns) > _SHARED_NS:
            # The first message, or one of a daemon that started again, on a clock that may have, too.
            self._epoch_ns = epoch_ns
            here_ns = self._wall_clock() - now_ns
            self._shared = epoch_ns is not None and abs(epoch_ns - here_ns) < _SHARED_NS
            self._least_ns = 0.0 if self._shared else delay_ns
        elif not self._shared:
            self._least_ns += (now_ns - self._heard_ns) * _DRIFT
        self._heard_ns = now_ns
        self._least_ns = min(self._least_ns, delay_ns)
        return delay_ns - self._least_ns > self._max_age_ns and not isinstance(event, HealthEvent | PlateEvent)


def _epoch_ns(event: Event) -> int | None:
    """Return the UTC at which the event's `t_ns` was 0, ns: the same in all messages of one start of a computer."""
    try:
        wall_s = datetime.fromisoformat(event.wall).timestamp()
    except (ValueError, OverflowError):
        return None
    return round(wall_s * 1e9) - event.t_ns
