"""An audio interface as a DAQ, over a fake at the seam of the library with the twin's plate behind it."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from structlog.testing import capture_logs

from tests.audiocard import FakeCard, answers
from tests.processes import PATIENCE_S
from touchd.audio.capture import HighPass, periods_of, rates_of
from touchd.audio.card import Card, CardAbsent, loop_of
from touchd.cli.demo import SESSION
from touchd.config.rigs import AudioSettings
from touchd.config.schema import DeviceSettings, Settings
from touchd.errors import ConfigError, ModelMismatch
from touchd.frame import ACQUISITIONS, Frame
from touchd.localization.model import Model, default_model_path
from touchd.pipeline import Pipeline
from touchd.recording.format import read
from touchd.sources.audio import AudioDaq, acquisition_of, open_audio, rate_of
from touchd.sources.daq import DaqAbsent, DaqFrame, DaqGone, Waits
from touchd.sources.live import DaqSource
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.simulate import DEFAULT_PLATE

SESSION_ = read(SESSION)
ACQUISITION = SESSION_.acquisition
RATE_HZ, PERIOD = 125, 2000
SETTINGS = AudioSettings(sample_rate_hz=250_000, band_hz=(50e3, 100e3), chirp_s=1e-3)
UNTOUCHED = SESSION_.frames[:40]


def filtered(frames: np.ndarray) -> np.ndarray:
    """The mean of frames as an audio interface's are: without what lies below the chirp's band."""
    whole = np.zeros((4, PERIOD))
    whole[:, : ACQUISITION.samples] = frames.mean(axis=0)
    return HighPass(50e3, 250e3, *ACQUISITION.shape).around(whole)[:, : ACQUISITION.samples]


EXPECTED = filtered(UNTOUCHED)


@pytest.fixture(scope="module")
def model() -> Model:
    return Model(default_model_path())


@pytest.fixture(scope="module")
def reference(model: Model) -> np.ndarray:
    assert model.atlas is not None
    return model.atlas.baseline.astype(float)


def plate(**options: object) -> FakeCard:
    """A card with the session's untouched plate."""
    return FakeCard(ACQUISITION, answers(UNTOUCHED), PERIOD, **options)  # type: ignore[arg-type]


def started(card: FakeCard, reference: np.ndarray | None, settings: AudioSettings = SETTINGS) -> AudioDaq:
    daq = AudioDaq(card.open(), settings, ACQUISITION, reference, clock=card.clock)
    daq.start(RATE_HZ)
    return daq


def frames(daq: AudioDaq, count: int, blocks: int = 20_000) -> list[DaqFrame]:
    """The next frames, with copies of their counts."""
    found: list[DaqFrame] = []
    for _ in range(blocks):
        frame = daq.read(0.1)
        if frame is not None:
            found.append(
                DaqFrame(frame.counts.copy(), frame.sequence, frame.timestamp_us, frame.clipped, frame.withheld)
            )
            if len(found) == count:
                return found
    raise AssertionError(f"{len(found)} of {count} frames in {blocks} blocks")


def off_db(counts: np.ndarray, expected: np.ndarray) -> float:
    """How far counts are from what is expected, relative to it."""
    return float(10 * np.log10(np.square(counts - expected).sum() / np.square(expected).sum()))


@pytest.mark.parametrize("seed", range(4))
def test_any_delay_is_found(reference: np.ndarray, seed: int) -> None:
    """Whatever the delay of a start, whole or not, frames are those of a DAQ that triggers on the chirp."""
    card = plate(seed=seed)
    counts = np.mean([frame.counts for frame in frames(started(card, reference), 10)], axis=0)
    assert off_db(counts, EXPECTED) < -50


@pytest.mark.parametrize("block", [300, 2500, 30_000])
def test_any_block(reference: np.ndarray, block: int) -> None:
    """A card, or a sound server, that hands over many periods at a time loses none of them."""
    found = frames(started(plate(block=block), reference), 40)
    assert [frame.sequence for frame in found] == list(range(40))
    assert off_db(np.mean([frame.counts for frame in found], axis=0), EXPECTED) < -50


