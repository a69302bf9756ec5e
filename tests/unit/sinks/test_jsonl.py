"""Events as lines."""

from __future__ import annotations

import io
import json
import os

from touchd.event import KeyEvent, SpectrumEvent, TouchEvent
from touchd.sinks.sink import JsonlSink

TOUCH = TouchEvent("plate", 1, 0, "2025-01-01T00:00:00.000000Z", 9, [])
KEY = KeyEvent("plate", 1, 0, "2025-01-01T00:00:00.000000Z", "7", "press", 0.9)


def test_each_event_is_one_line_and_a_touch_says_how_late_it_is() -> None:
    stream = io.StringIO()
    sink = JsonlSink(stream, clock=lambda: 42_000)
    sink.publish(TOUCH, received_ns=0)
    sink.publish(KEY, received_ns=0)
    sink.close()
    touch, key = (json.loads(line) for line in stream.getvalue().splitlines())
    assert (touch["type"], touch["frame"], touch["latency_us"]) == ("touch", 9, 42.0)
    assert (key["type"], key["key"]) == ("key", "7")
    assert not stream.closed


def test_a_spectrum_is_not_written() -> None:
    stream = io.StringIO()
    sink = JsonlSink(stream)
    sink.publish(SpectrumEvent("plate", 1, 0, "", 1, [1.0]), received_ns=0)
    assert stream.getvalue() == ""
    assert sink.wants("touch")
    assert not sink.wants("spectrum")


def test_a_reader_that_has_gone_stops_the_lines_and_nothing_else() -> None:
    reader, writer = os.pipe()
    with os.fdopen(writer, "w", buffering=1) as stream:
        sink = JsonlSink(stream)
        os.close(reader)
        sink.publish(TOUCH, received_ns=0)
        sink.publish(TOUCH, received_ns=0)
        assert not sink.wants("touch")
        # The line that never got out fails once more on closing, for whoever opened the stream.
        os.dup2(os.open(os.devnull, os.O_WRONLY), writer)
