"""One acquisition of the plate (`Frame`) and the geometry of all of them (`Acquisition`)."""

from __future__ import annotations

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

Counts = NDArray[np.int16]

# Beyond these a number is a mistake, and would take memory or overflow somewhere else.
MAX_CHANNELS, MAX_SAMPLES = 1024, 65_536
MAX_RATE_HZ = 1e10


class Frame(Struct, gc=False, frozen=True):
    """What the receivers heard during one chirp.

    A struct, since one is made for each frame: it costs a quarter of a named tuple.
    """

    counts: Counts
    """ADC counts of shape (channels, samples). Valid until the source is read again."""
    sequence: int
    """The device's frame counter, unwrapped; a jump means that frames were lost."""
    t_ns: int
    """CLOCK_MONOTONIC at the start of the chirp, ns."""
    received_ns: int
    """CLOCK_MONOTONIC when the frame was complete on this host, ns."""


class _Description(BaseModel):
    """Part of a JSON object on disk: unknown keys are ignored, as the formats ask."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Chirp(_Description):
    """The emitted linear chirp."""

    start_hz: float = Field(default=50e3, ge=1, le=1e9)
    stop_hz: float = Field(default=100e3, ge=1, le=1e9)
    duration_s: float = Field(default=1e-3, ge=1e-6, le=10)
    dac_rate_hz: float = Field(default=500e3, ge=1, le=1e10)


class Plate(_Description):
    """The touched plate."""

    width_mm: float = Field(ge=1, le=1e5)
    """Along x, to the right."""
    height_mm: float = Field(ge=1, le=1e5)
    """Along y, down."""
    thickness_mm: float = Field(default=5.0, ge=1e-3, le=1e4)
    material: str = "glass"


def parse_plate(text: str) -> Plate:
    """Return the plate of `400x300` or `400x300x5`, mm; raises ValueError."""
    names = ("width_mm", "height_mm", "thickness_mm")
    sizes_mm = [float(size) for size in text.lower().split("x")]
    return Plate.model_validate(dict(zip(names[: max(2, len(sizes_mm))], sizes_mm, strict=True)))


class Acquisition(_Description):
    """How frames were acquired: everything a model must agree with."""

    channels: int = Field(gt=0, le=MAX_CHANNELS)
    samples: int = Field(gt=0, le=MAX_SAMPLES)
    sample_rate_hz: float = Field(ge=1, le=MAX_RATE_HZ)
    bits: int = Field(default=16, ge=2, le=16)
    full_scale_v: float = Field(default=10.0, ge=1e-9, le=1e6)
    chirp: Chirp = Chirp()

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of a frame's counts: (channels, samples)."""
        return self.channels, self.samples
