"""The pipeline's arithmetic written down a second time, plainly and in float64: slow, and sharing no code with it.

Features are those of `numpy.fft.rfft`; the temperature's part in them follows from the derivative of the band-limited
signal instead of from a matrix; networks are evaluated operator by operator by ONNX's own reference implementation;
the field comes from the B-splines' definition; and Gauss-Newton, with the strengths eliminated by a projection, goes
on until it stands still.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx.reference import ReferenceEvaluator
from scipy.signal.windows import tukey

from tests.scenes.numerics.double import in_double
from touchd.frame import Acquisition
from touchd.localization import fit as localizer_fit
from touchd.localization.atlas import Atlas

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

CONVERGED_MM = 1e-9
MOST_STEPS = 200
STEP = 1e-6
"""Of a stretch, either way, for its derivative."""
EXPANDED = 2e-4
"""Steps of stretches about which the fast path goes to first order."""
PRIOR = np.array([
    [-1.2 * np.exp(0.4j) / 2.0, 0, 0.5 / 2.0, 0.5 / 2.0, 0],
    [0, 0, 0.5 / 1.2, -0.5 / 1.2, 0],
    [0, 0, 0, 0, 1 / 1.2],
    [0, 1 / 0.2, 0, 0, 0],
])  # fmt: skip
"""How far a contact's five amplitudes are from tissue's, in standard deviations, over the first of them."""

Orders = Sequence[tuple[int, int]]


def band(acquisition: Acquisition) -> NDArray[np.int64]:
    """The bins strictly within the chirp's band, shape (bins,)."""
    f_hz = np.fft.rfftfreq(acquisition.samples, 1 / acquisition.sample_rate_hz)
    low, high = acquisition.chirp.start_hz, acquisition.chirp.stop_hz
    return np.flatnonzero((f_hz > low * (1 + 1e-12)) & (f_hz < high * (1 - 1e-12)))


def bins_of(signal: NDArray[np.floating], bins: NDArray[np.int64], taper: float = 1.0) -> Complex:
    """Windowed bins of a signal (..., samples), shape (..., bins)."""
    wide = np.asarray(signal, np.float64)
    return np.asarray(np.fft.rfft(tukey(wide.shape[-1], taper) * wide)[..., bins])


def stretched_bins(
    signal: NDArray[np.floating], bins: NDArray[np.int64], acquisition: Acquisition, taper: float, stretch: float
) -> Complex:
    """Those bins as they are once all of the plate's resonances have risen by a share.

    Each wave of the frame's Fourier series, of frequency f, was an answer to what the linear chirp sent out at f; now
    it is one of f (1 + stretch), to what was sent out there, in another phase.
    """
    wide, n, chirp = np.asarray(signal, np.float64), acquisition.samples, acquisition.chirp
    t_s, f_hz = np.arange(n) / acquisition.sample_rate_hz, np.fft.rfftfreq(n, 1 / acquisition.sample_rate_hz)
    sweep = (chirp.stop_hz - chirp.start_hz) / chirp.duration_s
    sent, sent_now = (-np.pi * (each - chirp.start_hz) ** 2 / sweep for each in (f_hz, f_hz * (1 + stretch)))
    turns = [np.exp(2j * np.pi * np.outer(f_hz, t_s))[1:-1]]  # neither mean nor alternating signal are waves
    turns.append(np.exp(2j * np.pi * np.outer(f_hz * (1 + stretch), t_s) + 1j * (sent_now - sent)[:, None])[1:-1])
    moved = 2 / n * np.fft.rfft(wide)[..., 1:-1] @ (turns[1] - turns[0])
    return bins_of(wide + moved.real, bins, taper)


def expanded(
    signal: NDArray[np.floating], bins: NDArray[np.int64], acquisition: Acquisition, taper: float, stretch: float,
    about: float,
) -> tuple[Complex, Complex]:  # fmt: skip
    """Bins after a stretch to first order about another, as the fast path has them, and their derivative there."""
    middle, *ends = (stretched_bins(signal, bins, acquisition, taper, about + by) for by in (0.0, STEP, -STEP))
    slope = (ends[0] - ends[1]) / (2 * STEP)
    return middle + (stretch - about) * slope, slope


