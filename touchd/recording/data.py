"""A recording in memory: frames, true contacts, and a description of the rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from touchd.frame import MAX_RATE_HZ, Acquisition, Chirp, Plate


class Device(BaseModel):
    """The DAQ that took a recording."""

    model_config = ConfigDict(frozen=True, extra="ignore")
    serial: str = ""
    firmware: str = ""


class Act(BaseModel):
    """What a person was asked to do, and the frames in which it was done."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)
    name: str
    """`untouched`, `tap`, `stroke`, `palm` or `thumb`."""
    begin: int = Field(ge=0)
    """The first frame."""
    end: int = Field(ge=0)
    """The frame after the last one."""
    places_mm: tuple[tuple[float, float], ...] = ()
    """The place that was told; of a stroke, both ends."""
    uncertainty_mm: float | None = None
    """Standard deviation per axis of where the person really was; of a stroke, across it."""


class Meta(BaseModel):
    """The JSON object of a recording's `meta` key."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    sample_rate_hz: float = Field(ge=1, le=MAX_RATE_HZ)
    bits: int = Field(ge=2, le=16)
    full_scale_v: float = Field(ge=1e-9, le=1e6)
    frame_rate_hz: float = Field(ge=1e-6, le=1e6)
    plate: Plate
    chirp: Chirp = Chirp()
    emitter_mm: tuple[float, float] | None = None
    receivers_mm: tuple[tuple[float, float], ...] | None = None
    source: str = ""
    device: Device = Device()
    created: str = ""
    notes: str = ""
    acts: tuple[Act, ...] = ()
    """Of `touchd record --label`, in order."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A whole recording in memory, or one chunk of it: n frames, k contacts."""

    meta: Meta
    frames: NDArray[np.int16]
    """ADC counts of shape (n, channels, samples)."""
    sequence: NDArray[np.int64]
    """The device's frame counter, shape (n,)."""
    timestamp_ns: NDArray[np.int64]
    """Start of the chirp since the first frame, shape (n,), ns."""
    contacts_mm: NDArray[np.float32] | None = None
    """True positions of shape (n, k, 2), NaN where finger k does not touch."""
    force_n: NDArray[np.float32] | None = None
    """True force of shape (n, k), NaN where unknown or not touching."""
    faces: NDArray[np.float32] | None = None
    """True long and short axis (mm, from end to end) of each contact's face, and its direction (degrees from +x towards
    +y), shape (n, k, 3), NaN where unknown or not touching."""
    temperature_c: NDArray[np.float32] | None = None
    """Shape (n,)."""

    def during(self, *names: str) -> NDArray[np.bool_]:
        """Return which frames belong to acts of these names, shape (n,)."""
        found = np.zeros(len(self.sequence), np.bool_)
        for act in self.meta.acts:
            if act.name in names:
                found[act.begin : act.end] = True
        return found

    @property
    def acquisition(self) -> Acquisition:
        """The geometry of the frames."""
        _, channels, samples = self.frames.shape
        m = self.meta
        return Acquisition(
            channels=channels, samples=samples, sample_rate_hz=m.sample_rate_hz, bits=m.bits,
            full_scale_v=m.full_scale_v, chirp=m.chirp,
        )  # fmt: skip
