"""One finger found in one frame: what localization passes to tracking."""

from __future__ import annotations

from msgspec import Struct


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
