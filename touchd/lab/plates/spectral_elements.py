"""Three-dimensional elasticity of a plate with discs on one face, by spectral elements.

Lagrange functions through Gauss-Lobatto points (Komatitsch & Tromp, Geophys. J. Int. 139, 1999) on a box, so that the
mass matrix is diagonal. As all elements are equal boxes, the stiffness is a sum of products of one matrix per axis, and
no element is ever visited. Imports NumPy and torch only, and nothing of the twin, which it tests.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch

Floats = NDArray[np.float64]

ORDER, ORDER_Z = 6, 4
"""Order of the elements in the plane and through the thickness; one element is as thick as the plate."""
HIGHEST_HZ = 120e3
"""Elements are at most half a wavelength of A0 long there: 12 nodes per wavelength."""
RATE_HZ = 400e3
"""Samples per second of what is kept. The pulse has 1e-5 of its peak at half of it."""
LOSS_HZ = 55e3, 95e3
"""Rayleigh damping has the loss factor at these frequencies, and 4 % less between them."""
SAFETY = 0.95
"""Of the largest stable time step: the power iteration finds the largest eigenvalue from below."""
MARGIN = 24
"""Polynomials of the face beyond pi per wavelength."""
RIM_POINTS = 48


class Solid(NamedTuple):
    """A plate, of the material of `touchd.lab.plates.cases.GLASS` by default, and its discs on the upper face."""

    size_mm: tuple[float, float, float]
    discs_mm: Floats
    """Centres, shape (D, 2); the first one emits."""
    E_pa: float = 71.1e9
    nu: float = 0.226
    rho_kg_m3: float = 2490.0
    loss: float = 6e-3
    diameter_mm: float = 6.0
    mass_g: float = 0.43
    """Mass of a disc."""
    membrane_n_m: float = 0.5 * 62e9 * 2e-3 / (1 - 0.3**2)
    """Stiffness of a disc in its plane, E t / (1 - nu^2): half of 2 mm of PZT's, as the bond takes half."""
    membrane_nu: float = 0.3

    @property
    def moduli_pa(self) -> tuple[float, float]:
        """Lame's constants."""
        mu = self.E_pa / (2 * (1 + self.nu))
        return 2 * mu * self.nu / (1 - 2 * self.nu), mu

    def wavelength_mm(self, frequency_hz: float) -> float:
        """Return A0's wavelength, up to 6 % too short: the wave is slower than thin plates' and Rayleigh's waves."""
        omega, thick_m = 2 * np.pi * frequency_hz, self.size_mm[2] * 1e-3
        thin = math.sqrt(omega * thick_m) * (self.E_pa / self.rho_kg_m3 / (12 * (1 - self.nu**2))) ** 0.25
        rayleigh = 0.91 * math.sqrt(self.moduli_pa[1] / self.rho_kg_m3)
        return 1e3 / math.sqrt(thin**-2 + rayleigh**-2) / frequency_hz


