"""A contact over time: area, axes and direction of its face, averaged over frames, and the kind of finger."""

from __future__ import annotations

from math import atan2, degrees, exp, hypot, pi, sqrt

from msgspec import Struct

from touchd.touch import Face, Kind

AVERAGE_S = 0.05
"""Time constant of the average: a finger lands within 0.03 s, and rolls and spreads over tenths of a second."""
FORGET_S = 0.3
"""A face that was told in no frame for this time is not told."""
MOST_OVAL = 0.8
"""Largest (a^2 - b^2) / (a^2 + b^2) of an ellipse: three times as long as wide."""
TOLD_SIGMAS = 3.0
"""The direction is told if the face is longer than wide by this many standard errors."""
STEADY_S, CHANGE_S = 0.06, 0.25
"""For so long a kind is seen until it is told, and until it takes the place of another: a finger that lands or lifts
has all sizes within 0.03 s, and one of 100 mm^2 that moves is now a finger, now a thumb."""


class Ellipse(Struct, gc=False, frozen=True):
    """A contact's face, with standard errors."""

    area_mm2: float
    major_mm: float
    """Long axis, from end to end."""
    minor_mm: float
    sigma_area_mm2: float
    sigma_major_mm: float
    sigma_minor_mm: float
    angle_deg: float | None = None
    """Of the long axis from +x towards +y, -90..90; None of a face too round to tell."""
    sigma_angle_deg: float | None = None


def ellipse_of(face: Face) -> Ellipse:
    """Return the ellipse of a face."""
    mean, sigma, oval_sigma = face.mean_mm2, face.mean_sigma_mm2, face.oval_sigma_mm2
    seen = hypot(face.along_mm2, face.diagonal_mm2)
    # Noise makes a round face oval: less its part, on average.
    oval = min(sqrt(max(seen * seen - oval_sigma * oval_sigma, 0.0)), MOST_OVAL * mean)
    a, b = sqrt(mean + oval), sqrt(mean - oval)
    # area = pi sqrt(mean^2 - oval^2), and each axis is twice the root of mean +- oval.
    area_sigma = pi * hypot(mean * sigma, oval * oval_sigma) / (a * b)
    axis_sigma = hypot(sigma, oval_sigma)
    angle = angle_sigma = None
    if seen > TOLD_SIGMAS * oval_sigma:
        angle = degrees(atan2(face.diagonal_mm2, face.along_mm2)) / 2
        angle_sigma = degrees(oval_sigma / seen) / 2
    return Ellipse(pi * a * b, 2 * a, 2 * b, area_sigma, axis_sigma / a, axis_sigma / b, angle, angle_sigma)


class FaceAverage:
    """Averages the moments of one finger's face; an angle is averaged with them, as what has no direction."""

    __slots__ = ("_age_s", "face")

    def __init__(self, face: Face | None) -> None:
        self.face = face
        """None while it cannot be told."""
        self._age_s = 0.0

    def update(self, face: Face | None, elapsed_s: float) -> None:
        """Take the face of a frame, this long after the one before."""
        self._age_s = self._age_s + elapsed_s if face is None else 0.0
        if face is None or self.face is None:
            self.face = face if face is not None or self._age_s > FORGET_S else self.face
            return
        old, weight = self.face, 1 - exp(-elapsed_s / AVERAGE_S)
        if abs(face.mean_mm2 - old.mean_mm2) > face.mean_sigma_mm2:
            weight = 1.0  # it lands, lifts, or is pressed: what was before is not what is
        self.face = Face(
            old.mean_mm2 + weight * (face.mean_mm2 - old.mean_mm2),
            old.along_mm2 + weight * (face.along_mm2 - old.along_mm2),
            old.diagonal_mm2 + weight * (face.diagonal_mm2 - old.diagonal_mm2),
            # Model error, the larger part, is alike in all frames: averaging makes it no smaller.
            face.mean_sigma_mm2,
            face.oval_sigma_mm2,
        )


class SteadyKind:
    """Tells the kind of a finger that was seen for 0.06 s without another one; it changes after 0.25 s of one."""

    __slots__ = ("_candidate", "_for_s", "kind")

    def __init__(self, kind: Kind | None) -> None:
        self.kind: Kind | None = None
        """None until it can be told."""
        self._candidate, self._for_s = kind, 0.0

    def update(self, kind: Kind, elapsed_s: float) -> None:
        """Take the kind of a frame that tells one, this long after the one before."""
        if kind == self.kind:
            self._candidate = None
        elif kind != self._candidate:
            self._candidate, self._for_s = kind, 0.0
        else:
            self._for_s += elapsed_s
            if self._for_s >= (STEADY_S if self.kind is None else CHANGE_S):
                self.kind = kind
