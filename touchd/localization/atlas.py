"""The field atlas: what a touch of unit strength at any place adds to each bin, learned from labelled touches.

A touch at (x, y) with the complex strength z adds z u(x, y) to the bins of a frame's residual. u is stored as
the coefficients of cubic B-splines on a grid, which give its gradient too. The atlas lies beside the network
that it was learned with, as `NAME.atlas.npz` beside `NAME.onnx`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from touchd.errors import ModelInvalid, OutputError, RecordingError
from touchd.files import replacing
from touchd.frame import HANN, Acquisition, Plate
from touchd.localization import plate_modes
from touchd.localization.features import windowed_dft
from touchd.localization.plate_modes import PlateModes
from touchd.recording import npz

FORMAT = "touchd-atlas"
MAX_BYTES = 32_000_000
"""A plate of 30 wavelengths has fewer."""
_MAX_LOADED_BYTES = 3 * MAX_BYTES  # a field compresses by less than 2
_KEYS = ("format", "version", "description", "coefficients", "scale", "baseline", "error")
_YIELDS = "yields"
_MAX_COUNTS = 1e9
"""Of a field at strength 1, and of its mean square error; squares of more overflow float32."""
_MARGIN_NODES = 2
"""Nodes beyond the touched part on each side: every point of it has its four neighbours."""

Array = NDArray[np.floating]
"""Of the pipeline's floating-point type: float32, or float64 where a test asks for it."""


class AtlasDescription(BaseModel):
    """What an atlas says of itself: the JSON object `description` in its file."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    version: Literal[1] = 1
    acquisition: Acquisition
    plate: Plate
    bins: tuple[int, ...] = Field(min_length=1)
    """Indices of the DFT bins it holds: those that tell something of a finger."""
    taper: float = Field(default=HANN, ge=0, le=1)
    """Of the bins' window: the share of the frame over which it rises and falls; 1 is Hann's."""
    weights: tuple[float, ...] = ()
    """Of each bin, in coefficients and frames alike; empty for 1. Resonances count for less where the field's error
    limits what they tell."""
    step_mm: float = Field(ge=1e-2, le=1e4)
    origin_mm: tuple[float, float]
    """x and y of the first node."""
    low_mm: tuple[float, float]
    high_mm: tuple[float, float]
    """Corners of the part that was touched: beyond it the field is not known."""
    noise_scale: float = Field(default=1.0, ge=1e-6, le=1e6)
    field_scale: float = Field(default=1.0, ge=1e-6, le=1e6)
    """How much larger the errors of held-out touches are than white noise, and the field's own error, explain."""
    face_mm: float = Field(default=0.0, ge=0, le=10)
    """Standard deviation, along x and y, of the face over which the field is a mean; 0 of a small contact's."""
    touches: int = Field(default=0, ge=0)
    """How many it was learned from."""
    wavenumber_rad_m: tuple[float, ...] = ()
    """Of the plate's flexural wave at each bin: the dispersion that limits the field's band."""
    fitted: bool = False
    """Whether the dispersion was fitted to the touches, the material being unknown."""
    scores: dict[str, float] = {}
    """Of the test touches, from the network's answer on, for example `rmse_mm`."""
    data_sha256: str = ""
    """Digest of the training recording's frames and truth."""
    command: str = ""
    seed: int = 0

    @property
    def bin_weights(self) -> NDArray[np.float64]:
        """Weight of each bin, shape (bins,)."""
        return np.array(self.weights or np.ones(len(self.bins)))

    @property
    def to_bins(self) -> NDArray[np.float64]:
        """Matrix from samples to weighted bins, real and then imaginary parts, shape (samples, 2 * bins)."""
        return windowed_dft(self.acquisition, np.array(self.bins), self.taper) * np.tile(self.bin_weights, 2)


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Atlas:
    """A loaded atlas; tables made of it are kept as long as it is."""

    description: AtlasDescription
    coefficients: Array
    """B-spline coefficients, shape (rows, columns, channels * 2 * bins): for each channel the real parts of all
    bins, then the imaginary parts, as `touchd.localization.features` orders them; ADC counts at strength 1."""
    baseline: Array
    """The untouched plate at the temperature that the field is meant for, shape (channels, samples), ADC counts."""
    error: Array
    """Mean square of what the field misses in each channel and bin at strength 1, shape (channels, bins)."""
    yields: Array | None = None
    """Coefficients of the share of the wave that a touch of strength 1 takes from itself, as the plate yields under it,
    shape (rows, columns, 2 * bins); None where a touch is so light, or the frame so short, that the field just grows
    with it (`touchd.localization.loading`)."""
    modes: PlateModes | None = None
    """What tells how several touches scatter each other's waves; None where that is not known, or next to nothing."""

    @property
    def size(self) -> int:
        """Length of a feature vector: channels * 2 * bins."""
        return int(self.coefficients.shape[2])


