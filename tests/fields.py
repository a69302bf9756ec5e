"""A plate whose field is a formula: what a finger adds anywhere, with its gradient, and an atlas sampled from it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.ndimage import spline_filter1d

from touchd.frame import Acquisition, Plate
from touchd.localization.atlas import Atlas, AtlasDescription
from touchd.localization.features import windowed_dft
from touchd.localization.fit import Bins
from touchd.localization.plate_modes import PlateModes

RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
PLATE = Plate(width_mm=120, height_mm=90)
BINS = tuple(range(54, 99, 3))
STEP_MM = 2.5
LOW_MM, HIGH_MM = (2.5, 2.5), (117.5, 87.5)
COUNTS = 400.0
"""Root mean square of the field in a bin at amplitude 1."""
Finger = tuple[float, float, complex]


def wavenumber_rad_mm(f_hz: np.ndarray) -> np.ndarray:
    """Of flexural waves on 5 mm of glass, about: 22 mm long at 100 kHz."""
    return np.asarray(0.28 * np.sqrt(f_hz / 100e3))


class Field:
    """In each channel and bin the product of two sums of plane waves, one from the emitter and one to the receiver."""

    def __init__(self, seed: int = 0, waves: int = 6) -> None:
        self._drawn = seed, waves
        rng = np.random.default_rng(seed)
        shape = (2, waves, RIG.channels, len(BINS))
        angle = rng.uniform(0, 2 * np.pi, (*shape[:3], 1))
        k = wavenumber_rad_mm(np.array(BINS) * RIG.sample_rate_hz / RIG.samples)
        self._kx, self._ky = np.cos(angle) * k, np.sin(angle) * k
        self._size = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * np.sqrt(COUNTS / (2 * waves))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Field) and self._drawn == other._drawn

    def __hash__(self) -> int:
        return hash(self._drawn)

    def value(self, x_mm: float, y_mm: float) -> np.ndarray:
        """The field alone."""
        waves = self._size * np.exp(1j * (self._kx * x_mm + self._ky * y_mm))
        return np.asarray(np.multiply(*waves.sum(axis=1)))

    def at(self, x_mm: float, y_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The field and its derivatives by x and y (1/mm), each of shape (channels, bins)."""
        waves = self._size * np.exp(1j * (self._kx * x_mm + self._ky * y_mm))
        (a, b), (a_x, b_x), (a_y, b_y) = (
            (factor * waves).sum(axis=1) for factor in (1.0, 1j * self._kx, 1j * self._ky)
        )
        return a * b, a_x * b + a * b_x, a_y * b + a * b_y

    def frame(self, fingers: list[Finger], noise: float = 0.0, seed: int = 0) -> np.ndarray:
        """Features of fingers and of white noise of a standard deviation, shape (channels * 2 * bins,)."""
        features = features_of(
            sum((z * self.value(x, y) for x, y, z in fingers), np.zeros((RIG.channels, len(BINS)), complex))
        )
        if noise:
            features += noise * np.random.default_rng(seed).standard_normal(len(features))
        return features

    def residual(self, fingers: list[Finger], noise: float = 0.0, seed: int = 0) -> np.ndarray:
        """The shortest samples that have the features of these fingers, and white noise, (channels, samples)."""
        samples = self.frame(fingers).reshape(RIG.channels, -1) @ TO_SAMPLES
        return np.asarray(samples + noise * np.random.default_rng(seed).standard_normal(RIG.shape)).astype(np.float32)


TO_SAMPLES = np.linalg.pinv(windowed_dft(RIG, np.array(BINS)))


def features_of(bins: np.ndarray) -> np.ndarray:
    """Complex bins (channels, bins) in the order of the features, (channels * 2 * bins,)."""
    return np.asarray(np.stack([bins.real, bins.imag], axis=1).ravel())


@cache
def untouched(stretch: float = 0.0, delay_s: float = 0.0, seed: int = 1) -> np.ndarray:
    """The untouched plate, (channels, samples), not to be written to: delayed and dispersed echoes of the chirp.

    It is stretched exactly. A plate whose resonances have risen by a share answers at f what it answered at
    f / (1 + share).
    """
    rng = np.random.default_rng(seed)
    n, chirp = 2048, RIG.chirp
    t_s, f_hz = np.arange(n) / RIG.sample_rate_hz, np.fft.rfftfreq(n, 1 / RIG.sample_rate_hz)
    sweep = (chirp.stop_hz - chirp.start_hz) / chirp.duration_s
    emitted = np.sin(2 * np.pi * (chirp.start_hz + sweep * t_s / 2) * t_s) * (t_s < chirp.duration_s)
    way_mm = rng.uniform(50, 1000, (RIG.channels, 12, 1))
    share = rng.normal(size=way_mm.shape) * np.exp(-way_mm / 500)
    answer = (share * np.exp(-1j * wavenumber_rad_mm(f_hz / (1 + stretch)) * way_mm)).sum(axis=1)
    heard = np.fft.irfft(np.fft.rfft(emitted) * answer * np.exp(-2j * np.pi * f_hz * delay_s), n)
    found = np.asarray(1000 * heard[:, : RIG.samples])
    found.flags.writeable = False
    return found