def flat(bins: Complex) -> Floats:
    """Complex bins (..., channels, bins) as features: of each channel the real parts, then the imaginary parts."""
    parts = np.stack([bins.real, bins.imag], axis=-2)
    return parts.reshape(*bins.shape[:-2], -1)


@dataclass(frozen=True, slots=True)
class Plate:
    """What has become of the untouched plate since the atlas was learned."""

    stretch: float
    gains: Complex
    """Along the band, shape (channels, bins)."""
    dead: NDArray[np.bool_]
    """Shape (channels,)."""


def plate_of(baseline: NDArray[np.floating], atlas: Atlas) -> Plate:
    """Compare the untouched plate with that of the atlas: a stretch, and a gain and some drive for each live channel.

    Least squares over the bins. A gain is complex and linear along the band; the drive is the chirp and its derivative,
    each at any phase. It is iterated to the stretch, about which the model is not linear.
    """
    d = atlas.description
    a, bins = d.acquisition, np.array(d.bins)
    known, live = (bins_of(np.asarray(each, np.float64), bins, d.taper) for each in (atlas.baseline, baseline))
    chirp, t_s = a.chirp, np.arange(a.samples) / a.sample_rate_hz
    hz = chirp.start_hz + (chirp.stop_hz - chirp.start_hz) * t_s / chirp.duration_s
    turning = np.where(t_s < chirp.duration_s, np.exp(1j * np.pi * (chirp.start_hz + hz) * t_s), 0)
    played = np.stack([turning.imag, turning.real, hz * turning.imag, hz * turning.real])
    drive = bins_of(played / np.linalg.norm(played, axis=1)[:, None], bins, d.taper)
    heard = np.linalg.qr(flat(drive[:, None]).T)[0].T.reshape(4, 2, -1)
    drive = heard[:, 0] + 1j * heard[:, 1]
    there, once = (
        flat(each[:, None]) - flat(each[:, None]) @ flat(drive[:, None]).T @ flat(drive[:, None])
        for each in (live, known)
    )
    dead = np.asarray(np.square(there).sum(axis=1) < 0.05 * np.square(once).sum(axis=1))
    gains, stretch, channels = np.ones((a.channels, len(bins)), complex), 0.0, a.channels
    alive = np.flatnonzero(~dead)
    if not len(alive):
        return Plate(stretch, gains, dead)
    along = 2 * (bins - bins.mean()) / np.ptp(bins)
    size = np.linalg.norm(known)
    for k in range(8):  # as often as the fast path, which has to be quick
        about = EXPANDED * round(stretch / EXPANDED)
        expected, rise = expanded(atlas.baseline, bins, a, d.taper, stretch, about)
        columns = [gains * rise]
        for r in alive:
            own = np.arange(channels)[:, None] == r
            columns += [np.where(own, part * expected, 0) for part in (1, 1j, along, 1j * along)]
            columns += [np.where(own, size * wave, 0) for wave in drive]
        system = np.stack([flat(c[alive]) for c in columns], axis=1)
        move = np.linalg.lstsq(system, flat((live - gains * expected)[alive]), rcond=1e-9)[0]
        steps = move[1:].reshape(len(alive), 8, 1)
        stretch += move[0]
        gains[alive] += steps[:, 0] + 1j * steps[:, 1] + along * (steps[:, 2] + 1j * steps[:, 3])
        if k >= 2 and abs(move[0]) < 1e-6:
            break
    if not (abs(stretch) < 3e-2 and 1 / 30 < np.abs(gains).min() <= np.abs(gains).max() < 30):
        stretch, gains = 0.0, np.ones_like(gains)
    return Plate(stretch, gains, dead)


