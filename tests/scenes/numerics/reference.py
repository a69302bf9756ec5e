"""The pipeline's arithmetic written down a second time, plainly and in float64: slow, and sharing no code with it.

Features are those of `numpy.fft.rfft`; the temperature's part in them follows from the derivative of the band-limited
signal instead of from a matrix; networks are evaluated operator by operator by ONNX's own reference implementation;
the field comes from the B-splines' definition; and Gauss-Newton, with the strengths eliminated by a projection, goes
on until it stands still.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx.reference import ReferenceEvaluator

from tests.scenes.numerics.double import in_double
from touchd.frame import Acquisition
from touchd.localization.atlas import Atlas

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

CONVERGED_MM = 1e-9
MOST_STEPS = 200


def band(acquisition: Acquisition) -> NDArray[np.int64]:
    """The bins strictly within the chirp's band, shape (bins,)."""
    f_hz = np.fft.rfftfreq(acquisition.samples, 1 / acquisition.sample_rate_hz)
    low, high = acquisition.chirp.start_hz, acquisition.chirp.stop_hz
    return np.flatnonzero((f_hz > low * (1 + 1e-12)) & (f_hz < high * (1 - 1e-12)))


def bins_of(signal: NDArray[np.floating], bins: NDArray[np.int64]) -> Complex:
    """Windowed bins of a signal (..., samples), shape (..., bins)."""
    wide = np.asarray(signal, np.float64)
    return np.asarray(np.fft.rfft(np.hanning(wide.shape[-1]) * wide)[..., bins])


def stretched_bins(signal: NDArray[np.floating], bins: NDArray[np.int64], acquisition: Acquisition) -> Complex:
    """How those bins change when the plate's resonances rise, for a relative rise of 1, in first order.

    What a linear chirp sends out at f leaves at tau(f), and from there on the answer is stretched: the change is
    y'(t) (t - tau(f)) before window and transform.
    """
    wide, n = np.asarray(signal, np.float64), acquisition.samples
    t_s, f_hz = np.arange(n) / acquisition.sample_rate_hz, np.fft.rfftfreq(n, 1 / acquisition.sample_rate_hz)
    spectrum = np.fft.rfft(wide) * 2j * np.pi * f_hz
    if n % 2 == 0:
        spectrum[..., -1] = 0.0
    slope = np.fft.irfft(spectrum, n)
    chirp = acquisition.chirp
    tau_s = (f_hz[bins] - chirp.start_hz) * chirp.duration_s / (chirp.stop_hz - chirp.start_hz)
    return np.asarray(bins_of(slope * t_s, bins) - tau_s * bins_of(slope, bins))


def flat(bins: Complex) -> Floats:
    """Complex bins (..., channels, bins) as features: of each channel the real parts, then the imaginary parts."""
    parts = np.stack([bins.real, bins.imag], axis=-2)
    return parts.reshape(*bins.shape[:-2], -1)


@dataclass(frozen=True, slots=True)
class Plate:
    """What has become of the untouched plate since the atlas was learned."""

    stretch: float
    gains: Floats
    """Shape (channels,)."""
    dead: NDArray[np.bool_]
    """Shape (channels,)."""


def plate_of(baseline: NDArray[np.floating], atlas: Atlas) -> Plate:
    """Compare the untouched plate with that of the atlas: a stretch, a delay, and a gain for each live channel.

    Least squares over the bins, the model linear in a stretch and a delay for small ones, iterated until it stands
    still.
    """
    d = atlas.description
    a, bins = d.acquisition, np.array(d.bins)
    known, live = np.asarray(atlas.baseline, np.float64), np.asarray(baseline, np.float64)
    dead = (live**2).sum(axis=1) < 0.05 * (known**2).sum(axis=1)
    gains, stretch, channels = np.ones(a.channels), 0.0, a.channels
    alive = np.flatnonzero(~dead)
    if not len(alive):
        return Plate(stretch, gains, dead)
    value, rise, found = bins_of(known, bins), stretched_bins(known, bins, a), bins_of(live, bins)
    omega = 2 * np.pi * bins * a.sample_rate_hz / a.samples
    for _ in range(2):  # as often as the fast path, which has to be quick
        expected = value + stretch * rise
        columns = [gains[:, None] * rise, gains[:, None] * -1j * omega * expected]
        columns += [np.where(np.arange(channels)[:, None] == r, expected, 0) for r in alive]
        system = np.stack([flat(c[alive]) for c in columns], axis=1)
        move = np.linalg.lstsq(system, flat((found - gains[:, None] * expected)[alive]), rcond=1e-9)[0]
        stretch, gains[alive] = stretch + move[0], gains[alive] + move[2:]
    if not (abs(stretch) < 3e-3 and np.abs(gains - 1).max() < 1):
        stretch, gains = 0.0, np.ones(channels)
    return Plate(stretch, gains, dead)