def atlas_path(model: Path) -> Path:
    """Return where the atlas of a network lies: `plate.atlas.npz` for `plate.onnx`."""
    return model.parent / f"{model.stem}.atlas.npz"  # of a folder without a name, too, which whoever opens it refuses


def save_atlas(atlas: Atlas, path: Path) -> None:
    """Write an atlas, whole or not at all.

    Half precision: its rounding, 5e-4 of each coefficient, is far below what any touch teaches.

    Raises
    ------
    OutputError
        It cannot be written, or would be larger than `MAX_BYTES`.
    """
    scale = np.float32(np.abs(atlas.coefficients).max() or 1.0)
    more: dict[str, Any] = {} if atlas.yields is None else {_YIELDS: atlas.yields.astype(np.float16)}
    more |= plate_modes.to_arrays(atlas.modes) if atlas.modes else {}
    with replacing(path) as file:
        np.savez_compressed(
            file, format=np.array(FORMAT), version=np.array(1),
            description=np.array(atlas.description.model_dump_json()),
            coefficients=(atlas.coefficients / scale).astype(np.float16), scale=np.array(scale),
            baseline=atlas.baseline, error=atlas.error, **more,
        )  # fmt: skip
        size_bytes = file.tell()
        if size_bytes > MAX_BYTES:
            raise OutputError(
                f"the atlas would take {size_bytes / 1e6:.1f} MB, more than {MAX_BYTES / 1e6:.0f}",
                str(path),
                "learn it for a smaller plate, or from fewer bins",
            )


