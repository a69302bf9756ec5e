"""The map of the expected error believes taps near them, and the model elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from touchd.calibration.taps import Taps, taps_of, with_gains
from touchd.calibration.wizard.error_map import GRID, ErrorMap
from touchd.localization.atlas import Atlas
from touchd.recording.format import write
from touchd.training.field.place import place
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches


@pytest.fixture(scope="module")
def reference(instrument: Instrument, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Untouched frames."""
    path = tmp_path_factory.mktemp("reference") / "plate.untouched.npz"
    made = simulate_touches(10, seed=3, instrument=instrument)
    untouched = np.isnan(made.contacts_mm).all(axis=(1, 2)) if made.contacts_mm is not None else np.zeros(0, bool)
    frames = made.frames[untouched][:50]
    number = np.arange(len(frames))
    write(path, replace(made, frames=frames, sequence=number, timestamp_ns=number * 10**7, contacts_mm=None,
                        force_n=None, faces=None, temperature_c=None))  # fmt: skip
    return path


@pytest.fixture(scope="module")
def taps(instrument: Instrument, atlas: Atlas) -> Taps:
    return taps_of(simulate_touches(30, seed=7, instrument=instrument), atlas)


def wrong(atlas: Atlas) -> Atlas:
    """A field whose channels are off."""
    bins = np.linspace(-1, 1, len(atlas.description.bins))
    off = np.exp(1j * np.outer([0.5, -0.4, 0.3], bins**2)) * (1 + np.outer([0.2, -0.2, 0.1], bins))
    return with_gains(atlas, off)


def rms_mm(atlas: Atlas, taps: Taps) -> float:
    """How far taps are placed from where they were."""
    apart_mm = place(atlas, taps.values, taps.label_mm).position_mm - taps.label_mm
    return float(np.sqrt(np.square(apart_mm).sum(axis=1).mean()))


def test_right_field(atlas: Atlas, taps: Taps, reference: Path) -> None:
    """With taps as without, the map of a right field says how far touches are placed from where they are."""
    errors = ErrorMap(atlas, reference)
    for known in (None, taps):
        assert 0.5 < float(np.median(errors.error_mm(known))) / rms_mm(atlas, taps) < 2.0


def test_wrong_field(atlas: Atlas, taps: Taps, reference: Path) -> None:
    """A field that is wrong does not know it; ten taps tell, and thirty tell better."""
    model = wrong(atlas)
    errors, real_mm = ErrorMap(model, reference), rms_mm(model, taps)
    assert float(np.median(errors.error_mm(None))) < 0.3 * real_mm
    few, many = (
        float(np.median(errors.error_mm(Taps(taps.label_mm[:n], taps.values[:n])))) / real_mm for n in (10, 30)
    )
    assert 0.6 < few < many < 1.4


def test_near_and_far(atlas: Atlas, taps: Taps, reference: Path) -> None:
    """A tap counts near its place, and hardly far from it."""
    model = wrong(atlas)
    errors = ErrorMap(model, reference)
    grown = errors.error_mm(Taps(taps.label_mm[:1], taps.values[:1])) / errors.error_mm(None)
    p = model.description.plate
    column, row = (taps.label_mm[0] / (p.width_mm, p.height_mm) * GRID).astype(int)
    far = grown[GRID - 1 if row < GRID / 2 else 0, GRID - 1 if column < GRID / 2 else 0]
    assert grown[row, column] > 2.0
    assert far < 1.1


def test_nonsense(atlas: Atlas, taps: Taps, reference: Path) -> None:
    """A tap that no finger explains changes nothing."""
    random = np.random.default_rng(1)
    noise = np.abs(taps.values[:1]).mean() * random.standard_normal((1, *taps.values.shape[1:]))
    errors = ErrorMap(atlas, reference)
    assert errors.shown(Taps(taps.label_mm[:1], noise.astype(np.complex128))) == errors.shown(None)