def atlas_features(residual: NDArray[np.floating], plate: Plate, atlas: Atlas) -> Floats:
    """The bins of a residual as they would be on the plate that the atlas was learned on, shape (size,)."""
    d = atlas.description
    bins = np.array(d.bins)
    found = bins_of(residual, bins) - plate.stretch * stretched_bins(residual, bins, d.acquisition)
    if np.abs(plate.gains - 1).max() > 1e-3:  # the fast path leaves smaller differences be
        found = found / plate.gains[:, None]
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
    d = atlas.description
    (wx, dx), (wy, dy) = (
        _splines((at - origin) / d.step_mm, count)
        for at, origin, count in zip((x_mm, y_mm), d.origin_mm, atlas.coefficients.shape[1::-1], strict=True)
    )
    rows, columns = np.flatnonzero(wy), np.flatnonzero(wx)
    nodes = atlas.coefficients[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].astype(np.float64)
    wx, dx, wy, dy = wx[columns], dx[columns] / d.step_mm, wy[rows], dy[rows] / d.step_mm
    u, u_x, u_y = (_complex(np.einsum("r,c,rcm->m", *w, nodes), atlas) for w in ((wy, wx), (wy, dx), (dy, wx)))
    return u, u_x, u_y


def _splines(at: float, count: int) -> tuple[Floats, Floats]:
    """Cubic B-splines about the nodes 0 .. count - 1, and their slopes."""
    off = at - np.arange(count)
    far = np.abs(off)
    value = np.where(far < 1, 2 / 3 - far**2 * (1 - far / 2), np.where(far < 2, (2 - far) ** 3 / 6, 0.0))
    slope = np.where(far < 1, 1.5 * far**2 - 2 * far, np.where(far < 2, -((2 - far) ** 2) / 2, 0.0)) * np.sign(off)
    slope = np.where(value > 0, slope, 0.0)
    return value, slope


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
    atlas: Atlas, features: Floats, places_mm: Floats, mask: NDArray[np.bool_] | None = None, steps: int = MOST_STEPS
) -> Fit:
    """Gauss-Newton from places (c, 2) nearby, in at most so many steps, until none is longer than 1e-9 mm.

    The strengths' part in what is measured is projected out: with Q an orthonormal basis of all u_k and i u_k, what
    remains of the frame is (1 - Q Q^T) d, and so are the slopes. No product is accumulated beforehand, and no
    normal equations are formed: both are solved by orthogonal factors.
    """
    d = atlas.description
    keep = np.ones(atlas.size // 2, bool) if mask is None else _complex(mask.astype(float), atlas).real > 0
    data = _complex(features, atlas)[keep]
    places = np.array(places_mm, np.float64).reshape(-1, 2)
    size_mm = np.array([d.plate.width_mm, d.plate.height_mm])
    done = 0
    while True:
        looked = [tuple(part[keep] for part in field(atlas, x, y)) for x, y in places.tolist()]
        system = np.stack([column for u, _, _ in looked for column in (u, 1j * u)], axis=1)
        real = np.concatenate([system.real, system.imag])
        target = np.concatenate([data.real, data.imag])
        solved = np.linalg.lstsq(real, target, rcond=None)[0]
        z = solved[::2] + 1j * solved[1::2]
        basis = np.linalg.qr(real)[0]
        rest = target - basis @ (basis.T @ target)
        fit = Fit(places.copy(), z, float(rest @ rest), done)
        if done == steps:
            return fit
        slopes = np.stack([s * along for s, (_, *both) in zip(z, looked, strict=True) for along in both], axis=1)
        slopes = np.concatenate([slopes.real, slopes.imag])
        slopes -= basis @ (basis.T @ slopes)
        move = np.linalg.lstsq(slopes, rest, rcond=None)[0].reshape(-1, 2)
        places = np.clip(places + move, 0, size_mm)
        done += 1
        if np.linalg.norm(move, axis=1).max() < CONVERGED_MM:
            return fit
