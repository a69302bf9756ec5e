"""A finger never stays down by mistake, whatever becomes of the daemon."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.bridges.events import MS, contact, health, touch
from touchd.bridges import bridge
from touchd.bridges.bridge import Down, Following
from touchd.event import SILENCE_NS, Event, KeyEvent, Phase, State


def ids(following: Following) -> list[int]:
    return [one.id for one in following.down.values()]


def test_what_a_message_names_is_down() -> None:
    """What a message names is down, but for what goes up."""
    following = Following()
    following.take(touch(contact(1, "down")), 0)
    following.take(touch(contact(1), contact(2, "down")), 8 * MS)
    assert ids(following) == [1, 2]
    following.take(touch(contact(1, "up"), contact(2)), 16 * MS)
    assert ids(following) == [2]


def test_silence_lifts() -> None:
    """Without a touch message for 0.3 s a finger is lifted, and health messages do not hold it."""
    following = Following()
    following.take(touch(contact(1, "down")), 0)
    assert not following.check(300 * MS - 1)
    assert not following.take(health(), 300 * MS - 1)
    assert following.check(300 * MS)
    assert following.down == {}
    assert not following.check(2 * SILENCE_NS), "once"


def test_a_held_finger_stays() -> None:
    """The messages that repeat a still finger every 0.1 s hold it."""
    following = Following()
    following.take(touch(contact(1, "down")), 0)
    for k in range(1, 100):
        following.take(touch(contact(1, "hold")), k * 100 * MS)
        assert not following.check((k * 100 + 99) * MS)
    assert ids(following) == [1]


@pytest.mark.parametrize("state", ["starting", "uncalibrated", "stalled", "lost", "stopping"])
def test_any_other_state_lifts(state: State) -> None:
    """A daemon that does not stream knows of no finger."""
    following = Following()
    following.take(touch(contact(1, "down")), 0)
    assert following.take(health(state), MS)
    assert following.down == {}


def test_a_finger_that_was_there_all_along_means_nothing() -> None:
    """After a start or a lift by silence, a finger counts from its next `down`: else it would click where it lies."""
    following = Following()
    following.take(touch(contact(7, "hold")), 0)
    assert following.down == {}
    following.take(touch(contact(7, "move"), contact(8, "down")), MS)
    assert ids(following) == [8]
    assert following.check(SILENCE_NS + MS)
    following.take(touch(contact(7, "move"), contact(8, "hold")), SILENCE_NS + 2 * MS)
    assert following.down == {}
    following.take(touch(contact(9, "down")), SILENCE_NS + 3 * MS)
    assert ids(following) == [9]


def test_a_lost_down_costs_no_touch() -> None:
    """A finger whose `down` was lost on the way counts from the next message."""
    following = Following()
    following.take(touch(contact(1, "down")), 0)
    following.take(touch(contact(1), contact(2, "move")), MS)
    assert ids(following) == [1, 2]


def test_a_restarted_daemon_s_first_finger_is_another() -> None:
    """A restarted daemon numbers from 1 again: its first finger is not the one that was down before."""
    following = Following()
    following.take(touch(contact(1, "down")), 0)
    before = set(following.down)
    following.take(touch(contact(1, "down")), MS)
    assert ids(following) == [1]
    assert before.isdisjoint(following.down)


def test_dropped_messages_lift() -> None:
    """A message without contacts, in place of stale ones, lifts; the finger does not come down again by moving."""
    following = Following()
    following.take(touch(contact(1, "down")), 0)
    assert following.take(touch(), MS)
    following.take(touch(contact(1, "move")), 2 * MS)
    assert following.down == {}


STEP = st.one_of(
    st.lists(st.tuples(st.integers(1, 4), st.sampled_from(["down", "move", "hold", "up"])), min_size=1, max_size=4,
             unique_by=lambda pair: pair[0]),
    st.sampled_from(["lost", "streaming", "silence", "wait"]),
)  # fmt: skip


@given(st.lists(STEP, max_size=40))
def test_any_course_of_events(steps: list[list[tuple[int, str]] | str]) -> None:
    """Whatever comes: only what the last message names is down, under numbers that are never used again."""
    following, now_ns, used = Following(), 0, set[int]()
    for step in steps:
        now_ns += 5 * MS
        before = dict(following.down)
        if isinstance(step, list):
            following.take(touch(*(contact(n, phase) for n, phase in step)), now_ns)  # type: ignore[arg-type]  # phases
            named = {n for n, phase in step if phase != "up"}
            assert set(ids(following)) <= named
            assert {n for n, phase in step if phase == "down"} <= set(ids(following))
        elif step == "silence":
            now_ns += SILENCE_NS
            following.check(now_ns)
            assert following.down == {}
        elif step != "wait":
            following.take(health(step), now_ns)  # type: ignore[arg-type]  # a state
            assert step == "streaming" or following.down == {}
        new = following.down.keys() - before.keys()
        assert new.isdisjoint(used)
        used |= new
        assert 0.0 <= following.patience_s(now_ns, 0.25) <= 0.25


class _Ended(Exception):
    """The events of a test have ended."""


class _Events:
    """A subscription whose events the test has made."""

    def __init__(self, events: list[Event]) -> None:
        self._events = iter(events)

    def __enter__(self) -> _Events:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def receive(self, _timeout_s: float) -> Event:
        for event in self._events:
            return event
        raise _Ended


class _Keys:
    """An output that keeps what is pressed."""

    topics = ("touch", "key")

    def __init__(self) -> None:
        self.phases: list[str] = []

    def show(self, down: Down, t_ns: int) -> None:
        pass

    def press(self, event: KeyEvent) -> None:
        self.phases.append(event.phase)

    def idle(self, now_ns: int) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.mark.parametrize(("first", "phases"), [("down", ["press", "release"]), ("hold", ["release"])])
def test_keys(monkeypatch: pytest.MonkeyPatch, first: Phase, phases: list[str]) -> None:
    """A press counts if its finger does: a finger that has been there all along presses nothing, for nobody may ever
    release it; a release always counts."""
    keys = [KeyEvent("touchd", 1, 0, "", "5", phase, 0.9) for phase in ("press", "release")]
    events: list[Event] = [touch(contact(1, first)), *keys]
    monkeypatch.setattr(bridge, "Subscriber", lambda _address, _topics: _Events(events))
    output = _Keys()
    with pytest.raises(_Ended):
        bridge.run(None, output, lambda _now_ns: True)
    assert output.phases == phases


def test_numbers_last() -> None:
    """A number names one finger from its down to its up."""
    following = Following()
    following.take(touch(contact(1, "down"), contact(2, "down")), 0)
    first = {one.id: number for number, one in following.down.items()}
    for k in itertools.count(1):
        following.take(touch(contact(1), contact(2)), k * MS)
        assert {one.id: number for number, one in following.down.items()} == first
        if k == 10:
            break
