"""A trigger that jitters, electromagnetic impulses and dry feet neither hide taps nor make touches."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes.stages import empty_stage, play, score
from touchd.config.schema import Settings
from touchd.twin.electronics import Electronics, Impulses
from touchd.twin.instrument import Instrument
from touchd.twin.physics.mounting import Mounting, feet
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.simulate import DEFAULT_PLATE

RIGS = {
    "jitter": Electronics(jitter_s=20e-9),
    "impulses": Electronics(impulses=Impulses(share=0.2)),
    "both": Electronics(jitter_s=20e-9, impulses=Impulses(share=0.2)),
}


@pytest.mark.parametrize("finger", ["robot", "fingertip"])
@pytest.mark.parametrize("rig", RIGS)
def test_taps(rig: str, finger: str, instrument: Instrument) -> None:
    """Each tap is found once, where it is, and nothing else."""
    stage = stage_scene("tap", DEFAULT_PLATE, seed=17, finger=finger, electronics=RIGS[rig])
    result = score(stage, play(stage, instrument, 17))
    error_mm = np.linalg.norm(result.error_mm, axis=1)
    print(f"{rig} {finger}: {result.found} of {result.touches}, median {np.median(error_mm):.3f} mm")
    assert (result.missed, result.ghosts, result.split) == (0, 0, 0)
    assert np.median(error_mm) < 0.3


@pytest.mark.parametrize("rig", RIGS)
def test_idle(rig: str, instrument: Instrument) -> None:
    """Twenty seconds of an untouched plate bring no touch; the network runs for one of eight of its 500 impulses."""
    stage = empty_stage(20.0)
    stage.electronics = RIGS[rig]
    outcome = play(stage, instrument)
    print(f"{rig}: {outcome.counters}")
    assert outcome.touches == []
    assert outcome.counters.inferred <= 500 / 8


def test_dry_feet(instrument: Instrument) -> None:
    """Gloved taps on a pane of 0.5 kg are found once each if the feet are named; else these are touches, too."""
    mounting = Mounting(attachments=feet(*DEFAULT_PLATE.size_mm, preload_n=1.2))
    giving = Instrument(DEFAULT_PLATE, modes=instrument.response.modes, mounting=mounting)
    stage = stage_scene("tap", DEFAULT_PLATE, seed=17, finger="glove")
    named = Settings.model_validate({"model": {"feet_mm": [foot.middle_mm for foot in mounting.attachments]}})
    result, unnamed = (score(stage, play(stage, giving, 17, settings)) for settings in (named, Settings()))
    print(f"{result.found} of {result.touches} taps; unnamed {unnamed.ghosts} ghosts")
    assert (result.missed, result.ghosts, result.split) == (0, 0, 0)
    assert unnamed.ghosts >= result.touches
