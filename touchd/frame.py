"""One acquisition of the plate (`Frame`) and the geometry of all of them (`Acquisition`)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field

Counts = NDArray[np.int16]

# Beyond these a number is a mistake, and would take memory or overflow somewhere else.
MAX_CHANNELS, MAX_SAMPLES = 1024, 65_536
MAX_RATE_HZ = 1e10
HANN = 1.0
"""Taper of Hann's window, which falls from the middle on."""


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

    def copy(self) -> Frame:
        """Return the same frame with counts of its own, which stay valid."""
        return Frame(self.counts.copy(), self.sequence, self.t_ns, self.received_ns)


class Description(BaseModel):
    """Part of a JSON object on disk: unknown keys are ignored, as the formats ask."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class Chirp(Description):
    """The emitted linear chirp."""

    start_hz: float = Field(default=50e3, ge=1, le=1e9)
    stop_hz: float = Field(default=100e3, ge=1, le=1e9)
    duration_s: float = Field(default=1e-3, ge=1e-6, le=10)
    dac_rate_hz: float = Field(default=500e3, ge=1, le=1e10)
    period_s: float | None = Field(default=None, ge=1e-6, le=10)
    """From one chirp to the next if the plate still rings from earlier ones: frames are taken in steady state. None if
    each chirp meets a silent plate."""

    @property
    def band_hz(self) -> tuple[float, float]:
        """Lowest and highest frequency."""
        return min(self.start_hz, self.stop_hz), max(self.start_hz, self.stop_hz)

    def waveform(self) -> NDArray[np.float64]:
        """Return what the DAC plays: a linear chirp of continuous phase and unit amplitude, one value a DAC sample."""
        t = np.arange(round(self.duration_s * self.dac_rate_hz)) / self.dac_rate_hz
        rate = (self.stop_hz - self.start_hz) / self.duration_s
        return np.asarray(np.sin(2 * np.pi * (self.start_hz + rate * t / 2) * t))

    def spectrum(self, omega_rad_s: ArrayLike) -> NDArray[np.complex128]:
        """Return the Fourier transform of the DAC's output, s, each value held for one DAC sample.

        Exact at any complex frequency but zero; `omega_rad_s` has shape (F,), and so has the transform.
        """
        omega = np.asarray(omega_rad_s, dtype=np.complex128)
        played = self.waveform()
        step = -1j * omega[:, None] / self.dac_rate_hz
        hold = (1 - np.exp(step[:, 0])) / (1j * omega)
        # In rows of sqrt(T) samples: F sqrt(T) exponentials instead of F T.
        row = math.isqrt(len(played)) + 1
        rows = np.pad(played, (0, -len(played) % row)).reshape(-1, row)
        sums = np.exp(step * np.arange(row)) @ rows.T
        return np.asarray(hold * (sums * np.exp(step * (row * np.arange(len(rows))))).sum(axis=1))


class Plate(Description):
    """The touched plate."""

    width_mm: float = Field(ge=1, le=1e5)
    """Along x, to the right."""
    height_mm: float = Field(ge=1, le=1e5)
    """Along y, down."""
    thickness_mm: float = Field(default=5.0, ge=1e-3, le=1e4)
    material: str = "glass"

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height."""
        return self.width_mm, self.height_mm

    def __str__(self) -> str:
        """Return size and material, for a message."""
        return f"{self.width_mm:g} x {self.height_mm:g} x {self.thickness_mm:g} mm of {self.material}"


LEAST_SIDE_MM, LEAST_THICKNESS_MM, MOST_THICKNESS = 10.0, 0.1, 0.25
"""Shorter sides and thinner plates are in metres or centimetres. A thickness beyond that share of the shorter side is
no plate's, too."""


