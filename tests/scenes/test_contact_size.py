"""A subscriber learns how large a finger's contact is, how long, which way it lies, and whose it is."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.scenes.stages import play
from tests.system.soak.hands import perform
from touchd.twin.instrument import Instrument
from touchd.twin.scenes.catalogue import stage_scene
from touchd.twin.simulate import DEFAULT_PLATE


@pytest.mark.parametrize(("finger", "kind"), [("fingertip", "finger"), ("thumb", "thumb")])
def test_size(finger: str, kind: str, instrument: Instrument) -> None:
    """In a circle area, long axis and direction are right to 10 %, 1 mm and 10 degrees at the median."""
    stage = stage_scene("circle", DEFAULT_PLATE, seed=14, finger=finger, frames=300)
    off, kinds = [], []
    for event in play(stage, instrument, 14).touches:
        down = [one for one in stage.laid if np.isfinite(one.x_mm[event.frame])]
        if not down or len(event.contacts) != 1:
            continue
        contact, (area_mm2, _, ratio, angle_rad) = event.contacts[0], (row[event.frame] for row in down[0][4:])
        kinds.append(contact.kind)
        if contact.area_mm2 is None or contact.major_mm is None or contact.angle_deg is None:
            continue
        turn_deg = (contact.angle_deg - math.degrees(angle_rad) + 90) % 180 - 90
        major_mm = 2 * math.sqrt(area_mm2 * ratio / math.pi)
        off.append((contact.area_mm2 / area_mm2 - 1, contact.major_mm - major_mm, turn_deg))
    medians = np.median(np.abs(off), axis=0)
    print(f"{finger}: {len(off)} of {len(kinds)} told, medians {medians}")
    assert len(off) > len(kinds) / 2
    assert (medians < (0.10, 1.0, 10.0)).all()
    assert set(kinds) <= {None, kind}
    assert kinds.count(kind) > len(kinds) / 2


def test_a_thumb_that_rests_keeps_no_shape_from_its_landing(instrument: Instrument) -> None:
    """A still frame was once skipped before the shape was fitted again: for 0.2 s a thumb was a finger, 0.5 mm off."""
    found = perform("tap", "thumb", 300000, instrument, 5.0)
    print(found)
    assert (found.missed, found.ghosts, found.split, found.kinds) == (0, 0, 0, 0)