def atlas_features(residual: NDArray[np.floating], plate: Plate, atlas: Atlas) -> Floats:
    """The bins of a residual as they would be on the plate that the atlas was learned on, shape (size,)."""
    d = atlas.description
    bins = np.array(d.bins)
    about = EXPANDED * round(plate.stretch / EXPANDED)
    found, _ = expanded(residual, bins, d.acquisition, d.taper, *(-by / (1 + by) for by in (plate.stretch, about)))
    if np.abs(plate.gains - 1).max() > 3e-3:  # the fast path leaves smaller differences be
        found = found / plate.gains
    return flat(found)


def network_features(residual: NDArray[np.floating], acquisition: Acquisition) -> Floats:
    """What the network takes, shape (inputs,)."""
    return flat(bins_of(residual, band(acquisition)))


@cache
def _network(path: Path) -> ReferenceEvaluator:
    return ReferenceEvaluator(in_double(onnx.load(path)))


def network(path: Path, features: Floats) -> dict[str, Floats]:
    """The outputs of a network computed in float64 for features of shape (n, inputs)."""
    evaluator = _network(path)
    outputs = evaluator.run(None, {evaluator.input_names[0]: np.asarray(features, np.float64)})
    return dict(zip(evaluator.output_names, outputs, strict=True))


def field(atlas: Atlas, x_mm: float, y_mm: float) -> tuple[Complex, Complex, Complex]:
    """The atlas' field and its derivatives by x and y, per mm, each of shape (channels * bins,)."""
    u, u_x, u_y = derivatives(atlas, x_mm, y_mm, ((0, 0), (1, 0), (0, 1)))
    return u, u_x, u_y


def derivatives(atlas: Atlas, x_mm: float, y_mm: float, orders: Orders) -> list[Complex]:
    """Derivatives of the atlas' field of these orders along x and y, per mm, each of shape (channels * bins,)."""
    d = atlas.description
    along_x, along_y = (
        [_splines((at - origin) / d.step_mm, count, order) / d.step_mm**order for order in range(4)]
        for at, origin, count in zip((x_mm, y_mm), d.origin_mm, atlas.coefficients.shape[1::-1], strict=True)
    )
    rows, columns = np.flatnonzero(along_y[0]), np.flatnonzero(along_x[0])
    nodes = atlas.coefficients[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].astype(np.float64)
    return [
        _complex(np.einsum("r,c,rcm->m", along_y[by_y][rows], along_x[by_x][columns], nodes), atlas)
        for by_x, by_y in orders
    ]


def _splines(at: float, count: int, order: int) -> Floats:
    """Cubic B-splines about the nodes 0 .. count - 1, or a derivative of them."""
    off = at - np.arange(count)
    far, sign = np.abs(off), np.where(off < 0, -1.0, 1.0)
    near, outer = [
        (2 / 3 - far**2 * (1 - far / 2), (2 - far) ** 3 / 6),
        ((1.5 * far**2 - 2 * far) * sign, -((2 - far) ** 2) / 2 * sign),
        (3 * far - 2, 2 - far),
        (3 * sign, -sign),
    ][order]
    return np.where(far < 1, near, np.where(far < 2, outer, 0.0))


def contact_rows(atlas: Atlas, x_mm: float, y_mm: float) -> tuple[Complex, Complex, Complex]:
    """What the five amplitudes of a contact with a shape multiply, and its slopes by x and y.

    Each of shape (5, channels * bins): u, u along the band, u_xx, u_yy, u_xy.
    """
    d = atlas.description
    bins = np.array(d.bins, float)
    band = 2 * (bins - bins[0]) / max(bins[-1] - bins[0], 1) - 1
    along = np.tile(band, d.acquisition.channels)
    parts = []
    for x, y in ((0, 0), (1, 0), (0, 1)):
        u, *second = derivatives(atlas, x_mm, y_mm, [(x + i, y + j) for i, j in ((0, 0), (2, 0), (0, 2), (1, 1))])
        parts.append(np.stack([u, along * u, *second]))
    rows, rows_x, rows_y = parts
    return rows, rows_x, rows_y


