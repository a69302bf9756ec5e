"""Response of the plate between its discs, and its change by contacts, at fixed complex frequencies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.physics import chebyshev, legendre
from touchd.twin.physics.finger import Contact, impedance
from touchd.twin.physics.plate import size_m
from touchd.twin.physics.transducer import LoadedModes

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

FEW = 5
"""Number of contacts up to which multiple scattering costs less than receptances. Above it, as for a palm, scattering
is computed at a few temperatures only."""
SMOOTH = 0.02
"""Relative range of modes' frequencies over which a contact's change is smooth, because of damping."""


class Response:
    """Receptances of a plate with its discs: F frequencies, R receivers, M modes.

    A mode answers a force of frequency nu with 1 / (omega^2 (1 + i loss) - nu^2).

    Parameters
    ----------
    plate : Plate
    modes : LoadedModes
    nu_rad_s : array_like of shape (F,)
        Angular frequencies, real or complex; a negative imaginary part damps the time signal.
    loss : float
        Loss factor of the mounted plate.
    """

    def __init__(self, plate: Plate, modes: LoadedModes, nu_rad_s: ArrayLike, loss: float) -> None:
        self.plate = plate
        self.modes = modes
        self.nu_rad_s = np.asarray(nu_rad_s, dtype=np.complex128)
        H = 1 / (modes.omega_rad_s**2 * (1 + 1j * loss) - self.nu_rad_s[:, None] ** 2)
        # Shapes are real: stacking the parts makes one real product of what would be two.
        self._kernel = np.concatenate([H.real, H.imag])
        self._w = modes.w.reshape(len(modes.w), -1)

    def shape_at(self, x_mm: Floats, y_mm: Floats, area_mm2: Floats) -> Floats:
        """Deflection of each mode averaged over discs; all of shape (n,), result (M, n).

        Raises
        ------
        SimulationError
            When a disc is not wholly on the plate.
        """
        radius = np.sqrt(area_mm2 / np.pi)
        edge = np.minimum(np.minimum(x_mm, self.plate.width_mm - x_mm), np.minimum(y_mm, self.plate.height_mm - y_mm))
        if np.any(edge < radius) or not np.all(np.isfinite(edge)):
            i = int(np.argmin(edge - radius))
            raise SimulationError(
                f"a contact of {radius[i]:.1f} mm radius at ({x_mm[i]:.1f}, {y_mm[i]:.1f}) mm reaches over the edge",
                "contact",
                "move it inwards",
            )
        _, nx, ny = self.modes.w.shape
        centre = np.stack([x_mm, y_mm], axis=1) * 1e-3
        products = legendre.disc_average(centre, radius * 1e-3, size_m(self.plate), (nx, ny))
        return np.asarray(self._w @ products.reshape(len(x_mm), -1).T)

    def receptance(self, one: Floats, other: Floats) -> Complex:
        """Sum over modes of `one` times `other`, both (M, ...), times the modes' response; result (F, ...)."""
        product = one * other
        flat = self._kernel @ product.reshape(len(product), -1)
        half = len(flat) // 2
        return np.asarray(flat[:half] + 1j * flat[half:]).reshape(half, *product.shape[1:])

    def untouched(self) -> Complex:
        """Response of each receiver to the emitter, shape (R, F)."""
        discs = self.modes.discs
        return self.receptance(discs[:, :1], discs[:, 1:]).T

    def change(self, touches: Sequence[Sequence[Contact]], scale: Floats) -> Complex:
        """Change of the response by contacts, for n touches of the same number c of contacts each.

        Exact, multiple scattering included: -g_rc (1 + z g_cc)^-1 z g_ce with z = i omega Z (Woodbury's identity).
        Equal touches share their receptances. `scale` (n,) is the factor s of all the modes' frequencies: the response
        at omega = s nu is that at nu, divided by s^2. The result (n, R, F) is at the angular frequencies s nu.
        """
        which = {touch: k for k, touch in enumerate(dict.fromkeys(tuple(touch) for touch in touches))}
        distinct, rows = list(which), np.array([which[tuple(touch)] for touch in touches])
        shape = self._shapes(distinct)
        discs = self.modes.discs
        to_discs = self.receptance(shape[..., None], discs[:, None, None, :])  # (F, distinct, c, 1 + R)
        i, j = np.triu_indices(shape.shape[2])
        pairs = self.receptance(shape[..., i], shape[..., j])  # (F, distinct, pairs)
        if shape.shape[2] <= FEW:
            return self._scattered([distinct[k] for k in rows], scale, to_discs[:, rows], pairs[:, rows])
        result = np.empty((len(rows), discs.shape[1] - 1, len(self.nu_rad_s)), dtype=complex)
        for k, touch in enumerate(distinct):
            mine = np.flatnonzero(rows == k)
            at = _few_scales(scale[mine])
            some = self._scattered([touch] * len(at), at, to_discs[:, [k] * len(at)], pairs[:, [k] * len(at)])
            result[mine] = np.tensordot(chebyshev.weights(scale[mine], at), some, 1) if len(at) < len(mine) else some
        return result

    def _shapes(self, touches: Sequence[Sequence[Contact]]) -> Floats:
        """Deflection of each mode under each of c contacts of n touches, shape (M, n, c)."""
        table = np.array([[contact[:3] for contact in touch] for touch in touches], dtype=float)
        return self.shape_at(*table.reshape(-1, 3).T).reshape(-1, *table.shape[:2])

    def _scattered(
        self, touches: Sequence[Sequence[Contact]], scale: Floats, to_discs: Complex, pairs: Complex
    ) -> Complex:
        """Change of the response, as `change` has it, from receptances of shape (F, n, c, 1 + R) and (F, n, pairs)."""
        n, c, F = len(touches), len(touches[0]), len(self.nu_rad_s)
        area_mm2 = np.array([[contact.area_mm2 for contact in touch] for touch in touches])
        # i omega Z(omega) / s^2 at omega = s nu, shape (n, c, F)
        z = np.empty((n, c, F), dtype=complex)
        for kind in {contact.kind for touch in touches for contact in touch}:
            chosen = np.array([[contact.kind == kind for contact in touch] for touch in touches])
            s = np.broadcast_to(scale[:, None], (n, c))[chosen][:, None]
            z[chosen] = 1j * self.nu_rad_s / s * impedance(kind, s * self.nu_rad_s, area_mm2[chosen][:, None])
        if c == 1:
            strength = z[:, 0].T / (1 + z[:, 0].T * pairs[..., 0]) * to_discs[..., 0, 0]  # (F, n)
            change = -strength[..., None] * to_discs[..., 0, 1:]
        else:
            i, j = np.triu_indices(c)
            between = np.empty((F, n, c, c), dtype=complex)
            between[..., i, j] = between[..., j, i] = pairs
            z_last = z.transpose(2, 0, 1)
            force = np.linalg.solve(np.eye(c) + z_last[..., None] * between, (z_last * to_discs[..., 0])[..., None])
            change = -(force * to_discs[..., 1:]).sum(axis=-2)
        return np.asarray(change.transpose(1, 2, 0) / scale[:, None, None] ** 2)


def _few_scales(scale: Floats) -> Floats:
    """Return fewer factors, from which the responses at all of `scale` interpolate to 1e-12, or all factors."""
    low, high = float(scale.min()), float(scale.max())
    reach = (high - low) / 2
    count = 1
    while (reach / SMOOTH) ** count > 1e-12:
        count += 1
    return chebyshev.points((low + high) / 2, reach, count) if count < len(scale) else scale
