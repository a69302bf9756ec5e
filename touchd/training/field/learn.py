"""Learn the residual field: the bins of a touch of amplitude 1 at any position.

In a bin of frequency f the residual of a touch at (x, y) is a complex amplitude z times the product of two waves of the
plate. The product has no spatial frequency above 2 k(f), k from the plate's dispersion. So kernel ridge regression
interpolates the field between the recorded touches; see `touchd.training.field.regression` for the prior.

Only the product of amplitude and field is observable, so the two are fitted in turn. An amplitude fits the field of all
touches best, in a few bins, because it changes slowly along the band. Amplitude errors are common to all bins and move
positions accordingly, so the fit must converge. That takes many rounds. They are cheap: at fixed weights the field is
linear in the touches, so the inverse of each system serves many rounds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter1d

from touchd.training.field.leave_one_out import (
    LEAST_LABEL_NOISE_MM,
    Displaced,
    choose,
    displacements,
    label_noise_mm,
    replaced,
)
from touchd.training.field.regression import Array, Complex, Floats, Prior, Regression, Touches, each, smooth

Step = Callable[[int, int], None]
Hat = tuple[Array, Array]
"""Inverse of a bin's system, and the diagonal term added to it."""

Known = Callable[[int, Floats], Complex]
"""Maps a bin and positions (m, 2) in mm to a known part of the field, shape (m, channels), ADC counts."""

STEP_MM = 2.5
"""Spacing of the grid: a third of the shortest wavelength of the field on 5 mm glass at 100 kHz."""
BEYOND_NODES = 2
"""Nodes beyond the edge on each side, so that every position has its four neighbours."""
FILTER_NODES = 6
"""Further nodes, in which the spline filter may err: its error decays by 3.7 per node."""
OUTER_ROUNDS = 3
"""Rounds that update the touches' weights from their amplitudes."""
INNER_ROUNDS = 20
AMPLITUDE_BINS = 7
RELABEL_ROUNDS = 3
MOST_NOISE = 0.1
"""Largest noise share of a bin used for amplitudes."""
FIELD_ERROR = 3e-3
"""Share of the field's power that the field misses, beside the noise, in the weights of the bins."""
STEEPNESS = 0.1
"""Weight of the prior against a strong change along the band, which a weak touch cannot determine."""
WEAKEST = 0.05


@dataclass(frozen=True, slots=True)
class Field:
    """Cubic B-spline coefficients of the field on a grid over the touched part of the plate."""

    coefficients: Array
    """Shape (rows, columns, channels, 2, bins): real and imaginary parts, in the features' order."""
    origin_mm: tuple[float, float]
    """x and y of the first node."""
    low_mm: tuple[float, float]
    high_mm: tuple[float, float]
    """Corners of the touched part; the field is unknown beyond it."""
    amplitude: Array
    """|z| of each training touch, shape (n,), 1 on average."""


@dataclass(frozen=True, slots=True)
class Learned:
    """A field and by-products of learning it."""

    field: Field
    position_mm: Floats
    """Corrected positions of the training touches, shape (n, 2)."""
    amplitude: Complex
    """Their amplitudes, averaged over the bins, shape (n,)."""
    prior: Prior
    label_noise_mm: float
    """Deviation of the label error per axis; 0 if not distinguishable from the field's error."""


def learn_thoroughly(touches: Touches, wavenumber_per_mm: Floats, progress: Step = lambda _done, _all: None) -> Learned:
    """Learn the field, choose its prior, and correct label errors."""
    steps = Steps(progress)
    learner = Learner(touches, Prior(wavenumber_per_mm), steps)
    steps.all = OUTER_ROUNDS * len(learner.chosen) + touches.values.shape[2]
    amplitude = learner.converge(OUTER_ROUNDS - 1)
    learner.take(touches, choose(touches, learner.prior, amplitude, learner.chosen))
    amplitude = learner.converge(1, amplitude)
    displaced = learner.displacements(amplitude)
    noise_mm = label_noise_mm(displaced)
    rounds = RELABEL_ROUNDS if noise_mm >= LEAST_LABEL_NOISE_MM else 0
    steps.all += rounds * len(learner.chosen)
    for _ in range(rounds):
        position_mm = replaced(touches.position_mm, learner.touches.position_mm, displaced, noise_mm)
        better = replace(touches, position_mm=position_mm)
        learner.take(better, choose(better, learner.prior, amplitude, learner.chosen))
        amplitude = learner.converge(1, amplitude)
        displaced = learner.displacements(amplitude)
    mean = np.asarray(amplitude.mean(axis=1), np.complex64)
    known_mm = learner.touches.position_mm
    return Learned(learner.draw(amplitude), known_mm, mean, learner.prior, noise_mm if rounds else 0.0)


class Steps:
    """Counts the steps of a learner up to `all`; `progress` receives the steps done and the steps in all."""

    def __init__(self, progress: Step) -> None:
        self._progress = progress
        self._done = self.all = 0

    def __call__(self) -> None:
        """Count a step."""
        self._done += 1
        self._progress(self._done, self.all)


