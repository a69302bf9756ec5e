"""What the recipes' networks cost, and that classes are where their rectangles say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from touchd.frame import Plate
from touchd.keypad import PHONE, load_layout
from touchd.training.network.network import Normalise, PaperNetwork
from touchd.training.network.objectives import ClassObjective, make_objective
from touchd.training.network.recipe import RECIPES

PLATE = Plate(width_mm=200, height_mm=200)
LAYOUT = load_layout(PHONE)
STILL = np.zeros((0, 392), np.float32)
ON_PLATE = st.tuples(st.floats(0, 200), st.floats(0, 200))


def multiply_adds(network: torch.nn.Module) -> int:
    """Those of the linear layers, and of projecting drift out."""
    layers = sum(layer.weight.numel() for layer in network.modules() if isinstance(layer, torch.nn.Linear))
    return layers + sum(2 * part.drift.numel() for part in network.modules() if isinstance(part, Normalise))


def test_the_papers_networks_have_the_papers_size() -> None:
    """357 k and 45 k multiply-adds (Bahrami et al. 2022)."""
    assert multiply_adds(PaperNetwork(392, (200.0, 200.0))) == 357_000
    objective = make_objective(RECIPES["paper-keypad"], 392, PLATE, 0, LAYOUT, STILL)
    assert multiply_adds(objective.network) == pytest.approx(45_000, rel=0.01)


@pytest.mark.parametrize(("name", "most"), [("best", 357_000), ("keypad", 357_000), ("small", 35_700)])
def test_none_costs_more_than_the_papers_regression_and_small_a_tenth(name: str, most: int) -> None:
    """With temperature left out, the one direction in which the reference plate drifts."""
    objective = make_objective(RECIPES[name], 392, PLATE, 0, LAYOUT, np.eye(1, 392, dtype=np.float32))
    assert 0.9 * most < multiply_adds(objective.network) <= most


@given(st.lists(ON_PLATE, min_size=1, max_size=20), st.integers(2, 10))
def test_a_zone_holds_its_positions(places: list[tuple[float, float]], n: int) -> None:
    objective = ClassObjective(8, PLATE, replace(RECIPES["grid"], widths=(4,)), torch.zeros(0, 8), n, None)
    place_mm = np.array(places)
    rows, columns = np.divmod(objective.labels(place_mm), n)
    centre_mm = (np.stack([columns, rows], axis=1) + 0.5) * 200 / n
    assert (np.abs(place_mm - centre_mm) <= 100 / n + 1e-3).all()


@given(st.lists(ON_PLATE, min_size=1, max_size=20))
def test_a_label_is_the_key_that_the_layout_names(places: list[tuple[float, float]]) -> None:
    objective = ClassObjective(8, PLATE, RECIPES["paper-keypad"], torch.zeros(0, 8), 0, LAYOUT)
    names = [*(key.name for key in LAYOUT.key), None]
    assert [names[label] for label in objective.labels(np.array(places))] == [LAYOUT.at(x, y) for x, y in places]
