"""Make an atlas of a learned field: choose its bins, calibrate its standard error, score it.

Bins and standard error are chosen on the validation part and scores are measured on the test part, so neither uses
touches that the field was learned from. Scores start from the network's position, as the daemon does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import BASELINE_NOISE, Array, Dataset, Split
from touchd.evaluation.model_scores import Judgement, scores
from touchd.localization.atlas import Atlas, AtlasDescription
from touchd.localization.features import band_bins, windowed_dft
from touchd.localization.model import Model
from touchd.training.field.error_scale import FAR_MM, LEVELS_DB, Level, calibrate, field_error, level_of, within_sigma
from touchd.training.field.learn import STEP_MM, Field, Learned
from touchd.training.field.phase import aligned
from touchd.training.field.place import FieldMap, Placed, place
from touchd.training.field.regression import Complex, Floats, Touches, touches_of

SPARED = 0.01
"""Share of the signal that the weakest, omitted bins may contain together, on validation touches."""
_NOISE_SEED = 0xA71A5


@dataclass(frozen=True, slots=True)
class Calibration:
    """Calibration of an atlas on validation touches."""

    within: list[tuple[float, float, float]]
    """By noise level: signal-to-noise ratio of the plate in dB, share of errors within sigma, median error in mm."""
    snr: Floats
    """Signal-to-noise ratio of each bin of the band, shape (bins,)."""
    missed: Floats
    """Field error of an average touch relative to the noise, for each kept bin, shape (kept,)."""
    whole_mm: float
    """Median error with all bins."""
    kept_mm: float
    """Median error with the kept bins."""


@dataclass(frozen=True, slots=True)
class Trial:
    """Estimates of an atlas for the test touches."""

    judged: Judgement
    start_mm: Floats
    """Positions from the network, shape (n, 2)."""
    placed: Placed


def make_atlas(
    steady: Dataset, reference: Array, parts: Split, learned: Learned, said: dict[str, object]
) -> tuple[Atlas, Calibration]:
    """Make and calibrate the atlas of a field learned from the training part of touches at one temperature.

    Parameters
    ----------
    steady : Dataset
        Touches at one temperature.
    reference : array, shape (channels, samples)
        Untouched plate at that temperature.
    parts : Split
    learned : Learned
    said : dict
        Further fields of the atlas' description.
    """
    true_mm = steady.position_mm[parts.validation].astype(np.float64)
    touches = touches_of(steady, parts.validation)
    said = said | {"plate": steady.meta.plate, "touches": len(parts.train), "data_sha256": steady.sha256}
    snr = signal_over_noise(touches)
    kept = informative(snr)
    whole = place(atlas_of(learned.field, reference, steady, np.arange(len(snr)), said), touches.values, true_mm)
    plain = atlas_of(learned.field, reference, steady, kept, said)
    plain = aligned(plain, learned.position_mm, learned.amplitude.astype(np.complex128))
    values = np.ascontiguousarray(touches.values[:, :, kept])
    placed = place(plain, values, true_mm)
    near = np.linalg.norm(placed.position_mm - true_mm, axis=1) < FAR_MM
    predicted = FieldMap(plain).look_up(placed.position_mm[near])[0].reshape(values[near].shape)
    error = field_error(values[near], predicted, placed.amplitude[near], touches.noise)
    levels = noisy_levels(plain, steady, values, true_mm, learned.label_noise_mm)
    noise_scale, field_scale = calibrate([level for _, level in levels], float(error.mean()))
    scales = {"noise_scale": noise_scale, "field_scale": field_scale}
    atlas = replace(
        plain, description=plain.description.model_copy(update=scales), error=error.astype(np.float32)
    )  # fmt: skip
    power = float(np.square(np.abs(placed.amplitude[near])).mean())
    return atlas, Calibration(
        within=[(db, within_sigma(level, atlas), _median_mm(level.error_mm)) for db, level in levels],
        snr=snr,
        missed=error.mean(axis=0) * power / max(touches.noise, 1e-12),
        whole_mm=_median_mm(whole.position_mm - true_mm),
        kept_mm=_median_mm(placed.position_mm - true_mm),
    )


def atlas_of(
    field: Field, reference: Array, dataset: Dataset, kept: NDArray[np.int64], said: dict[str, object]
) -> Atlas:
    """Return an atlas of selected bins of a field, without error estimates."""
    a = dataset.acquisition
    nodes = field.coefficients[..., kept]
    description = said | {
        "acquisition": a, "bins": tuple(map(int, band_bins(a)[kept])), "step_mm": STEP_MM,
        "origin_mm": field.origin_mm, "low_mm": field.low_mm, "high_mm": field.high_mm,
    }  # fmt: skip
    return Atlas(
        AtlasDescription.model_validate(description),
        np.ascontiguousarray(nodes.reshape(*nodes.shape[:2], -1)),
        reference,
        np.zeros((a.channels, len(kept)), np.float32),
    )


def signal_over_noise(touches: Touches) -> Floats:
    """Return the signal-to-noise ratio of the touches in each bin, in power, shape (bins,)."""
    power = np.square(np.abs(touches.values)).mean(axis=(0, 1), dtype=np.float64)
    return np.asarray(np.maximum(power / max(touches.noise, 1e-12) - 1, 0.0))


def informative(snr: Floats) -> NDArray[np.int64]:
    """Return the bins that contain all but `SPARED` of the signal, in order."""
    order = np.argsort(snr)
    spared = np.cumsum(snr[order]) <= SPARED * snr.sum()
    return np.sort(order[~spared]) if snr.sum() > 0 else np.arange(len(snr))


def noisy_levels(
    atlas: Atlas, dataset: Dataset, values: Complex, true_mm: Floats, label_noise_mm: float
) -> list[tuple[float, Level]]:
    """Locate touches at their own noise and at added noise; return each level with its signal-to-noise ratio in dB."""
    a, bins = dataset.acquisition, np.array(atlas.description.bins)
    plain = windowed_dft(a, bins)
    window = float(np.square(np.hanning(a.samples)).sum())
    untouched = atlas.baseline - atlas.baseline.mean(axis=1, keepdims=True)
    plate = float(np.sqrt(np.square(untouched, dtype=np.float64).mean()))
    own_db = 20 * np.log10(plate / max(dataset.noise, 1e-6))
    rng = np.random.default_rng(_NOISE_SEED)
    levels = []
    for db in (own_db, *(level for level in LEVELS_DB if level < own_db - 1)):
        # Draw white noise in samples, so that the window correlates neighbouring bins.
        deviation = plate * 10 ** (-db / 20)
        added = np.sqrt(BASELINE_NOISE * max(deviation**2 - dataset.noise**2, 0.0))
        noise = rng.normal(size=(len(values), a.channels, a.samples)) @ plain * added
        louder = values + noise[:, :, : len(bins)] + 1j * noise[:, :, len(bins) :]
        placed = place(atlas, louder, true_mm)
        levels.append(
            (float(db), level_of(placed, true_mm, BASELINE_NOISE * deviation**2 * window / 2, label_noise_mm))
        )
    return levels


def try_atlas(
    atlas: Atlas, network: Model, steady: Dataset, plain: Dataset, parts: Split
) -> tuple[Trial, dict[str, float]]:
    """Locate the test touches from the network's positions, and score the result."""
    d = atlas.description
    true_mm = steady.position_mm[parts.test]
    start_mm = np.asarray(network.run(plain.residual[parts.test])["position_mm"], dtype=np.float64)
    kept = np.flatnonzero(np.isin(band_bins(d.acquisition), d.bins))
    touches = touches_of(steady, parts.test)
    placed = place(atlas, touches.values[:, :, kept], start_mm)
    level = Level(
        touches.noise / 2, placed.position_mm - true_mm, placed.fisher_information, np.square(np.abs(placed.amplitude))
    )
    sigma_mm = level.sigma_mm(d.noise_scale, d.field_scale, float(atlas.error.mean()))
    # One value for both axes, as in the daemon's messages.
    judged = Judgement(true_mm, placed.position_mm, np.sqrt(np.square(sigma_mm).mean(axis=1)), 1 - placed.misfit)
    return Trial(judged, start_mm, placed), scores(judged)


def _median_mm(error_mm: Floats) -> float:
    return float(np.median(np.linalg.norm(error_mm, axis=1)))
