"""Which of a frame's features are listened to, and how much of them is noise or the plate's own movement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Array, Atlas
from touchd.localization.noise_power import Noise

EXCESS_OF_HALF = 0.25
"""Share of the signal that a fit leaves unexplained at which it is as likely no finger: fingers unlike those of the
training leave up to 0.1, palms more than 0.6 (twin)."""
SPREAD = 0.25
"""Noise has seldom so much more energy in a frame than its mean: two deviations."""
SIGNIFICANT = 80.0
"""What a fit explains, in variances of a feature, for noise alone not to do so anywhere on a plate: at the best of a
thousand places noise explains some 15, neighbouring bins being correlated twice that."""

ALIKE, COMPARED_FRAMES = 50.0, 32
"""White noise in n features is of n shapes, or of n / 3 since neighbouring bins are correlated; with fewer than n / 50,
over so many frames that are heard, it is not white: tones and jitter have two to four (twin)."""


class Hearing:
    """Knows the noise in each feature, and leaves out dead channels and bins that drown.

    Parameters
    ----------
    atlas : Atlas
    """

    def __init__(self, atlas: Atlas) -> None:
        d = atlas.description
        self._noise = Noise(d.acquisition.channels, len(d.bins))
        self._per_channel = 2 * len(d.bins)
        self._error, self._noise_scale = atlas.error, d.noise_scale
        self._energy = np.zeros((), np.float32)
        self.mask = None
        self._last, self._before = np.zeros(atlas.size, np.float32), np.zeros(atlas.size, np.float32)
        self.forget()

    channels: NDArray[np.bool_]
    """Those listened to, shape (channels,)."""
    mask: Array | None
    """0 for each feature that is left out, 1 for the others; None if all are heard."""
    expected: float
    """Energy of the noise in a frame, counts squared."""
    variance: float
    """Of the noise in a feature, as far as it moves a place, counts squared."""
    least: float
    """A fit that explains no more may be one of noise, counts squared."""
    alive: int
    """Features listened to."""
    mean_error: float
    """Mean square of what the field misses in a channel and bin at strength 1."""
    own: Array
    """Orthonormal directions in which the untouched plate can move, of what is heard."""

    def forget(self) -> None:
        """Begin to hear anew."""
        self._noise.forget()
        self._alike, self._compared, self._last_energy = 0.0, 0, 0.0

    def hear(self, features: Array) -> bool:
        """Take in the features of an untouched frame, and return whether now enough were heard to listen by them."""
        self._compare(features)
        return self._noise.hear(features)

    @property
    def is_alike(self) -> bool:
        """Whether the noise is of few shapes, as tones and trigger jitter are, so that a finger's may be among them."""
        return self._alike * self.alive > ALIKE

    def _compare(self, features: Array) -> None:
        """Follow the squared cosine between a frame of noise and the one before, whose mean is one over its shapes."""
        last, before = self._before, self._last
        np.copyto(last, features)
        if self.mask is not None:
            np.multiply(last, self.mask, last)
        last.dot(last, self._energy)
        energy = self._energy.item()
        last.dot(before, self._energy)
        if energy > 0 and self._last_energy > 0:
            self._compared = min(self._compared + 1, COMPARED_FRAMES)
            cosine2 = self._energy.item() ** 2 / (energy * self._last_energy)
            self._alike += (cosine2 - self._alike) / self._compared
        self._last, self._before, self._last_energy = last, before, energy

    def hear_anew(self) -> None:
        """Let the frames to come tell what noise there is, and no earlier ones."""
        self._noise.begin()

    def listen_to(self, channels: NDArray[np.bool_], directions: Array) -> None:
        """Leave out the other channels, and bins that drown in noise; the plate can move along some directions."""
        if not channels.any():
            channels = np.ones_like(channels)  # nothing can be said; what the frames hold decides
        self.channels = channels
        features = np.repeat(channels, self._per_channel) & self._noise.quiet()
        self.mask = None if features.all() else features.astype(np.float32)
        self.alive = max(int(features.sum()), 1)
        self.expected = float(self._noise.power[features].sum())
        self.variance = self._noise_scale * self.expected / self.alive
        self.least = SIGNIFICANT * self.expected / self.alive
        self.mean_error = float(self._error[channels].mean())
        # Of what is listened to, orthonormal again.
        self.own = directions
        if self.mask is not None:
            self.own = np.linalg.qr((directions * features).T)[0].T.astype(np.float32)
        self._along = np.zeros(len(self.own), np.float32)

    def by_itself(self, features: Array) -> float:
        """Return the energy that features, shape (size,), may have by the plate's own movement, counts squared."""
        self.own.dot(features, self._along)
        self._along.dot(self._along, self._energy)
        return self._energy.item()

    def excess(self, left: float, signal: float) -> float:
        """Return what a fit leaves beyond what noise may have, as a share of the signal."""
        return (left - (1 + SPREAD) * self.expected) / signal
