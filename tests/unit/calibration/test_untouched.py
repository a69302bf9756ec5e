from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from touchd.calibration.plate_file import check_plate_file
from touchd.calibration.untouched import Untouched, check_chirp, untouched_mean
from touchd.errors import CalibrationError, PlateMismatch, PlateTouched, PlateUnsteady, SignalClipped
from touchd.frame import Acquisition, Chirp, Plate
from touchd.recording.data import Meta, Recording

SAID = check_plate_file({
    "plate": {"width_mm": 200, "height_mm": 150, "thickness_mm": 5, "material": "glass"},
    "discs": {"diameter_mm": 6, "emitter_mm": [30, 100], "receivers_mm": [[15, 15], [185, 20]]},
})  # fmt: skip
COUNT = 200
SIGNAL = 5000 * np.random.default_rng(0).standard_normal((2, 100)) / 3
OTHER = np.random.default_rng(1).standard_normal((2, 100)) * np.sqrt((SIGNAL**2).mean())
NOISE = 3.0


def recording(signal: NDArray[np.float64] | None = None, **meta: Any) -> Recording:
    """An untouched recording with white noise; `signal` is added, of shape (COUNT, 2, 100)."""
    rng = np.random.default_rng(2)
    counts = SIGNAL + NOISE * rng.standard_normal((COUNT, *SIGNAL.shape)) + (0 if signal is None else signal)
    facts = {"sample_rate_hz": 1e5, "bits": 16, "full_scale_v": 10, "frame_rate_hz": 100,
             "chirp": Chirp(start_hz=10e3, stop_hz=40e3),
             "plate": Plate(width_mm=200, height_mm=150)} | meta  # fmt: skip
    return Recording(
        Meta(**facts), np.clip(np.rint(counts), -32768, 32767).astype(np.int16), np.arange(COUNT),
        np.arange(COUNT) * 10_000_000,
    )  # fmt: skip


def change(level_db: float, when: NDArray[np.float64]) -> NDArray[np.float64]:
    """Another response, `level_db` of the signal, times `when` of shape (COUNT,)."""
    return np.asarray(10 ** (level_db / 20) * when[:, None, None] * OTHER)


def mean(signal: NDArray[np.float64] | None = None) -> Untouched:
    return untouched_mean(recording(signal), SAID)


def test_mean_and_noise() -> None:
    """The mean has the noise it says."""
    found = mean()
    assert found.frames >= 0.97 * COUNT
    np.testing.assert_allclose(found.noise, NOISE / np.sqrt(COUNT), rtol=0.05)
    assert np.sqrt(((found.mean - SIGNAL) ** 2).mean()) < 1.2 * NOISE / np.sqrt(COUNT)


def test_a_few_disturbed_frames_do_not_count() -> None:
    """Impulses in one frame of twenty leave the mean as it is."""
    hit = np.zeros(COUNT)
    hit[5::20] = 1.0
    found = mean(change(-6, hit))
    assert found.frames <= 0.96 * COUNT
    assert np.sqrt(((found.mean - SIGNAL) ** 2).mean()) < 1.3 * NOISE / np.sqrt(COUNT)


def test_a_little_drift_does_not_count() -> None:
    """A tenth of a kelvin over the recording is taken."""
    found = mean(change(-65, np.linspace(-0.5, 0.5, COUNT)))
    assert found.frames >= 0.95 * COUNT


@pytest.mark.parametrize(("start", "stop"), [(0, 60), (80, 200), (60, 120), (0, 100)])
def test_a_finger(start: int, stop: int) -> None:
    """A finger of -40 dB in a part of the recording is refused as a finger."""
    down = np.zeros(COUNT)
    down[start:stop] = 1.0
    with pytest.raises(PlateTouched, match="nothing on the plate"):
        mean(change(-40, down))


def test_drift() -> None:
    """A plate that warms by a few kelvins is refused as unsteady."""
    with pytest.raises(PlateUnsteady, match="drifts"):
        mean(change(-38, np.linspace(-0.5, 0.5, COUNT)))


def test_clipping() -> None:
    """A channel at the end of the ADC's range is named."""
    loud = np.zeros((COUNT, *SIGNAL.shape))
    loud[:, 1, 50] = 40_000.0
    with pytest.raises(SignalClipped, match="receiver 2"):
        untouched_mean(recording(loud), SAID)


def test_a_daq_that_hangs() -> None:
    """Frames that repeat each other are no measurement, however quiet."""
    one = recording()
    frames = np.repeat(one.frames[::50], 50, axis=0)
    with pytest.raises(PlateUnsteady, match="repeat"):
        untouched_mean(replace(one, frames=frames), SAID)


@pytest.mark.parametrize(
    "chirp",
    [{"stop_hz": 50e3}, {"start_hz": 1, "stop_hz": 2}, {"duration_s": 1e-6}, {"dac_rate_hz": 1}, {"period_s": 10}],
)
def test_chirps(chirp: dict[str, float]) -> None:
    """What no plate can be fitted to is refused before the fit."""
    with pytest.raises(PlateMismatch, match="chirp"):
        check_chirp(Acquisition(channels=4, samples=250, sample_rate_hz=250e3, chirp=Chirp(**chirp)), "recording")


@pytest.mark.parametrize(
    ("meta", "said"), [({"plate": Plate(width_mm=300, height_mm=150)}, "width_mm is 300, but 200")]
)
def test_another_plate(meta: dict[str, Any], said: str) -> None:
    """A recording of a plate of another size is refused with both numbers."""
    with pytest.raises(PlateMismatch, match=said):
        untouched_mean(recording(**meta), SAID)


def test_another_number_of_channels() -> None:
    """As many receivers as channels are asked for."""
    discs = SAID.discs.model_copy(update={"receivers_mm": ((15, 15), (185, 20), (100, 130))})
    with pytest.raises(PlateMismatch, match="2 channels, but 3 receivers"):
        untouched_mean(recording(), SAID.model_copy(update={"discs": discs}))


def test_too_short() -> None:
    """A handful of frames is refused."""
    whole = recording()
    short = Recording(whole.meta, whole.frames[:5], whole.sequence[:5], whole.timestamp_ns[:5])
    with pytest.raises(CalibrationError, match="5 frames"):
        untouched_mean(short, SAID)


def test_a_dead_channel_is_found() -> None:
    """A channel of noise alone is dead."""
    silent = np.zeros((COUNT, *SIGNAL.shape))
    silent[:, 0] = -SIGNAL[0]
    assert mean(silent).dead.tolist() == [True, False]


def test_hum() -> None:
    """Mains hum, louder than the signal, neither disturbs frames nor counts as noise of what a fit may leave."""
    turns = 50.0 * (np.arange(COUNT)[:, None] * 0.0103 + np.arange(SIGNAL.shape[1]) / 1e5)
    hum = np.repeat(8000 * np.sin(2 * np.pi * turns)[:, None], 2, axis=1)
    found = mean(hum)
    assert found.frames >= 0.97 * COUNT
    np.testing.assert_allclose(found.noise, NOISE / np.sqrt(COUNT), rtol=0.1)
