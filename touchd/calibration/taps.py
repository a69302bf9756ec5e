"""What taps at roughly known places tell of a fitted plate: orientation, labels' scatter, common errors of places.

The physical field places a tap ten times as exactly as a person hits a target, so that labels only choose among the
symmetries, four of a rectangle and eight of a square, which sound the same untouched, and tell what all places have in
common. Where physics lack something, the taps themselves tell its waves (`wave_correction`). Else the field stays: a
gain in each bin, learned from fingertips, explains them better and places every tip worse (twin).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.place_correction import LABELS_MM, Widths, correction_of, with_places
from touchd.calibration.plate_fit import PlateFit, Progress
from touchd.calibration.reduced_plate import Complex, Floats, ReducedPlate
from touchd.calibration.stages import GOOD_LEFT
from touchd.calibration.tap_fit import fit_taps
from touchd.calibration.verdict import is_square
from touchd.calibration.wave_correction import with_waves
from touchd.errors import CalibrationError, TrainingError
from touchd.evaluation.dataset import baseline_frames, complex_bins, labels
from touchd.frame import Acquisition
from touchd.localization.atlas import Atlas
from touchd.recording.data import Recording
from touchd.training.field.place import place

ORIENTATIONS = (
    "", "mirrored left to right", "mirrored top to bottom", "turned by 180 degrees",
    "mirrored along a diagonal, x and y exchanged", "turned by 90 degrees clockwise",
    "turned by 90 degrees counterclockwise", "mirrored along the diagonal from the top right",
)  # fmt: skip
"""Each is a number of three bits: mirrored left to right, top to bottom, and x and y exchanged before that."""
EXCHANGED = 4
"""The bit of `ORIENTATIONS` that exchanges x and y."""
CLEARER = 0.5
"""Another orientation leaves less than this share of what the drawing's leaves. At a right one taps leave 0.01, at a
wrong one half of their energy and more (twin)."""
LEAST_FIT = 0.25
"""Share of the taps that must fit: with fewer their labels, or the plate, are others."""
FITS = 0.2
"""Refuse a tap that leaves more than this share unexplained: two fingers, or none at that place."""
MISSED = 3.0
"""A tap this many median distances from its label missed it."""
LEAST_MOVED_MM = 5e-3
"""Places that move by less stay as they were fitted."""


@dataclass(frozen=True)
class Taps:
    """n taps."""

    label_mm: Floats
    """Shape (n, 2)."""
    values: Complex
    """Mean bins of the residual, shape (n, channels, bins of the atlas)."""


@dataclass(frozen=True)
class Refined:
    """A fitted plate with its atlas after taps."""

    orientation: str
    """What the drawing is, other than as PLATE.toml says; empty if it is right."""
    atlas: Atlas
    taps: int
    used: int
    """Taps that the field explains."""
    placed_mm: Floats
    """Where those lie that did not miss their labels, shape (m, 2)."""
    scatter_mm: float
    """Standard deviation of the labels per axis: how well a person hits."""
    moved_mm: float
    """Root mean square of what is added to the taps' places."""
    unexplained: float
    """Share of a tap's energy that the field leaves, median."""
    lack_stays: float
    """Share of what the fit's physics lack that stays, by taps left out; 1 if the field stays as it is."""


def taps_of(recording: Recording, atlas: Atlas) -> Taps:
    """Return the taps of a recording: its frames of one finger with one label, averaged.

    Raises CalibrationError if the recording has no labelled tap, or no untouched frame beside it, or another
    acquisition.
    """
    a = atlas.description.acquisition
    check_alike(recording, a)
    position_mm, touched, untouched = labelled(recording)
    beside = baseline_frames(recording.timestamp_ns, touched, untouched)
    new = np.flatnonzero(np.r_[True, (np.diff(touched) > 1) | (np.diff(position_mm, axis=0) != 0).any(axis=1)])
    to_bins = atlas.description.to_bins
    residual = recording.frames[touched] - recording.frames[beside].mean(axis=1, dtype=np.float64)
    features = (residual @ to_bins).reshape(len(touched), -1)
    counts = np.diff(np.r_[new, len(touched)])[:, None]
    values = complex_bins(np.add.reduceat(features, new, axis=0) / counts, a.channels)
    return Taps(position_mm[new].astype(np.float64), np.asarray(values, np.complex128))


