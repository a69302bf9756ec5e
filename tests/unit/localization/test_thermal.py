"""The stretch operator foretells what a warmer plate sends, without a plate at that temperature."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from touchd.frame import Acquisition, Chirp
from touchd.localization.features import band_bins, windowed_dft
from touchd.localization.plate_changes import emission_s, stretch_matrix

RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)


def plate_signal(acquisition: Acquisition, stretch: float, seed: int) -> np.ndarray:
    """What a plate of random resonances, all raised by `stretch`, answers to the chirp, shape (samples,)."""
    rng = np.random.default_rng(seed)
    chirp = acquisition.chirp
    rate_hz = 8 * acquisition.sample_rate_hz
    t_s = np.arange(8 * acquisition.samples) / rate_hz
    sweep = (chirp.stop_hz - chirp.start_hz) / chirp.duration_s
    emitted = np.sin(2 * np.pi * (chirp.start_hz * t_s + sweep * t_s**2 / 2)) * (t_s < chirp.duration_s)
    resonance_hz = rng.uniform(chirp.start_hz, chirp.stop_hz, 60) * (1 + stretch)
    response = (rng.normal(size=60)[:, None] * np.sin(2 * np.pi * resonance_hz[:, None] * t_s)).sum(axis=0)
    heard = np.convolve(emitted, response * np.exp(-t_s / 3e-4 * (1 + stretch)))[: len(t_s)]
    found: np.ndarray = heard[::8]
    return found


@given(st.integers(0, 30))
def test_it_foretells_the_features_of_a_plate_whose_resonances_have_risen(seed: int) -> None:
    """A tenth is left: a window holds no single frequency. About the frame's start it is wrong."""
    stretch = 1e-4
    before, after = (plate_signal(RIG, s, seed) for s in (0.0, stretch))
    change = (after - before) @ windowed_dft(RIG) / stretch
    foretold = before @ stretch_matrix(RIG, band_bins(RIG))
    assert np.linalg.norm(change - foretold) < 0.25 * np.linalg.norm(change)
    about_the_start = foretold + (before @ derivative_matrix()) * np.tile(emission_s(RIG, band_bins(RIG)), 2)
    assert np.linalg.norm(change - foretold) < 0.1 * np.linalg.norm(change - about_the_start)


def derivative_matrix() -> np.ndarray:
    """Features of the time derivative, from the definition: each sample's own band-limited derivative."""
    slope = 2j * np.pi * np.fft.rfftfreq(RIG.samples, 1 / RIG.sample_rate_hz)
    slope[-1] = 0
    each = np.fft.irfft(slope * np.fft.rfft(np.eye(RIG.samples), axis=1), RIG.samples, axis=1)
    found: np.ndarray = each @ windowed_dft(RIG)
    return found


@given(st.integers(60, 300), st.floats(150e3, 400e3))
def test_it_is_the_stretch_about_the_moment_at_which_each_frequency_is_emitted(samples: int, rate_hz: float) -> None:
    """Against the definition, sample by sample: (t - tau) times the derivative of that sample's own pulse."""
    a = Acquisition(channels=1, samples=samples, sample_rate_hz=rate_hz, chirp=Chirp(start_hz=40e3, stop_hz=60e3))
    bins = band_bins(a)
    slope = 2j * np.pi * np.fft.rfftfreq(samples, 1 / rate_hz)
    if samples % 2 == 0:
        slope[-1] = 0
    each = np.fft.irfft(slope * np.fft.rfft(np.eye(samples), axis=1), samples, axis=1)
    t_s = np.arange(samples) / rate_hz
    tau_s = np.tile(emission_s(a, bins), 2)
    expected = (each * t_s) @ windowed_dft(a) - (each @ windowed_dft(a)) * tau_s
    np.testing.assert_allclose(stretch_matrix(a, bins), expected, atol=1e-6 * np.abs(expected).max())
