"""The log says what happened, in a form that fits its reader, and can never hold a PIN."""

from __future__ import annotations

import io
import json
import os
import re
import select
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest
import structlog
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from touchd.config.schema import LogSettings
from touchd.detection.detector import OTHER_CHIRP
from touchd.frame import Frame
from touchd.service.daemon import log_notice
from touchd.service.log import PRIVATE, REDACTED, configure, redact


@pytest.fixture(autouse=True)
def _own_configuration() -> Iterator[None]:
    yield
    structlog.reset_defaults()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def logged(stream: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in stream.getvalue().splitlines()]


def test_without_a_terminal_each_event_is_one_line_of_json_in_utc() -> None:
    stream = io.StringIO()
    configure(LogSettings(), stream)
    structlog.get_logger().info("streaming", rate_hz=125)
    (line,) = logged(stream)
    assert (line["event"], line["level"], line["rate_hz"]) == ("streaming", "info", 125)
    assert line["timestamp"].endswith("Z")


def test_on_a_terminal_it_is_for_people() -> None:
    stream = Terminal()
    configure(LogSettings(), stream)
    structlog.get_logger().info("streaming", rate_hz=125)
    assert "streaming" in stream.getvalue()
    assert not stream.getvalue().startswith("{")


@pytest.mark.parametrize(
    ("variables", "coloured"),
    [({}, True), ({"NO_COLOR": "1"}, False), ({"NO_COLOR": ""}, True), ({"TERM": "dumb"}, False)],
)
def test_a_terminal_without_colours(variables: dict[str, str], coloured: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal that cannot show colours, or whose user wants none, gets plain text."""
    for name, value in ({"TERM": "xterm"} | variables).items():
        monkeypatch.setenv(name, value)
    if "NO_COLOR" not in variables:
        monkeypatch.delenv("NO_COLOR", raising=False)
    stream = Terminal()
    configure(LogSettings(), stream)
    structlog.get_logger().info("streaming", rate_hz=125)
    assert ("\x1b" in stream.getvalue()) == coloured
    assert "rate_hz" in stream.getvalue()


@pytest.mark.parametrize(("form", "json_"), [("console", False), ("json", True)])
def test_the_form_can_be_chosen(form: str, json_: bool) -> None:
    for stream in (Terminal(), io.StringIO()):
        configure(LogSettings.model_validate({"format": form}), stream)
        structlog.get_logger().info("streaming")
        assert stream.getvalue().startswith("{") == json_


def test_standard_error_is_where_it_goes(capsys: pytest.CaptureFixture[str]) -> None:
    configure(LogSettings())
    structlog.get_logger().warning("frames lost", lost=3)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert json.loads(captured.err)["lost"] == 3


@pytest.mark.parametrize(
    ("level", "seen"),
    [
        ("debug", ["debug", "info", "warning", "error"]),
        ("info", ["info", "warning", "error"]),
        ("warning", ["warning", "error"]),
        ("error", ["error"]),
    ],
)
def test_only_the_asked_for_levels_are_logged_even_by_loggers_made_before(level: str, seen: list[str]) -> None:
    early = structlog.get_logger()
    stream = io.StringIO()
    configure(LogSettings.model_validate({"level": level}), stream)
    for name in ("debug", "info", "warning", "error"):
        getattr(early, name)("hello")
    assert [line["level"] for line in logged(stream)] == seen


def test_a_disabled_call_touches_nothing_it_is_given() -> None:
    class Untouchable:
        def __getattribute__(self, name: str) -> Any:
            raise AssertionError("looked at")

    stream = io.StringIO()
    configure(LogSettings(level="info"), stream)
    log = structlog.get_logger().bind()
    log.debug("frame %s", Untouchable(), detail=Untouchable())
    assert stream.getvalue() == ""


def without_times(stream: io.StringIO) -> str:
    """What was logged, without its timestamps: their microseconds hold any digits."""
    return re.sub(r"\d{4}-\d\d-\d\dT[\d:.]+Z", "", stream.getvalue())


@pytest.mark.parametrize("name", sorted(PRIVATE))
@pytest.mark.parametrize("form", ["json", "console"])
def test_no_private_value_reaches_the_log_however_it_is_given(name: str, form: str) -> None:
    stream = io.StringIO()
    configure(LogSettings.model_validate({"format": form}), stream)
    structlog.get_logger().info("a", **{name: "7391"})
    structlog.get_logger().bind(**{name: "7391"}).info("b")
    structlog.get_logger().info("c", payload={"device": "door", name.upper(): "7391"}, deep=[{"a": ({name: 7391},)}])
    with structlog.contextvars.bound_contextvars(**{name: "7391"}):
        structlog.get_logger().info("d")
    assert "7391" not in without_times(stream)
    assert stream.getvalue().count(REDACTED) == 5


def test_objects_are_named_not_printed() -> None:
    @dataclass
    class Contact:
        x_mm: float = 7391.0

    class Pair(NamedTuple):
        counts: int = 7391

    stream, frame = io.StringIO(), Frame(np.full((1, 1), 7391, np.int16), 7391, 0, 0)
    configure(LogSettings(), stream)
    structlog.get_logger().info("odd", a=Contact(), b=Pair(), c=np.full(3, 7391), d=[frame], e=b"7391")
    (line,) = logged(stream)
    assert "7391" not in without_times(stream)
    named = {"a": "<Contact>", "b": "<Pair>", "c": "<ndarray>", "d": ["<Frame>"], "e": "<bytes>"}
    assert line | named == line


@pytest.mark.parametrize("form", ["json", "console"])
def test_a_traceback_never_shows_the_variables_it_went_through(form: str) -> None:
    stream = io.StringIO()
    configure(LogSettings.model_validate({"format": form}), stream)

    def fail(x_mm: int) -> None:
        raise RuntimeError(f"no model{'' if x_mm else '!'}")

    try:
        fail(int("73" + "91"))
    except RuntimeError:
        structlog.get_logger().exception("inference failed")
    assert "no model" in stream.getvalue()
    assert "7391" not in without_times(stream)


def test_what_is_harmless_is_kept() -> None:
    kept = {"event": "x", "exit_code": 3, "path": "a", "lost": 1, "none": None, "list": [1, "b"], "ok": True}
    assert redact(None, "info", dict(kept)) == kept
    assert redact(None, "info", {"lost": np.int64(3), "rms": np.float32(0.5)}) == {"lost": 3, "rms": 0.5}


def test_odd_keys_do_not_break_a_line() -> None:
    stream = io.StringIO()
    configure(LogSettings(), stream)
    structlog.get_logger().info("odd", by_reason={(1, 2): 3, None: 4, "pin": 5})
    (line,) = logged(stream)
    assert line["by_reason"] == {"(1, 2)": 3, "None": 4, "pin": REDACTED}


values = st.recursive(
    st.none() | st.integers() | st.text(max_size=4) | st.binary(max_size=2),
    lambda inner: (
        st.lists(inner, max_size=2) | st.dictionaries(st.sampled_from([*sorted(PRIVATE), "n"]), inner, max_size=2)
    ),
    max_leaves=8,
)


def holds_private(value: Any) -> bool:
    if isinstance(value, dict):
        return any((k in PRIVATE and v != REDACTED) or holds_private(v) for k, v in value.items())
    return isinstance(value, list) and any(map(holds_private, value))


@given(st.dictionaries(st.sampled_from([*sorted(PRIVATE), "payload"]), values))
def test_whatever_is_logged_nothing_private_is_left(event: dict[str, Any]) -> None:
    assert not holds_private(redact(None, "info", event))


def test_another_pane_is_a_warning_and_names_the_remedy() -> None:
    with capture_logs() as lines:
        log_notice(OTHER_CHIRP, {"frame": 510, "clocks_ppm": 20.0})
        log_notice("absorbed", {"frame": 600, "level_db": -30.0})
    assert [line["log_level"] for line in lines] == ["warning", "info"]
    assert "another pane" in lines[0]["event"]
    assert "clock" in lines[0]["fix"]
    assert lines[1]["reason"] == "absorbed"


def test_nobody_reads() -> None:
    """A pipe that is full holds nobody up: its lines are dropped, and later ones are there once it is read."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    with open(reader, "rb", 0) as log, open(writer, "w") as stream:
        configure(LogSettings(), stream)
        say = structlog.get_logger().info
        saying = threading.Thread(target=say, args=("dropped",), daemon=True)
        saying.start()
        saying.join(10)
        held_up = saying.is_alive()
        while not select.select([], [writer], [], 0)[1]:
            log.read(4096)
        say("written")
        stream.close()
        assert b"written" in (text := log.read().lstrip(b"\0"))
    assert not held_up
    assert b"dropped" not in text
