"""`touchd evaluate` as it is typed, on touches and streams of one finger and of several."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from tests.command_line import touchd
from touchd.cli.evaluate import command
from touchd.errors import RecordingValues
from touchd.localization.model import default_model_path
from touchd.recording.format import read, write
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_scene, simulate_touches

POSITIONS = {"n", "rmse_mm", "mean_mm", "sd_mm", "median_mm", "p95_mm", "max_mm"}
SHIPPED = default_model_path()
NETWORK = SHIPPED.with_name("small.onnx")
"""Without an atlas."""
GRID = SHIPPED.with_name("grid10.onnx")


def said(*arguments: object) -> str:
    """What the verb prints; a failure is raised."""
    done = CliRunner().invoke(command, [str(argument) for argument in arguments])
    if done.exception is not None:
        raise done.exception
    return done.output


@cache
def scores(model: Path, recording: Path) -> dict[str, Any]:
    """What is found of a recording, by one run for all tests."""
    found: dict[str, Any] = json.loads(said(model, recording, "--json"))
    return found


@pytest.fixture(scope="module")
def folder(instrument: Instrument, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Touches of one finger, of two, of one or two; and streams of two fingers and of a palm."""
    folder = tmp_path_factory.mktemp("evaluate")
    one = simulate_touches(60, seed=31, instrument=instrument)
    two = simulate_touches(60, seed=32, instrument=instrument, fingers=2, apart_mm=40.0)
    write(folder / "one.npz", one)
    write(folder / "two.npz", two)
    assert one.contacts_mm is not None
    assert two.contacts_mm is not None
    nobody = np.full_like(one.contacts_mm, np.nan)
    both = replace(
        one, frames=np.concatenate([one.frames, two.frames]), sequence=np.arange(240),
        timestamp_ns=(np.arange(240) + 1000 * (np.arange(240) >= 120)) * 500_000_000, force_n=None, faces=None,
        temperature_c=None,
        contacts_mm=np.concatenate([np.concatenate([one.contacts_mm, nobody], axis=1), two.contacts_mm]),
    )  # fmt: skip
    write(folder / "both.npz", both)
    write(folder / "tap.npz", simulate_scene("tap", seed=21, instrument=instrument))
    write(folder / "two-stream.npz", simulate_scene("two", seed=21, instrument=instrument, frames=500))
    write(folder / "palm.npz", simulate_scene("palm", seed=21, instrument=instrument))
    return folder


def test_one_untouched_frame(instrument: Instrument, tmp_path: Path) -> None:
    """It tells no noise, so that there is no bound; its touch is scored nevertheless."""
    write(tmp_path / "one.npz", simulate_touches(1, seed=33, instrument=instrument))
    found = scores(SHIPPED, tmp_path / "one.npz")
    assert found["n"] == 1
    assert "bound_mm" not in found


def test_one_finger(folder: Path) -> None:
    """Touches of one finger have their scores at the top."""
    found = scores(SHIPPED, folder / "one.npz")
    assert set(found) == POSITIONS | {"confident", "within_sigma", "by_fingers", "bound_mm", "times_bound"}
    assert 1 < found["times_bound"] == found["median_mm"] / found["bound_mm"]
    assert set(found["by_fingers"]) == {"1"}
    mine = found["by_fingers"]["1"]
    assert (found["n"], mine["n"], mine["missed"], mine["ghosts"]) == (60, 60, 0, 0)
    for name in ("rmse_mm", "median_mm", "p95_mm", "max_mm"):
        assert mine[name] == found[name], "all within the reach"
    assert mine["within_1_sigma"] == found["within_sigma"]


def test_two_fingers(folder: Path) -> None:
    """Touches of two fingers have their scores below their count.

    A network of one finger finds one of two at most, and is none the less judged.
    """
    found = scores(NETWORK, folder / "two.npz")
    assert (found["n"], found["rmse_mm"]) == (0, None)
    mine = found["by_fingers"]["2"]
    assert (mine["n"], mine["count_right"], mine["told_apart"], mine["all_within_2_mm"]) == (60, 0, 0, 0)
    assert 60 <= mine["missed"] <= 120
    assert mine["missed"] - mine["ghosts"] == 60


