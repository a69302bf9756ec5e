"""Make an atlas of a learned field: choose its bins, calibrate its standard error, score it.

Bins and standard error are chosen on the validation part, by a field of the training part. Then the field is learned
from both, and the error expected of it changes with the density of the touches. Scores are measured on the test part,
which no field was learned from; they start from the network's position, as the daemon does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import Array, Dataset, Split
from touchd.evaluation.model_scores import Judgement
from touchd.localization.atlas import Atlas, AtlasDescription
from touchd.localization.features import band_bins
from touchd.training.field.error_scale import FAR_MM, calibrate, field_error, level_of, noisy_levels
from touchd.training.field.learn import STEP_MM, Field, Learned
from touchd.training.field.place import FieldMap, complex_nodes, place, real_nodes
from touchd.training.field.regression import Floats, Regression, Touches, each, touches_of

REACH_MM = 4.0
"""Standard deviation of the spatial weights of a phase; a transducer is 6 mm wide."""
_ASSUMED = 0.5
"""Weight of an assumed touch of phase 0 at each position, for areas without touches."""
_ROWS = 512
_PLACES, _PLACES_SEED = 400, 0xF1E1D
_COMPARED = 7
"""Bins in which two fields' expected errors are compared; between them the ratio is interpolated."""

Calibration = list[tuple[float, float, float]]
"""By noise level: signal-to-noise ratio of the plate in dB, share of the validation touches' errors within sigma, and
median error in mm."""


def make_atlas(
    steady: Dataset, reference: Array, parts: Split, learned: Learned, kept: NDArray[np.int64], said: dict[str, object]
) -> tuple[Atlas, Calibration]:
    """Make and calibrate the atlas of a field learned from the training part of touches at one temperature.

    `reference`, shape (channels, samples), is the untouched plate at that temperature, `kept` the bins to hold, `said`
    further fields of the atlas' description.
    """
    true_mm = steady.position_mm[parts.validation].astype(np.float64)
    touches = touches_of(steady, parts.validation)
    said = said | {"plate": steady.meta.plate, "touches": len(parts.train), "data_sha256": steady.sha256}
    plain = atlas_of(learned.field, reference, steady, kept, said)
    plain = aligned(plain, learned.position_mm, learned.amplitude.astype(np.complex128))
    values = np.ascontiguousarray(touches.values[:, :, kept])
    placed = place(plain, values, true_mm)
    near = np.linalg.norm(placed.position_mm - true_mm, axis=1) < FAR_MM
    predicted = FieldMap(plain).at(placed.position_mm[near])
    error = field_error(values[near], predicted, placed.amplitude[near], touches.noise)
    levels = noisy_levels(
        plain, values, true_mm, steady.noise, held_counts=steady.noise, label_noise_mm=learned.label_noise_mm
    )
    mean = float(error.mean())
    noise_scale, field_scale = calibrate([level for _, level in levels], mean)
    scales = {"noise_scale": noise_scale, "field_scale": field_scale}
    atlas = replace(plain, description=plain.description.model_copy(update=scales), error=error.astype(np.float32))
    return atlas, [
        (
            db,
            float((level.ratio(noise_scale, field_scale, mean) <= 1).mean()),
            float(np.median(np.linalg.norm(level.error_mm, axis=1))),
        )
        for db, level in levels
    ]


def with_field(atlas: Atlas, steady: Dataset, parts: Split, learned: Learned, again: Learned) -> Atlas:
    """Replace an atlas' field by one that is learned `again`, from the validation touches too, at as many bins.

    A finger is nearer to some training touch than a validation touch was, which left a gap where it was taken out of a
    recording without gaps: there the field's error was 1.3 times that of any place. Both fields' expected errors follow
    from the prior, so that the atlas' error is multiplied by their ratio.
    """
    d = atlas.description
    kept = np.flatnonzero(np.isin(band_bins(d.acquisition), d.bins))
    known = np.concatenate([parts.train, parts.validation])
    said = d.model_dump(exclude_defaults=True) | {"touches": len(known)}
    fresh = aligned(
        atlas_of(again.field, atlas.baseline, steady, kept, said),
        again.position_mm,
        again.amplitude.astype(np.complex128),
    )
    low_mm, high_mm = again.position_mm.min(axis=0), again.position_mm.max(axis=0)
    anywhere_mm = np.random.default_rng(_PLACES_SEED).uniform(low_mm, high_mm, (_PLACES, 2))
    left_out_mm = steady.position_mm[parts.validation[:_PLACES]].astype(np.float64)
    compared = np.unique(np.linspace(kept[0], kept[-1], _COMPARED).round().astype(np.int64))

    def expected(by: Learned, part: NDArray[np.int64], at_mm: Floats) -> Floats:
        """Return the mean and the median over the places, shape (2, compared)."""
        regression = Regression(replace(touches_of(steady, part), position_mm=by.position_mm), by.prior)
        errors = each(lambda b: regression.variance(b, by.amplitude, at_mm), compared)
        return np.stack([np.mean(errors, axis=1), np.median(errors, axis=1)])

    mean, median = expected(again, known, anywhere_mm) / expected(learned, parts.train, left_out_mm)
    error = atlas.error * np.interp(kept, compared, mean)
    # A few places without neighbours make most of the mean, but 68 % of the errors are elsewhere.
    typical = d.field_scale * float(np.exp(np.log(median / mean).mean()))
    description = fresh.description.model_copy(update={"field_scale": typical})
    return replace(fresh, description=description, error=error.astype(np.float32))