@contextmanager
def source_of(card: FakeCard, reference: np.ndarray | None, settings: AudioSettings = SETTINGS) -> Iterator[DaqSource]:
    """The source that a daemon would have, on the card's clock."""

    def connect() -> AudioDaq:
        try:
            return AudioDaq(card.open(), settings, ACQUISITION, reference, clock=card.clock)
        except Exception as error:
            raise DaqAbsent(str(error)) from error

    source = DaqSource(
        lambda: iter([connect]), DeviceSettings(queue_frames=10_000), ACQUISITION, lambda _: None,
        waits=Waits(0.01, 1e-3, 2e-3), clock=card.clock, direct=False,
    )  # fmt: skip
    try:
        yield source
    finally:
        source.close()


def until_s(source: DaqSource) -> Iterator[Frame | None]:
    """What a source reads, while there is patience."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        yield source.read(0.1)
        source.changes()


def placed(pipeline: Pipeline, frames: Iterator[Frame | None], stop: int) -> list[list[tuple[float, float]]]:
    """The places of each contact."""
    found: dict[int, list[tuple[float, float]]] = {}
    first: int | None = None
    for frame in frames:
        if frame is None:
            continue
        first = frame.sequence if first is None else first
        for contact in pipeline.process(frame).contacts:
            found.setdefault(contact.id, []).append((contact.x_mm, contact.y_mm))
        if frame.sequence - first == stop:
            break
    return list(found.values())


@pytest.mark.parametrize("gains", [(1.0, 1.0, 1.0, 1.0), (0.1, 2.5, 1.0, 0.5)])
def test_the_whole_way(model: Model, reference: np.ndarray, gains: tuple[float, ...]) -> None:
    """From what a card captures to contacts: the session's touches, each where a triggered DAQ finds it, however the
    interface's knobs are turned."""
    session = SESSION_.frames
    card = FakeCard(ACQUISITION, answers(np.concatenate([np.repeat(UNTOUCHED, 4, axis=0), session])), PERIOD, seed=7)
    card.gains[:] = gains
    with source_of(card, reference) as source:
        by_card = placed(Pipeline(ACQUISITION, model, Settings()), until_s(source), len(session) + 40)
    replayed = (Frame(counts, i, 8_000_000 * i, 8_000_000 * i) for i, counts in enumerate(session))
    by_daq = placed(Pipeline(ACQUISITION, model, Settings()), replayed, len(session))
    assert len(by_card) == len(by_daq) == 6
    for one, other in zip(by_card, by_daq, strict=True):
        apart_mm = np.linalg.norm(np.array(one)[:, None] - np.array(other)[None], axis=2).min(axis=1)
        assert np.median(apart_mm) < 0.1


@pytest.mark.parametrize(("modelled", "most_db"), [(True, -65), (False, -60)])
def test_an_xrun_is_counted_and_costs_no_accuracy(reference: np.ndarray, modelled: bool, most_db: float) -> None:
    """The periods of an xrun are withheld by name, the next frames are numbered after them and look as before, also
    where the first sound alone told the delay."""
    card = plate(seed=3)
    daq = started(card, reference if modelled else None)
    before = frames(daq, 20)
    card.xrun = True
    after = frames(daq, 100)
    withheld = [frame for frame in after if frame.withheld]
    good = [frame for frame in after if not frame.withheld]
    assert {frame.withheld for frame in withheld} == {"xrun"}
    assert 20 < len(withheld) < 60, "0.2 to 0.5 s"
    numbers = [frame.sequence for frame in (*before, *after)]
    assert numbers == list(range(len(numbers)))
    gap_us = good[0].timestamp_us - before[-1].timestamp_us
    assert abs(gap_us - 8000 * (len(withheld) + 1)) < 8000
    means = [np.mean([frame.counts for frame in some], axis=0) for some in (before, good)]
    assert off_db(means[1], means[0]) < most_db


@pytest.mark.parametrize("loopback", [0, 5])
def test_an_xrun_while_it_starts_costs_no_second(reference: np.ndarray, loopback: int) -> None:
    """Just before its first frame, when all that was measured is lost, too."""
    card = plate(loopback=0.3 if loopback else 0.0)
    settings = SETTINGS.model_copy(update={"loopback": loopback})
    daq = started(card, None if loopback else reference, settings)
    frames(daq, 1)
    card.xrun = True
    began_ns = card.clock.ns
    while (frame := daq.read(0.1)) is None or frame.withheld:
        card.xrun |= card.starts == 2 and card.clock.ns - began_ns > 320e6
    assert card.starts == 3
    assert card.clock.ns - began_ns < 0.7e9


