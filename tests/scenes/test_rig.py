"""A trigger that jitters, a drive that ripples, impulses, the drive in the cables and dry feet neither hide taps nor
make ghosts."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.stages import empty_stage, play, score
from touchd.calibration.check import check_model
from touchd.config.schema import Settings
from touchd.lab.study import EFFECTS
from touchd.localization.model import default_model_path
from touchd.recording.format import write
from touchd.twin.electronics import Electronics, Impulses, Ripple
from touchd.twin.instrument import Instrument
from touchd.twin.physics.mounting import Mounting, feet
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.simulate import DEFAULT_PLATE, simulate_scene

RIGS = {
    "jitter": Electronics(jitter_s=20e-9),
    "impulses": Electronics(impulses=Impulses(share=0.2)),
    "ripple": Electronics(ripple=Ripple(share=0.01)),
    "ripple of 120 Hz": Electronics(ripple=Ripple(share=0.01, hz=120.0)),
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


@pytest.mark.parametrize("hz", [0.0, 100.0])
def test_a_ripple_hides_no_gloved_tap(hz: float, instrument: Instrument) -> None:
    """A drive's level that differs by 1 % from frame to frame. By 0.3 % it once hid all."""
    stage = stage_scene("tap", DEFAULT_PLATE, seed=18, finger="glove", electronics=Electronics(ripple=Ripple(0.01, hz)))
    result = score(stage, play(stage, instrument, 18))
    assert (result.missed, result.ghosts, result.split) == (0, 0, 0)
    assert np.median(np.linalg.norm(result.error_mm, axis=1)) < 0.3


def test_cables_that_were_moved() -> None:
    """The drive in all channels, as loud as the plate, hides no gloved tap; the shipped model knows nothing of it."""
    driven = EFFECTS["feedthrough 0 dB"].instrument(DEFAULT_PLATE)
    stage = stage_scene("tap", DEFAULT_PLATE, seed=17, finger="glove")
    result = score(stage, play(stage, driven, 17))
    assert (result.missed, result.ghosts, result.split) == (0, 0, 0)
    assert np.median(np.linalg.norm(result.error_mm, axis=1)) < 0.3


DRY = Mounting(attachments=feet(*DEFAULT_PLATE.size_mm, preload_n=1.2))
FEET_MM = [foot.middle_mm for foot in DRY.attachments]


def on_dry_feet(instrument: Instrument) -> Instrument:
    """The pane, pressed on four feet."""
    return Instrument(DEFAULT_PLATE, modes=instrument.response.modes, mounting=DRY)


def test_dry_feet(instrument: Instrument) -> None:
    """Gloved taps on a pane of 0.5 kg are found once each if the feet are named; else these are touches, too."""
    giving = on_dry_feet(instrument)
    stage = stage_scene("tap", DEFAULT_PLATE, seed=17, finger="glove")
    named = Settings.model_validate({"model": {"feet_mm": FEET_MM}})
    result, unnamed = (score(stage, play(stage, giving, 17, settings)) for settings in (named, Settings()))
    print(f"{result.found} of {result.touches} taps; unnamed {unnamed.ghosts} ghosts")
    assert (result.missed, result.ghosts, result.split) == (0, 0, 0)
    assert unnamed.ghosts >= result.touches


def test_feet_that_are_not_named_are_told(instrument: Instrument, tmp_path: Path) -> None:
    """`touchd check` tells where the feet are, to a millimetre; named, they are no news."""
    use = simulate_scene("tap", instrument=on_dry_feet(instrument), seed=1640004, finger="glove", frames=2000)
    write(tmp_path / "use.npz", replace(use, contacts_mm=None, force_n=None))
    unnamed, named = (
        check_model(default_model_path(), tmp_path / "use.npz", feet_mm).reasons for feet_mm in ((), FEET_MM)
    )
    told = [re.search(r"at \((\d+), (\d+)\) mm only beside other fingers", reason) for reason in unnamed]
    places_mm = [tuple(map(float, found.groups())) for found in told if found]
    assert len(places_mm) >= 2
    for place_mm in places_mm:
        assert min(math.dist(place_mm, foot_mm) for foot_mm in FEET_MM) < 1.5
    assert not any("feet_mm" in reason for reason in named)
