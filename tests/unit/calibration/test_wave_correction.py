"""Taps tell waves that a fit's physics lack: less is left unexplained elsewhere, and what stays is told."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.calibration.plates import PLATE, basis_of, elastic
from touchd.calibration.place_correction import Widths
from touchd.calibration.stages import GOOD_LEFT
from touchd.calibration.tap_fit import fit_taps
from touchd.calibration.taps import Taps, refine, taps_of
from touchd.calibration.wave_correction import Corrected, with_waves
from touchd.localization.atlas import Atlas
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.mounting import Attachment, Support, attach
from touchd.twin.simulate import simulate_touches

LOSS = 5e-3


@pytest.fixture(scope="module")
def heavy(instrument: Instrument) -> Instrument:
    """The plate with a glued button of steel, 3 g, of which the fit knows nothing."""
    plate = elastic(PLATE)
    modes = basis_of(PLATE).loaded(plate, instrument.layout)
    button = Attachment(x_mm=(60.0, 72.0), y_mm=(20.0, 32.0), round=True, support=Support(mass_kg_m2=4.0))
    modes = attach(modes, plate, (button,), LOSS, 75e3)
    return Instrument(PLATE, layout=instrument.layout, modes=modes, loss=LOSS)


@pytest.fixture(scope="module")
def lacking(instrument: Instrument, heavy: Instrument) -> float:
    """Share of the untouched response's energy that the fit leaves."""
    free, measured = (one.untouched([REFERENCE_C])[0] for one in (instrument, heavy))
    return float(np.square(measured - free).sum() / np.square(measured).sum())


def drawn(instrument: Instrument, atlas: Atlas, count: int, seed: int) -> Taps:
    return taps_of(simulate_touches(count, seed=seed, instrument=instrument, finger="fingertip"), atlas)


@pytest.fixture(scope="module")
def corrected(atlas: Atlas, heavy: Instrument, lacking: float) -> Corrected:
    taps = drawn(heavy, atlas, 80, 3)
    return with_waves(atlas, taps.values, fit_taps(atlas, taps.values, taps.label_mm).position_mm, lacking)


def test_elsewhere(atlas: Atlas, heavy: Instrument, corrected: Corrected) -> None:
    """Touches at other places are explained better and placed better, as much as taps left out say."""
    others = drawn(heavy, atlas, 60, 4)
    found = [fit_taps(one, others.values, others.label_mm) for one in (atlas, corrected.atlas)]
    left, after = (float(np.median(one.misfit)) for one in found)
    wrong_mm, after_mm = (float(np.median(np.linalg.norm(one.position_mm - others.label_mm, axis=1))) for one in found)
    assert 0.3 < corrected.stays < 0.7
    assert after < 0.6 * left
    assert after_mm < 0.9 * wrong_mm


def test_error(atlas: Atlas, corrected: Corrected) -> None:
    """Standard errors fall with what stays, and no further."""
    assert (corrected.atlas.error < atlas.error).all()
    assert (corrected.atlas.error >= (1 - 1e-6) * corrected.stays * atlas.error).all()


@pytest.mark.parametrize("repeats", [1, 4])
def test_few_places(atlas: Atlas, heavy: Instrument, lacking: float, repeats: int) -> None:
    """Taps at three places change nothing, however often: those at a place tell nothing of each other."""
    taps = drawn(heavy, atlas, 3, 6)
    values = np.concatenate([scale * taps.values for scale in np.linspace(0.8, 1.2, repeats)])
    assert with_waves(atlas, values, np.tile(taps.label_mm, (repeats, 1)), lacking).atlas is atlas


def test_right_field(atlas: Atlas, instrument: Instrument) -> None:
    """To a field that lacks nothing taps add nothing: no wave explains what is left of fingertips."""
    taps = drawn(instrument, atlas, 60, 5)
    assert with_waves(atlas, taps.values, taps.label_mm, 0.01) == Corrected(atlas, 1.0)


@pytest.mark.parametrize("share", [0.0, 0.9 * GOOD_LEFT])
def test_good_fit(atlas: Atlas, heavy: Instrument, share: float) -> None:
    """The field of a fit that leaves little stays as it is."""
    taps = drawn(heavy, atlas, 20, 7)
    assert refine(atlas, taps, 0, Widths((0.0, 0.0), 0.0, 0.0, share)).atlas is atlas
