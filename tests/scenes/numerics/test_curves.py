"""The curves of docs/robustness.md are measured as it says: a few of their points, with few touches."""

from __future__ import annotations

import numpy as np
import pytest

from tests.scenes.numerics.curves import AXES, SEED, Contender, by_atlas, by_dictionary, by_network, measured
from touchd.evaluation.dataset import make_dataset
from touchd.localization.model import Model, default_model_path
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

COUNT = 40


@pytest.fixture(scope="module")
def contenders(instrument: Instrument, atlas_model: Model) -> dict[str, Contender]:
    assert atlas_model.atlas is not None
    kept = make_dataset(simulate_touches(400, seed=7204, instrument=instrument))
    return {
        "atlas": by_atlas(atlas_model, atlas_model.atlas),
        "network": by_network(Model(default_model_path(), atlas=False)),
        "kNN": by_dictionary(kept, np.arange(len(kept)), "kNN"),
        "GCC": by_dictionary(kept, np.arange(len(kept)), "GCC"),
    }


def test_no_two_points_share_touches_and_none_are_those_of_the_training() -> None:
    seeds = [SEED + 100 * i + j for i, axis in enumerate(AXES) for j in range(len(axis.values))]
    assert len(set(seeds)) == len(seeds)
    assert min(seeds) > 1000
    assert len({axis.name for axis in AXES}) == len(AXES)


def test_errors_grow_with_noise_and_the_atlas_is_ten_times_nearer_than_the_network(
    contenders: dict[str, Contender], instrument: Instrument
) -> None:
    noise = next(axis for axis in AXES if axis.name == "noise")
    quiet, loud = measured(noise, contenders, COUNT, instrument, values=(60, 40))
    for name in ("atlas", "network"):
        assert quiet[name].percentile_mm(50) < loud[name].percentile_mm(50)
    assert quiet["atlas"].percentile_mm(50) < 0.25 * quiet["network"].percentile_mm(50) < 0.2
    assert quiet["kNN"].percentile_mm(50) > quiet["network"].percentile_mm(50)
    assert all(answer.placed > 0.9 for answer in quiet.values())


def test_a_dead_channel_costs_the_atlas_little(contenders: dict[str, Contender], instrument: Instrument) -> None:
    dead = next(axis for axis in AXES if axis.name == "dead")
    (one,) = measured(dead, {"atlas": contenders["atlas"]}, COUNT, instrument, values=("1",))
    assert one["atlas"].percentile_mm(50) < 0.1
