"""The residual field: what a touch of unit strength anywhere on the plate adds to each bin.

In a bin of frequency f the residual of a touch at (x, y) is a complex strength z times the product of two
waves of the plate, which holds no spatial frequency above 2 k(f), k from the plate's dispersion. So the
field between the recorded touches follows from them by kernel ridge regression with the kernel of such
functions, 2 J1(K r) / (K r) with K a little above 2 k(f).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import spline_filter1d
from scipy.special import j1
from threadpoolctl import threadpool_limits

from touchd.features import band_bins
from touchd.training.dataset import Dataset
from touchd.twin.dispersion import mindlin_wavenumber

Complex = NDArray[np.complex64]

STEP_MM = 2.5
"""Spacing of the grid: a third of the shortest wavelength of the field on 5 mm glass at 100 kHz."""
BAND_MARGIN = 1.15
"""Widens the band for what is no free wave: near fields of edges and discs."""
RIDGE = 3e-3
STRENGTH_ROUNDS = 5
STRENGTH_BINS = 7
_TABLE = 200  # nodes per unit of K r
_ROWS = 64  # a block at a time stays in the cache


@dataclass(frozen=True, slots=True)
class Field:
    """Cubic B-spline coefficients of the field on a grid over the touched part of the plate."""

    coefficients: NDArray[np.float32]
    """Shape (rows, columns, channels, 2, bins): real and imaginary parts, in the features' order."""
    origin_mm: tuple[float, float]
    """x and y of the first node."""
    low_mm: tuple[float, float]
    high_mm: tuple[float, float]
    """Corners of the part that was touched: beyond it the field is not known."""
    strength: NDArray[np.float32]
    """|z| of each touch it was learned from, shape (n,), 1 on average."""


def learn_field(
    dataset: Dataset, indices: NDArray[np.int64], progress: Callable[[int, int], None] = lambda _d, _a: None
) -> Field:
    """Learn the field from some touches of a dataset in the frequency domain.

    The strengths are found along with it: each touch's is the one that fits the field of all touches best,
    taken in a few bins, since it changes slowly along the band.
    """
    a = dataset.acquisition
    bins = band_bins(a)
    f_hz = bins * a.sample_rate_hz / a.samples
    cutoff_per_mm = 2 * BAND_MARGIN * mindlin_wavenumber(dataset.meta.plate, f_hz) * 1e-3
    place_mm = dataset.position_mm[indices].astype(np.float64)
    parts = dataset.residual[indices].reshape(len(indices), a.channels, 2, len(bins))
    values: Complex = (parts[:, :, 0] + 1j * parts[:, :, 1]).astype(np.complex64)
    scale = float(np.sqrt(np.mean(np.abs(values) ** 2)))
    distance_mm = np.linalg.norm(place_mm[:, None] - place_mm[None], axis=2).astype(np.float32)

    def fit(b: int, strength: Complex) -> Complex:
        return _solve(_kernel(distance_mm, cutoff_per_mm[b]), values[:, :, b] / scale, strength[:, b])

    def predict(b: int, strength: Complex) -> Complex:
        return _apply(_kernel(distance_mm, cutoff_per_mm[b]), fit(b, strength))

    low, high = place_mm.min(axis=0), place_mm.max(axis=0)
    # Two nodes beyond the edge on each side, so that every point has its four neighbours.
    x_mm = np.arange(low[0] - 2 * STEP_MM, high[0] + 3 * STEP_MM, STEP_MM)
    y_mm = np.arange(low[1] - 2 * STEP_MM, high[1] + 3 * STEP_MM, STEP_MM)
    nodes = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    to_nodes_mm = np.linalg.norm(nodes[:, None] - place_mm[None], axis=2).astype(np.float32)

    def draw(b: int, strength: Complex) -> NDArray[np.float32]:
        field = _apply(_kernel(to_nodes_mm, cutoff_per_mm[b]), fit(b, strength)) * np.float32(scale)
        grid = np.stack([field.real, field.imag], axis=-1).reshape(len(y_mm), len(x_mm), a.channels, 2)
        for axis in (0, 1):
            grid = spline_filter1d(grid, 3, axis=axis, output=np.float32, mode="mirror")
        return np.asarray(grid)

    chosen = np.linspace(0, len(bins) - 1, STRENGTH_BINS).round().astype(int)
    slope = np.linspace(-1, 1, len(bins))
    strength = np.ones((len(indices), len(bins)), np.complex64)
    jobs, done = STRENGTH_ROUNDS * len(chosen) + len(bins), 0

    def each(work: Callable[[int, Complex], NDArray[Any]], at: Iterable[int]) -> list[NDArray[Any]]:
        nonlocal done
        results = []
        for result in pool(delayed(work)(b, strength) for b in at):
            results.append(result)
            done += 1
            progress(done, jobs)
        return results

    # One bin a core: threads of the linear algebra beside one another would only wait for each other.
    with threadpool_limits(1), Parallel(n_jobs=-1, prefer="threads", return_as="generator") as pool:
        for _ in range(STRENGTH_ROUNDS):
            predicted = np.stack(each(predict, chosen), axis=-1)
            strength = _strengths(values[:, :, chosen] / scale, predicted, slope[chosen], slope)
        grid = np.stack(each(draw, range(len(bins))), axis=-1)
    return Field(
        coefficients=np.ascontiguousarray(grid),
        origin_mm=(float(x_mm[0]), float(y_mm[0])),
        low_mm=(float(low[0]), float(low[1])),
        high_mm=(float(high[0]), float(high[1])),
        strength=np.abs(strength).mean(axis=1).astype(np.float32),
    )


