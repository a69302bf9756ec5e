"""Finger or water? A likelihood ratio of two contacts, summed over the frames of each.

A drop is a mass, its impedance i omega m. Tissue takes power from the plate: a piston of radius a on it lags a mass by
0.6 a / c, c the speed of sound in it, alike at all frequencies (Kinsler & Frey, Fundamentals of Acoustics). Its
amplitude grows as a^3, so a finger of amplitude A lags a mass by at least `TISSUE_RAD` A^(1/3) at 67.5 kHz, by a
quarter of that at 17 kHz, a drop by nothing.

The sum is kept twice, less and plus what the field's error may add to it, and within `SURE` of 0 (Page, Biometrika
41:100, 1954): what a finger has left behind is water as soon as its own frames say so.

=============  ===================  ===================================================================
contact        becomes              if the sum
=============  ===================  ===================================================================
undecided      finger, water        reaches `SURE`, -`SURE`
finger         water                reaches -`SURE`; it is not placed while the sum is negative
water          finger               stays at `SURE` for 30 ms; at once within 0.1 s if it lags as a finger
=============  ===================  ===================================================================
"""

from __future__ import annotations

import cmath
import math
from enum import Enum
from typing import NamedTuple

import numpy as np
from msgspec import Struct

from touchd.localization.atlas import Atlas, AtlasDescription
from touchd.localization.fit import Bins, Fit, shapes_of, sizes_of
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.noise import NoiseModel
from touchd.localization.spline import ContactField, Position, Shape, Spline

USUAL_HZ = 67.5e3
"""Mean frequency of the bins that phases are stated for. They are delays: in other bins they change in proportion."""
TISSUE_RAD = 0.39
"""Lag behind a mass of a piston on soft tissue, at amplitude 1 and `USUAL_HZ`: gloves of 3 to 8 mm^2 lag by 0.16 to
0.26 rad (twin). Slower or lossy tissue, as silicone and skin, lags by more."""
BIAS_RAD = 0.02
"""Standard deviation of what does not average out: the error of the field's phase, from place to place (twin)."""
ERROR_SIGMAS = 1.5
"""Standard errors by what the field misses of all contacts that are added to it."""
SURE = 8.0
"""Log likelihood ratio: at most 1 drop in 3000 is ever taken for a finger (Wald's bound), with the field's error in its
favour. The sum goes no farther: more evidence would make a contact slow to change."""
SURE_ALONE = 0.5
"""The same of a frame that is judged alone: one look takes 1 drop in 500 for a finger, and 1 glove in 40 for water
(twin, 60 dB)."""
MOST_LAG = 2.0
"""A contact that lags by more than this, over a finger's least lag, tells no more."""
LOOK_NS, LOOK_SHARE = 200_000_000, 0.1
"""So often, and at a change of its amplitude by such a share, a sure finger is looked at."""
LAY_NS, DRY_NS = 100_000_000, 30_000_000
"""What leads for less than 0.1 s may be a finger that lands; of water one frame may say otherwise."""
NEAR_MM, REACH_SIGMAS, MOST_REACH_MM = 3.0, 3.0, 8.0
"""A drop stays where it is, but for this many standard errors of its position: else the frames that misplace it, and
its phase with it, would be judged alone."""
WATER_NS, FINGER_NS = 10_000_000_000, 100_000_000
"""A contact is remembered for so long after it was seen."""
MOST = 16
"""Contacts remembered: more are a wet plate, on which nothing can be told apart."""
POINT_SIZE, SMALL_SIZE, SHAPES_TELL = 0.4, 1.0, 0.005
"""Amplitudes below which a contact is a point and small, on short waves: a point's phase is that of a point's field, a
small one's that of its fitted shape, as is every other's where the field errs by less than this share. Elsewhere shapes
err more than faces differ (twin: acrylic at 50 to 100 kHz)."""
MASS_LEAD_S = 1.47e-6
"""By which a mass leads a silicone tip of 20 mm^2, the middle of the training's (piston on a half-space)."""
SILENT_SHARE = 0.9
"""Mean frequency of the bins over the middle of a band that chirps play to a silent plate: 0.88 to 0.91 (twin)."""