class Learner:
    """Learns amplitudes and fields together; calls `advance` after each bin of a round, and of `draw`."""

    def __init__(self, touches: Touches, prior: Prior, advance: Callable[[], None] = lambda: None) -> None:
        self.take(touches, prior)
        self.chosen = self._informative()
        self._hats: list[Hat] = []
        self._advance = advance

    def take(self, touches: Touches, prior: Prior) -> None:
        """Replace positions or prior."""
        self.touches, self.prior = touches, prior
        self._regression = Regression(touches, prior)

    def converge(self, rounds: int, amplitude: Complex | None = None) -> Complex:
        """Return the touches' amplitudes along the band after `rounds` rounds, shape (n, bins)."""
        r, chosen = self._regression, self.chosen
        values = r.touches.values
        if amplitude is None:
            amplitude = np.ones((len(values), values.shape[2]), np.complex64)
        deviation = np.sqrt(r.touches.noise + FIELD_ERROR * r.scale[chosen] ** 2)
        weight, slope = (1 / deviation).astype(np.float32), along_band(amplitude.shape[1])[chosen]
        values = values[:, :, chosen]
        for _ in range(rounds):
            self._hats = []  # free the memory of the last inverses first
            self._hats = each(partial(_hat, r, amplitude), chosen, self._advance)
            for _ in range(INNER_ROUNDS):
                predicted = self._predict(values / amplitude[:, None, chosen])
                amplitude = fit_amplitudes(values * weight, predicted * weight, slope, amplitude.shape[1])
        return amplitude

    def displacements(self, amplitude: Complex) -> Displaced:
        """Return the touches' displacements from their assumed positions; call after `converge`."""
        return displacements(self._regression, amplitude, self.chosen, [inverse for inverse, _ in self._hats])

    def draw(self, amplitude: Complex, known: Known | None = None) -> Field:
        """Evaluate the field on its grid; `known` adds a part that was subtracted from the touches."""
        r = self._regression
        self._hats = []
        low, high = r.touches.position_mm.min(axis=0), r.touches.position_mm.max(axis=0)
        beyond = BEYOND_NODES + FILTER_NODES
        x_mm, y_mm = (np.arange(low[i] - beyond * STEP_MM, high[i] + (beyond + 1) * STEP_MM, STEP_MM) for i in (0, 1))
        nodes_mm = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
        inside = slice(FILTER_NODES, -FILTER_NODES)

        def one(b: int) -> Array:
            field = r.at(b, r.weights(b, amplitude[:, b]), nodes_mm)
            if known is not None:
                field = field + known(b, nodes_mm)
            grid = np.stack([field.real, field.imag], axis=-1).reshape(len(y_mm), len(x_mm), -1, 2)
            for axis in (0, 1):
                grid = spline_filter1d(grid, 3, axis=axis, output=np.float32, mode="mirror")
            return np.asarray(grid[inside, inside])

        return Field(
            coefficients=np.ascontiguousarray(np.stack(each(one, range(amplitude.shape[1]), self._advance), axis=-1)),
            origin_mm=(float(x_mm[FILTER_NODES]), float(y_mm[FILTER_NODES])),
            low_mm=(float(low[0]), float(low[1])),
            high_mm=(float(high[0]), float(high[1])),
            amplitude=np.abs(amplitude).mean(axis=1).astype(np.float32),
        )

    def _predict(self, unit: Complex) -> Complex:
        def one(i: int) -> Complex:
            inverse, penalty = self._hats[i]
            targets = np.ascontiguousarray(unit[:, :, i]).view(np.float32)
            return smooth(inverse, penalty, targets).view(np.complex64)

        return np.stack(each(one, range(len(self._hats))), axis=-1)

    def _informative(self) -> NDArray[np.int64]:
        """Return bins spread over the part of the band with little noise."""
        r = self._regression
        clear = np.flatnonzero(r.touches.noise < MOST_NOISE * r.scale**2)
        last = clear[-1] if len(clear) else len(r.scale) - 1
        return np.unique(np.linspace(0, last, AMPLITUDE_BINS).round().astype(np.int64))


def along_band(bins: int) -> Floats:
    """Return -1 to 1 along the band, shape (bins,)."""
    return np.linspace(-1.0, 1.0, bins)


def fit_amplitudes(values: Complex, predicted: Complex, slope: Floats, bins: int) -> Complex:
    """Fit each touch's amplitude along the whole band, linear in frequency, shape (n, bins).

    `values` and `predicted`, of shape (n, channels, chosen), are touches and field in the chosen bins, with equal
    weights; `slope`, of shape (chosen,), is the position of these bins along the band, from -1 to 1.
    """
    n = len(values)
    # Two unknowns per touch, z = p + q s: least squares over channels and bins.
    basis = np.stack([predicted, predicted * slope.astype(np.float32)], axis=-1).reshape(n, -1, 2)
    gram = np.einsum("nki,nkj->nij", basis.conj(), basis)
    gram[:, 1, 1] += STEEPNESS * gram[:, 0, 0]
    right = np.einsum("nki,nk->ni", basis.conj(), values.reshape(n, -1))
    p, q = np.linalg.solve(gram, right[..., None])[..., 0].T
    amplitude = p[:, None] + q[:, None] * along_band(bins)
    # Normalise the mean amplitude; the field absorbs the factor.
    amplitude /= np.mean(np.abs(p)) * np.exp(1j * np.angle(p.sum()))
    amplitude[np.abs(amplitude) < WEAKEST] = WEAKEST
    found: Complex = amplitude.astype(np.complex64)
    return found


def _hat(regression: Regression, amplitude: Complex, b: int) -> Hat:
    return regression.inverse(b, amplitude[:, b]), regression.penalty(b, amplitude[:, b])
