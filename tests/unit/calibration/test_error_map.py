"""The map of the expected error believes taps near them, and the model elsewhere; what is common, all taps tell."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.calibration.plates import PLATE, off_channels
from touchd.calibration.place_correction import PlaceCorrection, Widths, left_mm, with_places
from touchd.calibration.taps import GRID, ErrorMap, Taps, refine, taps_of
from touchd.localization.atlas import Atlas
from touchd.training.field.place import FieldMap, place
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

SIZE_MM = (PLATE.width_mm, PLATE.height_mm)
RIGHT = Widths((0.0, 0.0), 0.0, 0.0)
CLAMPED = Widths((0.7, 0.25), 1e-3, 0.25)
WIDTHS = st.builds(Widths, st.tuples(st.floats(0, 1), st.floats(0, 1)), st.floats(0, 0.01), st.floats(0, 0.5))


@pytest.fixture(scope="module")
def noise_counts(instrument: Instrument) -> float:
    """Of untouched frames."""
    made = simulate_touches(10, seed=3, instrument=instrument)
    assert made.contacts_mm is not None
    untouched = np.isnan(made.contacts_mm).all(axis=(1, 2))
    return float(made.frames[untouched].std(axis=0, ddof=1).mean())


@pytest.fixture(scope="module")
def taps(instrument: Instrument, atlas: Atlas) -> Taps:
    return taps_of(simulate_touches(30, seed=7, instrument=instrument), atlas)


def rms_mm(atlas: Atlas, taps: Taps) -> float:
    """How far taps are placed from where they were."""
    apart_mm = place(atlas, taps.values, taps.label_mm).position_mm - taps.label_mm
    return float(np.sqrt(np.square(apart_mm).sum(axis=1).mean()))


def test_right_field(atlas: Atlas, taps: Taps, noise_counts: float) -> None:
    """With taps as without, the map of a right field says how far touches are placed from where they are."""
    errors = ErrorMap(atlas, noise_counts, RIGHT)
    for known in (None, taps):
        assert 0.5 < float(np.median(errors.error_mm(known))) / rms_mm(atlas, taps) < 2.0


def test_wrong_field(atlas: Atlas, taps: Taps, noise_counts: float) -> None:
    """A field that is wrong does not know it; ten taps tell, and thirty tell better."""
    model = off_channels(atlas)
    errors, real_mm = ErrorMap(model, noise_counts, RIGHT), rms_mm(model, taps)
    assert float(np.median(errors.error_mm(None))) < 0.3 * real_mm
    few, many = (
        float(np.median(errors.error_mm(Taps(taps.label_mm[:n], taps.values[:n])))) / real_mm for n in (10, 30)
    )
    assert 0.6 < few < many < 1.4


def test_near_and_far(atlas: Atlas, taps: Taps, noise_counts: float) -> None:
    """A tap counts near its place, and hardly far from it."""
    model = off_channels(atlas)
    errors = ErrorMap(model, noise_counts, RIGHT)
    grown = errors.error_mm(Taps(taps.label_mm[:1], taps.values[:1])) / errors.error_mm(None)
    p = model.description.plate
    column, row = (taps.label_mm[0] / (p.width_mm, p.height_mm) * GRID).astype(int)
    far = grown[GRID - 1 if row < GRID / 2 else 0, GRID - 1 if column < GRID / 2 else 0]
    assert grown[row, column] > 2.0
    assert far < 1.1


def test_nonsense(atlas: Atlas, taps: Taps, noise_counts: float) -> None:
    """A tap that no finger explains changes nothing."""
    random = np.random.default_rng(1)
    noise = np.abs(taps.values[:1]).mean() * random.standard_normal((1, *taps.values.shape[1:]))
    errors = ErrorMap(atlas, noise_counts, RIGHT)
    assert errors.shown(Taps(taps.label_mm[:1], noise.astype(np.complex128))) == errors.shown(None)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 30), scatter_mm=st.floats(0.1, 10), widths=WIDTHS)
@settings(max_examples=100, deadline=None)
def test_another_tap(seed: int, count: int, scatter_mm: float, widths: Widths) -> None:
    """What all places have in common is known after another tap no worse, at any place, wherever the tap is."""
    random = np.random.default_rng(seed)
    places_mm, taps_mm = (random.uniform(0, SIZE_MM, (n, 2)) for n in (20, count + 1))
    before, after = (left_mm(places_mm, taps_mm[:n], scatter_mm, SIZE_MM, widths) for n in (count, count + 1))
    assert (after <= before * (1 + 1e-9)).all()


def test_more_taps(atlas: Atlas, noise_counts: float) -> None:
    """Taps that leave what the fit expects make the map worse nowhere, and better in the median."""
    random = np.random.default_rng(5)
    errors = ErrorMap(atlas, noise_counts, CLAMPED)
    label_mm = random.uniform(10, np.array(SIZE_MM) - 10, (40, 2))
    values = FieldMap(atlas).look_up(label_mm)[0].reshape(40, atlas.description.acquisition.channels, -1)
    before = errors.error_mm(None)
    for count in (1, 7, 8, 9, 12, 20, 40):
        after = errors.error_mm(Taps(label_mm[:count], values[:count]))
        assert (after <= before * (1 + 1e-6)).all(), count
        before = after
    shown = errors.shown(Taps(label_mm, values))
    assert shown["median_mm"] < 0.5 * shown["fitted_mm"]


def test_wrong_places(atlas: Atlas, taps: Taps, noise_counts: float) -> None:
    """Of plates whose places are off, the map is within a factor of two of the error before and after taps."""
    random, rms = np.random.default_rng(11), {0: [], 24: []}  # type: ignore[var-annotated]
    expected: dict[int, list[float]] = {0: [], 24: []}
    for _ in range(6):
        wide = np.array([*CLAMPED.shift_mm, CLAMPED.scale, *[CLAMPED.bent_mm] * 9])
        model = with_places(atlas, PlaceCorrection(SIZE_MM, wide * random.standard_normal(12), 1.0))
        errors = ErrorMap(model, noise_counts, CLAMPED)
        rough = Taps(taps.label_mm + random.standard_normal(taps.label_mm.shape), taps.values)
        some = Taps(rough.label_mm[:24], rough.values[:24])
        for count, known, made in ((0, None, model), (24, some, refine(model, some, 0, CLAMPED).atlas)):
            expected[count].append(float(np.median(errors.error_mm(known))))
            rms[count].append(rms_mm(made, taps))
    for count, found in rms.items():
        assert 0.5 < float(np.mean(expected[count])) / float(np.sqrt(np.square(found).mean())) < 2.0, count
    assert np.mean(expected[24]) < 0.7 * np.mean(expected[0])