def test_a_burst_of_xruns_is_one_line_in_the_log(reference: np.ndarray) -> None:
    """A computer that is too slow for minutes fills no disk; each period is counted all the same."""
    card = plate()
    daq = started(card, reference)
    frames(daq, 1)
    with capture_logs() as logs:
        lost = 0
        for _ in range(3000):
            card.xrun |= card.clock.ns % 100_000_000 == 0
            frame = daq.read(0.1)
            lost += frame is not None and frame.withheld == "xrun"
    assert card.starts > 10
    assert lost > 300
    assert [line["event"] for line in logs] == ["xrun"]


@pytest.mark.parametrize("muted_s", [0.1, 0.3, 0.45])
@pytest.mark.parametrize("loopback", [0, 5])
def test_an_output_that_is_silent_at_first(reference: np.ndarray, muted_s: float, loopback: int) -> None:
    """Converters that mute themselves while they start are waited for, and frames are as of any other card."""
    card = plate(loopback=0.3 if loopback else 0.0)
    card.muted_s = muted_s
    settings = SETTINGS.model_copy(update={"loopback": loopback})
    daq = started(card, None if loopback else reference, settings)
    assert off_db(np.mean([frame.counts for frame in frames(daq, 10)], axis=0), EXPECTED) < -50
    assert card.starts == 1


def test_a_process_that_stood_still_knows_for_how_long(reference: np.ndarray) -> None:
    """Numbers and times of the frames after seconds without a read are those of the clock."""
    card = plate()
    daq = started(card, reference)
    (before,) = frames(daq, 1)
    began_ns = card.clock.ns
    card.clock.ns += 5_000_000_000
    card.xrun = True
    after = next(frame for frame in iter(lambda: frames(daq, 1)[0], None) if not frame.withheld)
    gone_us = (card.clock.ns - began_ns) / 1e3
    assert abs(after.timestamp_us - before.timestamp_us - gone_us) < 16_000
    assert abs(after.sequence - before.sequence - gone_us / 8000) < 2


