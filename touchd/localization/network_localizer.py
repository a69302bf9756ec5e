"""Place one finger by the network alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import DTypeLike

from touchd.config.schema import Settings
from touchd.detection.baseline import Signal
from touchd.detection.detection import Detection
from touchd.frame import Acquisition
from touchd.keypad import Layout
from touchd.localization.estimator import Estimator, TouchMaker
from touchd.localization.features import Features, band_bins, windowed_dft
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.localization import UNTOUCHED, Localization
from touchd.localization.model import Model
from touchd.localization.plate_changes import plate_directions, stretched_dft
from touchd.localization.stillness import StillFrame
from touchd.outcome import Outcome
from touchd.touch import Touch

EDGE_SIGMAS = 3.0
"""A position beyond the plate by less is moved to its edge; one farther away is dropped."""
_FAINT = Localization(Outcome.FAINT)
_PLATE_MOVED = Localization(Outcome.FAINT, plate_moved=True)


class PlateMovement:
    """Tells the plate's own movement, of temperature, delay and gains, from a finger.

    Parameters
    ----------
    acquisition : Acquisition
    dtype : type
    """

    def __init__(self, acquisition: Acquisition, dtype: DTypeLike) -> None:
        bins = band_bins(acquisition)
        self._features = Features("frequency", acquisition, dtype)
        self._plain, self._stretched = windowed_dft(acquisition), stretched_dft(acquisition, bins, 0.0)[1]
        self._omega_rad_s = 2 * np.pi * bins * acquisition.sample_rate_hz / acquisition.samples
        self._bins: Signal = np.zeros(self._features.size, dtype)
        self._directions: Signal = np.zeros((0, self._features.size), dtype)
        self._along: Signal = np.zeros(0, dtype)
        self._energy = np.zeros((), dtype)
        self._most = 0.0  # energy, counts squared

    def set_baseline(self, baseline: Signal) -> None:
        """Take the untouched plate, (channels, samples)."""
        live = baseline.astype(np.float64)
        bins = live @ self._plain
        directions = plate_directions(bins, live @ self._stretched, self._omega_rad_s)
        self._directions = directions.astype(self._bins.dtype)
        self._along = np.zeros(len(directions), self._bins.dtype)
        self._most = CRITERIA.most_moved * float(np.square(bins).sum())

    def split(self, residual: Signal, noise_energy: float) -> tuple[float, float, float]:
        """Return the energy of a residual's bins: the plate's movement, what that and noise leave, and the noise.

        Parameters
        ----------
        residual : array of shape (channels, samples)
        noise_energy : float
            Of the residual of an untouched frame, counts squared.
        """
        bins, along = self._bins, self._along
        self._features.extract(residual, bins)
        self._directions.dot(bins, along)
        along.dot(along, self._energy)
        moved, noise = self._energy.item(), self._features.noise_gain * noise_energy
        bins.dot(bins, self._energy)
        return moved, self._energy.item() - moved - noise, noise

    def explains(self, moved: float, left: float, noise: float) -> bool:
        """Return whether the plate's movement and noise are all that a residual split into these energies holds."""
        return moved < self._most and left <= min(CRITERIA.noise_margin * noise + CRITERIA.plate * moved, moved)


