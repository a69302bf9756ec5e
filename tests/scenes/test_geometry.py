"""Any acquisition through the whole product: twin, plate fit, physical atlas, single frames, live pipeline."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from tests.scenes.stages import empty_stage, play, score
from tests.unit.calibration.plates import exact_fit, model_of
from touchd.calibration.calibrate import fit_recording, make_model
from touchd.calibration.plate_file import check_plate_file
from touchd.config.schema import Settings
from touchd.errors import ModelMismatch
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.frame import ACQUISITIONS, Acquisition, Plate, parse_acquisition
from touchd.localization.model import Model
from touchd.recording.format import read, write
from touchd.service.replay import replay
from touchd.training.field.bins import MOST_FEATURES
from touchd.twin.instrument import Instrument
from touchd.twin.physics.transducer import Layout
from touchd.twin.scenes.timeline import still
from touchd.twin.simulate import simulate_scene, simulate_touches

PLATE = Plate(width_mm=110, height_mm=90, thickness_mm=5)
LAYOUT = Layout(emitter_mm=(20, 50), receivers_mm=((12, 12), (98, 18), (85, 78), (30, 82)))
OFF_MM = np.array([[0.3, -0.2], [-0.4, 0.2], [0.3, 0.4], [0.1, -0.4], [-0.3, 0.3]])
GEOMETRIES = ["audio-96", "100000:300:20000-45000:0.0025:0.004", "200000:400:30000-80000:0.002"]


class Rig(NamedTuple):
    """A plate with its fitted model."""

    instrument: Instrument
    model: Model


@pytest.fixture(scope="module", params=GEOMETRIES)
def rig(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Rig:
    acquisition: Acquisition = parse_acquisition(request.param)
    instrument = Instrument(PLATE, layout=LAYOUT, acquisition=acquisition)
    places = (LAYOUT.centres_mm + OFF_MM).tolist()
    said = check_plate_file(
        {
            "plate": {"width_mm": 110.1, "height_mm": 89.9, "thickness_mm": 5.01, "material": "glass"},
            "discs": {"diameter_mm": 6, "emitter_mm": places[0], "receivers_mm": places[1:]},
        }
    )
    path = tmp_path_factory.mktemp("geometry") / "idle.npz"
    write(path, simulate_scene("idle", frames=200, instrument=instrument, seed=1))
    made = make_model(fit_recording(read(path), said), path.with_name("plate.onnx"))
    return Rig(instrument, made.model)


def test_fingertips(rig: Rig) -> None:
    """A model fitted to an untouched recording of any geometry places fingertips, one in each frame."""
    recording = simulate_touches(200, seed=5, instrument=rig.instrument, finger="fingertip")
    frames = touched_frames(recording)
    seen = see(find_with(rig.model, rig.model.atlas, frames), frames)
    error_mm = [
        min((np.hypot(t.x_mm - x, t.y_mm - y) for t in one.found), default=np.inf)
        for one in seen for x, y in one.true_mm
    ]  # fmt: skip
    assert np.median(error_mm) < 0.3
    assert np.mean([len(one.found) == 1 for one in seen]) > 0.95


def test_bins(rig: Rig) -> None:
    """What a fit goes through in each step stays near the source paper's, however long the frames."""
    assert rig.model.atlas is not None
    assert rig.model.atlas.size <= MOST_FEATURES


def test_live(rig: Rig, tmp_path: Path) -> None:
    """A recording of any geometry is replayed through the live pipeline: a contact for each tap, where it is."""
    recording = simulate_scene("tap", instrument=rig.instrument, seed=3, finger="fingertip", frames=300)
    write(tmp_path / "tap.npz", recording)
    outcome = replay(tmp_path / "tap.npz", Settings.model_validate({"model": {"path": rig.model.path}}))
    assert recording.contacts_mm is not None
    true_mm = dict(zip(recording.sequence.tolist(), recording.contacts_mm[:, 0].tolist(), strict=True))
    taps = np.diff(np.isfinite(recording.contacts_mm[:, 0, 0]).astype(int)) > 0
    found = [(true_mm[event.frame], contact) for event in outcome.touches for contact in event.contacts]
    assert len({contact.id for _, contact in found}) == taps.sum() > 0
    assert np.nanmedian([np.hypot(c.x_mm - x_mm, c.y_mm - y_mm) for (x_mm, y_mm), c in found]) < 0.5


def test_taps_beside_a_finger_that_the_model_explains_poorly(tmp_path: Path) -> None:
    """While it rests, and its frames need not be looked at, the search for others goes on: of eleven taps it lost 3."""
    instrument = Instrument(PLATE, layout=LAYOUT, acquisition=ACQUISITIONS["audio-192"])
    model = Model(model_of(exact_fit(instrument), tmp_path / "plate.onnx"))
    stage, rng = empty_stage(7.4, seed=2614001), np.random.default_rng(2614001)
    stage.plate = PLATE
    rests_mm = rng.uniform(14, [96, 76])
    stage.lay("fingertip", 0.8, 7.2, still(*rests_mm), force_n=0.4)
    at_s = 1.2
    while at_s < 6.7:
        place_mm = rng.uniform(14, [96, 76])
        if np.hypot(*(place_mm - rests_mm)) > 25:
            stage.lay("fingertip", at_s, at_s + 0.3, still(*place_mm), force_n=0.5, column=1)
            at_s += 0.6
    found = score(stage, play(stage, instrument, model=model))
    assert found.touches > 10
    assert (found.missed, found.ghosts) == (0, 0)


def test_another_period(rig: Rig) -> None:
    """A model is refused for frames in which more, or less, of the earlier chirps rings."""
    a = rig.instrument.acquisition
    other = None if a.chirp.period_s else 0.01
    changed = a.model_copy(update={"chirp": a.chirp.model_copy(update={"period_s": other})})
    with pytest.raises(ModelMismatch, match="chirp"):
        rig.model.check(changed)
