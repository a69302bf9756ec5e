"""What becomes a message: what somebody wants, and each contact that comes or goes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime

import pytest

from tests.conftest import Scene
from touchd.config.schema import Settings
from touchd.event import Event, SpectrumEvent, TouchEvent
from touchd.frame import Frame
from touchd.keypad import PHONE, load_layout
from touchd.localization.model import Model
from touchd.pipeline import Pipeline
from touchd.service.messages import Messages, all_but_spectra

HEAR_ALL = Settings.model_validate({"skip": {"unheard": False}})


class Run:
    """A scene that is played bit by bit."""

    def __init__(self, scene: Scene, model: Model, name: str) -> None:
        recording = scene(name)
        rows = zip(recording.frames, recording.sequence.tolist(), recording.timestamp_ns.tolist(), strict=True)
        self.frames = [Frame(counts, sequence, t_ns, t_ns) for counts, sequence, t_ns in rows]
        layout = load_layout(PHONE) if name == "keypad" else None
        self._pipeline = Pipeline(recording.acquisition, model, Settings(), layout)

    def events(self, messages: Messages, part: slice = slice(None)) -> list[Event]:
        """The messages of some frames."""
        return list(self.each(messages, part))

    def each(
        self, messages: Messages, part: slice = slice(None), spectrum: Callable[[], list[float]] | None = None
    ) -> Iterator[Event]:
        """The messages of some frames, each as soon as it is made."""
        for frame in self.frames[part]:
            yield from messages.make(self._pipeline.process(frame), spectrum or self._pipeline.spectrum)


@pytest.fixture
def play(scene: Scene, model: Model) -> Callable[[str], Run]:
    return lambda name: Run(scene, model, name)


def make(wants: Callable[[str], bool] = lambda _topic: True, settings: Settings | None = None) -> Messages:
    """Messages by a monotonic clock that began with 1970."""
    return Messages(settings or Settings(), wants, wall_offset=lambda: 0)


def phases(events: list[Event]) -> list[tuple[int, str]]:
    """Contacts that go down or up, in order."""
    contacts = [contact for event in events if isinstance(event, TouchEvent) for contact in event.contacts]
    return [(contact.id, contact.phase) for contact in contacts if contact.phase in ("down", "up")]


def test_numbers(play: Callable[[str], Run]) -> None:
    """Each topic counts its own messages from one."""
    events = play("keypad").events(make())
    for topic in ("touch", "key", "spectrum"):
        numbers = [event.seq for event in events if event.type == topic]
        assert numbers == list(range(1, len(numbers) + 1))
        assert numbers


def test_time(play: Callable[[str], Run]) -> None:
    """A message bears the time of its frame, and UTC at that time."""
    run = play("tap")
    time_ns = {frame.sequence: frame.t_ns for frame in run.frames}
    touches = [event for event in run.events(make()) if isinstance(event, TouchEvent)]
    assert touches
    for event in touches:
        assert event.t_ns == time_ns[event.frame]
        wall = datetime.fromisoformat(event.wall) - datetime.fromtimestamp(0, UTC)
        assert wall.total_seconds() == pytest.approx(event.t_ns * 1e-9, abs=2e-6)


@pytest.mark.parametrize("step_s", [3600.0, -3600.0], ids=["slept, or set forward", "set back"])
def test_a_clock_that_is_set(step_s: float) -> None:
    """Within a second a message's UTC follows the computer's clock; that it jitters shows in no message."""
    offset_ns = [0]
    messages = Messages(Settings(), all_but_spectra, wall_offset=lambda: offset_ns[-1])

    def utc_s(t_s: float) -> float:
        return datetime.fromisoformat(messages.stamp("touch", round(t_s * 1e9))[3]).timestamp()

    assert utc_s(7200.0) == 7200.0
    offset_ns.append(1_000_000)
    assert utc_s(7201.5) == 7201.5
    offset_ns.append(round(step_s * 1e9))
    assert utc_s(7202.5) == 7202.5 + step_s
    assert utc_s(7202.6) == pytest.approx(7202.6 + step_s)


def test_spectrum(play: Callable[[str], Run], model: Model) -> None:
    """A spectrum is made only while somebody wants it."""
    wanted: set[str] = set()
    run, messages = play("tap"), make(wanted.__contains__)
    assert not any(isinstance(event, SpectrumEvent) for event in run.events(messages, slice(400)))
    wanted.add("spectrum")
    spectra = [event for event in run.events(messages, slice(400, None)) if isinstance(event, SpectrumEvent)]
    assert spectra
    assert {len(event.features) for event in spectra} == {model.description.inputs}
    assert spectra[0].seq == 1


def test_a_touch_does_not_wait_for_the_spectrum(play: Callable[[str], Run]) -> None:
    """The spectrum is taken once the frame's other messages are out."""
    run, out = play("tap"), [""]
    for event in run.each(make(), spectrum=lambda: [float(out[-1] == "touch")]):
        if isinstance(event, SpectrumEvent) and event.features == [1.0]:
            return
        out.append(event.type)
    raise AssertionError("no spectrum after a touch")


def test_unheard(play: Callable[[str], Run]) -> None:
    """Without a subscriber only what goes down or comes up has a message; what has none is counted."""
    heard, unheard = make(), make(lambda _topic: False)
    told, untold = play("circle").events(heard), play("circle").events(unheard)
    assert phases(untold) == phases(told)
    touches = [event for event in told if isinstance(event, TouchEvent)]
    assert len(untold) == len(phases(told))
    assert [event.seq for event in untold] == list(range(1, len(untold) + 1)), "nobody takes them for lost"
    assert unheard.unheard["touch"] == len(touches) - len(untold)
    assert unheard.unheard["spectrum"] == len(told) - len(touches) > 100
    assert heard.unheard == {"touch": 0, "spectrum": 0}


def test_skip_unheard(play: Callable[[str], Run]) -> None:
    """With `skip.unheard` off every message is made, from the start or from a reload on."""
    told = play("circle").events(make())
    assert play("circle").events(make(lambda _topic: False, HEAR_ALL)) == told
    later = make(lambda _topic: False)
    later.configure(HEAR_ALL)
    assert play("circle").events(later) == told
