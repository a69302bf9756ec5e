"""Plate and discs as fitted to the untouched response: the result of `fit_plate`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.plate_file import PlateFile
from touchd.calibration.untouched import Untouched
from touchd.frame import Acquisition
from touchd.twin.physics.material import ElasticPlate
from touchd.twin.physics.transducer import Layout

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Verdict = Literal["good", "usable", "poor"]
Progress = Callable[[str, float], object]
"""Receives the stage's name and the share of the whole work that is done, 0 .. 1."""


class Parameter(NamedTuple):
    """One fitted number beside what PLATE.toml said."""

    name: str
    """For example `thickness`, `emitter x` or `receiver 2 y`."""
    unit: str
    said: float
    fitted: float
    standard_error: float
    at_prior: bool
    """Whether the data pull it further from what was said than its uncertainty allows."""


@dataclass(frozen=True)
class PlateFit:
    """A fitted plate: R receivers, S samples, F frequencies."""

    plate: ElasticPlate
    layout: Layout
    acquisition: Acquisition
    loss: float
    """Loss factor at the middle of the chirp."""
    gains: Complex
    """Coefficients of each channel's complex gain, shape (R, 3), in powers of `band`; counts per unit of response."""
    parameters: tuple[Parameter, ...]
    verdict: Verdict
    expected_mm: float
    """Expected median error of a touch with a physical atlas of this plate."""
    reasons: tuple[str, ...]
    """Why the verdict is not better, each with the next thing to do."""
    unexplained: float
    """Share of the untouched energy that the fit leaves."""
    noise_share: float
    """Share of the untouched energy that is the mean frame's noise."""
    measured: Floats
    """Untouched mean frame, shape (R, S), ADC counts."""
    fitted: Floats
    """The same as the fitted plate gives it."""

    def gain(self, frequency_hz: Floats) -> Complex:
        """Return each channel's complex gain at frequencies (F,), shape (R, F), counts."""
        x = band(self.acquisition, frequency_hz)
        return np.asarray(self.gains @ np.stack([x**k for k in range(self.gains.shape[1])]))

    def residual(self) -> tuple[Floats, Floats]:
        """Return frequencies (F,), Hz, and the share of each channel's energy left there, shape (R, F)."""
        spectrum = np.abs(np.fft.rfft(self.measured - self.fitted, axis=1)) ** 2
        energy = (np.abs(np.fft.rfft(self.measured, axis=1)) ** 2).sum(axis=1, keepdims=True)
        hz = np.fft.rfftfreq(self.measured.shape[1], 1 / self.acquisition.sample_rate_hz)
        return hz, spectrum / np.maximum(energy, np.finfo(float).tiny)


def band(acquisition: Acquisition, frequency_hz: Floats) -> Floats:
    """Map frequencies to -1 .. 1 over the chirp's band; beyond it to at most 1.3."""
    low, high = sorted((acquisition.chirp.start_hz, acquisition.chirp.stop_hz))
    return np.asarray(np.clip((frequency_hz - (low + high) / 2) / ((high - low) / 2), -1.3, 1.3))


def fit_plate(said: PlateFile, recording_mean: Untouched, progress: Progress = lambda _stage, _share: None) -> PlateFit:
    """Fit plate, discs and gains to the untouched response.

    Parameters
    ----------
    said : PlateFile
    recording_mean : Untouched
        The mean untouched frame, of `touchd.calibration.untouched`.
    progress : callable, optional

    Raises
    ------
    CalibrationError
        The recording does not fit the plate, or too few channels live.
    """
    raise NotImplementedError