def test_mixed(folder: Path) -> None:
    """Of a mixed recording the top scores are those of its single fingers."""
    found = scores(SHIPPED, folder / "both.npz")
    single = found["by_fingers"]["1"]
    assert {name: found[name] for name in POSITIONS if name in single} == {
        name: single[name] for name in POSITIONS if name in single
    }
    assert found["n"] == 60
    assert {key: part["n"] for key, part in found["by_fingers"].items()} == {"1": 60, "2": 60}


def test_mixed_without_noise(folder: Path) -> None:
    """They are those of the single fingers alone, to the last digit where a recording's noise decides nothing."""
    found, alone = scores(NETWORK, folder / "both.npz"), scores(NETWORK, folder / "one.npz")
    assert {name: found[name] for name in POSITIONS} == pytest.approx({name: alone[name] for name in POSITIONS})


def test_grid(folder: Path) -> None:
    """A grid is scored by its zones and by its contacts."""
    found = scores(GRID, folder / "both.npz")
    assert 0.5 < found["accuracy"] <= 1
    assert found["n"] == 60
    assert found["by_fingers"]["1"]["median_mm"] < 15
    assert scores(GRID, folder / "two.npz")["n"] == 0


def test_stream(folder: Path) -> None:
    """A stream of single touches has the scores of a stream, too."""
    found = scores(SHIPPED, folder / "tap.npz")
    assert set(found) >= POSITIONS | {"down_latency_ms", "jitter_mm", "moving_rmse_mm"}
    assert found["touches"] == found["found"] > 3
    assert (found["missed"], found["ghosts"], found["split"], found["switches"]) == (0, 0, 0, 0)
    assert set(found["by_fingers"]) == {"0", "1"}
    assert found["by_fingers"]["0"]["ghosts"] == found["by_fingers"]["1"]["missed"] == 0


def test_other_plate(folder: Path, tmp_path: Path) -> None:
    """Of a stream of another plate than the model's, `evaluate` and `draw` warn, and go on."""
    tap = read(folder / "tap.npz")
    plate = tap.meta.plate.model_copy(update={"width_mm": 210.0})
    write(tmp_path / "other.npz", replace(tap, meta=tap.meta.model_copy(update={"plate": plate})))
    for arguments in (("evaluate", NETWORK), ("draw", "-o", tmp_path / "drawn.png", "--model", NETWORK)):
        ended = touchd(*arguments, tmp_path / "other.npz")
        assert ended.code == 0, ended.err
        assert "for a plate of 200 x 200 x 5 mm of glass, the recording is of one of 210 x 200 x 5 mm" in ended.err
        assert "warning" not in touchd(*arguments, folder / "tap.npz").err


def test_single_frames(folder: Path, tmp_path: Path) -> None:
    """Of a training set, whose touches no replay finds, `draw` and `demo` say what scores it."""
    for arguments in (("draw", "-o", tmp_path / "drawn.png"), ("demo", "--speed", "max", "--json")):
        ended = touchd(*arguments, folder / "one.npz")
        assert ended.code == 0, ended.err
        assert "2 frames a second are no stream to replay: touchd evaluate scores each alone" in ended.err
    assert not touchd("draw", "-o", tmp_path / "drawn.png", folder / "tap.npz").err


def test_stream_beyond_the_plate(folder: Path, tmp_path: Path) -> None:
    """A stream whose labels lie off the plate, as in another unit, is refused: all its touches would be missed."""
    tap = read(folder / "tap.npz")
    assert tap.contacts_mm is not None
    write(tmp_path / "um.npz", replace(tap, contacts_mm=tap.contacts_mm * 1000))
    with pytest.raises(RecordingValues, match="positions lie outside the plate of 200 x 200 mm"):
        said(SHIPPED, tmp_path / "um.npz")


