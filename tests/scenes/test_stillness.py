"""A frame that has not changed is skipped, and the touches stay the same."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import Scene
from touchd.config.schema import Settings
from touchd.frame import Frame
from touchd.localization.model import Model
from touchd.outcome import Counters
from touchd.pipeline import Pipeline

Reports = dict[int, tuple[float, float, float, float]]
"""x_mm, y_mm, sigma_mm and force of each contact."""


def played(
    scene: Scene, name: str, model: Model, skip: bool
) -> tuple[Counters, list[tuple[int, int, str]], list[Reports]]:
    """The counters; when which contact went down or up; where each contact was last reported, frame by frame."""
    recording = scene(name)
    # Without a dead band, so that the places themselves are compared and not which side of it they fell on.
    settings = Settings.model_validate({"skip": {"still": skip}, "tracker": {"dead_band_mm": 0.0}})
    pipeline = Pipeline(recording.acquisition, model, settings)
    changes: list[tuple[int, int, str]] = []
    places: list[Reports] = []
    last: Reports = {}
    for i, (counts, sequence) in enumerate(zip(recording.frames, recording.sequence.tolist(), strict=True)):
        contacts = pipeline.process(Frame(counts, sequence, int(recording.timestamp_ns[i]), 0)).contacts
        changes += [(i, c.id, c.phase) for c in contacts if c.phase in ("down", "up")]
        last = last | {c.id: (c.x_mm, c.y_mm, c.sigma_mm, c.force) for c in contacts}
        places.append(last)
    return pipeline.counters, changes, places


@pytest.mark.parametrize(("name", "most"), [("hold", 0.1), ("tap", 0.3), ("keypad", 0.3), ("circle", 1.0)])
def test_touches(name: str, most: float, scene: Scene, model: Model) -> None:
    """The touches are the same within sigma, still frames skipped or not."""
    without, changes, places = played(scene, name, model, skip=False)
    with_, its_changes, its_places = played(scene, name, model, skip=True)
    assert its_changes == changes, "the same contacts go down and up in the same frames"
    assert changes
    apart = []
    for mine, its in zip(places, its_places, strict=True):
        assert mine.keys() == its.keys()
        for (x_mm, y_mm, sigma_mm, force), (its_x_mm, its_y_mm, _, its_force) in zip(
            mine.values(), its.values(), strict=True
        ):
            apart.append(np.hypot(x_mm - its_x_mm, y_mm - its_y_mm) / sigma_mm)
            assert its_force == pytest.approx(force, abs=0.05)
    print(f"{name}: {with_.inferred} instead of {without.inferred} inferred, at most {max(apart):.2f} sigma apart")
    # Either is an estimate with its own noise: they may differ by as much as two do.
    assert np.percentile(apart, 95) < 1.0
    assert max(apart) < 2.0
    assert with_.inferred <= most * without.inferred
    assert without.skipped["still"] == 0
    assert with_.skipped["still"] == without.inferred - with_.inferred
