"""From the amplitudes of a contact's second derivatives to the size and shape of its face, and the kind of finger.

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
from math import hypot, pi, sqrt

from touchd.localization.atlas import Atlas
from touchd.localization.fit import Fit
from touchd.localization.noise import NoiseModel
from touchd.localization.position_error import PHASE_RAD, shape_information
from touchd.touch import Face, Kind

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
THUMB_MM2 = 104.0
"""Fingertips of 40 to 110 mm^2 and thumbs of 100 to 160 mm^2 are told right in 97 of 100 frames, and
not told in 12 of 100 (twin)."""
GLOVE_SIZE = 0.4
"""Gloves of 8 mm^2 have 0.34, a robot's tip of 12 mm^2 has 0.47 (twin)."""


class ContactSize:
    """Tells the size and shape of fitted contacts.

    Parameters
    ----------
    atlas : Atlas
    noise : NoiseModel
    """

    def __init__(self, atlas: Atlas, noise: NoiseModel) -> None:
        self._noise = noise
        self._values = atlas.size
        self._turn = cmath.rect(1.0, -PHASE_RAD)
        # The moment that a contact has where the field is one of a wide face, before any is fitted.
        self._face_moment_mm2 = atlas.description.face_mm**2 / 2
        self._of_mean, self._of_oval, _ = shape_information(atlas)

    def faces(self, fit: Fit) -> list[Face | None]:
        """Return the faces of a fit's contacts, None of those that cannot be told."""
        noise = self._noise
        left = max(fit.residual_energy - noise.ceiling, 0.0) / noise.active_bins
        # Bins that are left out count as if they told as much as others.
        variance = (noise.variance + UNUSUAL * left) * self._values / max(noise.active_bins, 1)
        found: list[Face | None] = []
        for position, z, (_, xx, yy, xy) in zip(fit.positions_mm, fit.amplitudes, fit.shapes, strict=True):
            power = abs(z) ** 2
            moment = (((xx + yy) / (2 * z) + self._face_moment_mm2) * self._turn).real if power > 0 else 0.0
            of_mean, of_oval = self._of_mean.at(*position), self._of_oval.at(*position)
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


def kind_of(size: float, face: Face | None) -> Kind | None:
    """Return the kind of a contact in one frame: by the area of its face, or by how little it changes the field.

    ============================================  ===============
    frame says                                    kind
    ============================================  ===============
    area above 104 mm^2 by a standard error       thumb
    area below 104 mm^2 by a standard error       finger
    no size, and an amplitude below 0.4           glove
    anything else                                 not told
    ============================================  ===============

    A fingertip pressed with more than 1 N has the area of a thumb, and a dry finger or a stylus that of a glove. Water
    and palms are no touches: `classify` and `fit_criteria` keep them out. `size` is the modulus of the amplitude.
    """
    if face is None:
        return "glove" if size < GLOVE_SIZE else None
    oval2 = face.along_mm2**2 + face.diagonal_mm2**2
    area_mm2 = pi * sqrt(max(face.mean_mm2**2 - oval2, 0.0))
    if abs(area_mm2 - THUMB_MM2) <= pi * face.mean_sigma_mm2:
        return None
    return "thumb" if area_mm2 > THUMB_MM2 else "finger"


def _interpolate(at: float, x: tuple[float, ...], y: tuple[float, ...]) -> tuple[float, float]:
    """Return the value of a broken line, and its slope; it goes on straight beyond its ends."""
    k = min(max(bisect(x, at), 1), len(x) - 1)
    slope = (y[k] - y[k - 1]) / (x[k] - x[k - 1])
    return y[k] + slope * (at - x[k]), slope
