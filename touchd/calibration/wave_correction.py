"""What taps tell of a field whose physics lack something: the waves that it adds to the emitter's and the receivers'.

A hole, a button or an edge that is held in another way scatters waves that the fitted plate has not. The field of a
touch is the product of two waves (`touchd.training.field.few_touches`), and what a fit leaves of the untouched response
it leaves of either. Each is corrected by the posterior mean of a random wave of that power, given what taps show beside
the physical field; they are placed again on the corrected one. Taps left out say how much of the lack stays.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.physical_atlas import lack_of_physics
from touchd.calibration.plate_fit import Progress
from touchd.calibration.reduced_plate import Complex, Floats
from touchd.calibration.spline_grid import coefficients_of, grid_of
from touchd.calibration.tap_fit import FittedTaps, fit_taps
from touchd.localization.atlas import Atlas
from touchd.localization.features import band_bins
from touchd.training.field.few_touches import Product, basis_of, covariance, product_of
from touchd.training.field.place import FieldMap

MOST_STAYS = 0.95
"""Of taps left out no more than this share of the lack stays, or the field does."""
NO_PRODUCT = 0.3
"""Share of what physics lack that is no product of two waves: the window cuts reverberation off (twin)."""
FAINT = 1e-3
"""The power of a tap's amplitude in a bin counts as this share of the taps' at least."""
MOST_TAPS = 200
"""Of more, these are enough: the time grows with the third power."""
ALIKE_RAD = np.pi / 2
"""Taps as near to each other tell the same wave: they are left out together."""
ROUNDS = 3
"""Of fitting the taps, and the waves to what they leave."""
_DRAWN, _PRODUCT_NOISE, _SEED = 500, 1e-4, 0x3A7E5


class Corrected(NamedTuple):
    """An atlas with the waves that taps tell."""

    atlas: Atlas
    stays: float
    """Share of what the physical field lacks that stays, by taps left out."""


def with_waves(
    atlas: Atlas, values: Complex, position_mm: Floats, lacking: float,
    progress: Progress = lambda _stage, _share: None,
) -> Corrected:  # fmt: skip
    """Add to a physical atlas the waves that taps tell.

    Parameters
    ----------
    atlas : Atlas
    values : array of shape (n, channels, bins)
        Of taps that the field explains, ADC counts.
    position_mm : array of shape (n, 2)
        Where the field places them.
    lacking : float
        Share of the untouched response's energy that the fit leaves beside noise.

    Returns
    -------
    Corrected
        The same atlas, of which all stays, where the waves explain too little of taps left out.
    """
    d = atlas.description
    x, y = (grid_of(side, d.step_mm) for side in d.plate.size_mm)  # as the atlas was made
    grid_mm = np.stack(np.meshgrid(x.samples_mm, y.samples_mm), axis=-1).reshape(-1, 2)
    physical = FieldMap(atlas)
    on_grid = physical.at(grid_mm)
    wavenumbers = _wavenumbers_per_mm(atlas)
    products = _products(physical, wavenumbers, atlas)
    waves = [product.waves_at(grid_mm) for product in products]
    values, position_mm = values[:MOST_TAPS], position_mm[:MOST_TAPS]
    together = _together(position_mm, ALIKE_RAD / float(wavenumbers.mean()))
    corrected, stays = atlas, 1.0
    for done in range(ROUNDS):
        fitted = fit_taps(corrected, values, position_mm)
        missing, weight = _beside(corrected, values, fitted, physical)
        position_mm, field = fitted.position_mm, on_grid.copy()
        lack, left = 0.0, 0.0
        for b, (product, k) in enumerate(zip(products, wavenumbers.tolist(), strict=True)):
            near = covariance(position_mm, position_mm, k)
            emitter, receivers = product.waves_at(position_mm)
            sent, received, left_out = _missing_waves(
                missing[:, :, b], weight[:, b], emitter, receivers, near, lacking, together
            )
            far = covariance(grid_mm, position_mm, k)
            sent, received = far @ sent, far @ received
            field[:, :, b] += waves[b][0][:, None] * received + sent[:, None] * (waves[b][1] + received)
            lack += float(weight[:, b] @ np.square(np.abs(missing[:, :, b])).sum(axis=1))
            left += float(weight[:, b] @ np.square(np.abs(left_out)).sum(axis=1))
        stays = left / max(lack, 1e-30)
        corrected = replace(atlas, coefficients=coefficients_of(field, x, y))
        progress("taps", (done + 1) / ROUNDS)
    if not stays < MOST_STAYS:
        return Corrected(atlas, 1.0)
    mended = (1 - stays) * np.minimum(lack_of_physics(on_grid, lacking, d.acquisition), atlas.error)
    return Corrected(replace(corrected, error=(atlas.error - mended).astype(np.float32)), stays)


def _missing_waves(
    missing: Complex, weight: Floats, emitter: Complex, receivers: Complex, near: Floats, lacking: float,
    together: list[NDArray[np.intp]],
) -> tuple[Complex, Complex, Complex]:  # fmt: skip
    """Return the weights of the covariance about n taps that make the missing waves of a bin, and taps left out.

    Those of the emitter's wave have the shape (n,), those of the receivers' (n, channels), as has what stays of each
    tap when all others tell the waves, but those `together` with it. `missing` is what the taps show beside the field
    (n, channels), `weight` the power of their amplitudes, `emitter` and `receivers` the physical waves at them, `near`
    their covariance (n, n).
    """
    count, channels = receivers.shape
    sent = lacking * np.square(np.abs(emitter)).mean()
    received = lacking * np.square(np.abs(receivers)).mean(axis=0)
    by_emitter = sent * near[:, None, :, None] * receivers[:, :, None, None] * receivers.conj()
    by_receiver = near * (emitter[:, None] * emitter.conj())
    for j, power in enumerate(received.tolist()):
        by_emitter[:, j, :, j] += power * by_receiver
    typical = float(np.median(weight))
    noise = NO_PRODUCT * np.square(np.abs(missing)).mean() * typical / np.maximum(weight, FAINT * typical)
    system = by_emitter.reshape(count * channels, -1)
    system[np.diag_indices(len(system))] += np.repeat(noise, channels)
    inverse = np.linalg.inv(system)
    solved = (inverse @ missing.reshape(-1)).reshape(count, channels)
    left_out, by_tap = np.empty_like(solved), inverse.reshape(count, channels, count, channels)
    for part in together:
        own = by_tap[part][:, :, part].reshape(len(part) * channels, -1)
        left_out[part] = np.linalg.solve(own, solved[part].reshape(-1)).reshape(-1, channels)
    of_emitter: Complex = sent * (receivers.conj() * solved).sum(axis=1)
    of_receivers: Complex = received * (emitter.conj()[:, None] * solved)
    return of_emitter, of_receivers, np.asarray(left_out, np.complex128)


def _together(position_mm: Floats, reach_mm: float) -> list[NDArray[np.intp]]:
    """Return the indices of taps in parts, each within `reach_mm` of its first."""
    parts, left = [], np.arange(len(position_mm))
    while len(left):
        near = np.linalg.norm(position_mm[left] - position_mm[left[0]], axis=1) < reach_mm
        parts.append(left[near])
        left = left[~near]
    return parts


def _beside(atlas: Atlas, values: Complex, fitted: FittedTaps, physical: FieldMap) -> tuple[Complex, Floats]:
    """Return what taps show beside the physical field, as contacts of amplitude 1, and the power of their amplitudes.

    The shapes are (n, channels, bins) and (n, bins).
    """
    field = FieldMap(atlas).at(fitted.position_mm)
    # Of a contact of any size: its part over the field, on average over the channels.
    amplitude = (field.conj() * (values - fitted.left)).sum(axis=1) / np.square(np.abs(field)).sum(axis=1)
    missing = fitted.left / amplitude[:, None] + field - physical.at(fitted.position_mm)
    return missing, np.square(np.abs(amplitude))


def _products(field: FieldMap, wavenumbers_per_mm: Floats, atlas: Atlas) -> list[Product]:
    """Return the two waves of each bin of a field, fitted all over the plate."""
    rng = np.random.default_rng(_SEED)
    places = rng.uniform(atlas.description.low_mm, atlas.description.high_mm, (_DRAWN, 2))
    values, one = field.at(places).astype(np.complex64), np.ones(_DRAWN, np.complex64)
    return [
        product_of(basis_of(places, k), part, one, _PRODUCT_NOISE * float(np.square(np.abs(part)).mean()))
        for k, part in zip(wavenumbers_per_mm.tolist(), np.moveaxis(values, 2, 0), strict=True)
    ]


def _wavenumbers_per_mm(atlas: Atlas) -> Floats:
    d = atlas.description
    of_band = dict(zip(band_bins(d.acquisition).tolist(), d.wavenumber_rad_m, strict=True))
    return 1e-3 * np.array([of_band[b] for b in d.bins])
