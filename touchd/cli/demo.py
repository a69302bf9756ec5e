"""`touchd demo`: replay a recording through daemon, bus and subscriber."""

from __future__ import annotations

import json
import math
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click
from msgspec.structs import asdict

from touchd.child import verb
from touchd.cli.listen import describe
from touchd.cli.options import PATH, parse_speed, warn_of_single_frames
from touchd.client import Subscriber
from touchd.errors import BusError, BusTimeout, RecordingValues
from touchd.evaluation.metrics import position_scores
from touchd.evaluation.replay_scores import score_stream
from touchd.event import Event, HealthEvent, TouchEvent
from touchd.localization.model import Model, default_model_path
from touchd.recording.format import read
from touchd.service.messages import latency_of

SESSION = Path(__file__).resolve().parent.parent / "demo" / "session.npz"
"""The recording that ships with touchd."""
_PATIENCE_S = 30
_LOOK_S = 0.5


@click.command()
@click.argument("recording", type=PATH, default=SESSION)
@click.option("--json", "as_json", is_flag=True, help="Print only the summary, as one JSON object.")
@click.option("--speed", default="1", callback=parse_speed, metavar="N|max", help="Speed of the replay.  [default: 1]")
@click.option("--model", type=PATH, help="Model (ONNX).  [default: shipped]")
def command(recording: Path, as_json: bool, speed: float, model: Path | None) -> None:
    """Replay RECORDING through the daemon, print the events that a subscriber receives, and summarise them.

    RECORDING (default: the shipped one) must be labelled with true contacts. Daemon and subscriber are separate
    processes.
    """
    truth = read(recording)
    if truth.contacts_mm is None:
        raise RecordingValues(
            "no true contacts to compare with", str(recording),
            "use a recording with contacts_mm, or replay it: touchd --replay FILE --print",
        )  # fmt: skip
    warn_of_single_frames(truth.meta)
    model = model or default_model_path()  # not one that `touchd model install` has put in its place
    Model(model).check(truth.acquisition)  # fails here with its own message and exit status
    events: list[Event] = []
    for event in _received(recording, speed, model):
        events.append(event)
        if not as_json:
            for line in describe(event):
                click.echo(line)
    touches = [event for event in events if isinstance(event, TouchEvent)]
    last = [event for event in events if isinstance(event, HealthEvent)][-1]
    scores = score_stream(truth, touches)
    latency_us = [event.latency_us for event in touches]
    summary: dict[str, Any] = {
        "frames": last.frames,
        "lost": last.lost,
        "touches": scores.touches,
        "found": scores.found,
        "missed": scores.missed,
        "ghosts": scores.ghosts,
        "split": scores.split,
        "rmse_mm": round(position_scores(scores.error_mm)["rmse_mm"], 3) if len(scores.error_mm) else None,
        "latency_us": asdict(latency_of(latency_us)) if latency_us else None,
        "inferred": last.inferred,
        "skipped": last.skipped,
    }
    click.echo(json.dumps(summary) if as_json else _table(summary, recording))


def _received(recording: Path, speed: float, model: Path) -> Iterator[Event]:
    """Run a daemon that replays `recording`, and yield what it publishes."""
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="touchd-demo-"))
        address = f"ipc://{folder}/bus"
        replay = verb("--replay", str(recording), "--bind", address, "--model", str(model))
        replay += ["--speed", "max" if speed == math.inf else str(speed), "--await-subscriber", str(_PATIENCE_S)]
        complaints = stack.enter_context(tempfile.TemporaryFile("w+"))
        # It runs this program, with file names as its only input.
        daemon = stack.enter_context(subprocess.Popen(replay, stderr=complaints, stdin=subprocess.DEVNULL))  # noqa: S603
        stack.callback(daemon.terminate)
        events = stack.enter_context(Subscriber(address, ("touch", "health"), max_age_s=None))
        deadline_s = time.monotonic() + _PATIENCE_S
        while daemon.poll() is None or not daemon.returncode:
            try:
                event = events.receive(_LOOK_S)
            except BusTimeout:
                if time.monotonic() < deadline_s:
                    continue
                raise
            yield event
            deadline_s = time.monotonic() + _PATIENCE_S
            if isinstance(event, HealthEvent) and event.state == "stopping":
                break
        if daemon.wait(_PATIENCE_S):
            complaints.seek(0)
            said = complaints.read().strip().splitlines() or ["no word"]
            raise BusError(f"the daemon ended with status {daemon.returncode}: {said[-1]}", fix="see the line above")


def _table(summary: dict[str, Any], recording: Path) -> str:
    latency_us = summary["latency_us"]
    rmse_mm = summary["rmse_mm"]
    skipped = ", ".join(f"{count} {reason}" for reason, count in summary["skipped"].items())
    lines = [
        ("recording", recording.name),
        ("frames", f"{summary['frames']}, {summary['lost']} lost"),
        ("touches", f"{summary['found']} of {summary['touches']} found, {summary['split']} split, "
         f"{summary['ghosts']} ghosts"),
        ("RMSE", "no contact" if rmse_mm is None else f"{rmse_mm:.2f} mm"),
        ("latency", "no message" if latency_us is None else
         f"p50 {latency_us['p50']:.0f} us, p99 {latency_us['p99']:.0f} us, max {latency_us['max']:.0f} us"),
        ("inferred", f"{summary['inferred']} frames"),
        ("skipped", f"{sum(summary['skipped'].values())} frames: {skipped}"),
    ]  # fmt: skip
    return "\n" + "\n".join(f"{name:10} {text}" for name, text in lines)
