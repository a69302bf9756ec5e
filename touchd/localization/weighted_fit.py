"""Where contacts are, by a fit that knows how the model errs: generalized least squares.

What a contact's five amplitudes leave out grows with the contact, and is alike for all receivers of a bin: with full
weight on every channel it moves the position. Here the errors of a bin's channels have the covariance

    R = 2 v I + sum over contacts of |z|^2 (F E + s (u u^H + O |u|^2))

===========  ==================================================================================================
v            variance of noise in a value
F E          what the field itself misses, by channel: `FIELD` of the atlas' error as its test touches scaled it
u u^H        an error of the contact's own amplitude in this bin, which all receivers share: what the expansion to
             second order leaves, and the waves that other fingers send to this one
O |u|^2      what they do not share: of each channel's own energy, and of its mean over the bins
s            `TISSUE` times the moment to the power of `POWER`, and `SCATTER` for each finger beside it
===========  ==================================================================================================

It says where contacts are, with standard errors, and by its misfit whether one is missing (`missing`); all else is
decided by unweighted energies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Atlas
from touchd.localization.contact_model import Complex, ContactModel, mean_moment_mm2
from touchd.localization.estimator import Finger
from touchd.localization.fit import Bins, Fit, finish, sigmas_mm, sizes_of
from touchd.localization.spline import ContactField, Position, Spline

FIELD = 0.55
"""Of half the touches, as a share of its mean: a few badly known places have most of it."""
TISSUE, POWER = 0.0035, 3.0
"""Share of a contact's energy in a bin for a moment of 1 mm^2, and how it grows with the moment. With it 68 and 95 % of
silicone tips, children's fingers, fingertips and thumbs are within one and two standard errors (twin)."""
SCATTER = 0.002
"""Share for each finger beside it. Half of it and twice it place five fingertips as well (twin)."""
OWN = 0.05
"""What each receiver misses alone, as a share of what all miss together."""
STEPS, MISFIT_STEPS = 3, 2
UNKNOWN = 12
"""Of a contact: its place, and five complex amplitudes."""
MOST_MM = 1.0
"""A fit that is farther away is one of another valley."""
SLOW_MM = 0.2
HOLD_MM = 1.0
"""A thirtieth of the wavelength: the field, and with it the model's error, is still much alike."""


class Place(NamedTuple):
    """Where a contact is."""

    x_mm: float
    y_mm: float
    sigma_mm: float
    """Standard error per axis."""


class WeightedFit:
    """Places contacts of a size and a shape once more.

    Parameters
    ----------
    atlas : Atlas
    """

    def __init__(self, atlas: Atlas) -> None:
        d, dtype = atlas.description, atlas.coefficients.dtype
        self._shape = d.acquisition.channels, len(d.bins)
        self._field = np.zeros((3, atlas.size), dtype)
        self._spline = Spline(atlas, self._field)
        self._model = ContactModel(atlas, ContactField(atlas, np.zeros_like(self._field)))
        self._error: NDArray[np.float64] = FIELD * d.field_scale * atlas.error.T.astype(np.float64)

    def place(self, bins: Bins, fit: Fit, variance: float) -> tuple[list[Place], float]:
        """Return where the contacts of a fit with shapes are, and their misfit.

        There are no places where that cannot be told better than it is. `variance` is that of the noise of a value,
        counts squared.
        """
        variance = _least(variance, bins)
        found, misfit = self._fit(bins, fit, variance, STEPS)
        if found is None:
            return [], misfit
        sigmas = sigmas_mm(found.fisher_information, variance)
        places = [Place(x, y, sigma) for (x, y), sigma in zip(found.positions_mm, sigmas, strict=True)]
        # Asked this way round, so that NaN is not taken.
        near = all(
            abs(place.x_mm - x) < MOST_MM and abs(place.y_mm - y) < MOST_MM and place.sigma_mm < MOST_MM
            for place, (x, y) in zip(places, fit.positions_mm, strict=True)
        )
        return places if near else [], misfit

    def misfit(self, bins: Bins, fit: Fit, variance: float) -> float:
        """Return what contacts with shapes leave of a frame, in variances that it may; infinite if none fit.

        They leave less than 1, as what the model misses is alike in many values: fits that lack no finger 0.15 (twin).
        """
        _, misfit = self._fit(bins, fit, _least(variance, bins), MISFIT_STEPS)
        return misfit

    def _fit(self, bins: Bins, fit: Fit, variance: float, steps: int) -> tuple[Fit | None, float]:
        """Return the contacts fitted with weights, and their misfit."""
        try:
            whiten = self._whitener(bins, fit, variance)
            found = finish(self._model.pieces(bins, fit.positions_mm, variance, steps, whiten=whiten))
        except np.linalg.LinAlgError:
            return None, math.inf
        values = bins.vector.size - UNKNOWN * len(found.positions_mm)
        return found, found.residual_energy / (max(values, 1) * variance)

    def _whitener(self, bins: Bins, fit: Fit, variance: float) -> Complex:
        """Return what makes the errors of each bin white, of the variance of noise, (bins, channels, channels)."""
        channels, count = self._shape
        covariance = np.zeros((count, channels, channels), complex)
        own = np.full((count, channels), 2 * variance)
        mask = None if bins.mask is None else bins.mask.reshape(channels, 2, count)[:, 0]
        sizes = sizes_of(fit.amplitudes, fit.turns)
        each = zip(fit.positions_mm, fit.amplitudes, sizes, shares(fit), strict=True)
        for (x_mm, y_mm), z, size, share in each:
            u = self._look_up(self._spline.inside(x_mm, y_mm), size, mask)
            power, energy = abs(z) ** 2, np.square(np.abs(u))
            covariance += power * share * (u[:, :, None] * u[:, None].conj())
            own += power * (self._error + OWN * share * (energy + energy.mean(axis=0)))
        covariance.reshape(count, -1)[:, :: channels + 1] += own
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        return np.asarray(np.sqrt(2 * variance) * root)

    def _look_up(self, at: Position, size: float, mask: NDArray[np.floating] | None) -> Complex:
        """Return the masked field of a contact over its amplitude, of modulus `size`, shape (bins, channels)."""
        self._spline.at(*at, size)
        real, imaginary = self._field[0].astype(np.float64).reshape(2, *self._shape)
        u = real + 1j * imaginary
        return np.asarray((u if mask is None else u * mask).T)


