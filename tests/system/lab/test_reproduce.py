"""`touchd reproduce` from end to end, with few touches and networks of one epoch."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from touchd.cli.reproduce import command
from touchd.errors import TrainingError
from touchd.evaluation.dataset import MIN_TOUCHES
from touchd.lab.reproduction import run
from touchd.lab.reproduction.sets import simulated
from touchd.localization.model import default_model_path
from touchd.recording import format as recording
from touchd.recording.data import Recording
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

FEW = ["--epochs", "1", "--jobs", "1"]
FEW_LEARNED = 120
"""Touches to learn from, where the command asks for more."""


@pytest.fixture(scope="module")
def touches(instrument: Instrument) -> Recording:
    """A small robot's session over a part of the plate."""
    return simulate_touches(140, seed=4, instrument=instrument, margin_mm=60.0)


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few heads and two shares instead of ten and five."""
    monkeypatch.setattr(run, "GRIDS", (2, 10))
    monkeypatch.setattr(run, "HEADS", ("R", "C-2", "C-10"))
    monkeypatch.setattr(run, "SHARES", (1.0, 0.2))
    monkeypatch.setattr(run, "KEYPAD_SEEDS", (0,))
    # Those that learn no field, which takes longer than all the rest and has tests of its own.
    monkeypatch.setattr(run, "KEYPAD_RECIPE", "paper-keypad")
    monkeypatch.setattr(run, "PLATE_RECIPE", "paper-regression")


def reproduce(*arguments: object) -> str:
    result = CliRunner().invoke(command, [str(argument) for argument in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def check(page: Path) -> str:
    """Return a report, every picture of which is there and nothing of which was left unsaid."""
    text = page.read_text()
    pictures = re.findall(r"\]\((\S+\.png)\)", text)
    assert pictures
    for picture in pictures:
        assert (page.parent / picture).stat().st_size > 5000
    assert "nan" not in text
    widths = {
        tuple(line.count("|") for line in block.splitlines()) for block in re.findall(r"(?:^\|.*\n)+", text, re.M)
    }
    assert all(len(set(width)) == 1 for width in widths), "every row has as many columns as its heading"
    return text


def test_given_recording(touches: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A given recording's faults are named, it is reported, and a second run computes nothing."""
    path, page = tmp_path / "touches.npz", tmp_path / "report.md"
    recording.write(path, touches)
    keep = ["--cache", tmp_path / "cache"]
    printed = reproduce(path, "-o", page, *FEW, *keep)
    assert "of the plate: the model is untrained elsewhere" in printed
    text = check(page)
    assert "a given recording" in text
    assert "circle" not in text, "what needs the twin is left out"
    for inconsistency in ("94.9 %", "11 x 11 cm", "class area"):
        assert inconsistency in text

    def never(*_arguments: object) -> None:
        raise AssertionError("computed again")

    monkeypatch.setattr("touchd.jobs.perform", never)
    reproduce(path, "-o", page, *FEW, *keep, "--force")
    untimed = re.compile(r"^.*\b(us|times as long)\b.*$|^\|.*\|.*\d+ \| \d+ \|$", re.M)
    assert untimed.sub("", check(page)) == untimed.sub("", text)


@pytest.mark.parametrize(("count", "named"), [(7, "7 touches"), (140, "on the central 110 mm")])
def test_too_few(count: int, named: str, instrument: Instrument, tmp_path: Path) -> None:
    """A recording of too few touches, on its plate or on the middle of it, is refused before all work."""
    recording.write(tmp_path / "few.npz", simulate_touches(count, seed=5, instrument=instrument))
    with pytest.raises(TrainingError, match=rf"few\.npz: .*{named}"):
        reproduce(tmp_path / "few.npz", "-o", tmp_path / "report.md", "--cache", tmp_path / "cache", *FEW)
    assert not (tmp_path / "cache").exists()


def test_twin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the twin the shipped models are judged on seeds of their own."""
    monkeypatch.setattr(run, "DOMAINS", ("frequency",))
    monkeypatch.setattr(run, "HEADS", ("R", "C-2", "C-5", "C-10"))
    learned = (run.TRAINING_SEED, run.CENTRAL_SEED, run.OTHER_SEED)

    def few(kind: str, count: int, seed: int) -> Recording:
        touches = FEW_LEARNED if seed in learned else MIN_TOUCHES
        return simulated(kind, count if kind == "circle" else touches, seed)

    monkeypatch.setattr(run, "simulated", few)
    page = tmp_path / "report.md"
    reproduce(
        "-o", page, "--touches", 200, *FEW, "--cache", tmp_path / "cache", "--models", default_model_path().parent
    )
    text = check(page)
    for row in ("mean error", "human finger", "keypad: accuracy", "noise 20 dB worse", "stale by 1 K", "never seen"):
        assert re.search(rf"^\| [^|]*{row}.*\d", text, re.M), row
    seeds = {run.TRAINING_SEED, run.CENTRAL_SEED, run.OTHER_SEED, *run.HELD_OUT.values(), run.OTHER_HELD_OUT_SEED}
    assert len(seeds) == 3 + len(run.HELD_OUT) + 1, "no two sets have a seed in common"