def mean_hz(description: AtlasDescription) -> float:
    """Return the mean frequency of the bins that tell a contact's phase.

    In steady state they are those that tell most, which may all lie in the upper third of the band.
    """
    d, a = description, description.acquisition
    if a.chirp.period_s is None:
        return SILENT_SHARE * sum(a.chirp.band_hz) / 2
    return sum(d.bins) / len(d.bins) * a.sample_rate_hz / a.samples


class MassPhase:
    """Tells by how much contacts lag masses at the same positions: the lead of a mass grows along the band.

    What lies along the plate's own movement tells nothing: a plate that has warmed under a finger turns the phase of a
    drop that lies there too.

    Parameters
    ----------
    atlas : Atlas
    solver : GaussNewton
        Of the fits.
    noise : NoiseModel
        Knows the directions of that movement.
    """

    def __init__(self, atlas: Atlas, solver: GaussNewton, noise: NoiseModel) -> None:
        d = atlas.description
        a = d.acquisition
        self._solver, self._noise = solver, noise
        self._parts = a.channels, 2, len(d.bins)
        self._rows = np.zeros((3, atlas.size), atlas.coefficients.dtype)
        self._spline = Spline(atlas, self._rows)
        self._faces = ContactField(atlas, self._rows) if d.face_mm else None
        moment_mm2 = complex(-(d.face_mm**2) / 2)
        self._point: Shape = (0j, moment_mm2, moment_mm2, 0j)
        self._shapes_tell = d.face_mm > 0 and _error_share(atlas) < SHAPES_TELL
        self._turn = np.exp(2j * np.pi * MASS_LEAD_S * np.array(d.bins) * a.sample_rate_hz / a.samples)

    def lag_rad(self, bins: Bins, fit: Fit, k: int) -> tuple[float, float]:
        """Return by how much contact `k` of a fit lags a mass, and the share of its energy that tells it.

        Both are 0 of a contact without energy.
        """
        left = self._solver.residual(bins, fit, without=k)  # without the bins that are left out
        self._look_up(fit, k)
        real, imaginary = self._rows[0].reshape(2, *self._parts[::2])
        mass = (real + 1j * imaginary) * self._turn
        rows = np.empty((2, *self._parts))
        rows[0, :, 0], rows[0, :, 1] = mass.real, mass.imag
        rows[1, :, 0], rows[1, :, 1] = -mass.imag, mass.real
        table = rows.reshape(2, -1) if bins.mask is None else rows.reshape(2, -1) * bins.mask
        own = self._noise.without_plate(table)
        (a, b), (_, c) = (own @ own.T).tolist()
        x, y = (own @ left).tolist()
        det, energy = a * c - b * b, float(table[0] @ table[0])
        amplitude = complex(c * x - b * y, a * y - b * x)
        if not det > 0 or not amplitude:
            return 0.0, 0.0
        # Variance of the phase: that of the part at right angles to the amplitude.
        s, t = -amplitude.imag / abs(amplitude), amplitude.real / abs(amplitude)
        across = (c * s * s - 2 * b * s * t + a * t * t) / det
        return -cmath.phase(amplitude), 1 / (energy * across)

    def _look_up(self, fit: Fit, k: int) -> None:
        """Look up the field that tells the phase of contact `k`: the atlas' own, a point's, or that of its shape."""
        at, size, heavy = fit.positions_mm[k], abs(fit.amplitudes[k]), sizes_of(fit.amplitudes, fit.turns)[k]
        if self._faces and size < POINT_SIZE:
            self._faces.of_shape(*at, self._point, heavy)
        elif self._faces and fit.shapes and (self._shapes_tell or size < SMALL_SIZE):
            self._faces.of_shape(*at, shapes_of(fit)[k], heavy)
        else:
            self._spline.at(*at, heavy)


def _error_share(atlas: Atlas) -> float:
    """Return the mean square of the field's error over that of the field."""
    nodes = atlas.coefficients.reshape(-1)
    return float(atlas.error.mean()) * nodes.size / (2 * float(nodes @ nodes))