def atlas_of(
    field: Field, reference: Array, dataset: Dataset, kept: NDArray[np.int64], said: dict[str, object]
) -> Atlas:
    """Return an atlas of selected bins of a field, without error estimates."""
    a = dataset.acquisition
    nodes = field.coefficients[..., kept]
    description = said | {
        "acquisition": a, "taper": dataset.taper, "bins": tuple(map(int, band_bins(a)[kept])), "step_mm": STEP_MM,
        "origin_mm": field.origin_mm, "low_mm": field.low_mm, "high_mm": field.high_mm,
    }  # fmt: skip
    return Atlas(
        AtlasDescription.model_validate(description),
        np.ascontiguousarray(nodes.reshape(*nodes.shape[:2], -1)),
        reference,
        np.zeros((a.channels, len(kept)), np.float32),
    )


def aligned(atlas: Atlas, position_mm: NDArray[np.float64], amplitude: NDArray[np.complex128]) -> Atlas:
    """Return an atlas in which touches at (n, 2) mm, of current amplitudes (n,), have a phase near 0.

    Only the product of amplitude and field is observable, so the field's phase at each position is arbitrary. Learning
    keeps it smooth; but where a transducer loads the plate, a finger leads by half a radian, as water does elsewhere.
    Turning the field by the mean phase of nearby touches gives a finger one phase everywhere, so that water can be
    distinguished.
    """
    d, nodes = atlas.description, complex_nodes(atlas)
    rows, columns = nodes.shape[:2]
    x_mm = d.origin_mm[0] + d.step_mm * np.arange(columns)
    y_mm = d.origin_mm[1] + d.step_mm * np.arange(rows)
    nodes_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    turn = np.exp(1j * np.angle(mean_direction(nodes_mm, position_mm, amplitude))).reshape(rows, columns, 1, 1)
    return replace(atlas, coefficients=real_nodes(nodes * turn))


def mean_direction(
    at_mm: NDArray[np.float64], position_mm: NDArray[np.float64], amplitude: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """Return the weighted mean direction of the amplitudes around positions (m, 2), shape (m,)."""
    direction = amplitude / np.maximum(np.abs(amplitude), 1e-12)
    mean = np.empty(len(at_mm), np.complex128)
    for start in range(0, len(at_mm), _ROWS):
        off_mm2 = np.square(at_mm[start : start + _ROWS, None] - position_mm[None]).sum(axis=2)
        weight = np.exp(-off_mm2 / (2 * REACH_MM**2))
        mean[start : start + _ROWS] = (weight @ direction + _ASSUMED) / (weight.sum(axis=1) + _ASSUMED)
    return mean


def signal_over_noise(touches: Touches) -> Floats:
    """Return the signal-to-noise ratio of the touches in each bin, in power, shape (bins,)."""
    power = np.square(np.abs(touches.values)).mean(axis=(0, 1), dtype=np.float64)
    return np.asarray(np.maximum(power / max(touches.noise, 1e-12) - 1, 0.0))


def try_atlas(atlas: Atlas, steady: Dataset, parts: Split, start_mm: Floats) -> Judgement:
    """Locate the test touches from the positions (n, 2) that the network gives."""
    d = atlas.description
    true_mm = steady.position_mm[parts.test]
    kept = np.flatnonzero(np.isin(band_bins(d.acquisition), d.bins))
    touches = touches_of(steady, parts.test)
    placed = place(atlas, touches.values[:, :, kept], start_mm)
    level = level_of(placed, true_mm.astype(np.float64), touches.noise / 2, far_mm=np.inf)
    sigma_mm = level.sigma_mm(d.noise_scale, d.field_scale, float(atlas.error.mean()))
    # One value for both axes, as in the daemon's messages.
    return Judgement(true_mm, placed.position_mm, np.sqrt(np.square(sigma_mm).mean(axis=1)), 1 - placed.misfit)
