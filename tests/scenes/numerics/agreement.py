"""How far the fast path is from float64, scene by scene: features, rounding, and where Gauss-Newton stops early."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import dist

import numpy as np

from tests.scenes.numerics import reference
from tests.scenes.numerics.watch import Look, Run, run
from tests.scenes.stages import frames_of
from touchd.event import Contact
from touchd.localization.atlas import Atlas
from touchd.localization.model import Model, default_model_path
from touchd.recording.data import Recording
from touchd.touch import Touch

FEATURES_RELATIVE = 1e-6
ROUNDING_MM = 1e-3


@dataclass(slots=True)
class Agreement:
    """One scene."""

    frames: int
    located: int
    """Frames that were located, not skipped."""
    contacts: int = 0
    """Fingers that were placed in them."""
    features: float = 0.0
    """Largest distance of a frame's features from the reference, relative to their length."""
    baseline_counts: float = 0.0
    """Largest difference of the followed baseline from the same in float64, ADC counts."""
    rounding_mm: list[float] = field(default_factory=list)
    """Of each place from the same steps in float64."""
    begun_elsewhere_mm: list[float] = field(default_factory=list)
    """The same, of places that a search began elsewhere in float64, since two beginnings left as much: each precision
    stops early on its own way to one minimum, and the distance is explained by how early."""
    other: int = 0
    """Frames in which float64 decided differently: another number of fingers, or a frame skipped by one of them."""
    truncation_mm: list[float] = field(default_factory=list)
    """Of each place from the minimum that a converged float64 solution of the same frame goes to."""
    truncation_sigmas: float = 0.0
    """The largest of them, as a share of that finger's own sigma."""
    same_events: bool = True
    """Whether the same contacts go down, move, hold and come up in the same frames."""


def compared(recording: Recording, atlas: Atlas) -> Agreement:
    """A scene run in both precisions, and each of its frames fitted by the reference."""
    frames = list(frames_of(recording))
    single, double = run(frames), run(frames, wide=True)
    result = Agreement(len(frames), len(single.looks))
    mine, its = ({look.number: look for look in one.looks} for one in (single, double))
    result.other = len(mine.keys() ^ its.keys())
    for number in sorted(mine.keys() & its.keys()):
        pairs = list(zip(mine[number].touches, its[number].touches, strict=False))
        if len(mine[number].touches) != len(its[number].touches):
            result.other += 1
            continue
        for a, b in pairs:
            distance_mm = dist(_place(a), _place(b))
            early = distance_mm > ROUNDING_MM and distance_mm < _early_mm(mine[number], a, b, atlas) + ROUNDING_MM
            (result.begun_elsewhere_mm if early else result.rounding_mm).append(distance_mm)
        off = np.abs(mine[number].baseline - its[number].baseline).max()
        result.baseline_counts = max(result.baseline_counts, float(off))
    result.same_events = outline(single) == outline(double)
    _against_reference(result, single.looks, atlas)
    return result


def _place(touch: Touch | Contact) -> tuple[float, float]:
    return touch.x_mm, touch.y_mm


def _early_mm(look: Look, one: Touch, other: Touch, atlas: Atlas) -> float:
    """How far two places of one finger are from the minimum of the frame, together."""
    features = reference.atlas_features(look.residual, reference.plate_of(look.baseline, atlas), atlas)
    fit = converged(look, features, atlas)
    which = min(range(len(look.places_mm)), key=lambda k: dist(look.places_mm[k], _place(one)))
    return dist(fit.places_mm[which], _place(one)) + dist(fit.places_mm[which], _place(other))


def outline(result: Run) -> list[tuple[int, list[tuple[int, str]]]]:
    """Which contact did what in which frame."""
    return [(event.frame, [(c.id, c.phase) for c in event.contacts]) for event in result.touches]


def _against_reference(result: Agreement, looks: list[Look], atlas: Atlas) -> None:
    plates: dict[bytes, reference.Plate] = {}
    for look in looks:
        key = look.baseline.tobytes()
        if key not in plates:
            plates[key] = reference.plate_of(look.baseline, atlas)
        features = reference.atlas_features(look.residual, plates[key], atlas)
        size = float(np.linalg.norm(features))
        if size > 0:
            off = float(np.linalg.norm(look.features + look.drifted - features)) / size
            result.features = max(result.features, off)
        if look.hits:  # the samples that a converter's limit has cut are unknowns of the fit, too
            result.contacts += len(look.fitted)
            continue
        for distance_mm, sigma_mm in truncations(look, features, atlas):
            result.contacts += 1
            result.truncation_mm.append(distance_mm)
            result.truncation_sigmas = max(result.truncation_sigmas, distance_mm / sigma_mm)


def converged(look: Look, features: reference.Floats, atlas: Atlas) -> reference.Fit:
    """The minimum that a frame's places go to, of the same model: points, shapes known before, or shapes of its own."""
    data, places = features - look.drifted, np.array(look.places_mm)
    if look.shapes is None or look.known:
        return reference.refine(atlas, data, places, look.mask, shapes=look.shapes)
    return reference.refine_shapes(atlas, data, places, look.mask, look.variance)


def truncations(look: Look, features: reference.Floats, atlas: Atlas) -> Iterator[tuple[float, float]]:
    """Of each finger of a frame, how far it is from the converged minimum (mm), and its sigma (mm)."""
    if not look.touches:
        return
    fit = converged(look, features, atlas)
    for x_mm, y_mm, sigma_mm in look.fitted:
        which = min(range(len(look.places_mm)), key=lambda k: dist(look.places_mm[k], (x_mm, y_mm)))
        yield dist(fit.places_mm[which], (x_mm, y_mm)), sigma_mm
    if look.weighed:
        assert look.fit is not None
        weighed = reference.refine_weighted(atlas, features - look.drifted, look.fit, look.mask, look.noise)
        for place, there_mm in zip(look.weighed, weighed.places_mm, strict=True):
            yield dist(place[:2], there_mm), place.sigma_mm


def networks(features: np.ndarray) -> tuple[reference.Floats, reference.Floats]:
    """How far the shipped network's places are from float64's, and int8's from them: (n,) each, mm."""
    path = default_model_path()
    small, said = (
        Model(each, atlas=False).run(features)["position_mm"] for each in (path.with_name("int8.onnx"), path)
    )
    wide = reference.network(path, features)["position_mm"]
    return np.linalg.norm(said - wide, axis=1), np.linalg.norm(small.astype(np.float64) - said, axis=1)
