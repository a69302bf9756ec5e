"""What labelled taps tell of a fitted plate's places: a smooth correction, as small as what the fit may have wrong.

The field places a tap ten times as exactly as a person hits a target, so that label less place is the label's error,
and what all places have in common: the ruler's factor, which no untouched plate tells, and what wrong physics shift.
That is a sum of a few terms, each with the width that ruler and fit leave it; the correction is their posterior mean,
with the labels' error as the evidence has it. Where the physics are right the widths are small, and nothing moves.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from touchd.calibration.loads import SIDES
from touchd.calibration.parameters import wavelength_mm
from touchd.calibration.plate_fit import PlateFit
from touchd.calibration.reduced_plate import Floats
from touchd.calibration.spline_grid import coefficients_of, grid_of
from touchd.calibration.verdict import CLAMPED_MM, GOOD_MM, MODEL
from touchd.localization.atlas import Atlas
from touchd.training.field.place import FieldMap, yields_of

LABELS_MM = np.geomspace(0.1, 10.0, 41)
"""Labels' errors per axis that are tried."""
COMMON = 0.1
"""Share of the errors by wrong physics that all places have in common; the rest varies within a wavelength (twin)."""
BESIDE = 0.35
"""Of the other terms beside a clamped edge, relative to the shift away from it (twin)."""
WRONG = 0.1
"""Probability before the taps that the places of a fit that may be good are off by as much as ruler and fit leave open.
Where they are right, taps add 0.002 mm to a median of 0.06; a ruler that is 0.15 % off costs 0.25 mm, 0.21 after 50
taps at 1 mm, which know it to 0.09 %, 0.10 after 200 (twin)."""
LEAST_FOR_PLACES = 8
_INVERTED = 4
"""Fixed-point steps that invert a correction: each leaves a hundredth of the step before it."""


class Widths(NamedTuple):
    """Standard deviations of what may be wrong with places."""

    shift_mm: tuple[float, float]
    """Of all places together, along x and y."""
    scale: float
    """Of the factor that all places share."""
    bent_mm: float
    """Of each other term, at the plate's corners."""
    lacking: float = 0.0
    """Share of the untouched response's energy that the fit leaves beside noise."""


class PlaceCorrection(NamedTuple):
    """A smooth correction of places, learned from taps."""

    size_mm: tuple[float, float]
    coefficients: Floats
    """Of the terms, shape (12,)."""
    label_mm: float
    """Standard deviation of the labels per axis."""

    def at(self, position_mm: Floats) -> Floats:
        """Return what is added to places (n, 2), mm."""
        return np.asarray((_terms(position_mm, self.size_mm) @ self.coefficients).reshape(-1, 2))


def widths_of(fit: PlateFit) -> Widths:
    """Return how far the places of a fit may be off."""
    varying_mm = MODEL * wavelength_mm(fit.plate, fit.acquisition.chirp) * float(np.sqrt(fit.lacking))
    common_mm = COMMON * varying_mm
    clamped = [side for side, kind in fit.edges.kinds.items() if kind == "clamped"]
    if clamped:
        common_mm = float(np.hypot(common_mm, BESIDE * CLAMPED_MM))
    x_mm, y_mm = (CLAMPED_MM if {*sides} & {*clamped} else common_mm for sides in (SIDES[:2], SIDES[2:]))
    return Widths((x_mm, y_mm), fit.scale_error, common_mm, fit.lacking)


def correction_of(placed_mm: Floats, label_mm: Floats, size_mm: tuple[float, float], widths: Widths) -> PlaceCorrection:
    """Return the correction that taps at `placed_mm` with labels `label_mm`, each (n, 2), tell of a plate.

    It is the posterior mean. Where the fit may be good, that is weighed by the probability that its places are wrong at
    all: the evidence of the terms against that of the labels' errors alone.
    """
    found = (label_mm - placed_mm).reshape(-1)
    terms = _terms(placed_mm, size_mm)
    prior = _prior(widths)
    alone, label = _evidence(np.zeros((len(found), 0)), np.zeros(0), found)
    if len(placed_mm) < LEAST_FOR_PLACES:
        return PlaceCorrection(size_mm, np.zeros(terms.shape[1]), label)
    u, s, vt = np.linalg.svd(terms * prior, full_matrices=False)
    evidence, label = _evidence(u, s, found)
    coefficients = prior * (vt.T @ (s / (s**2 + label**2) * (u.T @ found)))
    if max(widths.shift_mm) < GOOD_MM:
        coefficients /= 1 + (1 / WRONG - 1) * np.exp(min(alone - evidence, 700.0))
    return PlaceCorrection(size_mm, coefficients, label)