def impossible_lengths(width_mm: float, height_mm: float, thickness_mm: float) -> Iterator[tuple[str, str]]:
    """Yield the key of each length that no plate has in millimetres, and what is wrong with it."""
    for key, length_mm in (("width_mm", width_mm), ("height_mm", height_mm)):
        if length_mm < LEAST_SIDE_MM:
            yield key, f"{length_mm:g} mm is no plate: metres or centimetres?"
    if not LEAST_THICKNESS_MM <= thickness_mm <= MOST_THICKNESS * min(width_mm, height_mm):
        yield "thickness_mm", f"{thickness_mm:g} mm is no thickness of a {width_mm:g} x {height_mm:g} mm plate"


def parse_plate(text: str) -> Plate:
    """Return the plate of `400x300` or `400x300x5`, mm; raises ValueError."""
    names = ("width_mm", "height_mm", "thickness_mm")
    sizes_mm = [float(size) for size in text.lower().split("x")]
    return Plate.model_validate(dict(zip(names[: max(2, len(sizes_mm))], sizes_mm, strict=True)))


class Acquisition(Description):
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

    @property
    def highest_hz(self) -> float:
        """Frequency up to which the plate is heard: the chirp's end, and what its edges leak beyond it."""
        return 1.25 * self.chirp.band_hz[1]

    def window(self, taper: float = HANN) -> NDArray[np.float64]:
        """Return the weights of the samples in a spectrum, shape (samples,): 1 where the frame is a whole period.

        Else Tukey's, which rise and fall over `taper` of the frame, half at each end (Harris, Proc. IEEE 66:51, 1978,
        eq. 38).
        """
        if self.is_whole_period or taper == 0:
            return np.ones(self.samples)
        if taper == HANN:
            return np.hanning(self.samples)
        from_end = np.minimum(np.arange(self.samples), np.arange(self.samples)[::-1])
        return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.minimum(2 * from_end / (taper * (self.samples - 1)), 1.0)))

    @property
    def is_whole_period(self) -> bool:
        """Whether a frame is one period in steady state: its bins are the harmonics, and no window is needed."""
        period_s = self.chirp.period_s
        return period_s is not None and round(period_s * self.sample_rate_hz) == self.samples


def _audio(sample_rate_hz: float, samples: int, start_hz: float, stop_hz: float) -> Acquisition:
    """Return what an audio interface takes that plays one chirp after the other: each frame is a period."""
    period_s = samples / sample_rate_hz
    chirp = Chirp(
        start_hz=start_hz, stop_hz=stop_hz, duration_s=period_s, dac_rate_hz=sample_rate_hz, period_s=period_s
    )
    return Acquisition(channels=4, samples=samples, sample_rate_hz=sample_rate_hz, chirp=chirp)


ACQUISITIONS = {
    "usb": Acquisition(channels=4, samples=250, sample_rate_hz=250e3),
    "audio-192": _audio(192e3, 768, 20e3, 85e3),
    "audio-96": _audio(96e3, 96, 15e3, 44e3),
}
"""Geometries with a name: the source paper's rig, as a DAQ on USB has it, and audio interfaces in steady state."""


def parse_acquisition(text: str) -> Acquisition:
    """Return a named acquisition, or that of `RATE_HZ:SAMPLES:START_HZ-STOP_HZ:CHIRP_S[:PERIOD_S]`.

    Four channels; with a period frames are in steady state. Raises ValueError.
    """
    if text in ACQUISITIONS:
        return ACQUISITIONS[text]
    rate_hz, samples, band_hz, *seconds = text.split(":")
    start_hz, stop_hz = map(float, band_hz.split("-"))
    duration_s, period_s = map(float, seconds) if len(seconds) == 2 else (float(*seconds), None)
    dac_rate_hz = float(rate_hz) if period_s else 2 * float(rate_hz)
    chirp = Chirp(start_hz=start_hz, stop_hz=stop_hz, duration_s=duration_s, dac_rate_hz=dac_rate_hz, period_s=period_s)
    return Acquisition(channels=4, samples=int(samples), sample_rate_hz=float(rate_hz), chirp=chirp)
