"""Waves about as short as a finger is wide: 13 mm, on acrylic at 50 to 100 kHz."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.calibration.plates import basis_of, elastic, exact_fit
from touchd.calibration.calibrate import Fitted, make_model
from touchd.calibration.untouched import Untouched
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.frame import Plate
from touchd.localization.model import Model
from touchd.twin.instrument import Instrument
from touchd.twin.physics.transducer import Layout
from touchd.twin.simulate import simulate_scene, simulate_touches

ACRYLIC = Plate(width_mm=84, height_mm=68, thickness_mm=5, material="pmma")
LAYOUT = Layout(emitter_mm=(16, 38), receivers_mm=((9, 9), (75, 14), (65, 59)))
LOSS = 0.03


def acrylic(stretch: float = 0.0) -> Instrument:
    modes = basis_of(ACRYLIC).loaded(elastic(ACRYLIC), LAYOUT)
    return Instrument(ACRYLIC, layout=LAYOUT, modes=modes, loss=LOSS, stretch=stretch)


@pytest.fixture(scope="module")
def plate() -> Instrument:
    return acrylic()


@pytest.fixture(scope="module")
def model(plate: Instrument, tmp_path_factory: pytest.TempPathFactory) -> Model:
    """The model of the plate as an exact fit has it."""
    fit = exact_fit(plate, LOSS)
    idle = simulate_scene("idle", seed=4, instrument=plate, frames=200)
    noise = np.full(len(fit.measured), 1e-3 * float(np.sqrt(np.square(fit.measured).mean())) / 14)
    fitted = Fitted(idle, Untouched(fit.measured, noise, 200, plate.acquisition), fit, 0.0)
    return make_model(fitted, tmp_path_factory.mktemp("acrylic") / "plate.onnx").model


@pytest.mark.parametrize(("finger", "least", "median_mm"), [("fingertip", 99, 0.2), ("thumb", 92, 0.6)])
def test_adults_fingers_are_found(finger: str, least: int, median_mm: float, plate: Instrument, model: Model) -> None:
    """Beside a small contact's field two of these fingertips were miscounted, and 44 thumbs, which were 1.2 mm off."""
    assert model.atlas
    assert model.atlas.description.face_mm > 0
    frames = touched_frames(simulate_touches(100, seed=7, instrument=plate, finger=finger))
    seen = see(find_with(model, model.atlas, frames), frames)
    right = [one for one in seen if len(one.found) == 1]
    assert len(right) >= least
    off_mm = [np.hypot(one.found[0].x_mm - one.true_mm[0][0], one.found[0].y_mm - one.true_mm[0][1]) for one in right]
    assert np.median(off_mm) < median_mm


@pytest.mark.parametrize("stretch", [-0.02, -0.01, 0.01])
def test_another_days_temperature(stretch: float, model: Model) -> None:
    """Ten kelvin from the calibration robot's tips were 0.26 mm off; at twenty 96 of 100 were missed or miscounted."""
    frames = touched_frames(simulate_touches(50, seed=8, instrument=acrylic(stretch), finger="robot"))
    seen = see(find_with(model, model.atlas, frames), frames)
    right = [one for one in seen if len(one.found) == 1]
    assert len(right) >= 49
    off_mm = [np.hypot(one.found[0].x_mm - one.true_mm[0][0], one.found[0].y_mm - one.true_mm[0][1]) for one in right]
    assert np.median(off_mm) < 0.08
