"""A run can be stored, read, shown, drawn and compared, and tells nothing of whose computer it was."""

from __future__ import annotations

import json
import socket
import sys
from pathlib import Path

import click.testing
import pytest

from tests.system.lab.benchmark.conftest import cell, estimator
from touchd.cli.benchmark import command
from touchd.errors import ConfigError, OutputError
from touchd.lab.benchmark import results, tables
from touchd.lab.benchmark.page import PICTURES, VARIANTS, draw_errors, page
from touchd.lab.benchmark.results import BareTimes, Otherwise, Run, this_machine
from touchd.lab.benchmark.tables import BUDGETS

DOCS = Path(__file__).resolve().parents[4] / "docs"


def test_a_stored_run_is_read_as_it_was(run: Run, tmp_path: Path) -> None:
    results.store(run, tmp_path / "run.json")
    assert results.load(tmp_path / "run.json") == run


def test_the_stored_names_are_those_agreed_on(run: Run) -> None:
    stored = json.loads(run.model_dump_json())
    assert set(stored["bare_us"]) == {"p50", "p99", "p999"}
    assert {"name", "p50_us", "p99_us", "p999_us", "max_us", "rmse_mm", "median_mm", "p95_mm", "macs", "bytes",
            "ratio"} <= set(stored["estimators"][0])  # fmt: skip
    assert {"scene", "rate_hz", "p50_us", "p99_us", "p999_us", "ratio", "cpu_share"} <= set(stored["daemon"][0])


@pytest.mark.parametrize("content", ["", "{}", '{"version": 2}', "\xff", "[1]"])
def test_what_is_no_run_is_refused_with_its_name(tmp_path: Path, content: str) -> None:
    path = tmp_path / "other.json"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(ConfigError) as caught:
        results.load(path)
    assert caught.value.where == str(path)
    assert caught.value.fix


def test_a_missing_run_and_an_unwritable_place_are_explained(run: Run, tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        results.load(tmp_path / "none.json")
    with pytest.raises(OutputError):
        results.store(run, tmp_path / "none" / "run.json")


def test_the_machine_is_described_without_its_name() -> None:
    machine = this_machine()
    text = machine.model_dump_json()
    for private in (socket.gethostname(), str(Path.home()), str(Path.cwd()), sys.prefix):
        assert len(private) < 3 or private not in text
    assert machine.cores >= 1


def test_every_estimator_scene_and_picture_is_shown(run: Run) -> None:
    """Variants of an estimator stand in the terminal's table; all others, each scene and picture are on the page."""
    networks = [one for one in run.estimators if one.group == "network"]
    variants = tuple(networks[0].model_copy(update={"name": name}) for name in VARIANTS)
    run = run.model_copy(update={"estimators": run.estimators[:1] + variants + run.estimators[1:]})
    text = page(run)
    assert [row[0] for row in tables.estimator_table(run).rows[1:-2]] == [one.name for one in run.estimators]
    for one in run.estimators:
        assert (f"| {one.name} |" in text) is (one.name not in VARIANTS)
    for one_cell in run.daemon:
        assert f"| {one_cell.scene} |" in text
    assert f"({PICTURES}/errors.png)" in text
    picture = draw_errors(run)
    named = {text.get_text() for text in picture.axes[0].texts}
    assert not named & set(VARIANTS)
    assert named <= {one.name for one in run.estimators}
    legend = {text.get_text() for text in picture.legends[0].get_texts()}
    assert {"field atlas", "shipped networks", "the paper's regression (mean, its rig)"} <= legend
    assert "what is not there" in text


def test_what_the_bus_takes_by_itself_stands_beside_the_daemon(run: Run) -> None:
    floor = BareTimes(p50=160.0, p99=1500.0, p999=4321.0)
    apart = Otherwise(daemon_us=BareTimes(p50=260.0, p99=1600.0, p999=5432.0), bus_us=floor)
    asleep = Otherwise(daemon_us=BareTimes(p50=360.0, p99=1700.0, p999=6543.0))
    late = BareTimes(p50=0.1, p99=0.4, p999=765.0)
    placed = run.model_copy(update={"bus_us": floor, "apart": apart, "asleep": asleep, "held_up_us": late})
    text = page(placed)
    assert "p50 160, p99 1,500, p99.9 4,321 us" in text
    assert "share one processor" in text
    assert "p99.9 5,432 us" in text
    assert "p99.9 6,543 us" in text
    assert "p99.9 765 us late" in text
    for what in ("share one processor", "on another processor", "kept awake"):
        assert what not in page(run)


def test_a_run_is_compared_by_its_ratios_to_the_bare_network_and_not_by_its_times(run: Run) -> None:
    # The other computer is ten times slower; one estimator alone has become dearer.
    slower = run.model_copy(update={
        "estimators": (estimator("regression", 450, 0.35), estimator("small", 1100, 1.6, ratio=1.0)),
        "daemon": (cell("idle", 125.0, p50_us=1000.0),),
    })  # fmt: skip
    rows = {row[0]: row[1:] for row in tables.comparison_table(run, slower).rows}
    assert rows["regression"] == ["2.00", "2.00", "+0%"]
    assert rows["small"] == ["2.00", "1.00", "+100%"]
    assert rows["daemon, idle, 125 frames/s"] == ["1.50", "1.50", "+0%"]
    assert rows["atlas, tracking"] == ["2.00", "-", "-"]


def test_a_budget_is_held_or_not_by_its_own_sense(run: Run) -> None:
    budgets = {budget.what: budget for budget in BUDGETS}
    idle, full = budgets["idle frame, source to decision"], budgets["idle, full speed"]
    assert idle.read(run) == 1.5
    assert not idle.holds(1.5)
    assert idle.holds(0.2)
    assert full.read(run) == 25_000
    assert not full.holds(25_000)
    assert full.holds(25_000, margin=5)
    assert budgets["keypad frame"].read(run) is None  # that scene was not run
    verdicts = {row[0]: row[3] for row in tables.budget_table(run).rows}
    assert verdicts["idle frame, source to decision"] == "not held"
    assert verdicts["moving finger, source to message handed to the socket"] == "held"


def test_a_stored_run_can_be_shown_and_made_a_page_without_measuring(run: Run, tmp_path: Path) -> None:
    stored, docs = tmp_path / "run.json", tmp_path / "docs"
    results.store(run, stored)
    docs.mkdir()
    done = click.testing.CliRunner().invoke(
        command, ["--from", str(stored), "--docs", str(docs), "--compare", str(stored)]
    )
    assert done.exit_code == 0, done.output
    assert "atlas, tracking" in done.output
    assert (docs / "benchmarks.md").read_text() == page(run)
    assert results.load(docs / "benchmarks.json") == run
    assert sorted(file.name for file in (docs / PICTURES).iterdir()) == ["errors.png"]
    assert sorted(file.name for file in docs.iterdir()) == [PICTURES, "benchmarks.json", "benchmarks.md"]


def test_run_in_docs() -> None:
    """The stored run that docs/ shows is a whole one, made within three minutes."""
    run = results.load(DOCS / "benchmarks.json")
    assert not run.quick
    assert run.seconds < 180