@cache
def make_atlas(field: Field) -> Atlas:
    """The field as the daemon has it: sampled on the grid, as coefficients of B-splines; one for all tests."""
    beyond = 8  # nodes that the filter needs before the mirror is forgotten; two of them stay
    x, y = (np.arange(LOW_MM[i] - beyond * STEP_MM, HIGH_MM[i] + (beyond + 0.5) * STEP_MM, STEP_MM) for i in (0, 1))
    grid = np.array([[features_of(field.value(x_mm, y_mm)) for x_mm in x] for y_mm in y])
    for axis in (0, 1):
        grid = spline_filter1d(grid, 3, axis=axis, mode="mirror")
    cut = slice(beyond - 2, 2 - beyond)
    description = AtlasDescription(
        acquisition=RIG, plate=PLATE, bins=BINS, step_mm=STEP_MM, origin_mm=(x[beyond - 2], y[beyond - 2]),
        low_mm=LOW_MM, high_mm=HIGH_MM, touches=1000, scores={"rmse_mm": 0.1}, seed=3,
    )  # fmt: skip
    return Atlas(
        description, np.ascontiguousarray(grid[cut, cut], np.float32), untouched().astype(np.float32),
        np.full((RIG.channels, len(BINS)), (0.01 * COUNTS) ** 2, np.float32),
    )  # fmt: skip


@cache
def yielding() -> Atlas:
    """An atlas on a plate that yields by a share of 0.3, which has waves as the field has."""
    atlas = make_atlas(Field())
    rows, columns, _ = atlas.coefficients.shape
    y, x = np.mgrid[:rows, :columns]
    phases = 0.9 * x + np.arange(len(BINS))[:, None, None], 0.7 * y - 0.4 * np.arange(len(BINS))[:, None, None]
    share = 0.15 * (np.exp(1j * phases[0]) + np.exp(-1j * phases[1]))
    parts = np.concatenate([share.real, share.imag])
    for axis in (1, 2):
        parts = spline_filter1d(parts, 3, axis=axis, mode="mirror")
    return replace(atlas, yields=np.ascontiguousarray(parts.transpose(1, 2, 0), np.float32))


LOAD = 0.4
"""Of the reference touch, over what makes its share of the wave 1 / 2 at a resonance."""


@cache
def scattering(*, lossy: bool = False) -> Atlas:
    """An atlas on a plate that yields, and whose 24 modes tell how contacts scatter; complex ones if `lossy`."""
    rng, atlas, lines, n = np.random.default_rng(11), yielding(), 3 * len(BINS), 24
    step_mm, x0_mm, y0_mm = 5.0, -2.5, -2.5
    x, y = (coordinate.ravel()[:, None] for coordinate in np.mgrid[0:28, 0:22])
    kx, ky = rng.uniform(0.1, 0.9, (2, n))
    shapes = np.cos(kx * x + rng.uniform(0, 6, n)) * np.cos(ky * y + rng.uniform(0, 6, n))
    shapes = np.ascontiguousarray((shapes * np.exp(0.2j * (lossy and kx * x))).reshape(28, 22, n).swapaxes(0, 1))
    poles, at = np.linspace(1, 3, n)[:, None] ** 2, np.linspace(1, 3, lines)
    receptance = 1 / (poles * (1 + 0.05j) - at**2)
    mix = rng.normal(size=(lines, len(BINS))) + 1j * rng.normal(size=(lines, len(BINS)))
    discs = rng.normal(size=(n, 1 + RIG.channels)) * np.exp(0.1j * rng.normal(size=(n, 1 + RIG.channels)))
    modes = PlateModes(
        shapes if lossy else shapes.real.copy(), (step_mm, x0_mm, y0_mm), discs if lossy else discs.real.copy(),
        receptance, LOAD / np.abs(receptance).max() * at * 1j, np.tile(0.5 * COUNTS + 0j, (RIG.channels, lines)),
        np.block([[mix.real, mix.imag], [-mix.imag, mix.real]]),
    )  # fmt: skip
    return replace(atlas, modes=_cast(modes, np.float32))


