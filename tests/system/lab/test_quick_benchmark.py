"""The quick benchmark, as CI runs it: budgets with twice their room, as ratios within one process."""

from __future__ import annotations

import pytest

from tests.processes import PATIENCE_S, touchd
from touchd.lab.benchmark import results, tables
from touchd.lab.benchmark.budgets import BUDGETS, Budget
from touchd.lab.benchmark.estimators import NETWORKS
from touchd.lab.benchmark.results import EstimatorResult, Run
from touchd.lab.benchmark.scenes import WANTED
from touchd.localization.model import default_model_path

MARGIN = 2.0


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("benchmark")
    path, given = folder / "run.json", folder / "mine.onnx"
    given.write_bytes((default_model_path().parent / "small.onnx").read_bytes())
    done = touchd("benchmark", "--quick", "--json", path, "--also", given, patience_s=5 * PATIENCE_S)
    assert done.code == 0, done.err
    return results.load(path)


def test_the_figures_are_printed(quick: Run, capsys: pytest.CaptureFixture[str]) -> None:
    with capsys.disabled():
        print()
        for table in (tables.estimator_table(quick), tables.daemon_table(quick), tables.budget_table(quick)):
            print(tables.plain(table))
    assert quick.quick


@pytest.fixture(scope="module")
def found(quick: Run) -> dict[str, EstimatorResult]:
    return {one.name: one for one in quick.estimators}


@pytest.mark.parametrize("budget", [one for one in BUDGETS if one.unit == "x bare"], ids=lambda one: one.what)
def test_no_frame_costs_twice_its_budget(quick: Run, budget: Budget) -> None:
    value = budget.read(quick)
    assert value is not None
    assert budget.holds(value, MARGIN), f"{budget.what}: {value:.2f} x bare, budget {budget.limit}"


def test_every_estimator_and_every_scene_is_there(quick: Run, found: dict[str, EstimatorResult]) -> None:
    assert {*NETWORKS, "regression, rfft", "regression, DFT in the graph", "regression, float64"} <= found.keys()
    assert [cell.scene for cell in quick.daemon] == list(WANTED)
    assert {one.name for one in quick.skips} >= {"gate", "still", "unheard", "screen"}


def test_however_the_features_are_computed_the_positions_are_the_same(found: dict[str, EstimatorResult]) -> None:
    for name in ("regression, rfft", "regression, DFT in the graph", "regression, float64"):
        assert found[name].median_mm == pytest.approx(found["regression"].median_mm, abs=1e-3)


def test_a_model_that_is_given_is_asked_like_those_that_ship(found: dict[str, EstimatorResult]) -> None:
    assert found["mine"].group == "given"
    assert found["mine"].median_mm == found["small"].median_mm
    assert found["mine"].macs == found["small"].macs


def test_more_precise_estimators_are_more_precise(found: dict[str, EstimatorResult]) -> None:
    assert found["atlas, touch-down"].median_mm < 0.3 * found["regression"].median_mm
    assert found["atlas, tracking"].median_mm < 0.3 * found["regression"].median_mm
    assert found["regression"].median_mm < 0.5 * found["small"].median_mm < 0.5 * found["time"].median_mm
    assert found["int8"].median_mm < 1.3 * found["regression"].median_mm


def test_a_finger_that_is_followed_needs_no_network(quick: Run) -> None:
    moving = quick.cell("moving", None)
    assert moving is not None
    assert moving.inferred < 0.05
    assert moving.skipped["tracking"] > 0.9


def test_each_skip_saves_time_and_changes_no_contact(quick: Run) -> None:
    for one in quick.skips:
        assert one.saved > 0, f"{one.name} saves {one.saved:.0%}"
        assert "come or go" not in one.same, f"{one.name}: {one.same}"


def test_nothing_is_lost_at_full_speed_and_messages_come_where_something_touches(quick: Run) -> None:
    for cell in quick.daemon:
        assert cell.lost == 0, cell.scene
        assert (cell.messages > 0) == (cell.scene != "idle"), cell.scene


def test_it_tells_how_fast_the_weights_could_be_read_at_best(found: dict[str, EstimatorResult]) -> None:
    # int8 has a quarter of the weights: reading them takes clearly less.
    assert found["int8"].floor_us < 0.8 * found["regression"].floor_us
