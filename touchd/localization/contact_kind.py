"""What kind of finger a contact is: by the area of its face, or by how little a faint one changes the field.

============================================  ===============
frame says                                    kind
============================================  ===============
area above 104 mm^2 by a standard error       thumb
area below 104 mm^2 by a standard error       finger
no size, and an amplitude below 0.4           glove
anything else                                 not told
============================================  ===============

A fingertip pressed with more than 1 N has the area of a thumb, and a dry finger or a stylus that of a glove. Water and
palms are no touches: `classify` and `fit_criteria` keep them out.
"""

from __future__ import annotations

from math import pi, sqrt

from touchd.touch import Face, Kind

THUMB_MM2 = 104.0
"""Fingertips of 40 to 110 mm^2 and thumbs of 100 to 160 mm^2 are told right in 97 of 100 frames, and
not told in 12 of 100 (twin)."""
GLOVE_SIZE = 0.4
"""Gloves of 8 mm^2 have 0.34, a robot's tip of 12 mm^2 has 0.47 (twin)."""


def kind_of(size: float, face: Face | None) -> Kind | None:
    """Return the kind of a contact in one frame, None if it cannot be told.

    Parameters
    ----------
    size : float
        Modulus of its amplitude.
    face : Face, optional
    """
    if face is None:
        return "glove" if size < GLOVE_SIZE else None
    oval2 = face.along_mm2**2 + face.diagonal_mm2**2
    area_mm2 = pi * sqrt(max(face.mean_mm2**2 - oval2, 0.0))
    if abs(area_mm2 - THUMB_MM2) <= pi * face.mean_sigma_mm2:
        return None
    return "thumb" if area_mm2 > THUMB_MM2 else "finger"