def _kernel(distance_mm: NDArray[np.float32], cutoff_per_mm: float) -> NDArray[np.float32]:
    """Return 2 J1(K r) / (K r), by linear interpolation to 1e-6: a coarser kernel would not be positive definite."""
    nodes = np.arange(0.0, float(distance_mm.max()) * cutoff_per_mm + 2 / _TABLE, 1 / _TABLE)
    table = np.ones_like(nodes)
    table[1:] = 2 * j1(nodes[1:]) / nodes[1:]
    value, step = table.astype(np.float32), np.diff(table, append=0.0).astype(np.float32)
    kernel = np.empty_like(distance_mm)
    for start in range(0, len(kernel), _ROWS):
        at = distance_mm[start : start + _ROWS] * np.float32(cutoff_per_mm * _TABLE)
        below = at.astype(np.int32)
        at -= below
        kernel[start : start + _ROWS] = value[below] + at * step[below]
    return kernel


def _solve(kernel: NDArray[np.float32], values: Complex, strength: Complex) -> Complex:
    """Return the weights of kernel ridge regression, of shape (n, channels).

    A touch of strength z tells the field with its noise divided by |z|.
    """
    system = kernel.copy()
    power = np.maximum(np.abs(strength) ** 2, 1e-2)
    system[np.diag_indices(len(system))] += (RIDGE / power).astype(np.float32)
    target = np.ascontiguousarray(values / strength[:, None]).view(np.float32)
    factor = cho_factor(system, lower=True, overwrite_a=True, check_finite=False)
    solved: NDArray[np.float32] = cho_solve(factor, target, check_finite=False)
    weights: Complex = np.ascontiguousarray(solved.astype(np.float32)).view(np.complex64)
    return weights


def _apply(kernel: NDArray[np.float32], weights: Complex) -> Complex:
    """Return the field that weights (n, channels) mean at the points of a kernel (m, n), shape (m, channels)."""
    product: NDArray[np.float32] = np.ascontiguousarray(kernel @ weights.view(np.float32))
    field: Complex = product.view(np.complex64)
    return field


def _strengths(values: Complex, predicted: Complex, slope: NDArray[np.float64], along: NDArray[np.float64]) -> Complex:
    """Return each touch's strength along the band, linear in frequency, of shape (n, bins)."""
    n = len(values)
    # Two unknowns a touch, z = p + q s: least squares over channels and bins.
    basis = np.stack([predicted, predicted * slope], axis=-1).reshape(n, -1, 2)
    gram = np.einsum("nki,nkj->nij", basis.conj(), basis)
    gram[:, 1, 1] += 0.1 * gram[:, 0, 0]  # a strong slope is unlikely, and the data of a weak touch cannot tell
    right = np.einsum("nki,nk->ni", basis.conj(), values.reshape(n, -1))
    p, q = np.linalg.solve(gram, right[..., None])[..., 0].T
    strength = p[:, None] + q[:, None] * along
    # Only products of strength and field are seen: fix the mean of the one.
    strength /= np.mean(np.abs(p)) * np.exp(1j * np.angle(p.sum()))
    small = np.abs(strength) < 0.05
    strength[small] = 0.05
    found: Complex = strength.astype(np.complex64)
    return found