def load_atlas(path: Path, dtype: DTypeLike = np.float32) -> Atlas:
    """Read an atlas; its arrays, and all that is computed with them, are of type `dtype`.

    Raises
    ------
    ModelInvalid
        If the file is no atlas, or its parts do not fit each other.
    """
    try:
        found = npz.load(path, (*_KEYS, _YIELDS, *plate_modes.KEYS), _MAX_LOADED_BYTES)
    except RecordingError as error:
        raise _invalid(path, str(error)) from error
    missing = [key for key in _KEYS if key not in found]
    if missing or str(found["format"]) != FORMAT or str(found["version"]) != "1":
        raise _invalid(path, f"{', '.join(missing)} missing" if missing else "another format or version")
    try:
        description = AtlasDescription.model_validate_json(str(found["description"]))
    except ValidationError as error:
        first = error.errors()[0]
        raise _invalid(path, f"description: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    numbers = ("coefficients", "scale", "baseline", "error", *({_YIELDS} & found.keys()))
    if found["scale"].shape != () or any(found[key].dtype.kind != "f" for key in numbers):
        raise _invalid(path, f"{', '.join(f'{key} {found[key].dtype}{found[key].shape}' for key in numbers)}")
    try:
        modes = plate_modes.from_arrays(found, dtype)
    except ValueError as error:
        raise _invalid(path, str(error)) from error
    with np.errstate(all="ignore"):  # what overflows is infinite, and refused
        coefficients = found["coefficients"].astype(dtype) * found["scale"].astype(dtype)
        atlas = Atlas(
            description,
            np.ascontiguousarray(coefficients),
            found["baseline"].astype(dtype),
            found["error"].astype(dtype),
            np.ascontiguousarray(found[_YIELDS].astype(dtype)) if _YIELDS in found else None,
            modes,
        )
    _check(atlas, path)
    return atlas


def _check(atlas: Atlas, path: Path) -> None:
    """Raise ModelInvalid unless the arrays have the shapes that the description means, and hold numbers."""
    d = atlas.description
    channels, bins = d.acquisition.channels, len(d.bins)
    if atlas.coefficients.ndim != 3 or atlas.size != channels * 2 * bins or min(atlas.coefficients.shape[:2]) < 4:
        raise _invalid(
            path, f"coefficients of shape {atlas.coefficients.shape}, not (rows, columns, {channels * 2 * bins})"
        )
    if atlas.baseline.shape != d.acquisition.shape or atlas.error.shape != (channels, bins):
        raise _invalid(path, f"baseline of shape {atlas.baseline.shape} and error of shape {atlas.error.shape}")
    rows, columns, _ = atlas.coefficients.shape
    if atlas.yields is not None and atlas.yields.shape != (rows, columns, 2 * bins):
        raise _invalid(path, f"yields of shape {atlas.yields.shape}, not {(rows, columns, 2 * bins)}")
    if atlas.modes and atlas.yields is None:
        raise _invalid(path, "modes, but no yields")
    if atlas.modes and (len(atlas.modes.heard), atlas.modes.to_bins.shape[1]) != (channels, 2 * bins):
        raise _invalid(path, f"modes of {len(atlas.modes.heard)} channels and {atlas.modes.to_bins.shape[1]} values")
    reach_mm = (
        d.origin_mm[0] + (columns - _MARGIN_NODES) * d.step_mm, d.origin_mm[1] + (rows - _MARGIN_NODES) * d.step_mm
    )  # fmt: skip
    if any(d.low_mm[i] < d.origin_mm[i] + d.step_mm or not d.low_mm[i] < d.high_mm[i] < reach_mm[i] for i in (0, 1)):
        raise _invalid(path, f"the touched part {d.low_mm} to {d.high_mm} mm is not on the grid")
    size_mm = d.plate.width_mm, d.plate.height_mm
    if any(d.low_mm[i] < 0 or d.high_mm[i] > size_mm[i] for i in (0, 1)):
        raise _invalid(path, f"the touched part {d.low_mm} to {d.high_mm} mm is not on the plate of {size_mm} mm")
    if list(d.bins) != sorted({*d.bins}) or d.bins[0] < 0 or d.bins[-1] > d.acquisition.samples // 2:
        raise _invalid(path, f"bins from {d.bins[0]} to {d.bins[-1]} of {d.acquisition.samples} samples")
    if d.weights and (len(d.weights) != bins or not all(0 < weight <= 1 for weight in d.weights)):
        raise _invalid(path, f"{len(d.weights)} weights of {bins} bins, or one beyond 0 to 1")
    largest = [
        float(np.abs(array).max())
        for array in (
            atlas.coefficients,
            atlas.baseline,
            atlas.error,
            *([] if atlas.yields is None else [atlas.yields]),
        )
    ]
    if not all(value <= _MAX_COUNTS for value in largest):  # NaN too
        raise _invalid(path, "numbers that are none, or too large")
    if not largest[0] or float(atlas.error.min()) < 0:
        raise _invalid(path, "a field of zeros, or a negative error")


def _invalid(path: Path, what: str) -> ModelInvalid:
    return ModelInvalid(f"not a usable atlas ({what})", str(path), "train it again: touchd train --recipe atlas")
