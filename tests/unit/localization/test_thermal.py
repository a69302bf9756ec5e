"""The stretch operator foretells what a warmer plate sends, without a plate at that temperature."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.scenes.numerics import reference
from touchd.frame import Acquisition, Chirp
from touchd.localization.features import band_bins, windowed_dft
from touchd.localization.plate_changes import emission_s, stretched_dft

RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
BINS = band_bins(RIG)


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
    foretold = before @ stretched_dft(RIG, BINS, 0.0)[1]
    assert np.linalg.norm(change - foretold) < 0.25 * np.linalg.norm(change)
    about_the_start = foretold + (before @ derivative_matrix()) * np.tile(emission_s(RIG, BINS), 2)
    assert np.linalg.norm(change - foretold) < 0.1 * np.linalg.norm(change - about_the_start)


@given(st.integers(0, 30), st.floats(-2e-2, 2e-2).filter(lambda stretch: abs(stretch) > 1e-3))
def test_far_stretches(seed: int, stretch: float) -> None:
    """So it does twenty kelvin from there on acrylic, where the first order foretells nothing; and back again."""
    before, after = (plate_signal(RIG, s, seed) @ windowed_dft(RIG) for s in (0.0, stretch))
    forth = plate_signal(RIG, 0.0, seed) @ stretched_dft(RIG, BINS, stretch)[0]
    back = plate_signal(RIG, stretch, seed) @ stretched_dft(RIG, BINS, -stretch / (1 + stretch))[0]
    for found, true, other in ((forth, after, before), (back, before, after)):
        assert np.linalg.norm(found - true) < 0.25 * np.linalg.norm(other - true)


def derivative_matrix() -> np.ndarray:
    """Features of the time derivative, from the definition: each sample's own band-limited derivative."""
    slope = 2j * np.pi * np.fft.rfftfreq(RIG.samples, 1 / RIG.sample_rate_hz)
    slope[-1] = 0
    each = np.fft.irfft(slope * np.fft.rfft(np.eye(RIG.samples), axis=1), RIG.samples, axis=1)
    found: np.ndarray = each @ windowed_dft(RIG)
    return found


@given(st.integers(120, 300), st.floats(150e3, 400e3), st.floats(-2e-2, 2e-2), st.integers(0, 100))
def test_each_wave_becomes_the_one_that_was_sent_out_later(
    samples: int, rate_hz: float, stretch: float, seed: int
) -> None:
    """Against another sum: wave by wave, with the phase that the chirp has at either frequency."""
    a = Acquisition(channels=1, samples=samples, sample_rate_hz=rate_hz, chirp=Chirp(start_hz=40e3, stop_hz=60e3))
    bins, step = band_bins(a), 1e-6
    for taper in (0.25, 1.0):
        signal = np.random.default_rng(seed).standard_normal(samples) * a.window(taper)

        def exactly(by: float, signal: np.ndarray = signal, taper: float = taper) -> np.ndarray:
            return reference.flat(reference.stretched_bins(signal, bins, a, taper, by))

        matrix, derivative = stretched_dft(a, bins, stretch, taper)
        size = np.linalg.norm(exactly(stretch))
        assert np.linalg.norm(signal @ matrix - exactly(stretch)) < 0.02 * size
        slope = (exactly(stretch + step) - exactly(stretch - step)) / (2 * step)
        assert np.linalg.norm(signal @ derivative - slope) < 0.1 * np.linalg.norm(slope)
        assert (
            np.linalg.norm(signal @ (stretched_dft(a, bins, 0.0, taper)[0] - windowed_dft(a, bins, taper)))
            < 0.02 * size
        )
