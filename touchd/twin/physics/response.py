"""Response of the plate between its discs, and its change by contacts, at fixed complex frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.physics import chebyshev, legendre, pressing
from touchd.twin.physics.contact import COMPLIANT_FREQUENCIES, RIGID_FREQUENCIES, face_of, impedance_of
from touchd.twin.physics.finger import Contact, is_compliant
from touchd.twin.physics.mounting import Attachment
from touchd.twin.physics.plate import size_m
from touchd.twin.physics.transducer import LoadedModes

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

FEW = 5
"""Number of contacts up to which multiple scattering costs less than receptances. Above it, as for a palm, scattering
is computed at a few temperatures only."""
SMALL_DISC = (1, 4)
"""Rule for the averages over the discs of a compliant contact, of at most 1.3 mm radius: exact to 1e-4."""
POINT_MM2 = 1e-6
"""Area of a point of a support: so small that its mean is the value there."""
FAR, FAR_FREQUENCIES = 1.2, 32
"""What modes above this many times the highest frequency answer is smooth: it is computed at so few, and interpolated
to 1e-12."""
SMOOTH = 0.02
"""Relative range of modes' frequencies over which a contact's change is smooth, because of damping."""


class Response:
    """Receptances of a plate with its discs: F frequencies, R receivers, M modes.

    A mode answers a force of frequency nu with 1 / (omega^2 (1 + i loss) - nu^2). A negative imaginary part of the
    angular frequencies `nu_rad_s`, shape (F,), damps the time signal. `loss`, of shape () or (F,), is the mounted
    plate's loss factor; 0 with complex modes, which have it. Fingers press the plate on its `supports`.
    """

    def __init__(
        self, plate: Plate, modes: LoadedModes, nu_rad_s: ArrayLike, loss: ArrayLike,
        supports: Sequence[Attachment] = (),
    ) -> None:  # fmt: skip
        self.plate = plate
        self.modes, self.loss, self.supports = modes, loss, supports
        self.nu_rad_s = np.asarray(nu_rad_s, dtype=np.complex128)
        self._few: dict[int, tuple[Complex, Floats]] = {}
        # Where shapes are real, stacking the parts makes one real product of what would be two.
        self._parts = 1 if np.iscomplexobj(modes.w) else 2
        self._near = self._count_near()
        self._kernel = self._kernel_of(slice(self._near), self.nu_rad_s)
        if self._near < len(modes.omega_rad_s):
            self._far_kernel = self._kernel_of(slice(self._near, None), self._frequencies(FAR_FREQUENCIES)[0])
        self._w = modes.w.reshape(len(modes.w), -1)

    def _count_near(self) -> int:
        """Return the number of modes up to the last one that is not far above all frequencies."""
        if np.ndim(self.loss) > 0 or len(self._frequencies(FAR_FREQUENCIES)[0]) == len(self.nu_rad_s):
            return len(self.modes.omega_rad_s)
        near = self.modes.omega_rad_s.real <= FAR * self.nu_rad_s.real.max()
        return int(np.flatnonzero(near).max(initial=-1)) + 1

    def _kernel_of(self, modes: slice, nu_rad_s: Complex) -> Floats | Complex:
        """Return what modes answer at frequencies, with real and imaginary parts stacked if shapes are real."""
        stiff = self.modes.omega_rad_s[modes] ** 2 * (1 + 1j * np.reshape(self.loss, (-1, 1)))
        H = 1 / (stiff - nu_rad_s[:, None] ** 2)
        return np.concatenate([H.real, H.imag]) if self._parts == 2 else np.asarray(H)

    def _frequencies(self, count: int) -> tuple[Complex, Floats]:
        """Return up to `count` frequencies, and the weights (F, count) by which smooth functions follow from them."""
        if count not in self._few:
            self._few[count] = self._choose(count)
        return self._few[count]

    def _choose(self, count: int) -> tuple[Complex, Floats]:
        real, damping = self.nu_rad_s.real, self.nu_rad_s.imag
        if len(real) <= count or np.ptp(damping) > 0:
            return self.nu_rad_s, np.eye(len(real))
        nodes = chebyshev.points((real.max() + real.min()) / 2, (real.max() - real.min()) / 2, count)
        return nodes + 1j * damping[0], chebyshev.weights(real, nodes)

    def shape_at(self, x_mm: Floats, y_mm: Floats, area_mm2: Floats) -> Floats | Complex:
        """Deflection of each mode averaged over discs; all of shape (n,), result (M, n).

        Raises SimulationError if a disc is not wholly on the plate.
        """
        shapes: Floats | Complex = self._w @ self._disc_average(x_mm, y_mm, area_mm2).T
        return shapes

    def _disc_average(self, x_mm: Floats, y_mm: Floats, area_mm2: Floats, rule: tuple[int, int] = (3, 8)) -> Floats:
        """Products of polynomials averaged over discs, shape (n, nx ny); errors as of `shape_at`."""
        radius = np.sqrt(area_mm2 / np.pi)
        edge = np.minimum(np.minimum(x_mm, self.plate.width_mm - x_mm), np.minimum(y_mm, self.plate.height_mm - y_mm))
        if np.any(edge < radius) or not np.all(np.isfinite(edge)):
            i = int(np.argmin(edge - radius))
            what = f"a contact of {radius[i]:.1f} mm radius at ({x_mm[i]:.1f}, {y_mm[i]:.1f}) mm reaches over the edge"
            raise SimulationError(what, "contact", "move it inwards")
        _, nx, ny = self.modes.w.shape
        centre = np.stack([x_mm, y_mm], axis=1) * 1e-3
        return legendre.disc_average(centre, radius * 1e-3, size_m(self.plate), (nx, ny), rule).reshape(len(x_mm), -1)

    def receptance(self, one: Floats | Complex, other: Floats | Complex) -> Complex:
        """Sum over modes of `one` times `other`, both (M, ...), times the modes' response; result (F, ...)."""
        product = one * other
        flat = product.reshape(len(product), -1)
        found = (self._kernel @ flat[: self._near]).reshape(self._parts, len(self.nu_rad_s), -1)
        if self._near < len(flat):
            _, weights = self._frequencies(FAR_FREQUENCIES)
            far = self._far_kernel @ flat[self._near :]
            found += weights @ far.reshape(self._parts, weights.shape[1], -1)
        answer = found[0] if self._parts == 1 else found[0] + 1j * found[1]
        return np.asarray(answer).reshape(-1, *product.shape[1:])

    def untouched(self) -> Complex:
        """Response of each receiver to the emitter, shape (R, F)."""
        discs = self.modes.discs
        return self.receptance(discs[:, :1], discs[:, 1:]).T

    def change(self, touches: Sequence[Sequence[Contact]], scale: Floats) -> Complex:
        """Change of the response by contacts, for n touches with the same numbers of coupled forces, c in all.

        The result (n, R, F) is at the angular frequencies s nu, with s the factor `scale` (n,) of all the modes'
        frequencies: the response at omega = s nu is that at nu, divided by s^2.
        """
        change = self._by_contacts(touches, scale)
        return change + self._pressed(touches, scale) if self.supports else change

    def _by_contacts(self, touches: Sequence[Sequence[Contact]], scale: Floats) -> Complex:
        """Change of the response by the contacts alone, as `change` has it.

        Exact, multiple scattering included: -g_rc (1 + z g_cc)^-1 z g_ce with z = i omega Z (Woodbury's identity).
        Equal touches share their receptances.
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

    def _pressed(self, touches: Sequence[Sequence[Contact]], scale: Floats) -> Complex:
        """Change of the response by how fingers press the plate on its supports, as `change` has it; to first order."""
        rises = np.array([pressing.rises(self.supports, touch) for touch in touches])
        return np.asarray(np.tensordot(rises / scale[:, None] ** 2, self._of_supports, 1))

    @cached_property
    def _of_supports(self) -> Complex:
        """Change of the response if each support couples twice as much, to first order, shape (A, R, F)."""
        found = []
        for support in self.supports:
            x_mm, y_mm, area_m2 = pressing.points(support)
            shape = self.shape_at(x_mm, y_mm, np.full(len(x_mm), POINT_MM2))
            to_discs = self.receptance(shape[..., None], self.modes.discs[:, None])  # (F, Q, 1 + R)
            load = pressing.load(support.support, self.nu_rad_s)
            found.append(-np.einsum("f,q,fq,fqr->rf", load, area_m2, to_discs[..., 0], to_discs[..., 1:]))
        return np.stack(found)

    def _shapes(self, touches: Sequence[Sequence[Contact]]) -> Floats | Complex:
        """Deflection of each mode under each of the c forces of n touches, shape (M, n, c)."""
        faces = [face_of(contact) for touch in touches for contact in touch]
        many = [len(face.centres_mm) for face in faces]
        centres = np.concatenate([face.centres_mm for face in faces])
        area_mm2 = np.repeat([face.disc_mm2 for face in faces], many)
        rule = (3, 8) if max(many) == 1 else SMALL_DISC
        products = self._disc_average(centres[:, 0], centres[:, 1], area_mm2, rule)
        parts = np.split(products, np.cumsum(many)[:-1])
        forces = [part if len(part) == 1 else face.weights @ part for face, part in zip(faces, parts, strict=True)]
        shapes: Floats | Complex = self._w @ np.concatenate(forces).T
        return shapes.reshape(len(self._w), len(touches), -1)

    def _scattered(
        self, touches: Sequence[Sequence[Contact]], scale: Floats, to_discs: Complex, pairs: Complex
    ) -> Complex:
        """Change of the response, as `change` has it, from receptances of shape (F, n, c, 1 + R) and (F, n, pairs)."""
        n, c, F = len(touches), to_discs.shape[2], len(self.nu_rad_s)
        loads = self._loads(touches, scale)
        if c == 1:
            z = loads[0][..., 0, 0]
            strength = z / (1 + z * pairs[..., 0]) * to_discs[..., 0, 0]  # (F, n)
            change = -strength[..., None] * to_discs[..., 0, 1:]
        else:
            i, j = np.triu_indices(c)
            which = np.empty((c, c), dtype=np.intp)
            which[i, j] = which[j, i] = np.arange(len(i))
            system = pairs[..., which]  # (F, n, c, c): what each force moves where the others are
            load = np.empty((F, n, c, 1), dtype=complex)
            start = 0
            for z in loads:
                block = slice(start, start := start + z.shape[-1])
                if z.shape[-1] == 1:
                    system[..., block, :] *= z
                    load[..., block, :] = z * to_discs[..., block, :1]
                else:
                    system[..., block, :] = z @ system[..., block, :]
                    load[..., block, :] = z @ to_discs[..., block, :1]
            system.reshape(F, n, -1)[..., :: c + 1] += 1
            force = np.linalg.solve(system, load)
            change = -(force * to_discs[..., 1:]).sum(axis=-2)
        return np.asarray(change.transpose(1, 2, 0) / scale[:, None, None] ** 2)

    def _loads(self, touches: Sequence[Sequence[Contact]], scale: Floats) -> list[Complex]:
        """Return i omega Z(omega) at omega = s nu, over s^2, of each contact of n touches, each (F, n, K, K).

        Impedances are smooth in frequency: few are computed, once for all patches of a palm, and interpolated.
        """
        factor = 1j * self.nu_rad_s[:, None, None, None] / scale[:, None, None]
        known: dict[tuple[Contact, float], Complex] = {}
        loads: list[Complex] = []
        for column in zip(*touches, strict=True):
            compliant = is_compliant(column[0].kind)
            nodes, weights = self._frequencies(COMPLIANT_FREQUENCIES if compliant else RIGID_FREQUENCIES)
            rows = []
            for contact, s in zip(column, scale.tolist(), strict=True):
                key = contact._replace(x_mm=0.0, y_mm=0.0), s
                if key not in known:
                    known[key] = impedance_of(contact, s * nodes)
                rows.append(known[key])
            few = np.stack(rows, axis=1)  # (nodes, n, K, K)
            loads.append((weights @ few.reshape(len(nodes), -1)).reshape(-1, *few.shape[1:]) * factor)
        return loads


def _few_scales(scale: Floats) -> Floats:
    """Return fewer factors, from which the responses at all of `scale` interpolate to 1e-12, or all factors."""
    low, high = float(scale.min()), float(scale.max())
    reach = (high - low) / 2
    count = 1
    while (reach / SMOOTH) ** count > 1e-12:
        count += 1
    return chebyshev.points((low + high) / 2, reach, count) if count < len(scale) else scale
