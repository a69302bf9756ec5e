"""A recording of hours is scored in parts: with the scores of the whole, progress, and what a stopped run has done."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from touchd.config.schema import Settings
from touchd.errors import RecordingValues
from touchd.lab.replay_parts import CALM_NS, LEAD_NS, plan, score
from touchd.recording.data import Act
from touchd.recording.format import read, write
from touchd.service.replay import Replayed, run_through
from touchd.sources.source import Source
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_scene

PERIOD_NS, CHUNK, CHUNKS, PART, PARTS = 16_000_000, 625, 12, 2500, 3


@pytest.fixture(scope="module")
def folder(instrument: Instrument, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two minutes in chunks of 10 s, with taps in each other one, at half the usual rate."""
    folder = tmp_path_factory.mktemp("hours") / "recording"
    folder.mkdir()
    taps = simulate_scene("tap", seed=6, instrument=instrument)
    idle = simulate_scene("idle", seed=5, frames=CHUNK, instrument=instrument).frames
    assert taps.contacts_mm is not None
    tapped = slice(CHUNK // 2, CHUNK // 2 + 300)
    for number in range(CHUNKS):
        frames, contacts_mm = idle.copy(), np.full((CHUNK, 1, 2), np.nan, np.float32)
        if number % 2:
            frames[tapped], contacts_mm[tapped] = taps.frames[:600:2], taps.contacts_mm[:600:2]
        sequence = np.arange(number * CHUNK, (number + 1) * CHUNK)
        chunk = replace(taps, frames=frames, contacts_mm=contacts_mm, sequence=sequence,
                        timestamp_ns=PERIOD_NS * sequence, force_n=None, faces=None, temperature_c=None)  # fmt: skip
        write(folder / f"{number:06d}.npz", chunk, compress=False)
    return folder


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path


def test_plan(folder: Path) -> None:
    """Each frame is in one part; parts begin 2 s after a touch or later, led by a minute that does so too."""
    parts, contacts_mm = plan(folder, PART), read(folder).contacts_mm
    assert contacts_mm is not None
    touched = np.flatnonzero(np.isfinite(contacts_mm[:, 0, 0]))
    assert len(parts) == PARTS
    assert [part.first for part in parts[1:]] == [part.last + 1 for part in parts[:-1]]
    assert (parts[0].first, parts[-1].last) == (0, CHUNK * CHUNKS - 1)
    assert sum(part.frames for part in parts) == CHUNK * CHUNKS
    for part in parts:
        for at in (part.begin, part.first):
            assert ((touched > at) | (at - touched >= CALM_NS / PERIOD_NS)).all()
        assert part.begin == 0 or (part.first - part.begin) * PERIOD_NS >= LEAD_NS
        assert [int(Path(file).stem) for file in part.files] == [*range(part.begin // CHUNK, part.last // CHUNK + 1)]
    assert parts[-1].begin > 0, "nobody needs two minutes for one"
    assert len(plan(folder / "000001.npz", 10)) == 1, "a single file"


def test_same_scores(folder: Path) -> None:
    """Parts have the touches, ghosts and errors of the whole, and tell how many frames are done."""
    told: list[tuple[int, int]] = []
    parts = score(folder, Settings(), workers=2, progress=lambda *done: told.append(done), part_frames=PART)
    whole = score(folder, Settings(), progress=lambda *_: None)
    for name in ("touches", "found", "missed", "ghosts", "split", "switches", "clean"):
        assert getattr(parts, name) == getattr(whole, name), name
    assert whole.found == whole.touches > 10
    assert parts.down_latency_ms == whole.down_latency_ms
    np.testing.assert_allclose(parts.error_mm, whole.error_mm, atol=0.05)
    for name in ("fingers", "contacts", "told_apart", "frame"):
        np.testing.assert_array_equal(getattr(parts.settled, name), getattr(whole.settled, name))
    assert len(told) == PARTS
    assert told == sorted(told)
    assert told[-1] == (CHUNK * CHUNKS, CHUNK * CHUNKS)


def test_resume(folder: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After Ctrl-C the parts that have ended are not played again; after the last one nothing is left of them."""

    def stop(_done: int, _of: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        score(folder, Settings(), workers=1, progress=stop, part_frames=PART)
    played: list[Source] = []

    def noted(source: Source, settings: Settings) -> Replayed:
        played.append(source)
        return run_through(source, settings)

    monkeypatch.setattr("touchd.lab.replay_parts.run_through", noted)
    score(folder, Settings(), workers=1, progress=lambda *_: None, part_frames=PART)
    assert len(played) == PARTS - 1
    assert not list(cache.rglob("*.result"))


def test_acts(folder: Path, tmp_path: Path) -> None:
    """What a person was asked to do is known of the frames of each part: contacts of a palm are ghosts."""
    palms = Act(name="palm", begin=11 * CHUNK, end=12 * CHUNK)
    for number in range(CHUNKS):
        chunk = read(folder / f"{number:06d}.npz")
        write(tmp_path / f"{number}.npz", replace(chunk, meta=chunk.meta.model_copy(update={"acts": (palms,)})),
              compress=False)  # fmt: skip
    found = score(tmp_path, Settings(), workers=1, progress=lambda *_: None, part_frames=PART)
    assert found.ghosts > 0
    assert found.touches == found.found == found.ghosts * (CHUNKS // 2 - 1), "as many in each other chunk"


def test_labels_are_needed(folder: Path, tmp_path: Path) -> None:
    """A chunk without labels is named before anything is played."""
    write(tmp_path / "1.npz", replace(read(folder / "000000.npz"), contacts_mm=None))
    with pytest.raises(RecordingValues, match="no true contacts"):
        score(tmp_path, Settings(), progress=lambda *_: None)
