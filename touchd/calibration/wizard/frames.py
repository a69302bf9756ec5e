"""What the wizard takes of a daemon: untouched seconds, which a finger begins again, taps, and touches at crosses.

A tap is worth something if it is one steady fingertip, loud enough, where it should be; else it has a reason why not.
Touches at crosses that the page shows tell where the screen lies on the plate, as those of `touchd map` do.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.bridges.area import LEAST_TOUCHES, Crosses, Mapping, Touched, fit, keys_of
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.taps import FITS, Taps, turned
from touchd.client import Subscriber
from touchd.config.edit import set_keys
from touchd.config.load import load
from touchd.config.schema import InputSettings, Settings
from touchd.errors import BusError, BusTimeout, CalibrationError, OutputError, SourceError
from touchd.evaluation.dataset import complex_bins
from touchd.event import PlateEvent
from touchd.files import replacing
from touchd.frame import Frame
from touchd.localization.atlas import Atlas
from touchd.outcome import Outcome
from touchd.pipeline import Pipeline
from touchd.recording.data import Meta
from touchd.recording.format import write
from touchd.service.frame_feed import DaemonSource, open_daemon
from touchd.service.runner import frames_of
from touchd.sources.recorder import describe, recording_of
from touchd.training.field.place import place

TOUCHED_FRAMES = 3
"""As many touched frames in a row are a finger; fewer an impulse, which the fit leaves out."""
Progress = Callable[[float, str], object]
"""Receives the share that is done, and of what, or what holds it up."""
FINGER = "finger"
"""What holds it up: something is on the plate."""
LEAST_FRAMES, MOST_FRAMES = 10, 400
"""Refuse a shorter tap; of a longer one the last frames count."""
QUIET_FRAMES = 6
"""As many untouched frames end a tap."""
BASELINE_FRAMES = 16
LIGHT = 30.0
"""A tap has this many times the noise's energy, ..."""
LIGHTER = 0.05
"""... and this share of the median tap's."""
STEADY = 0.95
"""Least correlation between the tap's halves: a finger that moves by 2 mm has 0.8 (twin)."""
ALIKE = 2.0
"""Orientations that leave less than this multiple of the least are as likely: near the middle all are."""
BESIDE_MM = 12.0
"""Nobody misses a target by more."""
KEPT = 12
"""Frames of a tap that are kept."""
SILENT_S = 3.0
"""A daemon that runs says its health each second."""
_LOOK_S = 0.2
_TAKEN_S = 15.0
"""How long touchd-mapping.service may need."""


class Stopped(Exception):
    """The job was told to end."""


def open_feed(control: Path) -> DaemonSource:
    """Return the running daemon's frames; BusError without a daemon."""
    source = open_daemon(control)
    if source is None:
        raise BusError("no daemon runs there", str(control), "start it: systemctl start touchd")
    return source


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
    """Write frames that nobody touches to `path`; Stopped if `stop` was set, BusError if the daemon has ended."""
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


class Tapped(NamedTuple):
    """One tap."""

    reason: str
    """Why it does not count, as the page's texts name it: `short`, `clipped`, `light`, `unsteady`, `no_fit` or
    `beside`; empty of a good one."""
    frames: NDArray[np.int16]
    """Untouched frames, then touched ones, shape (n, channels, samples)."""
    touched: int
    """How many are touched."""
    found_mm: tuple[float, float] | None = None
    """Where the fitted plate says it was."""


class Tapper:
    """Finds taps in a daemon's frames, and judges them by a fitted plate."""

    def __init__(self, atlas: Atlas) -> None:
        d = atlas.description
        self._atlas, self._acquisition = atlas, d.acquisition
        self._to_bins = d.to_bins
        self._pipeline = Pipeline(d.acquisition, None, Settings())
        self._before: deque[NDArray[np.int16]] = deque(maxlen=BASELINE_FRAMES)
        self._touched: deque[NDArray[np.int16]] = deque(maxlen=MOST_FRAMES)
        self._quiet = 0
        self._energies: list[float] = []
        self.orientation: int | None = None
        """Of the drawing, one of `ORIENTATIONS`, once taps have told it: until then a tap may be any."""

    def feed(self, frame: Frame, label_mm: tuple[float, float]) -> Tapped | None:
        """Take a frame; return the tap that has just ended, at a target `label_mm`."""
        outcome = self._pipeline.process(frame).outcome
        if outcome is Outcome.UNCALIBRATED:
            self._touched.append(frame.counts.copy())
            self._quiet = 0
        elif outcome is Outcome.UNTOUCHED:
            self._quiet += 1
            if not self._touched:
                self._before.append(frame.counts.copy())
            elif self._quiet >= QUIET_FRAMES:
                touched, before = np.array(self._touched), np.array(self._before)
                self._touched.clear()
                return self._judge(before, touched, label_mm) if len(before) >= 4 else None
        return None

    def _judge(self, before: NDArray[np.int16], touched: NDArray[np.int16], label_mm: tuple[float, float]) -> Tapped:
        middle = touched[len(touched) // 4 : max(3 * len(touched) // 4, len(touched) // 4 + 1)]
        chosen = middle[np.linspace(0, len(middle) - 1, min(KEPT, len(middle))).astype(int)]
        made = Tapped("", np.concatenate([before, chosen]), len(chosen))
        if len(touched) < LEAST_FRAMES:
            return made._replace(reason="short")
        if (np.abs(chosen.astype(np.int32)) >= 2 ** (self._acquisition.bits - 1) - 2).any():
            return made._replace(reason="clipped")
        residual = chosen - before.mean(axis=0, dtype=np.float64)
        halves = [half.mean(axis=0).ravel() for half in np.array_split(residual, 2)]
        mean = residual.mean(axis=0)
        energy = float(np.square(mean).sum())
        noise = self._pipeline.detector.noise_counts() ** 2 * mean.size * (1 / len(chosen) + 1 / len(before))
        usual = float(np.median(self._energies)) if self._energies else 0.0
        if energy < LIGHT * noise or energy < LIGHTER * usual:
            return made._replace(reason="light")
        alike = float(halves[0] @ halves[1] / max(np.linalg.norm(halves[0]) * np.linalg.norm(halves[1]), 1e-30))
        if alike < STEADY:
            return made._replace(reason="unsteady")
        features = (mean @ self._to_bins).reshape(1, -1)
        taps = Taps(np.array([label_mm]), complex_bins(features, self._acquisition.channels))
        size_mm = self._atlas.description.plate.size_mm
        likely = range(4) if self.orientation is None else (self.orientation,)
        placed = [place(self._atlas, taps.values, turned(taps.label_mm, k, size_mm)) for k in likely]
        least = min(float(each.misfit[0]) for each in placed)
        if least > FITS:
            return made._replace(reason="no_fit")
        found = [turned(each.position_mm, k, size_mm)[0] for k, each in zip(likely, placed, strict=True)
                 if each.misfit[0] < ALIKE * least]  # fmt: skip
        x_mm, y_mm = min(found, key=lambda place_mm: float(np.hypot(*(place_mm - label_mm)))).tolist()
        made = made._replace(found_mm=(round(x_mm, 2), round(y_mm, 2)))
        if np.hypot(x_mm - label_mm[0], y_mm - label_mm[1]) > BESIDE_MM:
            return made._replace(reason="beside")
        self._energies.append(energy)
        return made


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
