"""A recording of another plate than the model's is named, before anybody wonders why no touch comes."""

from __future__ import annotations

from pathlib import Path

import pytest
from structlog.testing import capture_logs

from touchd.frame import Plate
from touchd.localization.model import Model, default_model_path
from touchd.recording.format import write
from touchd.service.daemon import warn_of_another_plate
from touchd.sources.replay import ReplaySource
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import DEFAULT_PLATE, simulate_scene

SMALL = Plate(width_mm=110, height_mm=90, thickness_mm=5)


@pytest.mark.parametrize(("plate", "named"), [(DEFAULT_PLATE, False), (SMALL, True)])
def test_named(tmp_path: Path, plate: Plate, *, named: bool) -> None:
    """Both sizes are told, and that the shipped model may be meant; of the model's own plate nothing is said."""
    path = tmp_path / "idle.npz"
    write(path, simulate_scene("idle", frames=40, instrument=Instrument(plate), seed=1))
    with capture_logs() as lines:
        warn_of_another_plate(ReplaySource(path), Model(default_model_path()))
    assert [(line["frames"], line["model"]) for line in lines] == [("110 x 90 mm", "200 x 200 mm")] * named
