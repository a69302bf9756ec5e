"""One Gauss-Newton step of several fingers at once, from the products of their fields: amplitudes first, then moves.

Two fingers, the usual case, are solved on plain numbers: library calls on matrices as small take three times as long.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Products = NDArray[np.complex128]
DAMPING = 1e-3
RIDGE = 1e-6
"""Shares added to the normal equations' diagonals: fields may be alike, or flat."""
_TINY = 1e-30
Block = tuple[float, float, float]
"""A symmetric matrix of 2 x 2: xx, xy, yy."""


class Step(NamedTuple):
    """What c fingers' best amplitudes leave to be gained by moving them."""

    amplitudes: list[complex]
    information: list[list[float]]
    """As in a fit."""
    gradient: list[float]
    """Of x and y of each finger in turn."""
    move: list[float]
    """The step, mm, in the same order."""
    changes: list[complex]
    """Of the amplitudes by the step, to first order."""


def step(products: Products) -> Step:
    """Return the step of c fingers.

    Parameters
    ----------
    products : array of shape (3 c, 3 c + 1)
        Of the fields of all fingers, then the slopes by x and y of each in turn, with each other and with the frame.
    """
    return _of_two(products) if len(products) == 6 else _of_several(products)


def _of_several(products: Products) -> Step:
    count = len(products) // 3
    own = products[:count, :count].copy()
    own.ravel()[:: count + 1] += RIDGE / count * own.trace().real
    solved = np.linalg.solve(own, products[:count, count:])
    z = solved[:, -1]
    twice = np.repeat(z, 2)
    # What the amplitudes leave of the products of the slopes with each other, and with the frame.
    left = twice.conj()[:, None] * (products[count:, count:] - products[:count, count:-1].conj().T @ solved)
    left[:, :-1] *= twice
    information, gradient = left.real[:, :-1], left.real[:, -1]
    damped = information.copy()
    damped.ravel()[:: 2 * count + 1] *= 1 + DAMPING
    damped.ravel()[:: 2 * count + 1] += _TINY
    move = np.linalg.solve(damped, gradient)
    changes = -solved[:, :-1] @ (twice * move)
    return Step(z.tolist(), information.tolist(), gradient.tolist(), move.tolist(), changes.tolist())


def _of_two(products: Products) -> Step:
    first, second, *slopes = products.tolist()
    ridge = RIDGE / 2 * (first[0].real + second[1].real)
    a, b, d = first[0].real + ridge, first[1], second[1].real + ridge
    det = max(a * d - (b * b.conjugate()).real, _TINY)
    a, b, d = a / det, b / det, d / det
    of_first, of_second, turned = first[2:], second[2:], b.conjugate()
    solved = [(d * one - b * two, a * two - turned * one) for one, two in zip(of_first, of_second, strict=True)]
    z, other = solved[-1]
    scales = z, z, other, other
    rows, gradient = [], []
    for i, row in enumerate(slopes):
        scale, one, two = scales[i].conjugate(), of_first[i].conjugate(), of_second[i].conjugate()
        left = [scale * (row[2 + j] - one * solved[j][0] - two * solved[j][1]) for j in range(i, 5)]
        gradient.append(left.pop().real)
        rows.append([(part * scales[i + j]).real for j, part in enumerate(left)])
    (xx, xy, xv, xw), (yy, yv, yw), (vv, vw), (ww,) = rows
    information = [[xx, xy, xv, xw], [xy, yy, yv, yw], [xv, yv, vv, vw], [xw, yw, vw, ww]]
    more = 1 + DAMPING
    own = inverse((xx * more + _TINY, xy, yy * more + _TINY))
    # The other finger's equations without this one's unknowns.
    p, q = (
        (own[0] * xv + own[1] * yv, own[1] * xv + own[2] * yv),
        (own[0] * xw + own[1] * yw, own[1] * xw + own[2] * yw),
    )
    rest = inverse((
        vv * more + _TINY - xv * p[0] - yv * p[1], vw - xv * q[0] - yv * q[1], ww * more + _TINY - xw * q[0] - yw * q[1]
    ))  # fmt: skip
    g_x, g_y, g_v, g_w = gradient
    g_v, g_w = g_v - p[0] * g_x - p[1] * g_y, g_w - q[0] * g_x - q[1] * g_y
    v, w = rest[0] * g_v + rest[1] * g_w, rest[1] * g_v + rest[2] * g_w
    g_x, g_y = g_x - xv * v - xw * w, g_y - yv * v - yw * w
    move = [own[0] * g_x + own[1] * g_y, own[1] * g_x + own[2] * g_y, v, w]
    change = other_change = 0j
    for (one, two), scale, length in zip(solved, scales, move, strict=False):
        change -= one * scale * length
        other_change -= two * scale * length
    return Step([z, other], information, gradient, move, [change, other_change])


def inverse(block: Block) -> Block:
    """Return the inverse of a block; zero if it is not positive."""
    xx, xy, yy = block
    det = xx * yy - xy * xy
    return (yy / det, -xy / det, xx / det) if det > 0 and xx > 0 else (0.0, 0.0, 0.0)


def blocks(information: Sequence[Sequence[float]]) -> list[Block]:
    """Return what is left of the information on each of two fingers when the other must be found too."""
    (xx, xy, xv, xw), (_, yy, yv, yw), (_, _, vv, vw), (_, _, _, ww) = information
    left = []
    for own, other, across in (
        ((xx, xy, yy), (vv, vw, ww), (xv, xw, yv, yw)), ((vv, vw, ww), (xx, xy, yy), (xv, yv, xw, yw))
    ):  # fmt: skip
        (a, b, c), (p, q, r), (av, aw, bv, bw) = own, inverse(other), across
        v, w = p * av + q * aw, q * av + r * aw
        left.append((a - av * v - aw * w, b - bv * v - bw * w, c - bv * (p * bv + q * bw) - bw * (q * bv + r * bw)))
    return left
