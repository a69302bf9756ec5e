"""What of a plate's modes tells how contacts scatter each other's waves, as an atlas holds it.

In its file each part is an array `modes_NAME`; the last axis holds real and imaginary parts, or real ones alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

Array = NDArray[np.inexact]
_SHAPES, _GRID, _TO_BINS = "modes_shapes", "modes_grid", "modes_to_bins"
_COMPLEX = ("modes_discs", "modes_receptance", "modes_loads", "modes_heard")
KEYS = (_SHAPES, _GRID, *_COMPLEX, _TO_BINS)


class PlateModes(NamedTuple):
    """The modes of a plate with R receivers at the F lines that an atlas' bins hold: n modes."""

    shapes: Array
    """B-spline coefficients of each mode's deflection under the reference touch, shape (rows, columns, n); complex
    where an edge has losses."""
    grid_mm: tuple[float, float, float]
    """Step of the nodes, and x and y of the first one."""
    discs: Array
    """How the emitter and each receiver couple to each mode, shape (n, 1 + R)."""
    receptance: Array
    """Of each mode at each line, shape (n, F)."""
    loads: Array
    """Of the reference touch on the plate, shape (F,)."""
    heard: Array
    """What each receiver's channel makes of a unit of displacement at the chirp's line, shape (R, F)."""
    to_bins: Array
    """From the lines' real and then imaginary parts to those of the bins, shape (2 F, 2 bins)."""


def to_arrays(modes: PlateModes) -> dict[str, NDArray[Any]]:
    """Return modes as arrays for an atlas' file."""
    each = (modes.discs, modes.receptance, modes.loads, modes.heard)
    return {
        _SHAPES: _parts(modes.shapes).astype(np.float16),
        _GRID: np.array(modes.grid_mm),
        _TO_BINS: modes.to_bins.astype(np.float32),
    } | {key: _parts(part).astype(np.float32) for key, part in zip(_COMPLEX, each, strict=True)}


def from_arrays(found: Mapping[str, NDArray[Any]], dtype: DTypeLike) -> PlateModes | None:
    """Return the modes in an atlas' file, None if it holds none; their numbers are of type `dtype`, or complex of it.

    Raises ValueError if they are not all there, do not fit each other, or are no numbers.
    """
    if not set(KEYS) & found.keys():
        return None
    if missing := [key for key in KEYS if key not in found]:
        raise ValueError(f"{', '.join(missing)} missing")
    with np.errstate(all="ignore"):  # what overflows is infinite, and refused
        cast = {key: found[key].astype(dtype) if found[key].dtype.kind == "f" else np.array(np.nan) for key in KEYS}
    for key, values in cast.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{key} holds what is no number")
    shapes, discs, receptance, loads, heard = (_whole(cast[key], key) for key in (_SHAPES, *_COMPLEX))
    to_bins, grid, turns = np.ascontiguousarray(cast[_TO_BINS]), found[_GRID], np.iscomplexobj
    counts = {
        _SHAPES: shapes.ndim == 3 and min(shapes.shape[:2]) >= 4 and shapes.shape[2] > 0,
        _GRID: grid.shape == (3,) and grid[0] > 0,
        "modes_discs": discs.ndim == 2 and len(discs) == shapes.shape[-1] and turns(discs) == turns(shapes),
        "modes_receptance": receptance.shape == (shapes.shape[-1], len(loads)) and turns(receptance),
        "modes_loads": loads.ndim == 1 and turns(loads),
        "modes_heard": heard.shape == (discs.shape[-1] - 1, len(loads)) and turns(heard),
        _TO_BINS: to_bins.ndim == 2 and len(to_bins) == 2 * len(loads),
    }
    if wrong := [key for key, fits in counts.items() if not fits]:
        raise ValueError(", ".join(f"{key} of shape {found[key].shape}" for key in wrong))
    step, x0, y0 = grid.tolist()
    return PlateModes(shapes, (step, x0, y0), discs, receptance, loads, heard, to_bins)


def _parts(values: Array) -> NDArray[np.floating]:
    """Return values with their real and imaginary parts, or the real ones alone, along one axis more."""
    return np.stack([values.real, values.imag] if np.iscomplexobj(values) else [values], axis=-1)


def _whole(parts: NDArray[np.floating], key: str) -> Array:
    """Undo `_parts`."""
    if parts.ndim < 2 or parts.shape[-1] not in (1, 2):
        raise ValueError(f"{key} of shape {parts.shape}")
    whole = (
        parts[..., 0]
        if parts.shape[-1] == 1
        else parts[..., 0] + np.array(1j, np.result_type(parts, 1j)) * parts[..., 1]
    )
    return np.ascontiguousarray(whole)
