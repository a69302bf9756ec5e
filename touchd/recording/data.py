"""A recording in memory: frames, true contacts, and a description of the rig; and what of it must hold."""

from __future__ import annotations

import re
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from touchd.errors import RecordingShape, RecordingValues
from touchd.frame import MAX_CHANNELS, MAX_RATE_HZ, MAX_SAMPLES, Acquisition, Chirp, Description, Plate

ARRAYS: dict[str, tuple[type[np.generic], str]] = {
    "frames": (np.int16, "(n, channels, samples)"),
    "sequence": (np.int64, "(n,)"),
    "timestamp_ns": (np.int64, "(n,)"),
    "contacts_mm": (np.float32, "(n, k, 2)"),
    "force_n": (np.float32, "(n, k)"),
    "faces": (np.float32, "(n, k, 3)"),
    "temperature_c": (np.float32, "(n,)"),
}
"""Type and shape of each key: n frames of (channels, samples), k contacts."""
REQUIRED = ("frames", "sequence", "timestamp_ns")
MAX_COUNT = 1 << 62
"""Of a counter or a time: what is added to it in a replay does not overflow."""
MAX_VALUE = 1e6
"""Of a position, force or temperature; a larger one is a mistake, and overflows when it is squared."""
_SEE = "see docs/formats.md"


class Device(Description):
    """The DAQ that took a recording."""

    serial: str = ""
    firmware: str = ""


class Act(Description):
    """What a person was asked to do, and the frames in which it was done."""

    name: str
    """`untouched`, `tap`, `stroke`, `palm` or `thumb`."""
    begin: int = Field(ge=0)
    """The first frame."""
    end: int = Field(ge=0)
    """The frame after the last one."""
    places_mm: tuple[tuple[float, float], ...] = ()
    """The place that was told; of a stroke, both ends."""
    uncertainty_mm: float | None = None
    """Standard deviation per axis of where the person really was; of a stroke, across it."""


class Meta(Description):
    """The JSON object of a recording's `meta` key."""

    sample_rate_hz: float = Field(ge=1, le=MAX_RATE_HZ)
    bits: int = Field(ge=2, le=16)
    full_scale_v: float = Field(ge=1e-9, le=1e6)
    frame_rate_hz: float = Field(ge=1e-6, le=1e6)
    plate: Plate
    chirp: Chirp = Chirp()
    emitter_mm: tuple[float, float] | None = None
    receivers_mm: tuple[tuple[float, float], ...] | None = None
    source: str = ""
    device: Device = Device()
    created: str = ""
    notes: str = ""
    acts: tuple[Act, ...] = ()
    """Of `touchd record --label`, in order."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A whole recording in memory, or one chunk of it: n frames, k contacts."""

    meta: Meta
    frames: NDArray[np.int16]
    """ADC counts of shape (n, channels, samples)."""
    sequence: NDArray[np.int64]
    """The device's frame counter, shape (n,)."""
    timestamp_ns: NDArray[np.int64]
    """Start of the chirp since the first frame, shape (n,), ns."""
    contacts_mm: NDArray[np.float32] | None = None
    """True positions of shape (n, k, 2), NaN where finger k does not touch."""
    force_n: NDArray[np.float32] | None = None
    """True force of shape (n, k), NaN where unknown or not touching."""
    faces: NDArray[np.float32] | None = None
    """True long and short axis (mm, from end to end) of each contact's face, and its direction (degrees from +x towards
    +y), shape (n, k, 3), NaN where unknown or not touching."""
    temperature_c: NDArray[np.float32] | None = None
    """Shape (n,)."""

    def during(self, *names: str) -> NDArray[np.bool_]:
        """Return which frames belong to acts of these names, shape (n,)."""
        found = np.zeros(len(self.sequence), np.bool_)
        for act in self.meta.acts:
            if act.name in names:
                found[act.begin : act.end] = True
        return found

    @property
    def acquisition(self) -> Acquisition:
        """The geometry of the frames."""
        _, channels, samples = self.frames.shape
        m = self.meta
        return Acquisition(
            channels=channels, samples=samples, sample_rate_hz=m.sample_rate_hz, bits=m.bits,
            full_scale_v=m.full_scale_v, chirp=m.chirp,
        )  # fmt: skip


