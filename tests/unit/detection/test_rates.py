"""The same statistics per time at any frame rate, and while the rate changes."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest

from touchd.config.schema import GateSettings, Settings
from touchd.detection.baseline import Baseline
from touchd.detection.detector import Detector
from touchd.detection.gate import Gate
from touchd.detection.pace import USUAL_NS, Pace
from touchd.frame import ACQUISITIONS, Frame
from touchd.outcome import Outcome

USB = ACQUISITIONS["usb"].model_copy(update={"channels": 2})
SHAPE = USB.shape
RATES_HZ = [10, 50, 125, 250, 500]


class Plate:
    """A detector on an untouched plate of noise, frame by frame."""

    def __init__(self) -> None:
        self.detector = Detector(USB, Settings(), lambda _reason, _fields: None)
        self.t_ns, self.number = 10**12, 0
        self._rng = np.random.default_rng(7)
        self._plate = 1000 * np.sin(np.arange(500).reshape(SHAPE))
        self.counts = np.zeros(SHAPE, np.int16)
        self.tone = 0.0
        self.tones_hz: tuple[float, ...] = ()

    def frame(self, rate_hz: float, change: float = 0.0, repeat: bool = False) -> Outcome:
        """Play one frame, with a tone if there is one, and let what came of it have its effect."""
        self.t_ns += round(1e9 / rate_hz)
        self.number += 1
        if not repeat:
            noise = self._rng.normal(0, 5, SHAPE)
            noise += self.tone * np.sin(0.7 * np.arange(SHAPE[1]) + self._rng.uniform(0, 6.28))
            self.counts = np.rint((1 + change) * self._plate + noise).astype(np.int16)
        detection = self.detector.detect(Frame(self.counts, self.number, self.t_ns, self.t_ns))
        if self.tone and detection.outcome is Outcome.TOUCHED:
            detection = self.detector.clean(detection)
        self.tones_hz = detection.tones_hz
        if detection.outcome > Outcome.LEARNING:
            self.detector.adapt(detection, found=False, departure=False, alive=False)
        return detection.outcome

    def play(self, rate_hz: float, seconds: float) -> list[Outcome]:
        return [self.frame(rate_hz) for _ in range(round(seconds * rate_hz))]


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_false_alarms(rate_hz: int) -> None:
    """Noise opens the gate as often in an hour at any rate."""
    seconds, per_frame = 400.0, 1e-3
    energies = np.random.default_rng(3).chisquare(1000, round(seconds * rate_hz)).tolist()
    gate = Gate(GateSettings(false_alarm_rate=per_frame))
    gate.learn(np.array(energies[:32]))
    gate.set_period(round(1e9 / rate_hz))
    alarms = 0
    for energy in energies:
        alarms += gate.decide(energy)
        gate.is_open = False
        gate.update(energy)
    expected = per_frame * seconds * 1e9 / USUAL_NS
    # Few frames tell the noise less surely, and the gate keeps to the safe side: by 16 % at 10 frames a second.
    assert 0.3 * expected < alarms < 1.3 * expected


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_noise_memory(rate_hz: int) -> None:
    """Noise that grows by 20 % is known after the same time at any rate."""
    gate = Gate(GateSettings())
    gate.learn(np.full(32, 1000.0))
    gate.set_period(round(1e9 / rate_hz))
    for i in range(60 * rate_hz):
        gate.update(1000.0 + i % 2)
    for i in range(8 * rate_hz):
        gate.update(1200.0 * (0.5 if i % 2 else 1.5))  # no step: every other frame is below the mean
    assert gate.noise_root == pytest.approx(1000 ** (1 / 3) + (1 - np.exp(-1)) * _shift(), abs=0.03)


def _shift() -> float:
    mean = (600 ** (1 / 3) + 1800 ** (1 / 3)) / 2
    return float(mean - 1000 ** (1 / 3))


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_time_constant(rate_hz: int) -> None:
    """The baseline follows a step to 63 % in the time constant."""
    baseline = Baseline(USB, Settings().baseline)
    t_ns = 0
    for _ in range(round(0.5 * rate_hz)):
        t_ns += round(1e9 / rate_hz)
        baseline.subtract(np.full(SHAPE, 100, np.int16), t_ns)
        baseline.follow(0.0)
    assert baseline.mean.mean() == pytest.approx(100 * (1 - np.exp(-1)), rel=0.06)


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_liveness(rate_hz: int) -> None:
    """A DAQ that repeats itself is found out within 0.1 s and a frame."""
    plate = Plate()
    plate.play(rate_hz, 5.0 if rate_hz < 50 else 1.0)
    began_ns = plate.t_ns
    while not plate.detector.liveness.fault:
        plate.frame(rate_hz, repeat=True)
        assert plate.t_ns - began_ns <= 100_000_000 + 1e9 / rate_hz
    assert plate.frame(rate_hz) is Outcome.UNTOUCHED


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_threshold(rate_hz: int) -> None:
    """The detector's gate opens by noise alone in a frame as seldom as makes its rate an hour's."""
    plate = Plate()
    plate.play(125, 1.0)
    plate.play(rate_hz, max(1.0, 30 / rate_hz))
    gate, rate = plate.detector.gate, Settings().gate.false_alarm_rate
    deviates = (gate.threshold_energy ** (1 / 3) - gate.noise_root) / gate.noise_deviation
    assert NormalDist().cdf(-deviates) == pytest.approx(rate * 125 / rate_hz, rel=0.02)


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_tone(rate_hz: int) -> None:
    """A tone that has ended is forgotten after about a second."""
    plate, frames = Plate(), 0
    plate.play(rate_hz, max(1.0, 40 / rate_hz))
    plate.tone = 50.0
    plate.play(rate_hz, 1.0)
    assert plate.tones_hz
    plate.tone = 0.0
    while plate.tones_hz and frames < 10 * rate_hz:
        plate.frame(rate_hz)
        frames += 1
    assert frames / rate_hz <= 1.1


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_learned_tone(rate_hz: int) -> None:
    """A tone that sounds while the plate is learned is forgotten, too, once it has ended."""
    plate = Plate()
    plate.tone = 50.0
    plate.play(rate_hz, max(1.0, 40 / rate_hz))
    assert plate.tones_hz
    plate.tone = 0.0
    plate.play(rate_hz, 2.5)
    assert not plate.tones_hz


def test_changing_rate() -> None:
    """A plate that is scanned now quickly, now slowly stays untouched, and a change opens the gate at any rate."""
    plate = Plate()
    plate.play(125, 1.0)
    for rate_hz in (50, 125, 10, 500, 50):
        assert set(plate.play(rate_hz, 20.0)) == {Outcome.UNTOUCHED}
        assert plate.frame(rate_hz, change=0.01) is Outcome.TOUCHED
        plate.play(rate_hz, 1.0)


def test_pace() -> None:
    """A lost or late frame is no other rate; four steps in a row are."""
    pace = Pace()
    for step_ms, period_ms in ((8, 8), (16, 8), (8, 8), (20, 8), (20, 8), (20, 8), (-5, 8), *[(20, 8)] * 3, (20, 20),
                               (16, 20), (24, 20), *[(8, 20)] * 3, (8, 8)):  # fmt: skip
        pace.update(step_ms * 1_000_000)
        assert pace.period_ns == period_ms * 1_000_000
