"""Messages that tell a page what it looks at: the plate, and where the fingers really are."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from touchd.config.schema import Settings
from touchd.event import DECODERS, PlateEvent, TruthEvent, encode
from touchd.frame import Acquisition, Frame, Plate
from touchd.keypad import PHONE, load_layout
from touchd.pipeline import Pipeline
from touchd.recording.data import Recording
from touchd.recording.format import write
from touchd.service.frame_feed import FeedDescription
from touchd.service.messages import Messages
from touchd.sources.replay import ReplaySource
from touchd.sources.simulated import SimulatedSource
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_scene

RIG = Acquisition(channels=4, samples=500, sample_rate_hz=500_000)
PLATE = Plate(width_mm=200, height_mm=200, material="glass")


def messages(*wanted: str) -> Messages:
    return Messages(Settings(), lambda topic: topic in wanted)


@pytest.mark.parametrize("plate", [None, PLATE])
def test_plate(plate: Plate | None) -> None:
    """A page can draw the plate, its discs and its keys; an unknown plate has no size."""
    description = FeedDescription(
        acquisition=RIG, rate_hz=125, source="usb", plate=plate, emitter_mm=(30, 100), receivers_mm=((1, 2), (3, 4))
    )
    said = messages().plate(description, load_layout(PHONE) if plate else None, 5)
    read = DECODERS["plate"].decode(encode(said))
    assert isinstance(read, PlateEvent)
    assert read == said
    assert (read.width_mm, len(read.keys)) == ((200.0, 12) if plate else (0.0, 0))
    assert (read.emitter_mm, read.receivers_mm) == ((30.0, 100.0), [(1.0, 2.0), (3.0, 4.0)])


def test_truth() -> None:
    """The truth is told in each touched frame and once after it, and not at all unless somebody wants it."""
    frame = Frame(np.zeros((4, 500), np.int16), 7, 1_000, 1_000)
    source, wanted = Mock(truth=Mock(side_effect=[[], [(1.0, 2.0)], [], []])), messages("truth")
    said = [wanted.truth(frame, source) for _ in range(4)]
    assert [one and one.contacts_mm for one in said] == [None, [(1.0, 2.0)], [], None]
    assert isinstance(said[1], TruthEvent)
    assert DECODERS["truth"].decode(encode(said[1])) == said[1]
    assert messages("touch").truth(frame, source) is None


def test_sources_know_it(instrument: Instrument, tmp_path: Path) -> None:
    """A scene and its recording tell the same places; frames without a finger none."""
    recording: Recording = simulate_scene("circle", frames=180, instrument=instrument)
    path = tmp_path / "circle.npz"
    write(path, recording, compress=False)
    replay = ReplaySource(path, speed=float("inf"))
    twin = SimulatedSource("circle", frames=180, paced=False, loop=False, instrument=instrument)
    told = []
    for _ in range(180):
        assert replay.read(10.0) is not None
        assert twin.read(60.0) is not None
        told.append(replay.truth())
        assert twin.truth() == told[-1]
    twin.close()
    assert [] in told
    assert any(told)


def test_noise_of_channels() -> None:
    """A channel with twice the noise shows it; a touched frame leaves the figures as they were."""
    pipeline = Pipeline(RIG, None, Settings())
    rng, t_ns = np.random.default_rng(1), 0
    scale = np.array([[5.0], [5.0], [10.0], [5.0]])
    assert pipeline.noise_channels() == []
    for n in range(120):
        counts = (rng.normal(size=RIG.shape) * scale).round().astype(np.int16)
        pipeline.process(Frame(counts, n, t_ns, t_ns))
        t_ns += 8_000_000
    noise = pipeline.noise_channels()
    assert noise[2] == pytest.approx(2 * noise[0], rel=0.3)
    chirp = np.arange(RIG.samples) * (1.3 + 0.002 * np.arange(RIG.samples))
    counts = np.tile(np.rint(3000 * np.sin(chirp)).astype(np.int16), (RIG.channels, 1))
    pipeline.process(Frame(counts, 120, t_ns, t_ns))
    assert pipeline.noise_channels() == noise