def label_scatter_mm(placed_mm: Floats, label_mm: Floats, size_mm: tuple[float, float], widths: Widths) -> float:
    """Return the standard deviation per axis of labels `label_mm` of taps at `placed_mm`, each (n, 2)."""
    u, s, _ = np.linalg.svd(_terms(placed_mm, size_mm) * _prior(widths), full_matrices=False)
    return _evidence(u, s, (label_mm - placed_mm).reshape(-1))[1]


def left_mm(
    position_mm: Floats, placed_mm: Floats, scatter_mm: float, size_mm: tuple[float, float], widths: Widths
) -> Floats:
    """Return what stays wrong at places (n, 2) after a correction by taps at `placed_mm` (m, 2): RMS distances, mm.

    Of the terms' posterior covariance, which the taps' places and their labels' scatter alone decide: another tap never
    widens it. Fewer than `LEAST_FOR_PLACES` correct nothing.
    """
    prior = _prior(widths)
    told = _terms(placed_mm if len(placed_mm) >= LEAST_FOR_PLACES else placed_mm[:0], size_mm) * prior / scatter_mm
    root = np.linalg.cholesky(np.eye(len(prior)) + told.T @ told)
    spread = np.linalg.solve(root, (_terms(position_mm, size_mm) * prior).T)
    return np.asarray(np.sqrt(np.square(spread).sum(axis=0).reshape(-1, 2).sum(axis=1)))


def _prior(widths: Widths) -> Floats:
    return np.array([*widths.shift_mm, widths.scale, *[widths.bent_mm] * 9])


def _terms(position_mm: Floats, size_mm: tuple[float, float]) -> Floats:
    """Return each term at places (n, 2), shape (2 n, 12): both shifts, scale, stretch, turn, shear, six squares."""
    size = np.array(size_mm)
    x, y = ((position_mm - size / 2) / (np.linalg.norm(size) / 2)).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    along_x = [one, zero, position_mm[:, 0], x, -y, y, x * x, x * y, y * y, zero, zero, zero]
    along_y = [zero, one, position_mm[:, 1], -y, x, x, zero, zero, zero, x * x, x * y, y * y]
    return np.stack([np.stack(along_x, axis=1), np.stack(along_y, axis=1)], axis=1).reshape(2 * len(x), len(along_x))


def _evidence(u: Floats, s: Floats, found: Floats) -> tuple[float, float]:
    """Return the logarithm of the evidence, and the labels' error that has most of it.

    `u` and `s` are the singular vectors and values of the terms as wide as they may be.
    """
    along = np.square(u.T @ found)
    beside = max(float(found @ found) - float(along.sum()), 0.0)
    variance = np.square(LABELS_MM)[:, None]
    total = variance + s**2
    evidence = -(np.log(total) + along / total).sum(axis=1) / 2
    evidence -= ((len(found) - len(s)) * np.log(variance[:, 0]) + beside / variance[:, 0]) / 2
    best = int(evidence.argmax())
    return float(evidence[best]), float(LABELS_MM[best])


def with_places(atlas: Atlas, correction: PlaceCorrection) -> Atlas:
    """Return an atlas with corrected places: its field is sampled again on a grid of the corrected plate."""
    d = atlas.description
    old = np.array(correction.size_mm)
    corners = np.array([[0.0, old[1] / 2], [old[0], old[1] / 2], [old[0] / 2, 0.0], [old[0] / 2, old[1]]])
    edges = corners + correction.at(corners)
    size = edges[1, 0].round(3), edges[3, 1].round(3)
    x, y = (grid_of(float(side), d.step_mm) for side in size)
    places = np.stack(np.meshgrid(x.samples_mm, y.samples_mm), axis=-1).reshape(-1, 2)
    before = places.copy()
    for _ in range(_INVERTED):
        before = places - correction.at(before)
    values = FieldMap(atlas).at(before)
    description = d.model_copy(update={
        "plate": d.plate.model_copy(update={"width_mm": float(size[0]), "height_mm": float(size[1])}),
        "origin_mm": (float(x.nodes_mm[0]), float(y.nodes_mm[0])),
        "high_mm": (float(size[0]), float(size[1])),
    })  # fmt: skip
    yields = atlas.yields
    if yields is not None:
        yields = coefficients_of(FieldMap(atlas, yields_of(atlas)).at(before), x, y)
    return replace(atlas, description=description, coefficients=coefficients_of(values, x, y), yields=yields)
