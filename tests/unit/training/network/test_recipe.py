"""What the recipes' networks cost, and that classes are where their rectangles say."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from touchd.evaluation.model_scores import classes
from touchd.frame import Acquisition, Plate
from touchd.keypad import PHONE, load_layout
from touchd.localization.model import Description
from touchd.training.network.network import Normalise, PaperNetwork
from touchd.training.network.recipe import RECIPES
from touchd.training.network.zones_and_keys import Classifier, make_network

PLATE = Plate(width_mm=200, height_mm=200)
LAYOUT = load_layout(PHONE)
ON_PLATE = st.tuples(st.floats(0, 200), st.floats(0, 200))


def network_of(name: str, directions: int = 0) -> torch.nn.Module:
    """An untrained network that projects out some directions."""
    return make_network(RECIPES[name], description(RECIPES[name].head), torch.eye(directions, 392))


def description(head: str, grid: int = 0) -> Description:
    acquisition = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
    layout = LAYOUT if head == "keypad" else None
    return Description.model_validate({
        "name": "test", "head": head, "domain": "frequency", "input": "residual", "acquisition": acquisition,
        "plate": PLATE, "grid": grid, "layout": layout,
    })  # fmt: skip


def multiply_adds(network: torch.nn.Module) -> int:
    """Those of the linear layers, and of projecting drift out."""
    layers = sum(layer.weight.numel() for layer in network.modules() if isinstance(layer, torch.nn.Linear))
    return layers + sum(2 * part.drift.numel() for part in network.modules() if isinstance(part, Normalise))


def test_the_papers_networks_have_the_papers_size() -> None:
    """357 k and 45 k multiply-adds (Bahrami et al. 2022)."""
    assert multiply_adds(PaperNetwork(392, (200.0, 200.0))) == 357_000
    assert multiply_adds(network_of("paper-keypad")) == pytest.approx(45_000, rel=0.01)


@pytest.mark.parametrize(("name", "most"), [("best", 357_000), ("keypad", 357_000), ("small", 35_700)])
def test_none_costs_more_than_the_papers_regression_and_small_a_tenth(name: str, most: int) -> None:
    """With temperature left out, the one direction in which the reference plate drifts."""
    assert 0.9 * most < multiply_adds(network_of(name, directions=1)) <= most


@given(st.lists(ON_PLATE, min_size=1, max_size=20), st.integers(2, 10))
def test_a_zone_holds_its_positions(places: list[tuple[float, float]], n: int) -> None:
    place_mm, about = np.array(places), description("grid", n)
    labels = classes(place_mm, about)
    rows, columns = np.divmod(labels, n)
    centre_mm = (np.stack([columns, rows], axis=1) + 0.5) * 200 / n
    np.testing.assert_allclose(Classifier(about, (4,)).centres_mm[labels], centre_mm, rtol=1e-6)
    assert (np.abs(place_mm - centre_mm) <= 100 / n + 1e-3).all()


@given(st.lists(ON_PLATE, min_size=1, max_size=20))
def test_a_label_is_the_key_that_the_layout_names(places: list[tuple[float, float]]) -> None:
    names = [*(key.name for key in LAYOUT.key), None]
    labels = classes(np.array(places), description("keypad"))
    assert [names[label] for label in labels] == [LAYOUT.at(x, y) for x, y in places]
