"""Taps at roughly known places tell what an untouched plate cannot, and make no model worse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.unit.calibration.plates import LAYOUT, PLATE, exact_fit
from touchd.calibration.place_correction import PlaceCorrection, Widths, with_places
from touchd.calibration.taps import (
    ORIENTATIONS,
    Taps,
    orientation_of,
    refine,
    taps_of,
    turned,
    turned_fit,
    with_gains,
)
from touchd.errors import CalibrationError
from touchd.localization.atlas import Atlas, load_atlas, save_atlas
from touchd.training.field.place import place
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

SIZE_MM = (PLATE.width_mm, PLATE.height_mm)


@pytest.fixture(scope="module")
def exact(instrument: Instrument, atlas: Atlas) -> Taps:
    """Sixty taps with their true places."""
    return taps_of(simulate_touches(60, seed=7, instrument=instrument), atlas)


def roughly(taps: Taps, error_mm: float) -> Taps:
    """The same taps as a person labels them."""
    return replace(taps, label_mm=taps.label_mm + error_mm * np.random.default_rng(1).standard_normal((60, 2)))


def median_mm(atlas: Atlas, taps: Taps) -> float:
    found = place(atlas, taps.values, taps.label_mm).position_mm
    return float(np.median(np.linalg.norm(found - taps.label_mm, axis=1)))


def test_orientation(atlas: Atlas, exact: Taps) -> None:
    """Three taps tell which way a drawing is turned, whatever the labels' error."""
    for orientation in range(len(ORIENTATIONS)):
        rough = roughly(exact, 2.0)
        some = Taps(turned(rough.label_mm, orientation, SIZE_MM)[:3], rough.values[:3])
        assert orientation_of(atlas, some) == orientation, ORIENTATIONS[orientation]


def test_turned_drawing(instrument: Instrument) -> None:
    """A fit whose drawing is turned has its discs turned, and says how."""
    fit = exact_fit(instrument)
    mirrored = turned_fit(fit, 1)
    assert mirrored.layout.emitter_mm == (SIZE_MM[0] - LAYOUT.emitter_mm[0], LAYOUT.emitter_mm[1])
    assert "mirrored left to right" in mirrored.reasons[0]
    assert turned_fit(fit, 0).reasons == fit.reasons


def test_scatter(atlas: Atlas, exact: Taps) -> None:
    """The scatter is the labels' error per axis."""
    for error_mm in (0.5, 1.5):
        rough = roughly(exact, error_mm)
        drawn_mm = np.sqrt(np.square(rough.label_mm - exact.label_mm).mean())
        refined = refine(atlas, rough)
        assert refined.scatter_mm == pytest.approx(drawn_mm, rel=0.1)
        assert refined.used == 60


def test_wrong_gains(atlas: Atlas, exact: Taps) -> None:
    """Taps mend a field whose channels are off, by a third and more."""
    bins = np.linspace(-1, 1, len(atlas.description.bins))
    off = np.exp(1j * np.outer([0.5, -0.4, 0.3], bins**2)) * (1 + np.outer([0.2, -0.2, 0.1], bins))
    wrong = with_gains(atlas, off)
    refined = refine(wrong, roughly(exact, 1.0))
    assert refined.unexplained[1] < refined.unexplained[0]
    assert median_mm(refined.atlas, exact) < 0.67 * median_mm(wrong, exact)


def test_never_worse(atlas: Atlas, exact: Taps) -> None:
    """Where the physics are right, 20 or 60 taps with any error change nothing for the worse."""
    for count, error_mm in ((20, 1.0), (60, 2.0)):
        rough = roughly(exact, error_mm)
        refined = refine(atlas, Taps(rough.label_mm[:count], rough.values[:count]))
        assert median_mm(refined.atlas, exact) < 1.02 * median_mm(atlas, exact)


@pytest.mark.parametrize("error_mm", [1.0, 2.0])
def test_wrong_places(atlas: Atlas, exact: Taps, tmp_path: Path, error_mm: float) -> None:
    """Where a clamp leaves all places uncertain, taps bring them nearer by a third and more, in the file too."""
    off = np.zeros(12)
    off[0] = 0.9
    wrong = with_places(atlas, PlaceCorrection(SIZE_MM, off, 1.0))
    assert median_mm(wrong, exact) == pytest.approx(0.9, abs=0.05)
    refined = refine(wrong, roughly(exact, error_mm), 0, Widths((0.7, 0.02), 0.0, 0.02))
    save_atlas(refined.atlas, tmp_path / "plate.atlas.npz")
    assert median_mm(load_atlas(tmp_path / "plate.atlas.npz"), exact) < 0.67 * median_mm(wrong, exact)
    assert refined.scatter_mm == pytest.approx(error_mm, rel=0.3)


def test_wrong_ruler(atlas: Atlas, exact: Taps) -> None:
    """The factor that all places share is found as far as the labels tell it, and the plate becomes larger by it."""
    ruler = np.zeros(12)
    ruler[2] = -0.005
    short = with_places(atlas, PlaceCorrection(SIZE_MM, ruler, 1.0))
    assert short.description.plate.width_mm == pytest.approx(0.995 * SIZE_MM[0])
    refined = refine(short, roughly(exact, 1.0), 0, Widths((0.02, 0.02), 0.003, 0.02))
    assert median_mm(refined.atlas, exact) < 0.67 * median_mm(short, exact)
    assert refined.atlas.description.plate.width_mm == pytest.approx(SIZE_MM[0], abs=0.67 * 0.005 * SIZE_MM[0])


def test_right_places(atlas: Atlas, exact: Taps) -> None:
    """Where the physics are right and the ruler too, no place moves."""
    for count, error_mm in ((20, 1.0), (60, 1.0), (60, 2.0)):
        rough = roughly(exact, error_mm)
        refined = refine(atlas, Taps(rough.label_mm[:count], rough.values[:count]), 0, Widths((0.02, 0.02), 5e-4, 0.02))
        assert refined.moved_mm == 0, (count, error_mm)


def test_no_taps(atlas: Atlas, exact: Taps) -> None:
    """What is no touch of this plate fits nowhere, and is refused."""
    noise = np.random.default_rng(2).standard_normal((2, *exact.values.shape))
    with pytest.raises(CalibrationError, match="no tap fits"):
        refine(atlas, Taps(exact.label_mm, noise[0] + 1j * noise[1]))
