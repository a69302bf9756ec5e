"""Checks of `touchd doctor` on this computer: clock, the DAQ's entries in sysfs, frames of the source, their cost."""

from __future__ import annotations

import ctypes
import grp
import math
import os
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchd.bridges.screen import read
from touchd.config.schema import DeviceSettings
from touchd.doctor.checks import Finding, Sample, noise_counts
from touchd.errors import RecordingValues, SourceError
from touchd.frame import Counts, Frame
from touchd.localization.atlas import Atlas
from touchd.localization.model import Model
from touchd.localization.spline import Spline
from touchd.pipeline import Pipeline
from touchd.recording.format import Reader
from touchd.service.runner import frames_of
from touchd.sources.source import Change, Source
from touchd.sources.usb_protocol import INTERFACE_CLASS

SYSTEM = Path("/")
_INTERFACE, _ENDPOINT = 4, 5  # descriptor types, USB 2.0 table 9-5
_BULK_IN = (0x80, 0x02)
_HIGH_SPEED_MBIT_S = 480.0
_SILENCE_S = 5.0
"""Longest wait for a device's next frame."""
_CABLE = "check cable and power, and stop the daemon if it runs"
_REFERENCE_FRAMES = 256
_TAPS, _UNTOUCHED, _TOUCHED = 10, 10, 50
"""Taps to time, and their frames."""
_FIRM = 0.05
"""A firm finger's share of the signal."""
_UNSYNCHRONISED = 5  # adjtimex(2): TIME_ERROR
_EARLIEST_S = 1735689600  # 2025: without a clock battery a computer starts in 1970


def check_clock() -> Finding:
    """Check that the system clock is synchronised; only the messages' `wall` time depends on it."""
    timex = (ctypes.c_char * 512)()  # struct timex; zeros read the state without changing it
    state = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    return judge_clock(state, time.time())


def judge_clock(state: int, now_s: float) -> Finding:
    """Judge the result of adjtimex(2) and the UTC time in seconds."""
    if now_s < _EARLIEST_S:
        return Finding("clock", "failure", "this computer's clock is not set", "set it: timedatectl set-ntp true")
    if state in (_UNSYNCHRONISED, -1):
        text = "this computer's clock follows no time server: `wall` in messages may be off"
        return Finding("clock", "warning", text, "timedatectl set-ntp true; touches do not depend on it")
    return Finding("clock", "ok", "this computer's clock follows a time server")


def examine(settings: DeviceSettings, system: Path = SYSTEM) -> list[Finding]:
    """Check the DAQ by /sys and /dev below `system`, without opening it; the last finding fails if it is unusable."""
    ids = f"{settings.vendor_id:04x}:{settings.product_id:04x}"
    devices = sorted((system / "sys/bus/usb/devices").glob("*"))
    found = [device for device in devices if f"{read(device / 'idVendor')}:{read(device / 'idProduct')}" == ids]
    if not found:
        return [Finding("device", "failure", f"no device with the ids {ids} is plugged in",
                        "plug it in; check its cable and power; compare device.vendor_id and device.product_id with "
                        "lsusb")]  # fmt: skip
    if settings.serial:
        serials = [read(device / "serial") for device in found]
        found = [device for device in found if read(device / "serial") == settings.serial]
        if not found:
            return [Finding("device", "failure", f"{ids} has serial number {', '.join(map(repr, serials))}, "
                            f"not {settings.serial!r}", "correct device.serial")]  # fmt: skip
    device = found[0]
    bus, address = (read(device / number).zfill(3) for number in ("busnum", "devnum"))
    name = " ".join(filter(None, (read(device / "product"), read(device / "serial"))))
    name = "".join(c if c.isprintable() else "?" for c in name)  # a device may say anything to a terminal
    text = f"{ids} {name} on bus {bus} address {address}"
    several = f"; {len(found)} such devices, touchd uses the first" if len(found) > 1 else ""
    findings = [
        Finding("device", "warning", text + several, "set device.serial") if several else Finding("device", "ok", text),
        check_permissions(system / f"dev/bus/usb/{bus}/{address}"),
    ]
    try:
        findings.append(check_descriptors((device / "descriptors").read_bytes(), read(device / "speed")))
    except OSError as error:
        findings.append(Finding("descriptors", "failure", f"cannot be read ({error.strerror})", "plug it in again"))
    return findings


def check_permissions(node: Path) -> Finding:
    """Check that this user may open the device node."""
    try:
        status = node.stat()
    except OSError as error:
        return Finding("permissions", "failure", f"{node}: {error.strerror}", "plug it in again")
    try:
        group = grp.getgrgid(status.st_gid).gr_name
    except KeyError:
        group = str(status.st_gid)
    text = f"{node} is of group {group}, mode {status.st_mode & 0o777:04o}"
    if os.access(node, os.R_OK | os.W_OK):
        return Finding("permissions", "ok", text)
    if group == "root":
        return Finding("permissions", "failure", f"{text}: you may not open it",
                       "install 60-touchd.rules, with these ids, and plug the device in again")  # fmt: skip
    return Finding(
        "permissions", "failure", f"{text}: you may not open it", f"join its group: usermod -aG {group} USER"
    )