class Axis:
    """A row of n equal elements along one side: N nodes, their weights, and the row's matrices."""

    def __init__(self, length_m: float, count: int, order: int) -> None:
        self.order, self.count, self.step_m = order, count, length_m / count
        top = np.eye(order + 1)[order]
        self._points = np.concatenate([[-1.0], np.sort(legendre.legroots(legendre.legder(top)).real), [1.0]])
        weights = self.step_m / (order * (order + 1) * legendre.legval(self._points, top) ** 2)
        slopes = self._functions(self._points)[1]
        size = count * order + 1
        self.weights_m, self.stiffness, self.slope = np.zeros(size), np.zeros((size, size)), np.zeros((size, size))
        for k in range(count):
            own = slice(k * order, (k + 1) * order + 1)
            self.weights_m[own] += weights
            self.stiffness[own, own] += slopes.T @ (weights[:, None] * slopes)
            self.slope[own, own] += weights[:, None] * slopes
        self.nodes_m: Floats = np.unique(np.concatenate([
            (k + (self._points[:-1] + 1) / 2) * self.step_m for k in range(count)
        ] + [[length_m]]))  # fmt: skip

    def _functions(self, at: Floats) -> tuple[Floats, Floats]:
        """Return an element's functions at points of -1 .. 1 and their slopes per metre, both (n, order + 1)."""
        inverse = np.linalg.inv(legendre.legvander(self._points, self.order))
        slopes = legendre.legvander(at, self.order - 1) @ legendre.legder(np.eye(self.order + 1), axis=0)
        return legendre.legvander(at, self.order) @ inverse, slopes @ inverse * 2 / self.step_m

    def at(self, x_m: Floats) -> tuple[Floats, Floats]:
        """Return all nodes' functions at places, and their slopes, both (n, N)."""
        element = np.clip((x_m / self.step_m).astype(int), 0, self.count - 1)
        found = np.zeros((2, len(x_m), len(self.weights_m)))
        columns = element[:, None] * self.order + np.arange(self.order + 1)
        found[:, np.arange(len(x_m))[:, None], columns] = self._functions(2 * (x_m / self.step_m - element) - 1)
        return found[0], found[1]

    def window(self, low_m: float, high_m: float, elements: int) -> slice:
        """Return the nodes of consecutive elements from the one with `low_m` on, moved inwards at the end."""
        first = min(max(int(low_m / self.step_m), 0), self.count - elements)
        assert high_m <= (first + elements) * self.step_m * (1 + 1e-9)
        return slice(first * self.order, (first + elements) * self.order + 1)