def _complex(features: Floats, atlas: Atlas) -> Complex:
    parts = features.reshape(atlas.description.acquisition.channels, 2, -1)
    return np.asarray((parts[:, 0] + 1j * parts[:, 1]).ravel())


@dataclass(frozen=True, slots=True)
class Fit:
    """Where least of a frame remains."""

    places_mm: Floats
    """Shape (c, 2)."""
    strengths: Complex
    """Shape (c,)."""
    left: float
    """Energy that remains, counts squared."""
    steps: int


def refine(
    atlas: Atlas,
    features: Floats,
    places_mm: Floats,
    mask: NDArray[np.bool_] | None = None,
    steps: int = MOST_STEPS,
    shapes: Complex | None = None,
) -> Fit:
    """Gauss-Newton from places (c, 2) nearby, in at most so many steps, until none is longer than 1e-9 mm.

    The strengths' part in what is measured is projected out: with Q an orthonormal basis of all u_k and i u_k, what
    remains of the frame is (1 - Q Q^T) d, and so are the slopes. No product is accumulated beforehand, and no
    normal equations are formed: both are solved by orthogonal factors. `shapes`, (c, 4), are the contacts', if known.
    """

    def look(number: int, x_mm: float, y_mm: float) -> tuple[Complex, ...]:
        if shapes is None:
            return tuple(part[None] for part in field(atlas, x_mm, y_mm))
        mix = np.array([[1, *shapes[number]]])
        return tuple(mix @ part for part in contact_rows(atlas, x_mm, y_mm))

    return _descend(atlas, features, places_mm, mask, steps, look)


def refine_shapes(
    atlas: Atlas,
    features: Floats,
    places_mm: Floats,
    mask: NDArray[np.bool_] | None,
    variance: float,
    steps: int = MOST_STEPS,
) -> Fit:
    """The same of contacts with unknown shapes: five amplitudes each, the prior on them as rows of their own.

    `variance` is that of a value's noise. Where fingers leave more than that, it is what they leave that weighs the
    prior.
    """
    left = 0.0
    for _ in range(20):
        weigh = max(variance, left / atlas.size)
        fit = _descend(atlas, features, places_mm, mask, steps, lambda _, x, y: contact_rows(atlas, x, y), weigh)
        places_mm = fit.places_mm
        if abs(fit.left - left) < 1e-9 * fit.left:
            break
        left = fit.left
    return fit