@pytest.mark.parametrize("rate_hz", [125, 25])
def test_frames_read_late_hide_no_loss(reference: np.ndarray, rate_hz: int) -> None:
    """What an xrun loses begins behind the last frame's samples, not when they were read."""
    card = plate()
    daq = started(card, reference)
    daq.set_rate(rate_hz)
    before = frames(daq, 50 * rate_hz // 125)
    began_ns = card.clock.ns
    card.clock.ns += 80_000_000
    card.behind_ns = 80_000_000
    before += frames(daq, 5 * rate_hz // 125)
    card.xrun = True
    after = next(frame for frame in iter(lambda: frames(daq, 1)[0], None) if not frame.withheld)
    gone_us = (card.clock.ns - began_ns) / 1e3 - 40_000
    assert abs(after.timestamp_us - before[-1].timestamp_us - gone_us) < 16_000
    assert abs(after.sequence - before[-1].sequence - gone_us / 8000) < 2


def test_lower_rate(reference: np.ndarray) -> None:
    """At a lower rate chirps go on and frames are left out: numbers have no gaps, times tell, an xrun is withheld."""
    card = plate(seed=3)
    daq = started(card, reference)
    found = frames(daq, 5)
    daq.set_rate(50)
    found += frames(daq, 10)
    daq.set_rate(10)
    found += frames(daq, 1)
    passed_ns = card.clock()
    for _ in range(60):
        assert daq.read(0.1) is None
    card.xrun = True
    lost = frames(daq, 60)
    while lost[-1].withheld:
        lost += frames(daq, 1)
    gone_us = (card.clock() - passed_ns) / 1e3
    daq.set_rate(125)
    back = frames(daq, 10)
    everything = [*found, *lost, *back]
    assert [frame.sequence for frame in everything] == list(range(len(everything)))
    for some, step_us in ((found[:5], 8000), (found[6:-1], 16_000), (back, 8000)):
        assert set(np.diff([frame.timestamp_us for frame in some])) == {step_us}
    assert abs(lost[-1].timestamp_us - found[-1].timestamp_us - gone_us) < 16_000
    assert off_db(np.mean([frame.counts for frame in (*found[6:], *back)], axis=0), EXPECTED) < -50


def test_an_unplugged_card_is_gone(reference: np.ndarray) -> None:
    card = plate()
    card.unplugged_at_play = True
    with pytest.raises(DaqGone, match="No such device"):
        frames(started(card, reference), 3)
    card.unplugged_at_play = False
    daq = started(card, reference)
    frames(daq, 3)
    card.unplugged = True
    with pytest.raises(DaqGone, match="No such device"):
        frames(daq, 3)


def test_a_rate_in_name_alone_is_refused(reference: np.ndarray) -> None:
    """A card that resamples passes nothing above half of its own rate."""
    card = plate()
    card.lowpass_hz = 88_200
    with pytest.raises(DaqGone, match=r"nothing arrives above 88\.2 kHz"):
        frames(started(card, reference), 1)


@pytest.mark.parametrize("loopback", [0, 5])
def test_swapped_cables_are_told(reference: np.ndarray, loopback: int) -> None:
    """Also where a cable tells the delay."""
    card = plate(loopback=0.3 if loopback else 0.0)
    card.order[:2] = [1, 0]
    with pytest.raises(DaqGone, match="input of disc 2 where that of disc 1 should be"):
        frames(started(card, reference, SETTINGS.model_copy(update={"loopback": loopback})), 1)


@pytest.mark.parametrize("loopback", [0, 5])
def test_nothing_heard_is_told(reference: np.ndarray, loopback: int) -> None:
    card = plate(loopback=0.3 if loopback else 0.0)
    card.gains[:4] = 0
    with pytest.raises(DaqGone, match="nothing is heard: check the output's cable"):
        frames(started(card, reference, SETTINGS.model_copy(update={"loopback": loopback})), 1)


@pytest.mark.parametrize(
    ("gain", "order", "told"),
    [
        (0.0, [0, 1, 2, 3, 4], "nothing is heard at the loopback input"),
        (1.0, [0, 1, 2, 3, 0], "the loopback input hears something else"),
    ],
)
def test_a_loopback_without_its_cable_is_told(gain: float, order: list[int], told: str) -> None:
    """An input that hears nothing, or a disc, tells no delay, and no plate is blamed for it."""
    card = plate(loopback=0.3)
    card.gains[4], card.order = gain, order
    with pytest.raises(DaqGone, match=told):
        frames(started(card, None, SETTINGS.model_copy(update={"loopback": 5})), 1)


def change_to(source: DaqSource, state: str) -> str:
    """Read until the source enters a state, and return the reason."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        source.read(0.1)
        for change in source.changes():
            if change.state == state:
                return change.reason
    raise AssertionError(state)


def test_a_busy_card_and_a_silent_one_are_awaited() -> None:
    """Frames come once another program lets go of the card, and again once a card that fell silent speaks."""
    audio = AudioSettings(sample_rate_hz=96_000, band_hz=(15e3, 44e3), chirp_s=1e-3, loopback=5)
    acquisition = acquisition_of(audio)
    chirp = 2**14 * loop_of(acquisition.chirp, 96_000, acquisition.samples, audio.level_dbfs)
    card = FakeCard(acquisition, lambda _: np.tile(chirp, (4, 1)), acquisition.samples, loopback=0.3)
    card.busy = True
    settings = Settings(audio=audio, device=DeviceSettings(stall_s=0.05))  # a start takes longer than that
    source = open_audio(settings, lambda *_: card.open(), card.name, None, clock=card.clock)
    with closing(source):
        assert "in use by another program" in change_to(source, "lost")
        card.busy = False
        change_to(source, "streaming")
        card.silent = True
        change_to(source, "stalled")
        card.silent = False
        change_to(source, "streaming")


@pytest.mark.parametrize("again", [False, True])
def test_a_card_that_falls_silent_at_an_xrun_has_stalled(reference: np.ndarray, again: bool) -> None:
    """Periods withheld by the clock alone hide neither a card that brings nothing, nor one that brings xruns only."""
    card = plate()
    with source_of(card, reference) as source:
        change_to(source, "streaming")
        card.silent_at_xrun, card.xruns_only, card.xrun = not again, again, True
        change_to(source, "stalled")
        card.silent = card.silent_at_xrun = card.xruns_only = False
        change_to(source, "streaming")


def test_another_plate_is_told(reference: np.ndarray) -> None:
    """A delay that nothing confirms is no delay."""
    other = np.roll(reference[:, ::-1], 40, axis=1)
    with pytest.raises(DaqGone, match="not the plate that the model was made for"):
        frames(started(plate(), other), 1)


def test_another_program_that_plays_is_told(reference: np.ndarray) -> None:
    card = plate()
    card.disturbance = 60_000.0
    with pytest.raises(DaqGone, match="another program"):
        frames(started(card, reference), 1)


def test_a_gain_knob_ends_nothing(reference: np.ndarray) -> None:
    """The delay is found at any gains, and frames go on while a knob is turned."""
    card = plate()
    card.gains[:] = (0.3, 2.0, 1.0, 0.5)
    daq = started(card, reference)
    counts = np.mean([frame.counts for frame in frames(daq, 10)], axis=0)
    assert off_db(counts / card.gains[:, None], EXPECTED) < -55
    card.gains[0] *= 0.6
    assert len(frames(daq, 20)) == 20


@pytest.mark.parametrize("gains", [(-1, -1, -1, -1), (1, -1, 1, 1)])
def test_wires_that_are_swapped_since_the_model_was_made(reference: np.ndarray, gains: tuple[int, ...]) -> None:
    """An emitter, or a receiver, soldered the other way round inverts what is heard: it is heard, and watched."""
    card = plate()
    card.gains[:] = gains
    with capture_logs() as logs:
        daq = started(card, reference)
        counts = np.mean([frame.counts for frame in frames(daq, 10)], axis=0)
    assert off_db(counts * np.array(gains)[:, None], EXPECTED) < -50
    assert not [line for line in logs if "hear nothing" in line["event"]]
    card.gains[1] = 0
    with pytest.raises(DaqGone, match="input 2 no longer hears"):
        frames(daq, 5)


@pytest.mark.parametrize("fault", ["muted", "swapped", "slipped"])
def test_a_change_while_it_runs_ends_the_connection(reference: np.ndarray, fault: str) -> None:
    """Frames that would show a hand on the plate are none: within three of them the source starts afresh."""
    card = plate()
    daq = started(card, reference)
    frames(daq, 20)
    if fault == "muted":
        card.gains[2] = 0
    elif fault == "swapped":
        card.order = [0, 3, 2, 1]
    else:
        card.slip = 3
    with pytest.raises(DaqGone, match="no longer hears the chirp"):
        frames(daq, 5)


def test_a_dead_channel_does_not_keep_the_others_from_working(reference: np.ndarray) -> None:
    card = plate()
    card.gains[1] = 0
    counts = np.mean([frame.counts for frame in frames(started(card, reference), 10)], axis=0)
    kept = [0, 2, 3]
    assert off_db(counts[kept], EXPECTED[kept]) < -50


@pytest.mark.parametrize("noise", [0.0, 1.0, 100.0])
@pytest.mark.parametrize("loopback", [0, 5])
def test_a_dead_channel_of_a_plate_without_a_model(loopback: int, noise: float) -> None:
    """A disc whose cable is off, in silence or noise, is no reason to start again and again: nothing of it is lost."""
    rng = np.random.default_rng(0)

    def response(number: int) -> np.ndarray:
        heard: np.ndarray = UNTOUCHED[number % 40].astype(float)
        heard[1] = rng.normal(0, noise, len(heard[1]))
        return heard

    card = FakeCard(ACQUISITION, response, PERIOD, loopback=0.3 if loopback else 0.0)
    with capture_logs() as logs:
        assert len(frames(started(card, None, SETTINGS.model_copy(update={"loopback": loopback})), 100)) == 100
    assert [line["inputs"] for line in logs if "hear nothing" in line["event"]] == [[2]]
    assert card.starts == 1


@pytest.mark.parametrize(("same", "off"), [(True, (-200, -40)), (False, (-10, 20))])
def test_a_card_that_comes_back_has_its_delay_from_before(same: bool, off: tuple[int, int]) -> None:
    """A plate without a model or a cable is recorded on: its frames begin where they began before, far more exactly
    than the first sound tells. Another plate is heard as what it is."""
    audio = AudioSettings(sample_rate_hz=96_000, band_hz=(15e3, 44e3), chirp_s=1e-3)
    acquisition = acquisition_of(audio)
    rng = np.random.default_rng(3)
    rings = np.exp(-np.arange(96) / 12) * rng.normal(0, 1, (2, 4, 96))
    chirp = 2**13 * loop_of(acquisition.chirp, 96_000, 96, audio.level_dbfs)
    plates = np.fft.irfft(np.fft.rfft(rings) * np.fft.rfft(chirp), 96)
    on = [plates[0]]
    card = FakeCard(acquisition, lambda _: on[0], 96)
    source = open_audio(Settings(audio=audio), lambda *_: card.open(), card.name, None, clock=card.clock)
    means = []
    with closing(source):
        for _ in range(2):
            heard = (frame for frame in until_s(source) if frame is not None)
            means.append(np.mean([next(heard).counts for _ in range(10)], axis=0))
            card.unplugged = True
            change_to(source, "lost")
            on[0] = plates[0 if same else 1]
            card.unplugged = False
            change_to(source, "streaming")
    assert off[0] < off_db(means[1], means[0]) < off[1]


def humming(amplitude: float) -> FakeCard:
    """A card whose inputs all hear a low hum, too."""
    time_s = np.arange(PERIOD) / ACQUISITION.sample_rate_hz
    hum = amplitude * np.cos(2 * np.pi * 125 * time_s)

    def response(number: int) -> np.ndarray:
        full = np.tile(hum, (4, 1))
        full[:, : ACQUISITION.samples] += UNTOUCHED[number % 40]
        return full

    return FakeCard(ACQUISITION, response, PERIOD)


def test_clipping_is_counted(reference: np.ndarray) -> None:
    """Samples that clip are at the limit in the frame, where `touchd doctor` looks for them, be it by a hum."""
    assert not frames(started(plate(), reference), 5)[-1].clipped
    frame = frames(started(humming(20_000), reference), 5)[-1]
    assert frame.clipped
    at_limit = (frame.counts == 2**15 - 1) | (frame.counts == -(2**15))
    assert at_limit.any(axis=1).tolist() == [False, False, False, True]


def test_the_loopback_channel_tells_the_delay() -> None:
    """With a cable no model is needed, and two starts give the same frames."""
    settings = SETTINGS.model_copy(update={"loopback": 5})
    means = []
    for seed in (1, 2):
        daq = started(plate(seed=seed, loopback=0.3), None, settings)
        means.append(np.mean([frame.counts for frame in frames(daq, 10)], axis=0))
    assert off_db(means[0], means[1]) < -60
    assert off_db(means[0], EXPECTED) < -50


def test_without_either_the_first_sound_tells_it() -> None:
    """A plate that has no model yet can be recorded: the frame begins with what arrives first, to 20 us."""
    card = plate(seed=5)
    daq = started(card, None)
    counts = np.mean([frame.counts for frame in frames(daq, 10)], axis=0)
    assert np.square(counts[:, :5]).sum() < np.square(counts[:, 10:]).mean() * 40


def test_a_low_hum_is_left_out(reference: np.ndarray) -> None:
    """Mains hum as strong as the signal does not reach the frames."""
    card = humming(5000)
    counts = np.mean([frame.counts for frame in frames(started(card, reference), 10)], axis=0)
    assert off_db(counts, EXPECTED) < -40


@pytest.mark.parametrize(
    ("name", "settings", "rate_hz", "chirps"),
    [
        ("audio-192", AudioSettings(), 125, 2),
        ("audio-96", AudioSettings(sample_rate_hz=96_000, band_hz=(15e3, 44e3), chirp_s=1e-3), 1000, 1),
        ("audio-96", AudioSettings(sample_rate_hz=96_000, band_hz=(15e3, 44e3), chirp_s=1e-3), 125, 8),
    ],
)
def test_steady_state(name: str, settings: AudioSettings, rate_hz: int, chirps: int) -> None:
    """One chirp after the other: frames are what a model of that geometry was made for, quieter where they are means
    of several chirps, and the first comes within a second of a start."""
    acquisition = acquisition_of(settings)
    assert (acquisition.shape, acquisition.chirp) == (ACQUISITIONS[name].shape, ACQUISITIONS[name].chirp)
    untouched = 8000 * Instrument(DEFAULT_PLATE, acquisition=acquisition).untouched([REFERENCE_C])[0]
    rng = np.random.default_rng(0)
    card = FakeCard(acquisition, lambda _: untouched + rng.normal(0, 4, untouched.shape), acquisition.samples, seed=1)
    daq = AudioDaq(card, settings, acquisition, untouched, clock=card.clock)
    began_ns = card.clock()
    daq.start(rate_hz)
    counts = [frame.counts for frame in frames(daq, 1)]
    assert card.clock() - began_ns < 1e9
    counts += [frame.counts for frame in frames(daq, 30)]
    high_pass = HighPass(settings.band_hz[0], settings.sample_rate_hz, *acquisition.shape)
    assert off_db(np.mean(counts, axis=0), high_pass.around(untouched)) < -60
    assert np.std(np.array(counts) - np.mean(counts, axis=0)) < 4.2 / np.sqrt(chirps)


def test_a_frame_rate_that_no_chirps_fill_is_refused() -> None:
    """192 kHz and chirps of 4 ms make 250 frames a second, or a whole part of that."""
    with pytest.raises(ConfigError, match="use 250, or a whole part of it"):
        periods_of(ACQUISITIONS["audio-192"], 100)


@pytest.mark.parametrize(
    ("sample_rate_hz", "chirp_s", "rate_hz"), [(192_000, 0.004, 125), (96_000, 0.001, 125), (192_000, 0.005, 100)]
)
def test_the_default_rate_is_one_that_chirps_fill(sample_rate_hz: int, chirp_s: float, rate_hz: int) -> None:
    """Whoever sets no frame rate gets the one nearest to 125 without a pause between chirps; one that is set stays."""
    audio = AudioSettings(sample_rate_hz=sample_rate_hz, band_hz=(15e3, 44e3), chirp_s=chirp_s)
    acquisition = acquisition_of(audio)
    assert rate_of(acquisition, DeviceSettings()) == rate_hz
    assert rate_of(acquisition, DeviceSettings(rate_hz=50)) == 50
    source = open_audio(Settings(audio=audio), refuse, "hw:CARD=none", None)
    source.close()
    assert source.rate_hz == rate_hz


def refuse(name: str, _rate_hz: int, _inputs: int) -> Card:
    raise CardAbsent(name)


def test_a_model_of_another_acquisition_is_refused(model: Model) -> None:
    with pytest.raises(ModelMismatch):
        open_audio(Settings(), refuse, "hw:CARD=none", model)


@pytest.mark.parametrize(("sample_rate_hz", "chirp_s"), [(192_000, 0.003), (44_100, 0.004), (192_000, 1e-4)])
def test_chirps_that_fill_no_rate_are_refused(sample_rate_hz: int, chirp_s: float) -> None:
    """Of chirps of 3 ms no number lasts a whole part of a second; the nearest length that does is named, and works."""
    audio = AudioSettings(sample_rate_hz=sample_rate_hz, band_hz=(15e3, 20e3), chirp_s=chirp_s)
    acquisition = acquisition_of(audio)
    assert rates_of(acquisition) == []
    with pytest.raises(ConfigError, match="no rate fits") as failed:
        periods_of(acquisition, rate_of(acquisition, DeviceSettings()))
    named = re.search(r"audio.chirp_s = (\S+):", failed.value.fix)
    assert named is not None
    assert float(named[1]) == pytest.approx(chirp_s, rel=0.1)
    assert rates_of(acquisition_of(audio.model_copy(update={"chirp_s": float(named[1])})))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"band_hz": (1, 85e3)}, "less than a period of 1 Hz"),
        ({"chirp_s": 1e-4, "band_hz": (5e3, 85e3)}, "less than a period of 5000 Hz"),
        ({"sample_rate_hz": 768_000, "chirp_s": 0.1}, "more than 65536 samples"),
    ],
)
def test_a_chirp_that_cannot_be(wrong: dict[str, Any], told: str) -> None:
    """A chirp without a whole wave, or longer than a frame can be, is refused when the configuration is read.

    The filter of a band from 1 Hz on took a minute to compute; a frame too long was an internal error.
    """
    with pytest.raises(ValidationError, match=told):
        AudioSettings(**wrong)


@pytest.mark.parametrize("name", ["hw:CARD=\udcff", "hw:\0"])
def test_a_name_that_no_message_can_say_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"audio\.device"):
        open_audio(Settings(), refuse, name, None)
