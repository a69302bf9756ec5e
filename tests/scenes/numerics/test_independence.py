"""How the work is cut up changes nothing: batches and threads of networks, threads and pieces of recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.scenes.numerics.agreement import ROUNDING_MM
from tests.scenes.numerics.independence import by_batch_and_threads, chunked, farthest_mm, whole, with_blas_threads
from touchd.evaluation.dataset import make_dataset
from touchd.recording.data import Recording
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_scene, simulate_touches


@pytest.fixture(scope="module")
def recording(instrument: Instrument) -> Recording:
    """Two fingers, which take every way through the pipeline."""
    return simulate_scene("two", seed=22, frames=300, instrument=instrument)


def test_a_network_says_the_same_in_any_batch_on_any_number_of_threads(instrument: Instrument) -> None:
    data = make_dataset(simulate_touches(80, seed=7202, instrument=instrument), least=1)
    shifts_mm = by_batch_and_threads(data.residual)
    assert max(shifts_mm) <= ROUNDING_MM
    assert shifts_mm[0] == 0.0, "one by one it is what the daemon runs"


def test_a_recording_in_any_pieces_gives_the_same_events_to_the_bit(recording: Recording, tmp_path: Path) -> None:
    entire = whole(recording, tmp_path)
    assert len(entire) > 20
    for name, pieces in chunked(recording, tmp_path, (3, 64)):
        assert pieces == entire, name


def test_the_threads_of_the_linear_algebra_do_not_matter(recording: Recording, tmp_path: Path) -> None:
    entire = whole(recording, tmp_path)
    assert farthest_mm(entire, entire) == 0.0
    for threads in (1, 2):
        assert farthest_mm(with_blas_threads(tmp_path / "whole.npz", threads), entire) <= ROUNDING_MM
