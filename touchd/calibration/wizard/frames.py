"""What the wizard takes of a daemon: untouched seconds, which a finger begins again, and touches at crosses.

Touches at crosses that the page shows tell where the screen lies on the plate, as those of `touchd map` do.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from touchd.bridges.area import LEAST_TOUCHES, Crosses, Mapping, Touched, fit, keys_of
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.untouched import check_channels, check_chirp
from touchd.client import Subscriber
from touchd.config.edit import set_keys
from touchd.config.load import load
from touchd.config.schema import InputSettings, Settings
from touchd.errors import BusError, BusTimeout, CalibrationError, OutputError, SourceError
from touchd.event import PlateEvent
from touchd.files import replacing
from touchd.frame import Frame
from touchd.outcome import Outcome
from touchd.pipeline import Pipeline
from touchd.recording.data import Meta
from touchd.recording.format import write
from touchd.service.frame_feed import DaemonSource, open_daemon
from touchd.service.runner import frames_of
from touchd.sources.recorder import describe, recording_of

TOUCHED_FRAMES = 3
"""As many touched frames in a row are a finger; fewer an impulse, which the fit leaves out."""
Progress = Callable[[float, str], object]
"""Receives the share that is done, and of what, or what holds it up."""
FINGER = "finger"
"""What holds it up: something is on the plate."""
SILENT_S = 3.0
"""A daemon that runs says its health each second."""
HEALTH_S = 1.5
"""A running daemon is heard within this time: it publishes its health each second."""
_LOOK_S = 0.2
_TAKEN_S = 15.0
"""How long touchd-mapping.service may need."""


class Stopped(Exception):
    """The job was told to end."""


def open_feed(control: Path, bus: str | None, stop: threading.Event) -> DaemonSource:
    """Return the running daemon's frames.

    Raises Stopped if `stop` was set; BusError if no daemon listens at `control`: none runs, or one that publishes on
    `bus` has another control socket, or none.
    """
    source = open_daemon(control)
    if source is not None:
        return source
    if _publishes(bus, stop):
        if (source := open_daemon(control)) is not None:  # it started meanwhile
            return source
        raise BusError(
            "a daemon runs, but does not listen there", str(control),
            "set control.socket, the same for the daemon and touchd wizard, and start both again",
        )  # fmt: skip
    raise BusError("no daemon runs there", str(control), "start it: systemctl start touchd")


def _publishes(bus: str | None, stop: threading.Event) -> bool:
    """Return whether a daemon says its health on the bus; Stopped if `stop` was set."""
    until_s = time.monotonic() + HEALTH_S
    with contextlib.suppress(BusError), Subscriber(bus, "health", max_age_s=None) as events:
        while time.monotonic() < until_s:
            if stop.is_set():
                raise Stopped
            with contextlib.suppress(BusTimeout):
                events.receive(_LOOK_S)
                return True
    return False


def refuse_keypad(keypad: bool) -> None:
    """Raise CalibrationError on a keypad: what is tapped there may be a PIN, and nothing of it is to be kept."""
    if keypad:
        raise CalibrationError(
            "the plate is a keypad: its taps would tell the PIN, so none are taken", "keypad.layout",
            "while nobody types: comment it out, systemctl reload touchd, tap, and put it back",
        )  # fmt: skip


def frames_until(stop: threading.Event, source: DaemonSource, after: str) -> Iterator[Frame]:
    """Yield a daemon's frames; Stopped if `stop` was set, BusError if the daemon has ended: what comes `after` that."""
    frames = frames_of(source)
    while True:
        try:
            frame = next(frames)
        except SourceError as error:
            raise BusError("the daemon has ended", "", after) from error
        if stop.is_set():
            raise Stopped
        if frame is not None:
            yield frame


def meta_of(source: DaemonSource, said: PlateFile) -> Meta:
    """Return the description of a recording of a daemon's frames."""
    return describe(source.acquisition, said.described(), source.description.rate_hz, source="calibrate")


