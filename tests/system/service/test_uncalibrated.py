"""A daemon of a new plate: without a model at first, with one later, and back, in a process of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.command_line import touchd
from tests.processes import PATIENCE_S, ROOT, end, started, until
from touchd.cli.demo import SESSION
from touchd.client import Subscriber
from touchd.event import Event, HealthEvent, TouchEvent
from touchd.localization.model import default_model_path
from touchd.recording.format import read

SHIPPED = default_model_path()


def in_state(state: str, model: str) -> Callable[[Event], bool]:
    return lambda e: isinstance(e, HealthEvent) and (e.state, e.model) == (state, model)


def is_touch(event: Event) -> bool:
    return isinstance(event, TouchEvent)


def test_first_run(tmp_path: Path) -> None:
    """It starts uncalibrated and places nothing, hands its frames to `record`, takes a model that is installed, keeps
    it when another comes, and goes back, all in one life."""
    address = f"ipc://{tmp_path}/bus"
    variables = {
        "TOUCHD_CONTROL__SOCKET": str(tmp_path / "control"), "TOUCHD_HEALTH__PERIOD_S": "0.1",
        "TOUCHD_MODEL__PATH": str(tmp_path / "plate.onnx"),
    }  # fmt: skip
    options = ("--replay", SESSION, "--speed", "3", "--loop", "--bind", address, "--await-subscriber", PATIENCE_S)

    def model(*arguments: object) -> str:
        done = touchd("model", *arguments, cwd=ROOT, **variables)
        assert done.code == 0, done.err
        return done.out

    with (
        Subscriber(address, ("touch", "health"), timeout_s=PATIENCE_S, max_age_s=None) as events,
        started(*options, **variables) as daemon,
    ):
        heard = until(events, in_state("uncalibrated", ""))
        heard += until(events, lambda e: isinstance(e, HealthEvent) and e.skipped.get("uncalibrated", 0) > 20)
        assert not any(map(is_touch, heard))
        last = heard[-1]
        assert isinstance(last, HealthEvent)
        assert "touchd calibrate" in (last.reason or "")
        taken = tmp_path / "taken.npz"
        done = touchd("record", "-o", taken, "--frames", "100", cwd=ROOT, **variables)
        assert done.code == 0, done.err
        known = {frame.tobytes() for frame in read(SESSION).frames}
        frames = read(taken).frames
        assert len(frames) == 100
        assert all(frame.tobytes() in known for frame in np.asarray(frames))
        assert "the running daemon uses it" in model("install", SHIPPED)
        until(events, in_state("streaming", "best"))
        until(events, is_touch)
        model("install", SHIPPED.with_name("small.onnx"))
        until(events, in_state("streaming", "small"))
        model("rollback")
        until(events, in_state("streaming", "best"))
        until(events, is_touch)
        daemon.terminate()
        assert end(daemon).code == 0
    assert "no daemon runs there" in model("rollback")


def test_doctor(tmp_path: Path) -> None:
    """`doctor` says that there is no model and what makes one, and examines the frames nevertheless."""
    done = touchd(
        "doctor", "--replay", SESSION, TOUCHD_MODEL__PATH=str(tmp_path / "plate.onnx"),
        TOUCHD_BUS__BIND=f'["ipc://{tmp_path}/bus"]',
    )  # fmt: skip
    assert "uncalibrated" in done.out
    assert "touchd calibrate" in done.out
    assert "frames per second" in done.out
