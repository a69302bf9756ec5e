"""Taps at roughly known places tell what an untouched plate cannot, and make no model worse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.unit.calibration.plates import LAYOUT, PLATE, basis_of, elastic, exact_fit
from touchd.calibration.physical_atlas import make_physical_atlas
from touchd.calibration.place_correction import PlaceCorrection, Widths, correction_of, with_places
from touchd.calibration.taps import (
    ORIENTATIONS,
    Taps,
    orientation_of,
    refine,
    taps_of,
    turned,
    turned_back,
    turned_fit,
)
from touchd.errors import CalibrationError
from touchd.frame import Plate
from touchd.localization.atlas import Atlas, load_atlas, save_atlas
from touchd.training.field.place import place
from touchd.twin.instrument import Instrument
from touchd.twin.physics.transducer import Layout, Scatterer
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
    for orientation in range(4):
        rough = roughly(exact, 2.0)
        some = Taps(turned(rough.label_mm, orientation, SIZE_MM)[:3], rough.values[:3])
        assert orientation_of(atlas, some) == orientation, ORIENTATIONS[orientation]


def test_turned_drawing(instrument: Instrument) -> None:
    """A fit whose drawing is turned has its discs turned, and says how."""
    fit = exact_fit(instrument)
    mirrored = turned_fit(fit, 1)
    assert mirrored.layout.emitter_mm == (SIZE_MM[0] - LAYOUT.emitter_mm[0], LAYOUT.emitter_mm[1])
    assert "mirrored left to right" in mirrored.reasons[0]
    hole = Scatterer(at_mm=(30.0, 20.0), diameter_mm=8.0, mass_g=-1.0)
    carrying = replace(fit, layout=fit.layout.model_copy(update={"scatterers": (hole,)}))
    assert turned_fit(carrying, 2).layout.scatterers[0].at_mm == (30.0, SIZE_MM[1] - 20.0)
    assert turned_fit(fit, 0).reasons == fit.reasons


SQUARE = Plate(width_mm=70, height_mm=71, thickness_mm=5)
SQUARE_LAYOUT = Layout(emitter_mm=(20, 40), receivers_mm=((12, 12), (58, 15), (50, 60)))


@pytest.fixture(scope="module")
def square() -> Instrument:
    return Instrument(SQUARE, layout=SQUARE_LAYOUT, modes=basis_of(SQUARE).loaded(elastic(SQUARE), SQUARE_LAYOUT))


@pytest.mark.parametrize("orientation", range(8))
def test_a_square_is_turned_back(square: Instrument, orientation: int) -> None:
    """A square's drawing may have x and y exchanged as well: the fit of one is set right, sides and all."""
    right, name = exact_fit(square), ("width_mm", "height_mm")
    size_mm = right.plate.size_mm[::-1] if orientation & 4 else right.plate.size_mm
    emitter_mm, *receivers_mm = turned(right.layout.centres_mm, orientation, size_mm).tolist()
    places = {"emitter_mm": tuple(emitter_mm), "receivers_mm": tuple(map(tuple, receivers_mm))}
    drawn = replace(
        right, layout=right.layout.model_copy(update=places),
        plate=right.plate.model_copy(update=dict(zip(name, size_mm, strict=True))),
    )  # fmt: skip
    mended = turned_fit(drawn, orientation)
    np.testing.assert_allclose(mended.layout.centres_mm, right.layout.centres_mm, atol=1e-9)
    assert mended.plate == right.plate
    assert ORIENTATIONS[orientation] in "".join(mended.reasons)


def test_orientation_of_a_square(square: Instrument) -> None:
    """Three taps tell that x and y are exchanged, or that the drawing is turned by 90 degrees."""
    fit = exact_fit(square)
    atlas = make_physical_atlas(fit, 1e-3 * float(np.sqrt(np.square(fit.measured).mean())))
    taps = taps_of(simulate_touches(4, seed=7, instrument=square, label_noise_mm=1.0), atlas)
    for orientation in range(len(ORIENTATIONS)):
        made_mm = turned_back(taps.label_mm, orientation, fit.plate.size_mm)
        assert orientation_of(atlas, replace(taps, label_mm=made_mm)) == orientation, ORIENTATIONS[orientation]


@pytest.mark.parametrize("dead", [True, False])
def test_taps_that_fit_nowhere(atlas: Atlas, exact: Taps, *, dead: bool) -> None:
    """Silence, and labels at random, are refused."""
    label_mm = exact.label_mm if dead else np.random.default_rng(3).uniform((5, 5), np.array(SIZE_MM) - 5, (60, 2))
    values = np.zeros_like(exact.values) if dead else exact.values
    with pytest.raises(CalibrationError, match="taps fit"):
        refine(atlas, Taps(label_mm, values))


def test_scatter(atlas: Atlas, exact: Taps) -> None:
    """The scatter is the labels' error per axis."""
    for error_mm in (0.5, 1.5):
        rough = roughly(exact, error_mm)
        drawn_mm = np.sqrt(np.square(rough.label_mm - exact.label_mm).mean())
        refined = refine(atlas, rough)
        assert refined.scatter_mm == pytest.approx(drawn_mm, rel=0.1)
        assert refined.used == 60


def corrected_mm(shift: float, count: int, label_mm: float) -> tuple[float, float]:
    """RMS error of places that a ruler shifts by a factor, before taps and after, of 300 sets of taps."""
    widths, before, after = Widths((0.003, 0.003), 1e-3, 0.003), [], []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        true_mm = rng.uniform(0, (220, 160), (count, 2))
        placed_mm = (1 + shift) * true_mm
        correction = correction_of(placed_mm, true_mm + label_mm * rng.standard_normal((count, 2)), (220, 160), widths)
        before.append(np.square(placed_mm - true_mm).sum(axis=1).mean())
        after.append(np.square(placed_mm + correction.at(placed_mm) - true_mm).sum(axis=1).mean())
    return float(np.sqrt(np.mean(before))), float(np.sqrt(np.mean(after)))


@pytest.mark.parametrize(("count", "label_mm"), [(20, 1.0), (50, 1.0), (50, 2.0), (200, 1.0), (200, 2.0)])
def test_never_worse(count: int, label_mm: float) -> None:
    """Where ruler and physics are right, taps add under 0.02 mm (RMS); where the ruler is not, they take some off."""
    assert corrected_mm(0.0, count, label_mm)[1] < 0.02
    for shift in (0.0007, 0.0015):
        before, after = corrected_mm(shift, count, label_mm)
        assert after < before


def test_two_hundred_taps() -> None:
    """200 taps at 1 mm halve the error of a ruler that is 0.2 % off."""
    before, after = corrected_mm(0.002, 200, 1.0)
    assert after < 0.5 * before


def test_field_stays(atlas: Atlas, exact: Taps) -> None:
    """Taps of fingertips teach the field nothing that would place a rigid tip worse."""
    assert refine(atlas, roughly(exact, 1.0), 0, Widths((0.0, 0.0), 0.0, 0.0)).atlas is atlas


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
    refined = refine(short, roughly(exact, 0.5), 0, Widths((0.02, 0.02), 0.003, 0.02))
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
    with pytest.raises(CalibrationError, match="0 of 60 taps fit"):
        refine(atlas, Taps(exact.label_mm, noise[0] + 1j * noise[1]))