def check(recording: Recording, where: str = "recording") -> None:
    """Raise if a recording breaks the format. `where` names it in the error.

    Raises RecordingShape if an array has the wrong type or shape; RecordingValues if counters or times do not increase,
    or a number is NaN or infinite where it must not be.
    """
    _check_shapes(recording, where)
    for name in ("sequence", "timestamp_ns"):
        values = getattr(recording, name)
        # A comparison: the difference of two int64 can overflow.
        stuck = np.flatnonzero(values[1:] <= values[:-1])
        if stuck.size:
            i = int(stuck[0])
            raise RecordingValues(
                f"must increase from frame to frame, but frame {i + 1} has {values[i + 1]} after {values[i]}",
                f"{where}: {name}", "drop the repeated frames, or sort them",
            )  # fmt: skip
        for value in (values[0], values[-1]):
            if abs(int(value)) > MAX_COUNT:
                raise RecordingValues(f"is {value}, beyond 2^62", f"{where}: {name}", "count from the first frame")
    if recording.timestamp_ns[0] < 0:
        raise RecordingValues(
            f"is negative: {recording.timestamp_ns[0]}", f"{where}: timestamp_ns", "count from the first frame"
        )
    for name, allow_nan in (("contacts_mm", True), ("force_n", True), ("faces", True), ("temperature_c", False)):
        values = getattr(recording, name)
        bad = None if values is None else np.isinf(values) if allow_nan else ~np.isfinite(values)
        if bad is not None and bad.any():
            i = int(np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))[0])
            kind = "infinite" if allow_nan else "not a finite number"
            fix = "write NaN where the truth is unknown" if allow_nan else "leave the key out where it is unknown"
            raise RecordingValues(f"is {kind} in frame {i}", f"{where}: {name}", fix)
        if values is not None and values.size and (largest := np.nanmax(np.abs(values), initial=0.0)) > MAX_VALUE:
            raise RecordingValues(f"is {largest:g} in a frame", f"{where}: {name}", "write it in the unit of its name")
    if recording.contacts_mm is not None:
        nan = np.isnan(recording.contacts_mm)
        half = np.argwhere(nan[..., 0] != nan[..., 1])
        if half.size:
            raise RecordingValues(
                f"has x without y, or y without x, for contact {half[0][1]} in frame {half[0][0]}",
                f"{where}: contacts_mm", "write both coordinates, or NaN for both",
            )  # fmt: skip


def _check_shapes(recording: Recording, where: str) -> None:
    sizes: dict[str, int] = {"2": 2, "3": 3}
    origin: dict[str, str] = {}
    for name, (dtype, shape) in ARRAYS.items():
        array = getattr(recording, name)
        if array is None and name not in REQUIRED:
            continue
        at = f"{where}: {name}"
        if not isinstance(array, np.ndarray) or array.dtype != dtype:
            found = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
            raise RecordingShape(f"is {found}, must be {np.dtype(dtype)}", at, f"convert it to {np.dtype(dtype)}")
        axes = re.findall(r"\w+", shape)
        if array.ndim != len(axes):
            raise RecordingShape(f"has shape {array.shape}, must be {shape}", at, _SEE)
        for axis, size in zip(axes, array.shape, strict=True):
            expected = sizes.setdefault(axis, size)
            first = origin.setdefault(axis, f"{name} has shape {array.shape}")
            if size != expected:
                raise RecordingShape(f"has shape {array.shape}, must be {shape}, but {first}", at, _SEE)
        if name == "frames" and array.size == 0:
            raise RecordingShape(f"has shape {array.shape}: no frames", at, "record again, for longer")
        if name == "frames" and not (array.shape[1] <= MAX_CHANNELS and array.shape[2] <= MAX_SAMPLES):
            most = f"{MAX_CHANNELS} channels of {MAX_SAMPLES} samples"
            raise RecordingShape(f"has shape {array.shape}: more than {most}", at, _SEE)
    receivers = recording.meta.receivers_mm
    if receivers is not None and len(receivers) != sizes["channels"]:
        raise RecordingShape(
            f"names {len(receivers)} receivers, but frames has shape {recording.frames.shape}: "
            f"{sizes['channels']} channels", f"{where}: meta.receivers_mm", "name one receiver for each channel",
        )  # fmt: skip


def check_continues(before: Recording, before_path: Path, chunk: Recording, path: Path) -> None:
    """Raise if a chunk cannot follow the one before it: another rig, other keys, or an earlier time."""
    where = f"{path}, after {before_path.name}"
    fix = "keep the chunks of different recordings in different folders"
    for part in ("acquisition", "meta.plate", "meta.emitter_mm", "meta.receivers_mm"):
        old, new = attrgetter(part)(before), attrgetter(part)(chunk)
        if old != new:
            raise RecordingShape(f"{part.removeprefix('meta.')} changes from {old} to {new}", where, fix)
    for name in ARRAYS:
        was, now = (_shape_of_one(getattr(recording, name)) for recording in (before, chunk))
        if was != now:
            raise RecordingShape(f"{name} changes from {was} to {now}", where, fix)
    for name in ("sequence", "timestamp_ns"):
        old_last, new_first = getattr(before, name)[-1], getattr(chunk, name)[0]
        if new_first <= old_last:
            raise RecordingValues(f"{name} goes back from {old_last} to {new_first}", where, fix)


def _shape_of_one(array: NDArray[Any] | None) -> str:
    return "absent" if array is None else f"shape ({', '.join(['n', *map(str, array.shape[1:])])})"