class Mesh:
    """A meshed plate. Displacements have the shape (3, B, Nz, Nx, Ny) for B sources; the last of Nz is the upper face.

    `discs` says whether the discs load the plate.
    """

    def __init__(
        self, solid: Solid, *, device: str = "cpu", double: bool = False, discs: bool = True,
        elements: tuple[int, int] | None = None, orders: tuple[int, int] = (ORDER, ORDER_Z),
    ) -> None:  # fmt: skip
        import torch

        self.solid = solid
        kind = torch.float64 if double else torch.float32

        def to_device(array: NDArray[Any] | list[Floats]) -> torch.Tensor:
            return torch.as_tensor(np.array(array), dtype=kind, device=device)

        self._to = to_device
        longest_mm = solid.wavelength_mm(HIGHEST_HZ) / 2
        many = elements or [math.ceil(side / longest_mm) for side in solid.size_mm[:2]]
        x, y = (Axis(side * 1e-3, n, orders[0]) for side, n in zip(solid.size_mm, many, strict=False))
        z = Axis(solid.size_mm[2] * 1e-3, 1, orders[1])
        self.x, self.y, self.z = x, y, z
        self.shape = len(z.nodes_m), len(x.nodes_m), len(y.nodes_m)
        wx, wy, wz = x.weights_m, y.weights_m, z.weights_m
        self.mass_kg = solid.rho_kg_m3 * wz[:, None, None] * wx[:, None] * wy
        self._share = self.mass_kg[-1].copy()  # of a node's mass that is the plate's
        lame, mu = solid.moduli_pa[0] / solid.rho_kg_m3, solid.moduli_pa[1] / solid.rho_kg_m3
        self._matrices = []
        for k, axis in enumerate((x, y, z)):
            per_kg = 1 / axis.weights_m[:, None]
            own = np.arange(3) == k
            factors = mu + (lame + mu) * own, np.where(own, lame, mu)
            self._matrices.append((
                *(self._to(per_kg * each) for each in (axis.slope, axis.stiffness, axis.slope.T)),
                *(self._to(each.reshape(3, 1, 1, 1, 1)) for each in factors),
            ))  # fmt: skip
        self._discs(device, discs)
        self._share /= self.mass_kg[-1]
        self._on_face = self._to(self._share)

    def _discs(self, device: str, loaded: bool) -> None:
        """Find the nodes around each disc, the discs' rims and stiffness there, and add their masses."""
        import torch

        solid, (_, nx, ny) = self.solid, self.shape
        radius = solid.diameter_mm / 2e3
        over = [min(math.ceil(2 * radius / axis.step_m) + 1, axis.count) for axis in (self.x, self.y)]
        angle = 2 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
        normal = np.stack([np.cos(angle), np.sin(angle)])
        r, weight = np.polynomial.legendre.leggauss(8)
        spread = (radius * (r + 1) / 2)[:, None] * normal[:, None, :]  # (2, 8, points)
        area = np.repeat(radius**2 * (r + 1) / 4 * weight * 2 * np.pi / RIM_POINTS, RIM_POINTS)
        nu = solid.membrane_nu
        moduli = solid.membrane_n_m * np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]])
        nodes, rims, stiff, per_kg = [], [], [], []
        for cx, cy in solid.discs_mm * 1e-3:
            some_x = self.x.window(cx - radius, cx + radius, over[0])
            some_y = self.y.window(cy - radius, cy + radius, over[1])
            own = np.arange(nx * ny).reshape(nx, ny)[some_x, some_y].ravel()
            per_kg.append(1 / self._share.ravel()[own])

            def fields(
                points: Floats, cx: float = cx, cy: float = cy, some_x: slice = some_x, some_y: slice = some_y
            ) -> list[Floats]:
                (px, dx), (py, dy) = self.x.at(cx + points[0].ravel()), self.y.at(cy + points[1].ravel())
                pairs = (px, py), (dx, py), (px, dy)
                return [(a[:, some_x, None] * b[:, None, some_y]).reshape(len(a), -1) for a, b in pairs]

            rims.append((normal @ fields(radius * normal)[0]) / RIM_POINTS)
            _, dx, dy = fields(spread)
            none = np.zeros_like(dx)
            strain = np.stack([np.hstack([dx, none]), np.hstack([none, dy]), np.hstack([dy, dx])])
            stiff.append(np.einsum("aqi,ab,q,bqj->ij", strain, moduli, area, strain, optimize=True))
            nodes.append(own)
            if loaded:
                self._add_mass(cx, cy, radius)
        self.nodes, force = np.array(nodes), np.array(per_kg)[:, None]
        self._index = torch.as_tensor(self.nodes.ravel(), device=device)
        self._rims, self._push = self._to(rims), self._to(force * np.array(rims))  # (D, 2, nodes)
        loads = np.array(stiff) * np.tile(force, 2).transpose(0, 2, 1) if loaded else None
        self._stiff = None if loads is None else self._to(loads.transpose(0, 2, 1))

    def _add_mass(self, cx: float, cy: float, radius: float) -> None:
        """Add a disc's mass to the nodes of the face, smoothly in half a node's distance; its centre is exact."""
        dx, dy = (self.x.nodes_m - cx)[:, None], (self.y.nodes_m - cy)[None, :]
        blur = self.x.step_m / self.x.order / 2
        inside = self.x.weights_m[:, None] * self.y.weights_m / (1 + np.exp(
            np.clip((np.hypot(dx, dy) - radius) / blur * 4, -60, 60)
        ))  # fmt: skip
        terms = np.stack([np.ones_like(inside), dx + 0 * dy, dy + 0 * dx]).reshape(3, -1)
        moments = (terms * inside.ravel()) @ terms.T
        weights = np.linalg.solve(moments, [self.solid.mass_g * 1e-3, 0.0, 0.0]) @ terms
        self.mass_kg[-1] += inside * weights.reshape(inside.shape)

    def rest(self, sources: int) -> torch.Tensor:
        """Return displacements of zero."""
        return self._to(np.zeros((3, sources, *self.shape)))

    def acceleration(self, u: torch.Tensor, push: float = 0.0) -> torch.Tensor:
        """Return -M^-1 K u, and what a force of `push` newtons outwards on the rim of disc s adds in source s."""
        slopes = [_along(k, matrix[0], u) for k, matrix in enumerate(self._matrices)]
        total = u.new_zeros(u.shape)
        for k, (_, stiffness, turned, for_own, for_others) in enumerate(self._matrices):
            beside = [j for j in range(3) if j != k]
            mixed = u.new_empty(u.shape)
            for j in beside:
                mixed[j] = slopes[j][k]
            mixed[k] = slopes[beside[0]][beside[0]] + slopes[beside[1]][beside[1]]
            total.addcmul_(_along(k, stiffness, u), for_own, value=-1)
            total.addcmul_(_along(k, turned, mixed), for_others, value=-1)
        face = total[:2, :, -1].view(2, u.shape[1], -1)
        if self._stiff is not None:
            near = self._near(u)  # (D, B, 2 nodes)
            pull = (near @ self._stiff).view(*near.shape[:2], 2, -1).permute(2, 1, 0, 3)
            face.index_add_(2, self._index, pull.flatten(2), alpha=-1)
        if push:
            for s, each in enumerate(self._push[: u.shape[1]]):
                count = each.shape[1]
                face[:, s].index_add_(1, self._index[s * count : (s + 1) * count], each, alpha=push)
        total[:, :, -1] *= self._on_face
        return total

    def _near(self, u: torch.Tensor) -> torch.Tensor:
        """Return the face's displacements in the plane around the discs, shape (D, B, 2 nodes)."""
        face = u[:2, :, -1].flatten(2)[:, :, self._index].view(2, u.shape[1], *self.nodes.shape)
        near: torch.Tensor = face.permute(2, 1, 0, 3).flatten(2)
        return near

    def sense(self, u: torch.Tensor) -> torch.Tensor:
        """Return the mean outward displacement of each disc's rim, shape (B, D)."""
        return (self._near(u) @ self._rims.flatten(1)[:, :, None])[..., 0].T

    def largest_rad_s(self) -> float:
        """Return the highest angular frequency of the mesh, from below, by power iteration."""
        import torch

        u = self._to(np.random.default_rng(0).standard_normal((3, 1, *self.shape)))
        squared = 0.0
        for _ in range(150):
            u = self.acceleration(u / torch.linalg.vector_norm(u))
            squared = float(torch.linalg.vector_norm(u))
        return math.sqrt(squared)

    def damping(self) -> tuple[float, float]:
        """Return a and b of the damping a M + b K, 1/s and s."""
        low, high = (2 * np.pi * each for each in LOSS_HZ)
        return self.solid.loss * low * high / (low + high), self.solid.loss / (low + high)

    def time_step_s(self) -> float:
        """Return a stable time step that divides the kept samples' one."""
        omega, b = self.largest_rad_s(), self.damping()[1]
        limit_s = SAFETY * (math.sqrt(b**2 + 4 / omega**2) - b)
        return 1 / (RATE_HZ * math.ceil(1 / (RATE_HZ * limit_s)))

    def face_counts(self) -> tuple[int, int]:
        """Return the Legendre polynomials along x and y by which the face is kept: they resolve A0."""
        per_mm = np.pi / self.solid.wavelength_mm(HIGHEST_HZ)
        sides = zip(self.solid.size_mm[:2], self.shape[1:], strict=True)
        nx, ny = (min(math.ceil(per_mm * side) + MARGIN, 2 * nodes // 3) for side, nodes in sides)
        return nx, ny

    def to_polynomials(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return matrices that fit orthonormal Legendre polynomials to nodes' values, along x and y."""
        found = []
        for axis, count in zip((self.x, self.y), self.face_counts(), strict=True):
            length_m, root = axis.nodes_m[-1], np.sqrt(axis.weights_m)
            values = polynomials(axis.nodes_m, length_m, count)
            found.append(self._to(np.linalg.pinv(root[:, None] * values) * root))
        return found[0], found[1]


def _along(axis: int, matrix: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Multiply displacements by a matrix along x, y or z."""
    if axis == 0:
        return matrix @ u
    if axis == 1:
        return u @ matrix.T
    return (matrix @ u.flatten(3)).view_as(u)


def polynomials(x_m: Floats, length_m: float, count: int) -> Floats:
    """Return orthonormal Legendre polynomials at places, shape (n, count)."""
    scale = np.sqrt((2 * np.arange(count) + 1) / length_m)
    return np.asarray(legendre.legvander(2 * x_m / length_m - 1, count - 1) * scale)