def _cast(modes: PlateModes, dtype: type) -> PlateModes:
    of_complex = np.result_type(dtype, np.complex64)

    def cast(part: np.ndarray) -> np.ndarray:
        return part.astype(of_complex if np.iscomplexobj(part) else dtype)

    shapes, grid_mm, *others = modes
    return PlateModes(cast(shapes), grid_mm, *map(cast, others))


def in_double(atlas: Atlas) -> Atlas:
    """The same atlas in float64, as is all that is computed with it."""
    return replace(
        atlas, coefficients=atlas.coefficients.astype(np.float64), baseline=atlas.baseline.astype(np.float64),
        error=atlas.error.astype(np.float64), modes=_cast(atlas.modes, np.float64) if atlas.modes else None,
    )  # fmt: skip


def bins_of(features: np.ndarray, mask: np.ndarray | None = None, dtype: type = np.float32) -> Bins:
    """Features (channels * 2 * bins,) as the solver takes them; those that are masked are zero."""
    vector: np.ndarray = (features if mask is None else features * mask).astype(dtype)
    return Bins(vector, None if mask is None else mask.astype(dtype), float(vector @ vector))


def look_up(atlas: Atlas, x_mm: float, y_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The atlas' field and its derivatives in float64, each (channels * bins,), from the splines' definition."""
    d = atlas.description

    def weights(at_mm: float, origin_mm: float, count: int) -> tuple[np.ndarray, np.ndarray]:
        off = (at_mm - origin_mm) / d.step_mm - np.arange(count)
        far = np.abs(off)
        value = np.where(far < 1, 2 / 3 - far**2 + far**3 / 2, np.where(far < 2, (2 - far) ** 3 / 6, 0.0))
        slope = np.where(far < 1, 1.5 * far**2 - 2 * far, np.where(far < 2, -((2 - far) ** 2) / 2, 0.0)) * np.sign(off)
        return value, slope / d.step_mm

    rows, columns, _ = atlas.coefficients.shape
    (wx, dx), (wy, dy) = weights(x_mm, d.origin_mm[0], columns), weights(y_mm, d.origin_mm[1], rows)
    nodes = atlas.coefficients
    u, u_x, u_y = (as_complex(_sum(nodes, a, b)) for a, b in ((wx, wy), (dx, wy), (wx, dy)))
    return u, u_x, u_y


def _sum(nodes: np.ndarray, along_x: np.ndarray, along_y: np.ndarray) -> np.ndarray:
    rows, columns = along_y != 0, along_x != 0
    return np.asarray(np.einsum("r,c,rcm->m", along_y[rows], along_x[columns], nodes[rows][:, columns].astype(float)))


def as_complex(features: np.ndarray) -> np.ndarray:
    """Features (channels * 2 * bins,) as complex bins, (channels * bins,)."""
    parts = features.reshape(RIG.channels, 2, -1)
    return np.asarray((parts[:, 0] + 1j * parts[:, 1]).ravel())


def gauss_newton(
    atlas: Atlas, features: np.ndarray, positions_mm: np.ndarray, steps: int = 20
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 2) and amplitudes (n,) by plain Gauss-Newton over both together, in float64.

    The fast path eliminates the amplitudes; this leads to the same minimum another way.
    """
    data, positions = as_complex(features), positions_mm.astype(np.float64).copy()
    u = np.stack([look_up(atlas, *position)[0] for position in positions], axis=1)
    z = np.linalg.lstsq(u, data, rcond=None)[0]
    for _ in range(steps):
        looked = [look_up(atlas, *position) for position in positions]
        left = data - sum(s * u for s, (u, _, _) in zip(z, looked, strict=True))
        columns = [(s * u_x, s * u_y, u, 1j * u) for s, (u, u_x, u_y) in zip(z, looked, strict=True)]
        slope = np.concatenate([np.stack(four, axis=1) for four in columns], axis=1)
        system, right = np.concatenate([slope.real, slope.imag]), np.concatenate([left.real, left.imag])
        move = np.linalg.lstsq(system, right, rcond=None)[0].reshape(-1, 4)
        positions += move[:, :2]
        z = z + move[:, 2] + 1j * move[:, 3]
        if np.abs(move[:, :2]).max() < 1e-9:
            break
    return positions, z
