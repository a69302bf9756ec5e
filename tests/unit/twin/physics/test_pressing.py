"""Fingers press a plate on what it lies on as statics and the plate's own modes say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from touchd.frame import Plate
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact, area_of
from touchd.twin.physics.mounting import EDGES, Attachment, Mounting, Support, attach, feet
from touchd.twin.physics.pressing import rises
from touchd.twin.physics.response import Response
from touchd.twin.physics.transducer import default_layout, loaded_modes

PLATE = Plate(width_mm=90, height_mm=80, thickness_mm=5, material="glass")
LAYOUT = default_layout(PLATE)
LOSS = 5e-3
FEET = feet(*PLATE.size_mm, preload_n=1.0)
ACROSS = st.floats(0, 90), st.floats(0, 80)


def glove(x_mm: float, y_mm: float, force_n: float) -> Contact:
    return Contact(x_mm, y_mm, float(area_of("glove", force_n)), "glove")


@given(*ACROSS, st.floats(0.01, 0.2))
def test_the_feet_carry_what_a_finger_adds(x_mm: float, y_mm: float, force_n: float) -> None:
    """Their loads balance its force, and its moments about both axes."""
    load_n = (1 + rises(FEET, [glove(x_mm, y_mm, force_n)])) ** 2 - 1
    assert load_n.sum() == pytest.approx(force_n)
    assert load_n @ np.array([foot.middle_mm for foot in FEET]) == pytest.approx(
        force_n * np.array([x_mm, y_mm]), abs=1e-9
    )


def test_a_foot_can_be_lifted() -> None:
    """A plate that is pressed hard at a corner leaves the foot across, and no farther."""
    assert rises(FEET, [glove(2.0, 2.0, 5.0)]).min() == -1.0


def test_feet_in_a_row() -> None:
    """Feet along one line share what is beside it as statics along the line says."""
    row = [foot.model_copy(update={"y_mm": (35.0, 45.0)}) for foot in FEET[:1] + FEET[2:3]]
    assert rises(row, [glove(45.0, 70.0, 0.5)]) == pytest.approx([np.sqrt(1.25) - 1] * 2)


def test_drops_do_not_press() -> None:
    assert not rises(FEET, [Contact(30.0, 30.0, 40.0, "drop")]).any()


def test_response_to_a_foot_that_couples_more() -> None:
    """To first order a foot that couples more by a share does what so much more of its springs and mass does."""
    share, spring = 1e-4, Support(stiffness_n_m3=8e10, loss=0.3, mass_kg_m2=0.4)
    modes = loaded_modes(PLATE, LAYOUT)

    def sprung(times: float, preload_n: float | None = None) -> Response:
        support = spring._replace(stiffness_n_m3=times * spring.stiffness_n_m3, mass_kg_m2=times * spring.mass_kg_m2)
        some = tuple(foot.model_copy(update={"support": support, "preload_n": preload_n}) for foot in FEET)
        held = attach(modes, PLATE, some, LOSS, 75e3)
        return Instrument(PLATE, layout=LAYOUT, modes=held, mounting=Mounting(attachments=some)).response

    pressed = sprung(1.0, preload_n=1.0)
    heavy = [glove(45.0, 40.0, 4 * ((1 + share) ** 2 - 1))]
    contact = sprung(1.0).change([heavy], np.ones(1))
    expected = sprung(1 + share).untouched() - pressed.untouched()
    found = (pressed.change([heavy], np.ones(1)) - contact)[0]
    assert np.linalg.norm(found - expected) < 0.01 * np.linalg.norm(expected)


def test_only_dry_feet_give() -> None:
    """Glued feet leave a finger's signal as it is; on dry ones a light finger adds what they do, at any temperature."""
    modes = loaded_modes(PLATE, LAYOUT)
    glued, dry = (
        Instrument(PLATE, layout=LAYOUT, modes=modes, mounting=Mounting(attachments=feet(*PLATE.size_mm, preload_n)))
        for preload_n in (None, 1.0)
    )
    touch, at_c = [[glove(40.0, 30.0, 0.4)]] * 2, [REFERENCE_C, REFERENCE_C + 3]
    alone, changed = glued.change(touch, at_c), dry.change(touch, at_c)
    assert np.array_equal(alone, Instrument(PLATE, layout=LAYOUT, modes=modes).change(touch, at_c))
    energy = np.square(changed - alone).sum(axis=(1, 2)) / np.square(alone).sum(axis=(1, 2))
    assert (energy > 0.3).all(), energy
    assert energy[0] == pytest.approx(energy[1], rel=0.1)


def test_pads_that_nothing_glues() -> None:
    assert all(pad.preload_n == 0.4 for pad in Mounting(left="pads", preload_n=0.4).on(PLATE))
    with pytest.raises(ValidationError, match="only round"):
        Attachment(x_mm=(0, 5), y_mm=(0, 80), support=EDGES["tape"], preload_n=1.0)
