"""The graph that the steps in NumPy are measured against does the same: else the comparison would mean nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.system.bench.unrolled import Unrolled, touches
from touchd.localization import gauss_newton as refine
from touchd.localization.gauss_newton import Refiner
from touchd.localization.model import Model, default_model_path


@pytest.mark.parametrize("samples", [False, True], ids=["features", "samples"])
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_the_unrolled_graph_places_touches_as_the_refiner_does(
    steps: int, samples: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To 1e-3 mm, from starts some of which are further away than the longest step."""
    monkeypatch.setattr(refine, "STILL_MM", 0.0)  # the graph never stops early
    atlas = Model(default_model_path()).atlas
    assert atlas is not None
    data, refiner, graph = touches(atlas, 100, off_mm=1.5), Refiner(atlas), Unrolled(atlas, steps, samples=samples)
    for i, (x_mm, y_mm) in enumerate(data.start_mm.tolist()):
        refiner.frame[:] = data.features[i]
        refiner.take()
        graph.frame[:] = (data.residual if samples else data.by_part)[i]
        fit, place = refiner.one(x_mm, y_mm, steps), graph.one(x_mm, y_mm)
        assert math.dist(fit.places_mm[0], place) < 1e-3
        assert abs(complex(*graph.strength.tolist()) / fit.strengths[0] - 1) < 1e-3
        assert abs(graph.left.item() - fit.left) < 1e-4 * refiner.energy
    assert np.isfinite(graph.place).all()