def take_untouched(
    source: DaemonSource, said: PlateFile, path: Path, seconds: float, stop: threading.Event, progress: Progress
) -> None:
    """Write frames that nobody touches to `path`.

    Raises Stopped if `stop` was set; BusError if the daemon has ended; PlateMismatch if no fit can follow: channels
    and receivers differ in number, or the chirp suits no plate.
    """
    check_chirp(source.acquisition, "the daemon's frames")
    check_channels(source.acquisition.channels, said, "the daemon's frames")
    pipeline = Pipeline(source.acquisition, None, Settings())
    wanted = max(round(seconds * source.description.rate_hz), 1)
    kept: list[Frame] = []
    touched = 0
    for frame in frames_until(stop, source, "the seconds begin again once it runs"):
        outcome = pipeline.process(frame).outcome
        touched = touched + 1 if outcome is Outcome.UNCALIBRATED else 0
        if touched >= TOUCHED_FRAMES:
            kept.clear()
            progress(0.0, FINGER)
            continue
        if kept and frame.sequence <= kept[-1].sequence:  # the device restarted
            kept.clear()
        kept.append(frame.copy())
        if len(kept) % 16 == 0:
            progress(len(kept) / wanted, "")
        if len(kept) == wanted:
            write(path, recording_of(meta_of(source, said), kept, kept[0].t_ns))
            return


def take_crosses(
    address: str | None, stop: threading.Event, due: Callable[[Any], object], silent_s: float = SILENT_S
) -> list[Touched]:
    """Take a touch at each cross; `due` is called with the next one, for the page.

    A step's `at` says None once the daemon has been silent for `silent_s`.

    Raises Stopped if `stop` was set; CalibrationError if the plate is a keypad.
    """
    crosses, shown, heard_s = Crosses(), None, time.monotonic()
    with Subscriber(address, ("touch", "plate", "health"), max_age_s=None) as events:
        while crosses.due:
            silent = time.monotonic() - heard_s > silent_s
            cross = {"number": len(crosses.taken) + 1, "of": LEAST_TOUCHES, "at": None if silent else crosses.due}
            if cross != shown:
                due(shown := cross)
            if stop.is_set():
                raise Stopped
            with contextlib.suppress(BusTimeout):
                event = events.receive(_LOOK_S)
                heard_s = time.monotonic()
                refuse_keypad(isinstance(event, PlateEvent) and bool(event.keys))
                crosses.feed(event)
    return crosses.taken


def keep(
    touched: Sequence[Touched], config: Path, handed: Path, *, writable: bool | None = None
) -> dict[str, Any] | None:
    """Fit the mapping, write it to the configuration, and return it as `shown` does.

    Where the configuration is root's, the touches are left at `handed`: touchd-mapping.service fits and writes them.

    Raises BridgeError if no mapping explains the touches; OutputError if nobody writes it.
    """
    mapping = fit(touched)
    if os.access(os.path.dirname(os.path.realpath(config)), os.W_OK) if writable is None else writable:
        set_keys(config, "input", keys_of(mapping))
    else:
        with replacing(handed) as file:
            file.write(json.dumps(touched).encode())
        _await(mapping, config, handed)
    return shown(load(config).input)


def shown(settings: InputSettings) -> dict[str, Any] | None:
    """Return where the screen lies, for the page; None where nobody knows."""
    if not settings.screen_mm:
        return None
    return {"screen_mm": list(settings.screen_mm), "rotate": settings.rotate, "residual_mm": settings.residual_mm}


def _await(mapping: Mapping, config: Path, handed: Path) -> None:
    until_s = time.monotonic() + _TAKEN_S
    while time.monotonic() < until_s:
        found = load(config if config.exists() else None).input
        if (tuple(found.screen_mm), found.rotate) == (mapping.screen_mm, mapping.rotate):
            return
        time.sleep(_LOOK_S)
    raise OutputError("nobody has written the mapping", str(config), f"as root: touchd map --from {handed}")
