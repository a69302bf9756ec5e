"""Untouched seconds hold no frame from before a finger."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.unit.calibration.plates import PLATE
from touchd.calibration.wizard.frames import FINGER, take_untouched
from touchd.errors import PlateMismatch
from touchd.frame import Frame
from touchd.recording.format import read
from touchd.twin.electronics import Digitiser, Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact

RATE_HZ = 100
BEFORE, TOUCHED, AFTER = 60, 5, 150
WANTED = 80


def frames(instrument: Instrument) -> Iterator[Frame]:
    """Frames of a plate that is left alone, touched, and left alone."""
    untouched = instrument.untouched([REFERENCE_C])[0]
    change = instrument.change([[Contact(60.0, 40.0, 20.0, "silicone")]], [REFERENCE_C])[0]
    digitiser = Digitiser(Electronics(), instrument.acquisition, untouched, np.random.SeedSequence(3))
    for number in range(BEFORE + TOUCHED + AFTER):
        signal = untouched + (change if BEFORE <= number < BEFORE + TOUCHED else 0.0)
        counts = digitiser.counts(signal[None].copy(), np.array([number / RATE_HZ]))[0]
        yield Frame(counts, number, number * 10**9 // RATE_HZ, 0)


def said(receivers: int = 3) -> Any:
    """What was measured."""
    return SimpleNamespace(described=lambda: PLATE, discs=SimpleNamespace(receivers_mm=[(12.0, 12.0)] * receivers))


def test_another_number_of_receivers(instrument: Instrument, tmp_path: Path) -> None:
    """A receiver too many is said before the first frame is taken: the fit would say it after the seconds."""
    source = cast("Any", SimpleNamespace(acquisition=instrument.acquisition))
    with pytest.raises(PlateMismatch, match="3 channels, but 4 receivers"):
        take_untouched(source, said(4), tmp_path / "untouched.npz", 1.0, threading.Event(), lambda *_: None)


def test_finger(instrument: Instrument, tmp_path: Path) -> None:
    """A finger begins the seconds and their progress again: the recording has the frames after it, without a gap."""
    coming, told = frames(instrument), list[tuple[float, str]]()
    source = SimpleNamespace(
        read=lambda _timeout_s: next(coming), acquisition=instrument.acquisition,
        description=SimpleNamespace(rate_hz=float(RATE_HZ)),
    )  # fmt: skip
    path = tmp_path / "untouched.npz"
    take_untouched(
        cast("Any", source), said(), path, WANTED / RATE_HZ, threading.Event(),
        lambda share, note: told.append((share, note)),
    )  # fmt: skip
    found = read(path)
    assert found.sequence[0] >= BEFORE + TOUCHED
    assert np.diff(found.sequence).tolist() == [1] * (WANTED - 1)
    finger = told.index((0.0, FINGER))
    assert [share for share, _ in told[:finger]] == [16 / WANTED, 32 / WANTED, 48 / WANTED]
    assert told[-1] == (1.0, "")