class _Moved(NamedTuple):
    """What a weighted fit has moved a finger by."""

    from_mm: Position
    by_mm: Position
    share: float
    """Of the fit's standard error, what was left: a finger that lifts is less sure in each frame."""


class Refinement:
    """Decides when fingers are placed by the weighted fit, and how long that holds.

    | fingers with shapes | are placed |
    |---|---|
    | of a frame judged alone, or that are new and step less than `SLOW_MM` | by the weighted fit |
    | that have gone less than `HOLD_MM` since | as fitted, but for what the weighted fit moved them then |
    | that move | as fitted |

    A step of a finger that moves is longer than what the weighted fit would move it by, and the time is its own.

    Parameters
    ----------
    weighted : WeightedFit
    """

    def __init__(self, weighted: WeightedFit) -> None:
        self._weighted = weighted
        self.reset()

    def reset(self) -> None:
        """Forget all fingers."""
        self._moved: Sequence[_Moved] = ()
        self._last_mm: Sequence[Position] = ()
        self.misfit = 0.0
        """Of the fingers, if they were placed by the weighted fit in the last frame; else 0."""

    def place(
        self, bins: Bins, fit: Fit, fingers: list[Finger], variance: float, *, new: bool, alone: bool
    ) -> tuple[list[Position], list[Finger]]:
        """Return where the contacts of a fit are, and the fingers among them with the standard errors of that.

        Parameters
        ----------
        bins : Bins
        fit : Fit
        fingers : list of Finger
            With the standard errors of the fit.
        variance : float
            Of the noise of a value, counts squared.
        new : bool
            Whether the shapes are this frame's.
        alone : bool
            Whether no further frame will be judged.
        """
        at, last, self._last_mm, self.misfit = fit.positions_mm, self._last_mm, fit.positions_mm, 0.0
        if not fit.shapes:
            self._moved = ()
        elif new or not self._holds(at):
            slow = len(last) == len(at) and max(map(math.dist, at, last)) < SLOW_MM
            self._moved = self._weigh(bins, fit, fingers, variance) if alone or slow else ()
        if not self._moved:
            return at, fingers
        moved = [(x + one.by_mm[0], y + one.by_mm[1]) for (x, y), one in zip(at, self._moved, strict=True)]
        return moved, [(k, self._moved[k].share * sigma_mm, size) for k, sigma_mm, size in fingers]

    def _holds(self, at: Sequence[Position]) -> bool:
        """Return whether the fingers are near where they were placed last."""
        return len(self._moved) == len(at) and all(
            math.dist(position, one.from_mm) < HOLD_MM for position, one in zip(at, self._moved, strict=True)
        )

    def _weigh(self, bins: Bins, fit: Fit, fingers: list[Finger], variance: float) -> Sequence[_Moved]:
        places, self.misfit = self._weighted.place(bins, fit, variance)
        sigmas_mm = {k: sigma_mm for k, sigma_mm, _ in fingers}
        return [
            _Moved((x, y), (place.x_mm - x, place.y_mm - y), place.sigma_mm / sigmas_mm.get(k, place.sigma_mm))
            for k, ((x, y), place) in enumerate(zip(fit.positions_mm, places, strict=False))
        ]


def _least(variance: float, bins: Bins) -> float:
    """Return a variance that is one: frames of nothing but fingers have none."""
    return max(variance, 1e-12 * bins.energy / bins.vector.size, 1e-30)


def shares(fit: Fit) -> Sequence[float]:
    """Return of each contact of a fit with shapes which share of its energy in a bin the model misses."""
    beside = SCATTER * (len(fit.positions_mm) - 1)
    return [
        TISSUE * mean_moment_mm2(z, shape) ** POWER + beside
        for z, shape in zip(fit.amplitudes, fit.shapes, strict=True)
    ]
