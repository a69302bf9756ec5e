"""A training set computed in parts is the one computed at once, and goes on where a killed run was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from touchd.cli.main import main
from touchd.frame import Plate
from touchd.twin.cache import parts_kept
from touchd.twin.electronics import Electronics, Impulses
from touchd.twin.instrument import Instrument
from touchd.twin.rig import Rig
from touchd.twin.scenes.robot import TouchSet
from touchd.twin.simulate import BLOCK, Session, simulate_session, simulate_touches

PLATE = Plate(width_mm=90, height_mm=60, thickness_mm=5)
ELECTRONICS = Electronics(jitter_s=5e-9, impulses=Impulses(share=0.3))
SESSION = Session(TouchSet(150, stale_k=0.5), 3, PLATE, 5e-3, Rig(electronics=ELECTRONICS))


@pytest.mark.parametrize("chunk", [BLOCK, 2 * BLOCK, 64 * BLOCK])
def test_parts_of_any_size_make_the_same_recording(chunk: int) -> None:
    told: list[int] = []
    whole = simulate_touches(150, seed=3, instrument=Instrument(PLATE, loss=5e-3), electronics=ELECTRONICS, stale_k=0.5)
    parts = simulate_session(SESSION, workers=1, chunk=chunk, progress=told.append)
    assert sum(told) == 300
    np.testing.assert_array_equal(parts.frames, whole.frames)
    np.testing.assert_array_equal(parts.contacts_mm, whole.contacts_mm)
    np.testing.assert_array_equal(parts.temperature_c, whole.temperature_c)


def test_only_what_is_missing_is_computed_after_a_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    told: list[int] = []

    def stop_in_the_middle(frames: int) -> None:
        told.append(frames)
        if len(told) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), parts_kept("touches", SESSION) as kept:
        simulate_session(SESSION, workers=1, chunk=BLOCK, kept=kept, progress=stop_in_the_middle)
    with parts_kept("touches", SESSION) as kept:
        assert kept is not None
        stored = {path: path.stat().st_mtime_ns for path in kept.iterdir()}
        assert len(stored) == 3
        made = simulate_session(SESSION, workers=1, chunk=BLOCK, kept=kept)
        later = {path: path.stat().st_mtime_ns for path in kept.iterdir()}
        assert len(later) == 5
        assert stored.items() <= later.items()
    assert not kept.exists()
    np.testing.assert_array_equal(made.frames, simulate_session(SESSION, workers=1).frames)


@pytest.mark.parametrize("options", [("--jobs", "2"), ("--dask", "tcp://127.0.0.1:1")])
def test_scenes_refuse_to_be_divided(
    options: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", "tap", "-o", str(tmp_path / "x.npz"), *options]) == 2
    assert "apply to touches" in capsys.readouterr().err


def test_jobs_and_a_cluster_exclude_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--jobs", "2", "--dask", "tcp://127.0.0.1:1"]
    assert main(["simulate", "touches", "-o", str(tmp_path / "x.npz"), *options]) == 2
    assert "cluster's workers" in capsys.readouterr().err
