"""One finger found in one frame: what localization passes to tracking."""

from __future__ import annotations

import math
from typing import Literal

from msgspec import Struct

Kind = Literal["finger", "thumb", "glove"]


class Face(Struct, gc=False, frozen=True):
    """The second moments of a contact's face: those of an ellipse of semi-axes a and b, turned by an angle t.

    They are linear in what is measured, so they can be averaged; `touchd.tracking.face` makes axes of them.
    """

    mean_mm2: float
    """(a^2 + b^2) / 2."""
    along_mm2: float
    """(a^2 - b^2) / 2 cos 2t: how far the face is longer along x than along y."""
    diagonal_mm2: float
    """(a^2 - b^2) / 2 sin 2t: how far it is longer along x = y than across."""
    mean_sigma_mm2: float
    """Standard error of `mean_mm2`."""
    oval_sigma_mm2: float
    """Standard error of `along_mm2` and of `diagonal_mm2`, each."""


PART_MM = 25.0
"""What is nearer to a part of a palm belongs to it."""


class PalmArea(Struct, gc=False, frozen=True):
    """Where a palm lies: what is nearer to its middle than `reach_mm`, or to a part of it, belongs to it."""

    x_mm: float
    y_mm: float
    reach_mm: float
    parts_mm: tuple[tuple[float, float], ...] = ()
    """Of a long one, as of a forearm: what of it was seen beyond its reach."""

    def has(self, x_mm: float, y_mm: float) -> bool:
        """Return whether a position is within reach, or at a part."""
        if math.hypot(x_mm - self.x_mm, y_mm - self.y_mm) < self.reach_mm:
            return True
        return any(math.hypot(x_mm - x, y_mm - y) < PART_MM for x, y in self.parts_mm)


class Touch(Struct, gc=False, frozen=True):
    """A finger found in one frame. Millimetres from the plate's top-left corner, x right, y down."""

    x_mm: float
    y_mm: float
    sigma_mm: float
    """Predicted standard error of the position, per axis."""
    confidence: float
    """0..1: how much the frame looks like fingers."""
    force: float
    """0..1: the change of the signal, in full scales."""
    key: str | None = None
    """The key under the finger, in keypad mode."""
    face: Face | None = None
    """Size and shape, if they can be told."""
    kind: Kind | None = None
    """What kind of finger it is in this frame, if that can be told."""