def check_descriptors(descriptors: bytes, speed_mbit_s: str) -> Finding:
    """Find touchd's interface and its bulk IN endpoint in the device's descriptors."""
    here, found = False, False
    at = 0
    while at + 2 <= len(descriptors) and descriptors[at] >= 2:
        length, kind = descriptors[at], descriptors[at + 1]
        fields = descriptors[at : at + length]
        if kind == _INTERFACE and len(fields) >= 9:
            here = tuple(fields[5:8]) == INTERFACE_CLASS
        elif kind == _ENDPOINT and len(fields) >= 7:
            found |= here and (fields[2] & 0x80, fields[3] & 0x03) == _BULK_IN
        at += length
    if not found:
        return Finding("descriptors", "failure", "no interface of touchd's protocol with a bulk endpoint to the host",
                       "install firmware for protocol 1 on the DAQ: docs/usb-protocol.md")  # fmt: skip
    speed = float(speed_mbit_s) if speed_mbit_s.replace(".", "", 1).isdecimal() else 0.0
    text = f"interface of protocol 1, at {speed:g} Mbit/s"
    if speed < _HIGH_SPEED_MBIT_S:
        fix = "use a cable and a port for USB 2 (480 Mbit/s): 12 Mbit/s carry some 400 frames per second"
        return Finding("descriptors", "warning", text, fix)
    return Finding("descriptors", "ok", text)


def take(source: Source, seconds: float) -> Sample:
    """Read frames until their times span `seconds`, or until a recording or a scene ends.

    Raises SourceError if fewer than two frames arrived, or if the source fell silent or failed.
    """
    counts: list[Counts] = []
    sequence: list[int] = []
    t_ns: list[int] = []
    reason = "no frame came"

    def note(change: Change) -> None:
        nonlocal reason
        reason = change.reason

    deadline_s = time.monotonic() + _SILENCE_S
    for frame in frames_of(source, on_change=note):
        if frame is not None:
            counts.append(frame.counts.copy())
            sequence.append(frame.sequence)
            t_ns.append(frame.t_ns)
            deadline_s = time.monotonic() + _SILENCE_S
            if frame.t_ns - t_ns[0] >= seconds * 1e9:
                break
        elif time.monotonic() > deadline_s:
            raise SourceError(f"{reason}, for {_SILENCE_S:g} s", "source", _CABLE)
    if len(t_ns) < 2:
        raise SourceError(reason, "source", _CABLE)
    corrupt = source.tally.corrupt if source.tally else 0
    return Sample(source.acquisition, np.array(counts), np.array(sequence, np.int64), np.array(t_ns, np.int64), corrupt)


def untouched(path: Path, model: Model) -> NDArray[np.float64]:
    """Return the mean untouched frame of a recording, of shape (channels, samples), ADC counts.

    Raises RecordingError if the recording is unreadable, or has no untouched frame; ModelMismatch if recording and
    model differ in their acquisition.
    """
    reader = Reader(path)
    model.check(reader.acquisition)
    total, count = np.zeros(reader.acquisition.shape), 0
    for chunk in reader:
        free = slice(None) if chunk.contacts_mm is None else np.isnan(chunk.contacts_mm[..., 0]).all(axis=1)
        frames = chunk.frames[free][: _REFERENCE_FRAMES - count]
        total += frames.sum(axis=0, dtype=np.float64)
        count += len(frames)
        if count == _REFERENCE_FRAMES:
            break
    if not count:
        raise RecordingValues("no frame of the untouched plate", str(path), "record the plate without a finger")
    return total / count


def time_frames(sample: Sample, pipeline: Pipeline, learn_frames: int, rate_hz: float) -> list[float]:
    """Return the computing time of each of 500 frames of a finger that taps and moves, through all stages, us.

    The sample gives the untouched plate and its noise, the pipeline's model the finger.
    """
    model, plain, rng, spent_us = pipeline.model, sample.untouched, np.random.default_rng(0), []
    noise = np.maximum(noise_counts(sample), 0.5)[:, None]
    finger = _finger(plain, model.atlas if model else None)
    for i in range(-learn_frames, _TAPS * (_UNTOUCHED + _TOUCHED)):
        touched = i >= 0 and i % (_UNTOUCHED + _TOUCHED) >= _UNTOUCHED
        counts = plain + noise * rng.standard_normal(plain.shape)
        counts = np.rint(counts + next(finger) if touched else counts).clip(-(2**15), 2**15 - 1)
        frame = Frame(counts.astype(np.int16), i, t_ns := round((learn_frames + i) / rate_hz * 1e9), t_ns)
        begin_ns = time.perf_counter_ns()
        pipeline.process(frame)
        if touched:
            spent_us.append((time.perf_counter_ns() - begin_ns) * 1e-3)
    return spent_us


def _finger(untouched: NDArray[np.float64], atlas: Atlas | None) -> Iterator[NDArray[np.float64]]:
    """Yield what a finger adds to frame after frame as it moves; to a network alone any change is as dear."""
    heard = untouched - untouched.mean(axis=1, keepdims=True)
    if atlas is not None:
        d, field = atlas.description, np.zeros((3, atlas.size), atlas.coefficients.dtype)
        spline, to_samples = Spline(atlas, field), np.linalg.pinv(d.to_bins)
    for i in count():
        change = np.roll(heard, 2 + i % 3, axis=1)
        if atlas is not None:
            x_mm, y_mm = (low + (high - low) * (0.5 + 0.4 * math.sin(rate * i))
                          for low, high, rate in zip(d.low_mm, d.high_mm, (0.02, 0.03), strict=True))  # fmt: skip
            spline.at(x_mm, y_mm)
            change = field[0].reshape(2, len(heard), -1).swapaxes(0, 1).reshape(len(heard), -1) @ to_samples
        yield _FIRM * np.linalg.norm(heard) / max(float(np.linalg.norm(change)), 1e-9) * change