def labelled(recording: Recording) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """Return the positions (n, 2) of single touches, their frames (n,), and the untouched frames (m,).

    Raises CalibrationError if the recording has none, or labels beyond the plate.
    """
    try:
        return labels(recording, least=1)
    except TrainingError as error:
        # Only labels beyond the plate have a place; what else is wrong takes another recording.
        fix = error.fix if error.where else "record single taps, the plate untouched in between: touchd record --label"
        raise CalibrationError(error.what, "--taps", fix) from error


def check_alike(recording: Recording, acquisition: Acquisition) -> None:
    """Raise CalibrationError if taps were sampled in another way than the untouched plate, or by another chirp."""
    for name in ("channels", "samples", "sample_rate_hz", "chirp"):
        of_taps, usual = getattr(recording.acquisition, name), getattr(acquisition, name)
        if of_taps != usual:
            raise CalibrationError(
                f"{name} is {of_taps}, but {usual} of the untouched plate", "--taps", "record both alike"
            )


def orientation_of(atlas: Atlas, taps: Taps) -> int:
    """Return which of `ORIENTATIONS` explains the taps."""
    size_mm = atlas.description.plate.size_mm
    left = [
        float(np.median(place(atlas, taps.values, turned(taps.label_mm, k, size_mm)).misfit))
        for k in orientations(size_mm)
    ]
    best = int(np.argmin(left))
    return best if left[best] < CLEARER * left[0] else 0


