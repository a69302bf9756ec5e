"""What the solvers take and return: the bins of a frame, the fingers that explain them, and work in pieces.

Work that goes on in the next frame is a generator that yields what each piece of it has cost. Cost is counted and never
timed, so that a recording gives the same contacts at any speed. The unit is one look-up of one finger's field in a fit
of several: about 0.03 ms.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from typing import TypeVar

import numpy as np
from msgspec import Struct

from touchd.localization.atlas import Array
from touchd.localization.joint import blocks
from touchd.localization.spline import Position, Shape

Matrix = Sequence[Sequence[float]]
T = TypeVar("T")
Steps = Generator[float, None, T]
"""Yields the cost of each piece, and returns the result."""
SHAPE_COST = 2.0
"""Cost of one step of one contact whose shape is fitted too, in look-ups."""
SCAN_COST, REST_COST = 5.0, 1.0
"""Cost of a scan of the atlas, whose tables are seldom in a cache, and of a residual."""


class Bins(Struct, gc=False, frozen=True):
    """The bins of one frame, as the solver takes them."""

    vector: Array
    """Shape (channels * 2 * bins,), ADC counts; zero where the mask is."""
    mask: Array | None
    """0 for each value left out, 1 for the others; None if all are in use."""
    energy: float
    """Of the vector, counts squared."""

    def copy(self) -> Bins:
        """Return bins that stay valid after the frame."""
        return Bins(self.vector.copy(), self.mask, self.energy)

    def without(self, scattered: Array) -> Bins:
        """Return the bins less what a fit's contacts add to each other's fields."""
        vector = self.vector - scattered
        return Bins(vector, self.mask, float(vector @ vector))


class Fit(Struct, gc=False, frozen=True):
    """Fingers that explain a frame."""

    positions_mm: list[Position]
    amplitudes: list[complex]
    energies: list[float]
    """|z u|^2 of each finger, ADC counts squared."""
    fisher_information: Matrix
    """Re(J^H J) with the amplitudes projected out, for x and y of each finger in turn, 2c rows of 2c: its inverse times
    the noise variance of a value is the covariance of the positions in mm^2."""
    residual_energy: float
    """Energy that the fingers do not explain, ADC counts squared."""
    shapes: Sequence[Sequence[complex]] = ()
    """Of each finger what `contact_model` adds: slope along the band, u_xx, u_yy, u_xy; none of points."""
    turns: Sequence[complex] = ()
    """Of each finger with a shape, its amplitude as a point's over its own, on average over the bins; none of
    points."""
    points_energy: float = 0.0
    """What as many points leave, of a fit with shapes."""
    shares: Sequence[float] = ()
    """Of the information on each finger's position, what is left when its shape must be found too; none if all is."""
    scattered: Array | None = None
    """What its fingers add to each other's fields, as the bins have it: it was taken out of them first."""


Fitted = tuple[Bins, Fit]
"""A frame's bins, less what is no finger's, and what is fitted to them."""


def finish(steps: Steps[T]) -> T:
    """Take all pieces of work at once."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            found: T = end.value
            return found


def no_fit(energy: float) -> Fit:
    """Return the fit of no fingers, which leaves all energy unexplained."""
    return Fit([], [], [], (), energy)


def shapes_of(fit: Fit) -> list[Shape]:
    """Return the shapes of a fit's fingers, over their amplitudes; none of points."""
    return [
        tuple([part / z for part in shape]) if z else (0j,) * 4
        for z, shape in zip(fit.amplitudes, fit.shapes, strict=False)
    ]


def as_points(amplitudes: Sequence[complex], turns: Sequence[complex]) -> Sequence[complex]:
    """Return fingers' amplitudes as points'; `turns` are those of a fit."""
    return [z * turn for z, turn in zip(amplitudes, turns, strict=True)] if turns else amplitudes


def sizes_of(amplitudes: Sequence[complex], turns: Sequence[complex]) -> list[float]:
    """Return how heavy fingers are: the moduli of their amplitudes, as points'; `turns` are those of a fit."""
    return list(map(abs, as_points(amplitudes, turns)))


def sigmas_mm(fisher_information: Matrix, variance: float) -> list[float]:
    """Return each finger's standard error per axis, mm: the root mean square over both axes.

    Parameters
    ----------
    fisher_information : matrix
        Of a `Fit`.
    variance : float
        Of the noise of a value, counts squared.
    """
    if len(fisher_information) == 2:  # one finger, the usual case
        (a, b), (_, c) = fisher_information
        det = a * c - b * b
        return [math.sqrt(variance * (a + c) / (2 * det)) if det > 0 < a else math.inf]
    if len(fisher_information) == 4:
        return [
            math.sqrt(variance * (a + c) / (2 * det)) if (det := a * c - b * b) > 0 < a else math.inf
            for a, b, c in blocks(fisher_information)
        ]
    try:
        spread = np.linalg.inv(np.array(fisher_information)).diagonal().tolist()
    except np.linalg.LinAlgError:
        return [math.inf] * (len(fisher_information) // 2)
    pairs = [variance * (x + y) / 2 for x, y in zip(spread[::2], spread[1::2], strict=True)]
    return [math.sqrt(pair) if pair > 0 else math.inf for pair in pairs]
