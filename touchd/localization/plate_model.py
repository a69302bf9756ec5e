"""From a residual to bins: corrected for temperature, gains and drift, without dead channels and drowned bins.

What the correction needs, the untouched frames tell: the noise of each bin, and how far the plate has come from the one
that the atlas was learned on.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from touchd.detection.baseline import Signal
from touchd.detection.detection import Detection
from touchd.localization.atlas import Array, Atlas
from touchd.localization.drift import Drift
from touchd.localization.fit import Bins, Fit
from touchd.localization.fit_criteria import CRITERIA
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.noise import NoiseModel
from touchd.localization.nuisance import Nuisance, hit_rows

NOISE_NS = 128_000_000
"""Of untouched frames: one in this time updates the noise model."""
COMPARE_NS = 1_000_000_000
"""The baseline is compared at this interval: temperature and gains change far more slowly."""
TONE_BINS = 2.0
"""Bins nearer than this to a tone are left out: with the tone, the detector has taken out what fingers have there."""
DRIFTED = 0.1
"""The baseline has moved if by this share of the noise energy: on glass 0.05 K at 60 dB."""


class PlateModel:
    """Turns residuals into bins, and follows the untouched plate.

    Parameters
    ----------
    atlas : Atlas
    """

    def __init__(self, atlas: Atlas) -> None:
        dtype = atlas.coefficients.dtype
        self.drift = Drift(atlas)
        self.noise = NoiseModel(atlas)
        self.nuisance = Nuisance(atlas.size, dtype)
        acquisition = atlas.description.acquisition
        self._bins = np.array(atlas.description.bins)
        self._channels, self._bin_hz = acquisition.channels, acquisition.sample_rate_hz / acquisition.samples
        self._quiet: NDArray[np.bool_] | None = None
        self._tones_hz: tuple[float, ...] = ()
        """Tones beside which no bin is used."""
        self._left_out = False  # whether `drop_silent` has left out channels
        self._vector: Array = np.zeros(atlas.size, dtype)
        self._energy = np.zeros((), dtype)
        self._baseline = atlas.baseline.copy()
        self._moved = np.zeros_like(self._baseline)
        self._live: NDArray[np.bool_] = np.ones(atlas.description.acquisition.channels, bool)
        self._untouched_ns = 0  # since the noise model was updated
        self._noise_energy = 0.0  # the detector's, of the last untouched frame
        self._compared_ns = 0
        """When the baseline was compared last."""
        self.moved = False
        """Whether what was explained last was more movement of the plate than noise."""
        self.set_baseline(atlas.baseline)

    def explains(self, bins: Bins, plate_energy: float, t_ns: int) -> bool:
        """Return whether noise and the plate's own movement explain bins, and if so follow that movement.

        A trigger that comes early or late delays all channels alike, which looks like a faint finger on the emitter; so
        does what is left of a change of temperature when a finger lifts.

        Parameters
        ----------
        bins : Bins
        plate_energy : float
            Of the bins along the plate's directions, counts squared.
        t_ns : int
        """
        drift, noise_energy = self.drift, self.noise.noise_energy
        noise_spread = CRITERIA.noise_spread * noise_energy
        evidence, movement = bins.energy - noise_energy - plate_energy, drift.energy + plate_energy
        plausible = movement < CRITERIA.most_moved * drift.signal_energy
        # Asked this way round, so that NaN is not followed.
        if not evidence <= noise_spread + (CRITERIA.plate * movement if plausible else 0.0):
            return False
        self.moved = False
        if plausible:
            drift.absorb(bins.vector, t_ns)
            self.moved = drift.energy > max(evidence, noise_spread)
        return True

    def update(self, baseline: Signal, residuals: Signal | None = None) -> None:
        """Take another baseline, (channels, samples), and residuals that tell its noise, (n, ...); else that stays."""
        if residuals is None:
            self.set_baseline(baseline)
            return
        self.noise.reset()
        self.nuisance.reset()
        self.set_baseline(baseline)
        for residual in residuals:
            self.drift.correct(residual, self._vector)
            self.nuisance.learn(self._vector)
        for residual in residuals:
            self.hear(residual)
        self._select()

    def listen(self, detection: Detection) -> bool:
        """Use the channels that are live, and no bin beside a tone; return whether others were used before."""
        changed = False
        self.noise.listen(detection.sounds, detection.t_ns)
        if detection.live is not self._live:
            self._live, changed = detection.live, True
            self._select()
        if detection.tones_hz is not self._tones_hz:
            self._set_tones(detection.tones_hz)
            changed = True
        return changed

    def observe(self, detection: Detection) -> bool:
        """Follow noise and baseline on an untouched frame; return whether it updated the noise model."""
        self.noise.listen(False, detection.t_ns)
        if detection.live is not self._live or detection.tones_hz is not self._tones_hz:
            self.listen(detection)
        if self._left_out:  # with the gate closed every channel holds what the baseline does
            self._select()
        if detection.noise_changed:
            self.noise.restart(min(detection.noise_energy / max(self._noise_energy, 1e-30), 1.0))
            self._select()
        self._noise_energy = detection.noise_energy
        self._untouched_ns += detection.period_ns
        due = self._untouched_ns >= NOISE_NS
        if due or detection.t_ns - self._compared_ns > COMPARE_NS:
            self._follow(detection)
        if due:
            self._untouched_ns = 0
            self.hear(detection.residual)
        return due

    def _follow(self, detection: Detection) -> None:
        """Compare the baseline with the one that the bins are corrected for, once a second."""
        if 0 <= detection.t_ns - self._compared_ns <= COMPARE_NS:
            return
        self._compared_ns = detection.t_ns
        np.subtract(detection.baseline, self._baseline, out=self._moved)
        flat = self._moved.reshape(-1)
        # By less a frame shows no difference, and neither does a position.
        if float(flat.dot(flat)) > DRIFTED * detection.noise_energy:
            self.set_baseline(detection.baseline)

    def hear(self, residual: Signal) -> None:
        """Update the noise model with an untouched frame's residual, shape (channels, samples)."""
        self.drift.correct(residual, self._vector)
        self.nuisance.hear(self._vector)
        if self.noise.update(self._vector):
            self._select()

    def _set_tones(self, tones_hz: tuple[float, ...]) -> None:
        """Use no bin beside tones of these frequencies."""
        self._tones_hz = tones_hz
        apart = np.abs(self._bins[:, None] - np.array(tones_hz) / self._bin_hz)
        quiet = (apart > TONE_BINS).all(axis=1)
        self._quiet = None if quiet.all() else np.tile(quiet, 2 * self._channels)
        self._select()

    def set_baseline(self, baseline: Signal) -> None:
        """Compare the untouched plate, (channels, samples), with the one that the atlas was learned on."""
        np.copyto(self._baseline, baseline)
        self.drift.set_baseline(baseline)
        self.signal_rms = math.sqrt(self.drift.signal_energy)
        """Root of the energy of the untouched plate's bins, counts."""
        self._select()

    def change(self, field_energy: float) -> float:
        """Return by what share a contact of amplitude 1 changes the signal, whose field has this energy on average."""
        return math.sqrt(field_energy) / self.signal_rms

    def drop_silent(self, detection: Detection) -> bool:
        """Leave out channels that have died since the baseline was learned, until the plate is untouched.

        Return whether there are any.
        """
        silent = self.drift.silent(detection.residual, detection.baseline)
        if not silent.any() or silent.all() or not (silent & self.noise.channels).any():
            return False
        self._use(self.noise.channels & ~silent & self._live)
        self._left_out = True
        return True

    def bins(self, residual: Signal, hits: tuple[int, ...] = ()) -> Bins:
        """Return the bins of a residual, shape (channels, samples); valid until the next call.

        `hits` are the starts of runs of samples that an impulse has hit. They and the drive's own changes are taken
        out, and with them some of the fingers until `nuisance.settle`.
        """
        vector, mask = self._vector, self.noise.mask
        self.drift.correct(residual, vector)
        if mask is not None:
            np.multiply(vector, mask, vector)
        if hits or self.nuisance.engaged:
            self.nuisance.remove(vector, hit_rows(self.drift.matrix, hits, len(residual)), mask)
        vector.dot(vector, self._energy)
        return Bins(vector, mask, self._energy.item())

    def settle(self, bins: Bins, fit: Fit, solver: GaussNewton, hits: tuple[int, ...]) -> tuple[Bins, Fit]:
        """Give fingers back what the drive and hit samples took from them; too few fingers cannot tell it."""
        noise_energy = self.noise.noise_energy
        lacking = fit.residual_energy > CRITERIA.half_confidence * bins.energy + noise_energy
        if not self.nuisance.engaged or (lacking and not hits):
            return bins, fit
        return self.nuisance.settle(bins, fit, solver, noise_energy)

    def _select(self) -> None:
        """Leave out dead channels, and bins that drown in noise."""
        self._left_out = False
        self._use(~self.drift.dead & self._live)

    def _use(self, channels: NDArray[np.bool_]) -> None:
        self.noise.set_channels(channels, self.drift.directions, self._quiet)
        self.nuisance.set_drive(self.drift.drive_changes, self.noise.mask)