def refine_weighted(
    atlas: Atlas, features: Floats, found: localizer_fit.Fit, mask: NDArray[np.bool_] | None, variance: float
) -> Fit:
    """The same with the bins' errors made white: what a bin's channels miss is correlated, and goes with the contacts.

    `found` are the contacts as the fast path fitted them: they say how large the errors are.
    """
    white = whitening(atlas, found, mask, variance)
    keep = np.ones(atlas.size // 2) if mask is None else _complex(mask.astype(float), atlas).real

    def look(_: int, x_mm: float, y_mm: float) -> tuple[Complex, ...]:
        return tuple(white(part * keep) for part in contact_rows(atlas, x_mm, y_mm))

    data = flat(white(_complex(features, atlas) * keep).reshape(atlas.description.acquisition.channels, -1))
    return _descend(atlas, data, np.array(found.positions_mm), None, MOST_STEPS, look, variance)


def whitening(
    atlas: Atlas, found: localizer_fit.Fit, mask: NDArray[np.bool_] | None, variance: float
) -> Callable[[Complex], Complex]:
    """What makes errors white in rows (..., channels * bins): the covariance's inverse root, by its eigenvectors."""
    d = atlas.description
    channels, bins = d.acquisition.channels, len(d.bins)
    keep = np.ones(atlas.size // 2) if mask is None else _complex(mask.astype(float), atlas).real
    covariance = 2 * variance * np.tile(np.eye(channels, dtype=complex), (bins, 1, 1))
    for (x_mm, y_mm), z, (_, xx, yy, _) in zip(found.positions_mm, found.amplitudes, found.shapes, strict=True):
        share = 0.0035 * (abs(xx + yy) / 2 / abs(z)) ** 3 + 0.002 * (len(found.positions_mm) - 1)
        u = (field(atlas, x_mm, y_mm)[0] * keep).reshape(channels, bins)
        mean = np.square(np.abs(u)).mean(axis=1)
        for k in range(bins):
            covariance[k] += abs(z) ** 2 * share * np.outer(u[:, k], u[:, k].conj())
            alone = 0.55 * d.field_scale * atlas.error[:, k] + 0.05 * share * (np.abs(u[:, k]) ** 2 + mean)
            covariance[k] += abs(z) ** 2 * np.diag(alone)
    roots = []
    for one in covariance:
        values, vectors = np.linalg.eigh(one)
        roots.append(np.sqrt(2 * variance) * vectors @ np.diag(values**-0.5) @ vectors.conj().T)

    def white(rows: Complex) -> Complex:
        parts = rows.reshape(-1, channels, bins)
        return np.stack([roots[k] @ parts[:, :, k].T for k in range(bins)], axis=-1).swapaxes(0, 1).reshape(rows.shape)

    return white


Look = Callable[[int, float, float], tuple[Complex, ...]]


def _descend(
    atlas: Atlas, features: Floats, places_mm: Floats, mask: NDArray[np.bool_] | None, steps: int, look: Look,
    weigh: float | None = None,
) -> Fit:  # fmt: skip
    d = atlas.description
    keep = np.ones(atlas.size // 2, bool) if mask is None else _complex(mask.astype(float), atlas).real > 0
    data = _complex(features, atlas)[keep]
    places = np.array(places_mm, np.float64).reshape(-1, 2)
    size_mm = np.array([d.plate.width_mm, d.plate.height_mm])
    done = 0
    while True:
        looked = [tuple(part[:, keep] for part in look(k, x, y)) for k, (x, y) in enumerate(places.tolist())]
        columns, target = np.concatenate([rows for rows, _, _ in looked]).T, data
        each = len(looked[0][0])
        if weigh is not None:
            priors = np.zeros((len(looked), 4, columns.shape[1]), complex)
            for k, (rows, _, _) in enumerate(looked):
                size = abs(np.vdot(rows[0], data)) / np.vdot(rows[0], rows[0]).real
                priors[k, :, k * each : (k + 1) * each] = np.sqrt(2 * weigh) / size * PRIOR
            prior = priors.reshape(-1, columns.shape[1])
            columns, target = np.concatenate([columns, prior]), np.concatenate([data, np.zeros(len(prior))])
        system = np.stack([part for column in columns.T for part in (column, 1j * column)], axis=1)
        real, wanted = np.concatenate([system.real, system.imag]), np.concatenate([target.real, target.imag])
        solved = np.linalg.lstsq(real, wanted, rcond=None)[0]
        z = (solved[::2] + 1j * solved[1::2]).reshape(len(looked), each)
        basis = np.linalg.qr(real)[0]
        rest = wanted - basis @ (basis.T @ wanted)
        fit = Fit(places.copy(), z[:, 0], float(rest @ rest), done)
        if done == steps:
            return fit
        slopes = np.stack([own @ along for own, (_, *both) in zip(z, looked, strict=True) for along in both], axis=1)
        slopes = np.concatenate([slopes, np.zeros((len(target) - len(data), slopes.shape[1]))])
        slopes = np.concatenate([slopes.real, slopes.imag])
        slopes -= basis @ (basis.T @ slopes)
        move = np.linalg.lstsq(slopes, rest, rcond=None)[0].reshape(-1, 2)
        places = np.clip(places + move, 0, size_mm)
        done += 1
        if np.linalg.norm(move, axis=1).max() < CONVERGED_MM:
            return fit
