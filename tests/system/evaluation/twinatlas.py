"""A field atlas straight from the twin's physics, without noise and without training: what a perfect one would know."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchd.localization.atlas import Atlas, AtlasDescription
from touchd.localization.features import band_bins, windowed_dft
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact

STEP_MM, AREA_MM2 = 2.5, 20.0


def twin_atlas(instrument: Instrument, margin_mm: float) -> Atlas:
    """The field of a silicone finger of middling area, whose strength is 1, but for a margin along all edges."""
    plate, acquisition = instrument.plate, instrument.acquisition
    x_mm, y_mm = (np.arange(margin_mm, size - margin_mm + 1e-9, STEP_MM) for size in (plate.width_mm, plate.height_mm))
    bins = band_bins(acquisition)
    counts = Electronics().peak * 2 ** (acquisition.bits - 1)
    to_bins = counts * windowed_dft(acquisition)
    rows = [
        instrument.change([[Contact(x, y, AREA_MM2, "silicone")] for x in x_mm], np.full(len(x_mm), REFERENCE_C))
        @ to_bins
        for y in y_mm
    ]  # each of shape (columns, channels, 2 * bins)
    field = np.stack(rows)
    power = np.square(field.reshape(*field.shape[:3], 2, len(bins))).sum(axis=3).mean(axis=(0, 1))
    nodes = np.einsum("ij,jk...->ik...", _through(len(y_mm)), field)
    nodes = np.einsum("kj,ij...->ik...", _through(len(x_mm)), nodes)
    about = AtlasDescription(
        acquisition=acquisition, plate=plate, bins=tuple(bins.tolist()), step_mm=STEP_MM,
        origin_mm=(margin_mm - STEP_MM, margin_mm - STEP_MM), low_mm=(margin_mm, margin_mm),
        high_mm=(float(x_mm[-1]) - 0.01, float(y_mm[-1]) - 0.01), touches=field.shape[0] * field.shape[1],
    )  # fmt: skip
    return Atlas(
        about,
        np.ascontiguousarray(nodes.reshape(*nodes.shape[:2], -1), dtype=np.float32),
        (counts * instrument.untouched([REFERENCE_C])[0]).astype(np.float32),
        (1e-5 * power).astype(np.float32),
    )


def _through(n: int) -> NDArray[np.float64]:
    """Coefficients (n + 2, n) of the cubic spline through n values, straight at its ends."""
    system = np.zeros((n + 2, n + 2))
    system[0, :3] = system[-1, -3:] = [1, -2, 1]
    for i in range(1, n + 1):
        system[i, i - 1 : i + 2] = np.array([1, 4, 1]) / 6
    return np.asarray(np.linalg.inv(system)[:, 1:-1])
