"""The touches that estimators are compared on are alike for all, and none was trained on."""

from __future__ import annotations

import numpy as np

from touchd.lab.benchmark.scenes import BLOCK, SCENE_SEED, SEED, STEP_MM, UNTOUCHED, held_out
from touchd.lab.reproduction.run import (
    CENTRAL_SEED,
    CIRCLE_SEED,
    HELD_OUT,
    OTHER_HELD_OUT_SEED,
    OTHER_SEED,
    TRAINING_SEED,
)
from touchd.twin.instrument import Instrument


def test_no_training_and_no_other_test_has_their_seed() -> None:
    others = {CENTRAL_SEED, CIRCLE_SEED, OTHER_HELD_OUT_SEED, OTHER_SEED, TRAINING_SEED, *HELD_OUT.values()}
    assert SEED not in others
    assert SCENE_SEED not in others | {SEED}


def test_the_same_seed_gives_the_same_touches(plate: Instrument) -> None:
    one, other = held_out(BLOCK, plate), held_out(BLOCK, plate)
    assert (one[0].residual == other[0].residual).all()
    assert (one[0].true_mm == other[0].true_mm).all()


def test_a_residual_is_the_touch_less_the_untouched_plate_of_its_own_temperature(plate: Instrument) -> None:
    held = held_out(3 * BLOCK, plate)
    assert sum(len(block.residual) for block in held) == 3 * BLOCK
    for block in held:
        assert block.residual.shape == block.before.shape == (BLOCK, *plate.acquisition.shape)
        assert len(block.untouched) == UNTOUCHED
        assert np.abs(block.untouched.mean(axis=0)).max() < 1e-2
        # A finger changes the plate by much more than noise, which is all that is left of the untouched plate.
        noise = np.square(block.untouched).sum(axis=(1, 2)).mean()
        assert (np.square(block.residual).sum(axis=(1, 2)) > 4 * noise).all()


def test_the_frame_before_is_of_the_same_finger_a_step_away(plate: Instrument) -> None:
    block = held_out(BLOCK, plate)[0]
    # Alike, since two millimetres are little of the field's wavelength, yet not the same.
    alike = [
        float((one * other).sum() / np.linalg.norm(one) / np.linalg.norm(other))
        for one, other in zip(block.before, block.residual, strict=True)
    ]
    assert np.median(alike) > 0.5
    assert max(alike) < 0.9999
    assert STEP_MM > 0