class Look(NamedTuple):
    """What one frame tells of a contact."""

    lag_rad: float
    """Behind a mass."""
    noise_rad: float
    """Its standard error by noise."""
    error_rad: float
    """And by what the field misses of all contacts, which is alike in the next frames."""
    size: float
    """Modulus of the amplitude."""
    frequency_ratio: float = 1.0
    """Mean frequency of the bins, over `USUAL_HZ`."""

    @property
    def finger_lag_rad(self) -> float:
        """Return the least lag of a finger of this amplitude."""
        return TISSUE_RAD * self.frequency_ratio * math.cbrt(max(self.size, 1e-6))

    @property
    def bias_rad(self) -> float:
        """Return the error that is alike in all frames."""
        return BIAS_RAD + ERROR_SIGMAS * self.error_rad

    def log_odds(self) -> float:
        """Return the log likelihood ratio of a finger over water in this frame alone."""
        own = self.finger_lag_rad
        ratio = self.lag_rad / own
        return (ratio * ratio - min(ratio - 1, 0.0) ** 2) * own**2 / (2 * (self.noise_rad**2 + self.bias_rad**2))


class State(Enum):
    """What a contact is."""

    UNDECIDED = "undecided"
    FINGER = "finger"
    WATER = "water"


class Evidence(Struct):
    """What the frames of one contact have told."""

    position_mm: Position
    state: State = State.UNDECIDED
    until_ns: int = 0
    """When it is forgotten unless it is seen."""
    least: float = 0.0
    """Sum of the log likelihood ratios of a finger over water, less what the field's error may add."""
    most: float = 0.0
    """The same plus what it takes away where one contact is alone."""
    since_ns: int = 0
    """When it became water."""
    likely_ns: int | None = None
    """Since when water has been likely to be a finger."""
    looked_ns: int = 0
    size: float = 0.0
    """Modulus of the amplitude at the last look."""

    @property
    def is_placed(self) -> bool:
        """Whether it is a finger, and not about to become water."""
        return self.state is State.FINGER and self.most >= 0

    def is_settled(self, size: float, t_ns: int) -> bool:
        """Return whether it is so surely a finger that another look would tell nothing yet."""
        return (
            self.state is State.FINGER
            and self.least >= SURE
            and abs(size - self.size) < LOOK_SHARE * self.size
            and 0 <= t_ns - self.looked_ns < LOOK_NS
        )

    def see(self, position_mm: Position, t_ns: int) -> None:
        """Take a frame in which it is not looked at: it stays what it is."""
        self.position_mm = position_mm
        self.until_ns = t_ns + (FINGER_NS if self.state is State.FINGER else WATER_NS)

    def update(self, position_mm: Position, look: Look, t_ns: int) -> None:
        """Take the contact of a frame."""
        own = look.finger_lag_rad
        weight = own**2 / (2 * max(look.noise_rad**2 + look.error_rad**2, 1e-12))
        if weight > 0:
            odds, margin = 2 * min(look.lag_rad / own, MOST_LAG) - 1, 2 / own
            self.least = _limited(self.least + weight * (odds - margin * look.bias_rad))
            self.most = _limited(self.most + weight * (odds + margin * BIAS_RAD))
        self.looked_ns, self.size = t_ns, look.size
        self._decide(t_ns, lags=look.lag_rad > own)
        self.see(position_mm, t_ns)

    def _decide(self, t_ns: int, *, lags: bool) -> None:
        if self.state is not State.WATER:
            if self.most <= -SURE:
                self.state, self.since_ns, self.likely_ns = State.WATER, t_ns, None
            elif self.least >= SURE:
                self.state = State.FINGER
        elif self.least < SURE:
            self.likely_ns = None
        else:
            self.likely_ns = t_ns if self.likely_ns is None else self.likely_ns
            landed = lags and self.likely_ns - self.since_ns < LAY_NS
            if landed or t_ns - self.likely_ns >= DRY_NS:
                self.state = State.FINGER


def _limited(log_odds: float) -> float:
    return max(-SURE, min(log_odds, SURE))
