"""Features: the paper's 49 bins, exactly."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.signal.windows import tukey

from touchd.frame import Acquisition, Chirp
from touchd.localization.features import Domain, Features, band_bins, windowed_dft

RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)


def reference(signal: np.ndarray, acquisition: Acquisition) -> np.ndarray:
    """The same features by numpy's FFT, in float64."""
    spectrum = np.fft.rfft(np.hanning(acquisition.samples) * signal.astype(float), axis=-1)
    band = spectrum[:, band_bins(acquisition)]
    return np.concatenate([band.real, band.imag], axis=1).reshape(-1)


def test_the_papers_rig_has_49_bins_from_51_to_99() -> None:
    assert band_bins(RIG).tolist() == list(range(51, 100))
    assert Features("frequency", RIG).size == 4 * 49 * 2 == 392
    assert Features("time", RIG).size == 1000


def test_a_falling_chirp_has_the_bins_of_a_rising_one() -> None:
    falling = RIG.model_copy(update={"chirp": Chirp(start_hz=RIG.chirp.stop_hz, stop_hz=RIG.chirp.start_hz)})
    assert band_bins(falling).tolist() == band_bins(RIG).tolist()


def test_the_matrix_is_the_windowed_fft_to_the_last_digits_of_float64() -> None:
    signal = np.random.default_rng(1).standard_normal((4, 250))
    product = (signal @ windowed_dft(RIG)).reshape(-1)
    np.testing.assert_allclose(product, reference(signal, RIG), rtol=0, atol=1e-12)


@given(samples=st.integers(8, 400), taper=st.just(0.0) | st.floats(1e-3, 1))
@example(samples=250, taper=1.0)
def test_window_is_tukeys(samples: int, taper: float) -> None:
    """Any taper from none to Hann's gives SciPy's window."""
    a = Acquisition(channels=1, samples=samples, sample_rate_hz=250e3)
    np.testing.assert_allclose(a.window(taper), tukey(samples, taper), atol=1e-12)


@given(
    counts=hnp.arrays(np.int16, (4, 250)),
    scale=st.floats(1e-3, 1e3),
)
def test_float32_features_are_those_of_float64_to_a_millionth_of_the_signal(counts: np.ndarray, scale: float) -> None:
    signal = (counts * scale).astype(np.float32)
    out = np.empty(392, np.float32)
    Features("frequency", RIG).extract(signal, out)
    # The largest bin that a signal of this size can have bounds what rounding may add.
    full = np.abs(signal).max() * np.hanning(250).sum()
    np.testing.assert_allclose(out, reference(signal, RIG), rtol=0, atol=1e-6 * full + 1e-30)


@given(
    channels=st.integers(1, 8),
    samples=st.integers(16, 600),
    rate_hz=st.sampled_from([100e3, 200e3, 250e3, 500e3, 1e6]),
)
@example(channels=1, samples=38, rate_hz=100e3)  # bin 19 lies on 50 kHz, where a rounded spacing misses it
@settings(max_examples=30)
def test_any_acquisition_has_its_band_strictly_inside_the_chirps(channels: int, samples: int, rate_hz: float) -> None:
    acquisition = Acquisition(channels=channels, samples=samples, sample_rate_hz=rate_hz, chirp=Chirp())
    f_hz = band_bins(acquisition) * rate_hz / samples
    assert ((f_hz > 50e3) & (f_hz < 100e3)).all()
    signal = np.random.default_rng(samples).standard_normal((channels, samples)).astype(np.float32)
    features = Features("frequency", acquisition)
    out = np.empty(features.size, np.float32)
    features.extract(signal, out)
    np.testing.assert_allclose(out, reference(signal, acquisition), rtol=0, atol=1e-5 * samples)


def test_time_features_are_the_samples_channel_by_channel() -> None:
    signal = np.arange(1000, dtype=np.float32).reshape(4, 250)
    out = np.empty(1000, np.float32)
    Features("time", RIG).extract(signal, out)
    assert out.tolist() == list(range(1000))


def test_a_chirp_outside_the_sampled_band_leaves_no_bins() -> None:
    slow = Acquisition(channels=1, samples=100, sample_rate_hz=50e3)
    assert len(band_bins(slow)) == 0


@pytest.mark.parametrize("domain", ["frequency", "time"])
def test_features_do_not_depend_on_what_was_in_the_buffer(domain: str) -> None:
    signal = np.random.default_rng(2).standard_normal((4, 250)).astype(np.float32)
    features = Features(domain, RIG)  # type: ignore[arg-type]  # parametrize knows no literals
    a, b = np.full(features.size, np.nan, np.float32), np.zeros(features.size, np.float32)
    features.extract(signal, a)
    features.extract(signal, b)
    assert (a == b).all()


@pytest.mark.parametrize("domain", ["frequency", "time"])
def test_white_noise_has_the_energy_in_the_features_that_its_gain_says(domain: Domain) -> None:
    features = Features(domain, RIG)
    noise = np.random.default_rng(5).standard_normal((4000, *RIG.shape)).astype(np.float32)
    rows = np.empty((len(noise), features.size), np.float32)
    for signal, out in zip(noise, rows, strict=True):
        features.extract(signal, out)
    energy = np.square(rows, dtype=np.float64).sum() / len(noise)
    assert energy == pytest.approx(features.noise_gain * np.prod(RIG.shape), rel=0.01)


def test_the_gain_of_the_bins_is_that_of_the_window() -> None:
    assert Features("frequency", RIG).noise_gain == pytest.approx(49 * np.square(np.hanning(250)).sum() / 250, rel=1e-6)
    assert Features("time", RIG).noise_gain == 1


@given(
    vector=hnp.arrays(np.float32, 392, elements=st.floats(-1e6, 1e6, width=32)),
    noise_energy=st.floats(0, 1e12),
)
def test_noise_to_signal_is_that_of_float64(vector: np.ndarray, noise_energy: float) -> None:
    route = Features("frequency", RIG)
    energy = max(np.square(vector, dtype=np.float64).sum(), 1e-12)
    expected = np.sqrt(route.noise_gain * noise_energy / energy)
    assert route.noise_to_signal(noise_energy, float(vector @ vector)) == pytest.approx(expected, rel=1e-5)
