"""What the examination says of frames: of good ones nothing, of each fault its name and what to do."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import Scene
from tests.scenes.stages import empty_stage
from touchd.doctor import checks as doctor
from touchd.doctor.checks import Finding, Sample, grade
from touchd.doctor.start import check_model_fit
from touchd.frame import Acquisition
from touchd.twin.instrument import Instrument
from touchd.twin.physics.other_pane import OtherPane
from touchd.twin.simulate import stream

RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
PERIOD_NS = 8_000_000
Change = Callable[[np.ndarray], np.ndarray]


def sample(counts: np.ndarray, corrupt: int = 0, period_ns: int = PERIOD_NS, acquisition: Acquisition = RIG) -> Sample:
    numbers = np.arange(len(counts))
    return Sample(acquisition, counts, numbers + 7, numbers * period_ns, corrupt)


@pytest.fixture
def idle(scene: Scene) -> np.ndarray:
    """Untouched frames."""
    return scene("idle").frames[:300]


def channel(number: int, change: Change) -> Change:
    """The same frames with one channel changed."""

    def apply(counts: np.ndarray) -> np.ndarray:
        changed = counts.astype(np.float64)
        changed[:, number] = change(changed[:, number])
        return np.clip(changed, -32768, 32767).round().astype(np.int16)

    return apply


def noisy(sigma: float) -> Change:
    return lambda signal: signal + np.random.default_rng(1).normal(0, sigma, signal.shape)


def every(check: Callable[..., Finding], counts: np.ndarray, *more: object) -> Finding:
    finding = check(sample(counts), *more)
    assert (finding.fix == "") == (finding.level == "ok"), "a fix where, and only where, something is wrong"
    return finding


def test_a_good_plate_is_ok_in_every_line(idle: np.ndarray) -> None:
    reference = idle[:32].mean(axis=0)
    findings = [
        every(doctor.check_rate, idle, 125.0), every(doctor.check_lost, idle), every(doctor.check_noise, idle),
        every(doctor.check_clipping, idle), every(doctor.check_dead, idle),
        every(doctor.check_baseline, idle, reference), doctor.check_time([50.0] * 100, 0.008),
    ]  # fmt: skip
    assert {finding.level for finding in findings} == {"ok"}
    assert len({finding.check for finding in findings}) == len(findings)


def test_taps_meanwhile_change_no_verdict(scene: Scene) -> None:
    frames = scene("tap").frames
    reference = scene("idle").frames[:32].mean(axis=0)
    assert every(doctor.check_noise, frames).level == "ok"
    assert every(doctor.check_baseline, frames, reference).level == "ok"
    assert every(doctor.check_dead, frames).level == "ok"


# -- time ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate_hz", "level"), [(125.0, "ok"), (120.0, "warning"), (62.5, "failure"), (250, "failure")])
def test_a_rate_that_was_not_asked_for(idle: np.ndarray, rate_hz: float, level: str) -> None:
    finding = doctor.check_rate(sample(idle, period_ns=round(1e9 / rate_hz)), 125.0)
    assert finding.level == level
    assert f"{rate_hz:.2f} frames per second" in finding.text


def test_lost_frames_are_counted_and_make_no_lower_rate(scene: Scene) -> None:
    recording = scene("lostframes")
    frames = Sample(recording.acquisition, recording.frames, recording.sequence, recording.timestamp_ns)
    missing = int(recording.sequence[-1] - recording.sequence[0]) + 1 - len(recording.frames)
    finding = doctor.check_lost(frames)
    assert (finding.level, finding.text.split()[0]) == ("failure", str(missing))
    assert doctor.check_rate(frames, 125.0).level == "ok"


def test_corrupt_frames_count_as_lost(idle: np.ndarray) -> None:
    assert doctor.check_lost(sample(idle, corrupt=1)).level == "warning"
    assert doctor.check_lost(sample(idle, corrupt=100)).level == "failure"


def test_a_computer_that_is_too_slow_fails_and_one_that_is_slow_at_times_is_warned_of() -> None:
    assert doctor.check_time([9000.0] * 100, 0.008).level == "failure"
    assert doctor.check_time([50.0] * 90 + [7000.0] * 10, 0.008).level == "warning"


# -- channels ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [lambda s: 0 * s, lambda s: 0 * s + 900, lambda s: noisy(3)(0 * s)],
                         ids=["zeros", "an offset", "noise alone"])  # fmt: skip
def test_a_channel_without_a_signal_is_dead_and_named_as_its_socket(idle: np.ndarray, change: Change) -> None:
    finding = every(doctor.check_dead, channel(2, change)(idle))
    assert finding.level == "failure"
    assert finding.text.endswith("channel 3 is dead")


def test_if_all_channels_are_dead_it_is_the_emitter(idle: np.ndarray) -> None:
    finding = every(doctor.check_dead, np.zeros_like(idle))
    assert finding.level == "failure"
    assert "emitter" in finding.fix
    assert every(doctor.check_noise, np.zeros_like(idle)).level == "failure"


def test_frames_that_repeat_are_no_measurement(idle: np.ndarray) -> None:
    """A DAQ that hangs, wholly or in a channel, is not praised for its low noise."""
    hangs = np.repeat(idle[:1], len(idle), axis=0)
    assert "channel 1, 2, 3, 4 repeats" in every(doctor.check_noise, hangs).text
    one = idle.copy()
    one[:, 2] = one[:1, 2]
    finding = every(doctor.check_noise, one)
    assert (finding.level, "channel 3 repeats" in finding.text) == ("failure", True)


def test_a_dead_channel_does_not_hide_the_noise_of_the_others(idle: np.ndarray) -> None:
    dead = channel(0, lambda s: 0 * s)(idle)
    assert every(doctor.check_noise, dead).level == "ok"
    assert every(doctor.check_noise, channel(1, noisy(200))(dead)).level == "warning"


@pytest.mark.parametrize(("sigma", "level"), [(3.0, "ok"), (40.0, "warning"), (1000.0, "failure")])
def test_noise_is_judged_beside_the_signal_and_the_other_channels(idle: np.ndarray, sigma: float, level: str) -> None:
    finding = every(doctor.check_noise, channel(3, noisy(sigma))(idle))
    assert finding.level == level
    assert ("channel 4 far above the others" in finding.text) == (sigma > 10)


def test_the_noise_of_a_channel_is_measured(idle: np.ndarray) -> None:
    quiet = np.repeat(idle[:1], 300, axis=0)
    measured = doctor.noise_counts(sample(channel(1, noisy(20.0))(quiet)))
    np.testing.assert_allclose(measured, [0, 20, 0, 0], rtol=0.05, atol=1e-9)


def test_clipping_names_the_channel(idle: np.ndarray) -> None:
    few = channel(0, lambda s: np.where(s == s.max(), 40000, s))(idle)
    assert every(doctor.check_clipping, few).level == "warning"
    many = every(doctor.check_clipping, channel(1, lambda s: 10 * s)(idle))
    assert many.level == "failure"
    assert many.text.endswith("channel 2")


def test_the_limit_is_that_of_the_converter(idle: np.ndarray) -> None:
    small = np.clip(idle, -2048, 2047)
    twelve = RIG.model_copy(update={"bits": 12})
    assert doctor.check_clipping(sample(small, acquisition=twelve)).level == "failure"
    assert every(doctor.check_clipping, small).level == "ok"


def test_hum_is_told_and_neither_noise_nor_a_changed_plate(idle: np.ndarray) -> None:
    """The daemon takes it out, and so do the checks: what they ask for is what it works with."""
    turns = 50.0 * (np.arange(len(idle))[:, None] * PERIOD_NS * 1e-9 + np.arange(250) / 250e3)
    hum = (3000 * np.sin(2 * np.pi * turns))[:, None, :]
    humming = np.rint(idle / 2 + hum).astype(np.int16)
    noise = every(doctor.check_noise, humming)
    print(noise.text)
    assert noise.level == "ok"
    assert noise.text.endswith("hum or vibration of up to +0 dB is taken out")
    np.testing.assert_allclose(doctor.noise_counts(sample(humming)), doctor.noise_counts(sample(idle)) / 2, rtol=0.1)
    assert every(doctor.check_baseline, humming, idle[:32].mean(axis=0)).level == "ok"


def test_another_pane_is_named_with_its_level_and_clock(instrument: Instrument) -> None:
    stage = empty_stage(3.0, seed=2633010)
    stage.other_panes.append(OtherPane(-30.0, clocks_ppm=-35.0))
    finding = doctor.find_other_pane(sample(np.concatenate(list(stream(stage, instrument, 1)))))
    assert finding is not None
    assert finding.level == "warning"
    assert finding.text.endswith("on a clock -35 ppm off")
    level_db = float(finding.text.split("chirp, ")[1].split(" dB")[0])
    assert -37 <= level_db <= -30
    assert "clock" in finding.fix


def test_nothing_else_is_another_pane(scene: Scene) -> None:
    for name in ("idle", "tap", "drift", "interference", "hold", "palm", "drop"):
        assert doctor.find_other_pane(sample(scene(name).frames[:400])) is None


# -- baseline ------------------------------------------------------------------------------------------


def test_another_gain_is_no_other_plate(idle: np.ndarray) -> None:
    reference = idle[:32].mean(axis=0)
    louder = channel(2, lambda s: 1.3 * s + 50)(idle)
    assert every(doctor.check_baseline, louder, reference).level == "ok"


def test_another_plate_is_found(idle: np.ndarray) -> None:
    reference = idle[:32].mean(axis=0)
    finding = every(doctor.check_baseline, idle[:, :, ::-1], reference)
    assert finding.level == "failure"
    assert "train" in finding.fix


def test_a_change_the_size_of_a_finger_s_is_a_warning(idle: np.ndarray) -> None:
    reference = idle[:32].mean(axis=0)
    echo = np.roll(reference, 9, axis=1) * 0.06  # -24 dB
    assert every(doctor.check_baseline, (idle + echo).astype(np.int16), reference).level == "warning"


def test_swapped_receivers_are_named(idle: np.ndarray) -> None:
    reference = idle[:32].mean(axis=0)
    finding = every(doctor.check_baseline, idle[:, [0, 2, 1, 3]], reference)
    assert finding.level == "failure"
    assert "channels 2, 3 are in another order" in finding.text


# -- limits --------------------------------------------------------------------------------------------


@given(st.floats(-100, 100), st.floats(-100, 100), st.floats(-100, 100))
def test_a_higher_value_is_never_graded_better(value: float, first: float, second: float) -> None:
    limits = min(first, second), max(first, second)
    order = ("ok", "warning", "failure")
    assert order.index(grade(value, limits)) <= order.index(grade(value + 1, limits))
    assert grade(limits[0], limits) == "ok"


def test_model_fit() -> None:
    """A daemon whose model explains its touches badly is told to be calibrated again."""
    assert check_model_fit(0.995).level == "ok"
    worn = check_model_fit(0.93)
    assert (worn.level, "93.0%" in worn.text, "calibrate" in worn.fix) == ("warning", True, True)
