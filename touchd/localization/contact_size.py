"""From the amplitudes of a contact's second derivatives to the size and shape of its face.

A contact pushes on the plate with K(s, s'), the force at s of its face for a deflection at s'. To second order in its
size the field is then z u + a_xx u_xx + a_yy u_yy + a_xy u_xy with z = sum K and, since u is a product of two waves,
a_ij / z = sum s_i s'_j K / (2 sum K): half a second moment of the face.

======================================  ===============================================================================
face                                    mean of a_xx and a_yy over z, in mean squared semi-axes
======================================  ===============================================================================
a bed of springs: K only where s = s'   1/8
tissue, a fluid half-space              0.05 to 0.08: K ~ exp(-i k r) / r couples its parts, the more as it is small
rigid                                   0: it feels the mean deflection alone, so its size cannot be told
======================================  ===============================================================================

The coupling's delay turns the ratio by 0.3 to 0.5 rad, alike for all sizes (Rayleigh's integral gives 0.42 rad for
child's fingers, 0.3 for fingertips). The part along `PHASE_RAD` is used: across it the ratio is noise and model error.
What makes a face long rather than large is in phase with z. The moments depend on where the face pushes, not on how
hard or on what tissue weighs: unlike `force` they need no reference.
"""

from __future__ import annotations

import cmath
from bisect import bisect
from math import hypot, sqrt
from weakref import WeakKeyDictionary

import numpy as np

from touchd.localization.atlas import Atlas
from touchd.localization.contact_field import place_in_band
from touchd.localization.fit import Fit
from touchd.localization.noise import NoiseModel
from touchd.localization.spline import Position
from touchd.touch import Face

PHASE_RAD = 0.4
SIZES_MM2 = (0.0, 8.0, 14.0, 20.0, 27.0, 34.0, 42.0, 52.0, 70.0)
"""Mean squared semi-axes of contacts: 26 mm^2 in area have 8, 107 have 34."""
MOMENTS_MM2 = (0.0, 0.4395, 0.8719, 1.362, 1.9996, 2.599, 3.2119, 3.8009, 4.861)
"""Their amplitudes' ratio along `PHASE_RAD`: fingertips, thumbs and children's fingers (twin)."""
OVAL_SIZES_MM2, OVALS = (0.0, 25.0, 35.0, 50.0), (0.08, 0.08, 0.0775, 0.0655)
"""Ratio of (a_xx - a_yy) / 2 z to (a^2 - b^2) / 2 at mean squared semi-axes (twin)."""
UNUSUAL = 8.0
"""Weight, relative to noise, of what a fit leaves beyond it: model error is alike in many bins. With it, and the next
two, 68 and 95 % of moments are within one and two standard errors at 50 and 60 dB (twin)."""
MEAN_SHARE, OVAL_SHARE = 0.015, 0.03
"""Standard errors of both moments, in moments, that are there without noise."""
TOLD_SIGMAS = 3.0
"""A moment below this many standard errors is not told: of a rigid or a small face."""
_STENCILS = np.array([[1, 4, 1], [-3, 0, 3], [6, -12, 6]]) / 6
"""Value and first two derivatives of a cubic B-spline at a node."""
_DERIVATIVES = ((1, 0), (0, 1), (0, 0), (2, 0), (0, 2), (1, 1))
"""Orders along x and y of u_x, u_y, u, u_xx, u_yy and u_xy."""
Spreads = list[list[tuple[float, float]]]
_known: WeakKeyDictionary[Atlas, Spreads] = WeakKeyDictionary()


