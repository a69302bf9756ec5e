"""One finger found in one frame: what localization hands to tracking."""

from __future__ import annotations

from msgspec import Struct


class Touch(Struct, gc=False):
    """A finger found in one frame."""

    x_mm: float
    y_mm: float
    sigma_mm: float
    confidence: float
    force: float
    key: str | None = None