class NetworkLocalizer:
    """Runs the network on every touched frame that differs from the last one by more than noise.

    Parameters
    ----------
    model : Model
    settings : Settings
    layout : Layout, optional
        The keys, in keypad mode.
    """

    stretch: float | None = None

    def __init__(self, model: Model, settings: Settings, layout: Layout | None) -> None:
        self._estimator = Estimator(model)
        self._still = StillFrame(model.description.acquisition.shape, settings.skip.still_false_alarm_rate, model.dtype)
        self._movement = PlateMovement(model.description.acquisition, model.dtype)
        self._found = UNTOUCHED
        self._signal_energy = 1.0
        self._size_mm = model.description.plate.width_mm, model.description.plate.height_mm
        # The other heads' sigma is the size of a zone or a key, in any frame.
        self._has_sigma = model.description.head == "regression"
        self.configure(settings, layout)

    model_fit: float | None = None
    """A network cannot tell how well it fits."""

    def configure(self, settings: Settings, layout: Layout | None) -> None:
        """Take other thresholds and keys; fingers are found again in the next frame."""
        self._min_confidence, self._keep_confidence = settings.model.min_confidence, settings.model.keep_confidence
        self._min_snr = 10 ** (settings.model.min_snr_db / 10)
        self._max_sigma_mm = settings.model.max_sigma_mm if self._has_sigma else math.inf
        self._touch_maker = TouchMaker(settings, layout)
        self._skips_still = settings.skip.still
        self._still.configure(settings.skip.still_false_alarm_rate)
        self.reset()

    def reset(self) -> None:
        """Forget the finger."""
        self._found = UNTOUCHED
        self._still.reset()

    def update(self, baseline: Signal, residuals: Signal | None = None) -> None:  # noqa: ARG002 - the atlas alone needs the residuals
        """Take a newly learned baseline, of shape (channels, samples)."""
        self._movement.set_baseline(baseline)
        flat = baseline.reshape(-1)
        self._signal_energy = max(float(flat.dot(flat)), 1.0)  # a dead DAQ sends zeros
        self.reset()

    def follow(self, detection: Detection) -> Localization | None:
        """Return the last touches if a touched frame differs from the last one examined by no more than noise."""
        if not self._found.touches or detection.energy < self._min_snr * detection.noise_energy:
            return None
        return self._found if self._still.holds(detection.residual) else None

    def localize(
        self,
        detection: Detection,
        *,
        alive: bool,
        complete: bool = False,  # noqa: ARG002 - the network searches nothing
    ) -> Localization:
        """Return the finger of a touched frame."""
        # An untouched frame comes here only to measure what the gate saves.
        touched = detection.outcome is Outcome.TOUCHED
        if touched and detection.energy < self._min_snr * detection.noise_energy:
            self.reset()
            return _FAINT
        # Where no finger was found the network looks again: under other noise it may see one.
        if self._found.touches and self._still.holds(detection.residual):
            return self._found
        moved, left, noise = self._movement.split(detection.residual, detection.noise_energy)
        if touched and self._movement.explains(moved, left, noise):
            self.reset()
            return _PLATE_MOVED
        # Of a fainter finger on a plate that has moved, the lift might look like noise.
        if self._skips_still and left > noise:
            self._still.update(detection.residual, detection.energy_above(self._still.quantile))
        else:
            self._still.reset()
        touches = self._look(detection, self._keep_confidence if alive else self._min_confidence)
        departure = not touches and not alive and self._estimator.of_residual
        departure = departure and self._estimator.opposite().confidence >= self._min_confidence
        # The next frames that hold are still.
        self._found = Localization(Outcome.STILL, touches)
        return Localization(Outcome.INFERRED, touches, departure)

    def observe(self, detection: Detection) -> Localization:  # noqa: ARG002 - training has shown the network all noise
        """Forget the finger: the plate is untouched."""
        if self._found.touches:
            self.reset()
        return UNTOUCHED

    def spectrum(self, detection: Detection) -> list[float]:
        """Return the model's input for a frame."""
        return self._estimator.spectrum(detection)

    def _look(self, detection: Detection, min_confidence: float) -> tuple[Touch, ...]:
        estimate = self._estimator.estimate(detection)
        sigma_mm = self._estimator.sigma_mm(estimate, detection.noise_energy)
        # Asked this way round, so that a network that says NaN places nothing.
        if not (min_confidence <= estimate.confidence < math.inf and 0 <= sigma_mm <= self._max_sigma_mm):
            return ()
        x_mm, y_mm = (min(max(at, 0.0), size) for at, size in zip(estimate[:2], self._size_mm, strict=True))
        # A finger at the edge may be placed beyond it, by little more than its standard error.
        if not math.dist((x_mm, y_mm), estimate[:2]) <= EDGE_SIGMAS * sigma_mm:
            return ()
        change = (detection.energy / self._signal_energy) ** 0.5
        return (
            self._touch_maker.touch(x_mm, y_mm, sigma_mm, min(estimate.confidence, 1.0), change, estimate.key),
        )  # fmt: skip