def orientations(size_mm: tuple[float, float]) -> range:
    """Return which of `ORIENTATIONS` a drawing of this size may have."""
    return range(len(ORIENTATIONS) if is_square(*size_mm) else len(ORIENTATIONS) // 2)


def turned(position_mm: Floats, orientation: int, size_mm: tuple[float, float]) -> Floats:
    """Return places (n, 2) as a drawing of one of `ORIENTATIONS` and of this size has them."""
    return _mirrored(position_mm[:, ::-1] if orientation & EXCHANGED else position_mm, orientation, size_mm)


def turned_back(drawn_mm: Floats, orientation: int, size_mm: tuple[float, float]) -> Floats:
    """Return places (n, 2) that a drawing of this size has turned."""
    found = _mirrored(drawn_mm, orientation, size_mm)
    return found[:, ::-1] if orientation & EXCHANGED else found


def _mirrored(position_mm: Floats, orientation: int, size_mm: tuple[float, float]) -> Floats:
    found = np.array(position_mm, np.float64)
    for axis in (0, 1):
        if orientation & (1 << axis):
            found[:, axis] = size_mm[axis] - found[:, axis]
    return found


def turned_fit(fit: PlateFit, orientation: int) -> PlateFit:
    """Return a fit whose drawing is turned: the untouched plate sounds the same."""
    size_mm, scatterers = fit.plate.size_mm, fit.layout.scatterers
    at_mm = np.array([each.at_mm for each in scatterers]).reshape(-1, 2)
    others = zip(scatterers, turned_back(at_mm, orientation, size_mm).tolist(), strict=True)
    places = turned_back(fit.layout.centres_mm, orientation, size_mm).tolist()
    beads = turned_back(np.array(fit.layout.beads_mm).reshape(-1, 2), orientation, (0.0, 0.0)).tolist()
    layout = fit.layout.model_copy(
        update={
            "emitter_mm": tuple(places[0]), "receivers_mm": tuple(map(tuple, places[1:])),
            "beads_mm": tuple(map(tuple, beads)),
            "scatterers": tuple(each.model_copy(update={"at_mm": tuple(at)}) for each, at in others),
        }
    )  # fmt: skip
    reasons = fit.reasons
    if orientation:
        reasons = (f"the drawing is {ORIENTATIONS[orientation]}: correct the discs' places", *reasons)
    plate, basis = fit.plate, fit.basis
    if orientation & EXCHANGED:
        (width_mm, height_mm), elastic = size_mm, plate.elastic._replace(orthotropy=1 / plate.elastic.orthotropy)
        plate = plate.model_copy(update={"width_mm": height_mm, "height_mm": width_mm, "elastic": elastic})
        basis = ReducedPlate(plate, fit.acquisition.chirp.band_hz[1])
    return replace(
        fit, plate=plate, basis=basis, layout=layout, edges=fit.edges.turned_back(orientation), undecided=(),
        reasons=reasons,
    )  # fmt: skip


def refine(
    atlas: Atlas, taps: Taps, orientation: int = 0, widths: Widths | None = None,
    progress: Progress = lambda _stage, _share: None,
) -> Refined:  # fmt: skip
    """Correct the field and the places of a rightly turned drawing as far as taps tell both.

    Without `widths` both stay.
    """
    placed = fit_taps(atlas, taps.values, taps.label_mm)
    fits = placed.misfit < FITS
    if fits.mean() < LEAST_FIT:
        raise CalibrationError(
            f"{fits.sum()} of {len(fits)} taps fit the calibrated plate", "--taps", "check the labels' places, in mm"
        )
    used = np.flatnonzero(fits)
    used = used[hits(placed.position_mm[used], taps.label_mm[used])]
    values, label_mm = taps.values[used], taps.label_mm[used]
    placed_mm, misfit = placed.position_mm[used], placed.misfit[used]
    lack_stays = 1.0
    if widths is not None and widths.lacking > GOOD_LEFT:
        atlas, lack_stays = with_waves(atlas, values, placed_mm, widths.lacking, progress)
        placed_mm, _, misfit, _ = fit_taps(atlas, values, placed_mm)
    scatter_mm, moved_mm = float(np.sqrt(np.square(placed_mm - label_mm).mean())), 0.0
    if widths is not None:
        correction = correction_of(placed_mm, label_mm, atlas.description.plate.size_mm, widths)
        added_mm = float(np.sqrt(np.square(correction.at(placed_mm)).sum(axis=1).mean()))
        if added_mm > LEAST_MOVED_MM:
            atlas, scatter_mm, moved_mm = with_places(atlas, correction), correction.label_mm, added_mm
    return Refined(
        ORIENTATIONS[orientation], atlas, len(fits), int(fits.sum()), placed_mm, scatter_mm, moved_mm,
        float(np.median(misfit)), lack_stays,
    )  # fmt: skip


def told_by(taps: Taps, atlas: Atlas) -> tuple[int, dict[str, Any], list[int]]:
    """Return the drawing's orientation, for the page what taps tell, and the indices of those that miss their labels.

    The page gets the taps' scatter, how many labels tell it, and `off_mm`, the median distance of taps from their
    labels. A tap misses if no place near its label explains it, while near those of most one does.
    """
    orientation = orientation_of(atlas, taps)
    label_mm = turned(taps.label_mm, orientation, atlas.description.plate.size_mm)
    placed = fit_taps(atlas, taps.values, label_mm)
    fits = placed.misfit < FITS
    scatter_mm, repeats = scatter_of(label_mm[fits], placed.position_mm[fits])
    off_mm = float(np.median(np.linalg.norm(placed.position_mm - label_mm, axis=1)))
    misses = np.flatnonzero(~fits).tolist() if 2 * fits.sum() > len(fits) else []
    return orientation, {
        "scatter_mm": scatter_mm, "repeats": repeats, "off_mm": off_mm, "orientation": ORIENTATIONS[orientation],
    }, misses  # fmt: skip


def scatter_of(label_mm: Floats, placed_mm: Floats) -> tuple[float | None, int]:
    """Return the standard deviation per axis of taps at labels (n, 2), and how many labels tell it.

    It is that of the places `placed_mm` (n, 2) of each label that was tapped more than once, about their mean: what a
    model has wrong at a label does not count. None where no label comes twice.
    """
    _, of, counts = np.unique(label_mm, axis=0, return_inverse=True, return_counts=True)
    of = of.reshape(-1)
    free = 2 * int((counts - 1).sum())
    if not free:
        return None, 0
    means = np.stack([np.bincount(of, placed_mm[:, axis]) / counts for axis in (0, 1)], axis=1)
    return float(np.sqrt(np.square(placed_mm - means[of]).sum() / free)), int((counts > 1).sum())


def hits(placed_mm: Floats, label_mm: Floats) -> NDArray[np.bool_]:
    """Return which taps, at `placed_mm` (n, 2), did not miss their labels."""
    apart = np.linalg.norm(placed_mm - label_mm, axis=1)
    return np.asarray(apart <= MISSED * max(float(np.median(apart)), LABELS_MM[0]))