def test_stream_of_two(folder: Path) -> None:
    """A stream of two fingers is scored per count."""
    found = scores(SHIPPED, folder / "two-stream.npz")
    assert set(found["by_fingers"]) == {"0", "1", "2"}
    assert found["touches"] == found["found"] + found["missed"]
    truth = read(folder / "two-stream.npz").contacts_mm
    assert truth is not None
    frames = {key: part["n"] for key, part in found["by_fingers"].items()}
    down = np.isfinite(truth[..., 0]).sum(axis=1)
    assert all(0 < frames[str(k)] < (down == k).sum() for k in (1, 2)), "but those that are not settled"


def test_palm(folder: Path) -> None:
    """A palm is no touch that could be missed."""
    found = scores(SHIPPED, folder / "palm.npz")
    assert (found["n"], found["touches"], found["missed"]) == (0, 0, 0)
    assert set(found["by_fingers"]) == {"0"}


def test_table(folder: Path, tmp_path: Path) -> None:
    """A person sees a line for each score and a column for each count; the errors of both counts are drawn, too."""
    picture = tmp_path / "errors.png"
    lines = said(SHIPPED, folder / "both.npz", "--plot", picture).splitlines()
    assert picture.read_bytes().startswith(b"\x89PNG")
    found = scores(SHIPPED, folder / "both.npz")
    (start,) = (i for i, line in enumerate(lines) if line.split()[:1] == ["fingers"])
    assert lines[start].split() == ["fingers", "1", "2"]
    table = {line.split()[0]: line.split()[1:] for line in lines[start + 1 :]}
    assert table["n"] == ["60", "60"]
    assert table["told_apart"] == ["-", f"{found['by_fingers']['2']['told_apart']:.3f}"]
    assert table["median_mm"] == [f"{found['by_fingers'][k]['median_mm']:.3f}" for k in "12"]
    assert len({len(line) for line in lines[start:]}) == 1, "in columns"


def test_no_touch(folder: Path, tmp_path: Path) -> None:
    """A recording without a touch is refused."""
    whole = read(folder / "one.npz")
    assert whole.contacts_mm is not None
    write(tmp_path / "idle.npz", replace(whole, contacts_mm=np.full_like(whole.contacts_mm, np.nan), force_n=None))
    with pytest.raises(RecordingValues, match="no touched frame"):
        said(SHIPPED, tmp_path / "idle.npz")


@pytest.mark.parametrize(("model", "recording"), [(SHIPPED, "one"), (SHIPPED, "two"), (GRID, "both")])
def test_plot(model: Path, recording: str, folder: Path, tmp_path: Path) -> None:
    """Errors are drawn for one finger and for several."""
    picture = tmp_path / "errors.png"
    said(model, folder / f"{recording}.npz", "--plot", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_nothing_matched(folder: Path, tmp_path: Path) -> None:
    """Where no contact was matched nothing is drawn."""
    with pytest.raises(RecordingValues, match="no contact to plot"):
        said(GRID, folder / "two.npz", "--plot", tmp_path / "errors.png")
    assert not (tmp_path / "errors.png").exists()


def test_hundreds_of_labels_a_frame(folder: Path, tmp_path: Path) -> None:
    """A recording that claims 500 fingers in each frame is scored in bounded memory, all but the found ones missed."""
    tap = read(folder / "tap.npz")
    claimed_mm = np.random.default_rng(5).uniform(0, 200, (60, 500, 2)).astype(np.float32)
    part = replace(
        tap, frames=tap.frames[:60], sequence=tap.sequence[:60], timestamp_ns=tap.timestamp_ns[:60],
        contacts_mm=claimed_mm, force_n=None, faces=None, temperature_c=None,
    )  # fmt: skip
    write(tmp_path / "claimed.npz", part)
    tracemalloc.start()
    try:
        found = scores(SHIPPED, tmp_path / "claimed.npz")
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    mine = found["by_fingers"]["500"]
    assert mine["n"] == 60
    assert mine["missed"] >= 60 * (500 - 10), "ten contacts at most are ever found"
    assert peak_bytes < 100e6, f"{peak_bytes / 1e6:.0f} MB"
