"""One Gauss-Newton step of the fingers of a frame, from the products of their fields: amplitudes first, then moves.

One finger and two, the usual cases, are solved on plain numbers: library calls on matrices as small take longer.
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
    energies: list[float]
    """|z u|^2 of each finger."""
    explained: float
    """Energy of the frame that the amplitudes explain."""
    information: list[list[float]]
    """As in a fit."""
    gradient: list[float]
    """Of x and y of each finger in turn."""
    move: list[float]
    """The step, mm, in the same order."""
    changes: list[complex]
    """Of the amplitudes by the step, to first order."""


def step_of_one(products: list[float]) -> tuple[complex, float, Block, tuple[float, float], tuple[complex, complex]]:
    """Return what one finger's best amplitude leaves to be gained; `products` are those of `sums_of_one`.

    These are the amplitude, what it explains, information and gradient, and the parts of u_x and u_y along u: to first
    order, what a step of 1 mm adds to the field.
    """
    uu, ud, ud_i, ux, ux_i, uy, uy_i, xx, xy, yy, xd, xd_i, yd, yd_i = products
    if uu <= 0:
        return 0j, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0), (0j, 0j)
    z, z_i, x, x_i, y, y_i = ud / uu, ud_i / uu, ux / uu, ux_i / uu, uy / uu, uy_i / uu
    power = z * z + z_i * z_i
    return (
        complex(z, z_i),
        power * uu,
        (power * (xx - ux * x - ux_i * x_i), power * (xy - ux * y - ux_i * y_i), power * (yy - uy * y - uy_i * y_i)),
        (z * xd + z_i * xd_i - power * ux, z * yd + z_i * yd_i - power * uy),
        (complex(x, x_i), complex(y, y_i)),
    )


def sums_of_one(dtype: np.dtype[np.floating]) -> NDArray[np.floating]:
    """Return what makes complex products of products of real and imaginary parts, shape (48, 14).

    The latter are those of the parts of u, u_x and u_y in turn with these and the frame's d, shape (6, 8). The former
    are uu, ud, ux, uy, xx, xy, yy, xd and yd, each its real part and, unless it is not needed, its imaginary part.
    """
    table = []
    for one, other in ((0, 0), (0, 3), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2), (1, 3), (2, 3)):
        real, imaginary = np.zeros((2, 3, 2, 4, 2), dtype)
        real[one, 0, other, 0] = real[one, 1, other, 1] = imaginary[one, 0, other, 1] = 1
        imaginary[one, 1, other, 0] = -1
        table += [real] if one == other or (one, other) == (1, 2) else [real, imaginary]
    return np.stack([row.reshape(-1) for row in table], axis=1)


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
    norms = own.diagonal().real.copy()
    own.ravel()[:: count + 1] += RIDGE / count * norms.sum()
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
    explained = float((z.conj() @ products[:count, -1]).real)
    return Step(
        z.tolist(), (np.square(np.abs(z)) * norms).tolist(), explained, information.tolist(), gradient.tolist(),
        move.tolist(), changes.tolist(),
    )  # fmt: skip


def _of_two(products: Products) -> Step:
    # Real and imaginary parts in turn: of the fields u and v, then of the slopes of u and of v.
    parts: list[list[float]] = products.view(np.float64).tolist()
    first, second, *slopes = parts
    uu, vv, (ud, ud_i), (vd, vd_i) = first[0], second[2], first[-2:], second[-2:]
    ridge = RIDGE / 2 * (uu + vv) + _TINY
    along_u, t, t_i = uu + ridge, first[2] / (uu + ridge), first[3] / (uu + ridge)
    # v less (t + i t_i) u, its part along u: its energy, and its products with the frame and the slopes.
    along_v = max(vv + ridge - first[2] * t - first[3] * t_i, _TINY)
    wd, wd_i = vd - t * ud - t_i * ud_i, vd_i - t * ud_i + t_i * ud
    z_v, z_vi = wd / along_v, wd_i / along_v
    z_u, z_ui = ud / along_u - t * z_v + t_i * z_vi, ud_i / along_u - t * z_vi - t_i * z_v
    u_root, v_root = along_u**-0.5, along_v**-0.5
    # What of each slope, times its finger's amplitude, lies along u, and along that rest of v.
    sides = []
    for k, z, z_i in ((4, z_u, z_ui), (6, z_u, z_ui), (8, z_v, z_vi), (10, z_v, z_vi)):
        p, p_i = first[k], first[k + 1]
        q, q_i = second[k] - t * p - t_i * p_i, second[k + 1] - t * p_i + t_i * p
        sides.append((
            u_root * (z * p - z_i * p_i), u_root * (z * p_i + z_i * p),
            v_root * (z * q - z_i * q_i), v_root * (z * q_i + z_i * q),
        ))  # fmt: skip
    (ax, bx, cx, dx), (ay, by, cy, dy), (av, bv, cv, dv), (aw, bw, cw, dw) = sides
    ad, bd, cd, dd = u_root * ud, u_root * ud_i, v_root * wd, v_root * wd_i
    of_x, of_y, of_v, of_w = slopes
    u2, v2 = z_u * z_u + z_ui * z_ui, z_v * z_v + z_vi * z_vi
    uv, uv_i = z_u * z_v + z_ui * z_vi, z_u * z_vi - z_ui * z_v
    xx = u2 * of_x[4] - ax * ax - bx * bx - cx * cx - dx * dx
    xy = u2 * of_x[6] - ax * ay - bx * by - cx * cy - dx * dy
    xv = uv * of_x[8] - uv_i * of_x[9] - ax * av - bx * bv - cx * cv - dx * dv
    xw = uv * of_x[10] - uv_i * of_x[11] - ax * aw - bx * bw - cx * cw - dx * dw
    yy = u2 * of_y[6] - ay * ay - by * by - cy * cy - dy * dy
    yv = uv * of_y[8] - uv_i * of_y[9] - ay * av - by * bv - cy * cv - dy * dv
    yw = uv * of_y[10] - uv_i * of_y[11] - ay * aw - by * bw - cy * cw - dy * dw
    v_v = v2 * of_v[8] - av * av - bv * bv - cv * cv - dv * dv
    vw = v2 * of_v[10] - av * aw - bv * bw - cv * cw - dv * dw
    ww = v2 * of_w[10] - aw * aw - bw * bw - cw * cw - dw * dw
    g_x = z_u * of_x[12] + z_ui * of_x[13] - ax * ad - bx * bd - cx * cd - dx * dd
    g_y = z_u * of_y[12] + z_ui * of_y[13] - ay * ad - by * bd - cy * cd - dy * dd
    g_v = z_v * of_v[12] + z_vi * of_v[13] - av * ad - bv * bd - cv * cd - dv * dd
    g_w = z_v * of_w[12] + z_vi * of_w[13] - aw * ad - bw * bd - cw * cd - dw * dd
    information = [[xx, xy, xv, xw], [xy, yy, yv, yw], [xv, yv, v_v, vw], [xw, yw, vw, ww]]
    x, y, v, w = move = _solve(information, [g_x, g_y, g_v, g_w])
    of_rest, of_rest_i = (
        v_root * (cx * x + cy * y + cv * v + cw * w), v_root * (dx * x + dy * y + dv * v + dw * w)
    )  # fmt: skip
    of_u, of_u_i = (
        u_root * (ax * x + ay * y + av * v + aw * w), u_root * (bx * x + by * y + bv * v + bw * w)
    )  # fmt: skip
    return Step(
        [complex(z_u, z_ui), complex(z_v, z_vi)], [u2 * uu, v2 * vv],
        z_u * ud + z_ui * ud_i + z_v * vd + z_vi * vd_i, information, [g_x, g_y, g_v, g_w], move,
        [complex(t * of_rest - t_i * of_rest_i - of_u, t * of_rest_i + t_i * of_rest - of_u_i),
         complex(-of_rest, -of_rest_i)],
    )  # fmt: skip


def _solve(information: list[list[float]], gradient: list[float]) -> list[float]:
    """Return the damped move of two fingers."""
    (xx, xy, xv, xw), (_, yy, yv, yw), (_, _, vv, vw), (_, _, _, ww) = information
    g_x, g_y, g_v, g_w = gradient
    more = 1 + DAMPING
    a, b, c = inverse((xx * more + _TINY, xy, yy * more + _TINY))
    # The other finger's equations without this one's unknowns.
    p, q, r, s = a * xv + b * yv, b * xv + c * yv, a * xw + b * yw, b * xw + c * yw
    d, e, f = inverse((
        vv * more + _TINY - xv * p - yv * q, vw - xv * r - yv * s, ww * more + _TINY - xw * r - yw * s
    ))  # fmt: skip
    g_v, g_w = g_v - p * g_x - q * g_y, g_w - r * g_x - s * g_y
    v, w = d * g_v + e * g_w, e * g_v + f * g_w
    g_x, g_y = g_x - xv * v - xw * w, g_y - yv * v - yw * w
    return [a * g_x + b * g_y, b * g_x + c * g_y, v, w]


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
