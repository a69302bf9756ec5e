"""Recorded frames through the whole daemon, over a real socket: what another process receives never changes unnoticed.

After a change that is meant to alter it, `make golden` rebuilds the result; the difference belongs in the commit.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from tests.scenes.golden import scenes
from tests.scenes.golden.rebuild import GOLDEN, received
from touchd.recording.data import Recording

PLACE_MM = 0.02
"""Another processor adds up in another order."""


@pytest.fixture(scope="module")
def golden() -> list[dict[str, Any]]:
    return [json.loads(line) for line in GOLDEN.read_text().splitlines()]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return received(tmp_path_factory.mktemp("golden"))


def test_the_checked_in_result_is_small_and_whole(golden: list[dict[str, Any]]) -> None:
    assert GOLDEN.stat().st_size < 400_000
    assert len(golden) > 100
    assert golden[-1]["lost"] == 0


def test_what_is_received_is_what_is_checked_in(golden: list[dict[str, Any]], found: list[dict[str, Any]]) -> None:
    def outline(events: list[dict[str, Any]]) -> list[Any]:
        return [[e["type"], e["frame"], [(c["id"], c["phase"]) for c in e["contacts"]]] for e in events[:-1]]

    assert outline(found) == outline(golden), "ids and phases; if that is meant: make golden"
    for number, (mine, its) in enumerate(zip(found, golden, strict=True)):
        assert_same(mine, its, f"message {number}")


def assert_same(found: Any, golden: Any, where: str) -> None:
    """The same keys and values; floats nearly so."""
    if isinstance(golden, dict):
        assert found.keys() == golden.keys(), where
        for name in golden:
            assert_same(found[name], golden[name], f"{where}: {name}")
    elif isinstance(golden, list):
        assert len(found) == len(golden), where
        for number, (mine, its) in enumerate(zip(found, golden, strict=True)):
            assert_same(mine, its, f"{where}: {number}")
    elif isinstance(golden, float):
        near = PLACE_MM if where.endswith(("x_mm", "y_mm")) else max(1e-3, 0.01 * abs(golden))
        assert found == pytest.approx(golden, abs=near, rel=0), where
    else:
        assert found == golden, where


def test_a_difference_would_be_seen(golden: list[dict[str, Any]]) -> None:
    for change in ({"frame": 1}, {"t_ns": 1}, {"seq": 0}, {"device": "other"}, {"new": 1}):
        with pytest.raises(AssertionError):
            assert_same(golden[0] | change, golden[0], "message 0")
    contact = golden[0]["contacts"][0]
    for name, step in (("x_mm", 0.03), ("id", 1), ("force", 0.02), ("sigma_mm", 0.1 * contact["sigma_mm"])):
        with pytest.raises(AssertionError):
            assert_same(contact | {name: contact[name] + step}, contact, "contact")
    assert_same(contact | {"x_mm": contact["x_mm"] + 0.01}, contact, "contact")


@pytest.mark.parametrize("case", scenes.CASES)
def test_scene(case: str, scene: Callable[[str], Recording]) -> None:
    """What comes of a scene is what is checked in, field by field; if a difference is meant: make golden."""
    assert scenes.differences(scenes.rows(case, scene(scenes.CASES[case][0])), scenes.stored(case)) == []


def test_each_scene_has_one_file() -> None:
    assert {path.stem for path in scenes.FOLDER.glob("*.jsonl")} == set(scenes.CASES)


def test_a_difference_in_a_scene_would_be_seen() -> None:
    """Of every column, of the events' number and order, and of the counters."""
    golden = scenes.stored("cross")
    assert scenes.differences(golden, golden) == []
    for column in range(len(scenes.COLUMNS)):
        changed = json.loads(json.dumps(golden))
        value = changed[0][4][0][column]
        step = 1.01 * scenes.TOLERANCE.get(scenes.COLUMNS[column], 1)
        changed[0][4][0][column] = value + step if isinstance(value, float | int) else "other"
        assert scenes.differences(changed, golden), scenes.COLUMNS[column]
    for changed in (golden[1:], [*golden[:-2], golden[-1]]):
        assert scenes.differences(changed, golden)
    changed = json.loads(json.dumps(golden))
    changed[-1]["counters"]["lost"] += 1
    assert scenes.differences(changed, golden)