class ContactSize:
    """Tells the size and shape of fitted contacts.

    Parameters
    ----------
    atlas : Atlas
    noise : NoiseModel
    """

    def __init__(self, atlas: Atlas, noise: NoiseModel) -> None:
        d = atlas.description
        self._noise = noise
        self._values = atlas.size
        self._origin_mm, self._step_mm = d.origin_mm, d.step_mm
        self._turn = cmath.rect(1.0, -PHASE_RAD)
        self._spreads = _spreads(atlas, self._turn)

    def faces(self, fit: Fit) -> list[Face | None]:
        """Return the faces of a fit's contacts, None of those that cannot be told."""
        noise = self._noise
        left = max(fit.residual_energy - noise.ceiling, 0.0) / noise.active_bins
        variance = noise.variance + UNUSUAL * left
        found: list[Face | None] = []
        for position, z, (_, xx, yy, xy) in zip(fit.positions_mm, fit.amplitudes, fit.shapes, strict=True):
            power = abs(z) ** 2
            moment = ((xx + yy) / (2 * z) * self._turn).real if power > 0 else 0.0
            of_mean, of_oval = self._spread(position)
            sigma = sqrt(of_mean * variance / max(power, 1e-30) + (MEAN_SHARE * moment) ** 2)
            if not moment > TOLD_SIGMAS * sigma:  # asked this way round, so that NaN is not told
                found.append(None)
                continue
            mean_mm2, slope = _interpolate(moment, MOMENTS_MM2, SIZES_MM2)
            oval, _ = _interpolate(mean_mm2, OVAL_SIZES_MM2, OVALS)
            oval_sigma = hypot(sqrt(of_oval * variance / power) / oval, OVAL_SHARE * mean_mm2)
            along, diagonal = ((xx - yy) / (2 * z)).real, (xy / (2 * z)).real
            found.append(Face(mean_mm2, along / oval, diagonal / oval, slope * sigma, oval_sigma))
        return found

    def _spread(self, position_mm: Position) -> tuple[float, float]:
        """Return the variances of both moments by noise of unit variance at amplitude 1, near a position.

        Bins that are left out count as if they told as much as others.
        """
        rows = self._spreads
        x, y = (
            min(max((at - low) / self._step_mm, 0.0), most - 1.001)
            for at, low, most in zip(position_mm, self._origin_mm, (len(rows[0]), len(rows)), strict=True)
        )
        column, row = int(x), int(y)
        x, y = x - column, y - row
        share = self._values / max(self._noise.active_bins, 1)
        mean, oval = (
            share * ((1 - y) * ((1 - x) * one + x * two) + y * ((1 - x) * three + x * four))
            for one, two, three, four in zip(
                rows[row][column], rows[row][column + 1], rows[row + 1][column], rows[row + 1][column + 1], strict=True
            )
        )
        return mean, oval


def _spreads(atlas: Atlas, turn: complex) -> Spreads:
    """Return `_inverted` of an atlas; the quarter of a second that it takes is spent once for each atlas."""
    if (known := _known.get(atlas)) is None:
        known = _known[atlas] = _inverted(atlas, turn)
    return known


def _inverted(atlas: Atlas, turn: complex) -> Spreads:
    """Invert the Fisher information of x, y and the five amplitudes of one contact at every node of an atlas.

    Return the variances of both moments by noise of unit variance at amplitude 1, for each row of nodes and column.
    Fingers nearby share their information; that is left out, as what the fit of several leaves is larger.
    """
    d, nodes = atlas.description, atlas.coefficients
    channels, bins = d.acquisition.channels, len(d.bins)
    stencils = _STENCILS.astype(nodes.dtype)
    band = place_in_band(atlas).astype(nodes.dtype)
    # The parts of a_xx, a_yy and a_xy are the last six of twelve unknowns.
    wanted = np.zeros((3, 12))
    wanted[0, -6:-2] = np.tile([turn.real / 2, -turn.imag / 2], 2)
    wanted[1, [-6, -4]], wanted[2, -2] = (0.5, -0.5), 0.5
    found = []
    for row in range(len(nodes)):
        above = np.clip(np.arange(row - 1, row + 2), 0, len(nodes) - 1)
        along_y = np.tensordot(stencils, nodes[above], 1)  # (orders, columns, size)
        beside = np.clip(np.arange(nodes.shape[1])[:, None] + (-1, 0, 1), 0, nodes.shape[1] - 1)
        fields = np.stack(
            [np.einsum("k,nks->ns", stencils[i], along_y[j][beside]) / d.step_mm ** (i + j) for i, j in _DERIVATIVES],
            axis=1,
        )
        parts = fields.reshape(len(fields), len(_DERIVATIVES), channels, 2, bins)
        x, y, u, *second = (
            (parts[..., 0, :] + np.complex64(1j) * parts[..., 1, :]).reshape(*fields.shape[:2], -1).swapaxes(0, 1)
        )
        columns = np.stack([x, y, *(turned * one for one in (u, u * band, *second) for turned in (1, 1j))], axis=1)
        information = (columns.conj() @ columns.swapaxes(1, 2)).real.astype(np.float64)
        # A field of zeros, as of a plate without channels, tells nothing.
        empty = ~(np.linalg.matrix_rank(information) == information.shape[-1])
        information[empty] = np.eye(information.shape[-1])
        spread = np.einsum("ki,nij,kj->nk", wanted, np.linalg.inv(information), wanted)
        spread[empty] = np.inf
        found.append([(mean, (along + diagonal) / 2) for mean, along, diagonal in spread.tolist()])
    return found


def _interpolate(at: float, x: tuple[float, ...], y: tuple[float, ...]) -> tuple[float, float]:
    """Return the value of a broken line, and its slope; it goes on straight beyond its ends."""
    k = min(max(bisect(x, at), 1), len(x) - 1)
    slope = (y[k] - y[k - 1]) / (x[k] - x[k - 1])
    return y[k] + slope * (at - x[k]), slope
