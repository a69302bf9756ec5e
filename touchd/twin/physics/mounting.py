"""What holds a plate: pads, tape or a clamp along its edges, and a pane bonded to it.

An attachment is a patch of springs, dashpots and mass per unit of area under the plate: soft pads and tape are lossy
rubber longer than its own wave, so that they absorb as dashpots of sqrt(E rho); a metal jaw is a stiff spring (a
penalty stiffness on the deflection); a bonded pane is mass with loss, its own bending stiffness left out.

With attachments the modes are complex. A dashpot's i omega c becomes i c (omega_0 / 2 + omega^2 / 2 omega_0): its
tangent in omega^2 at the band's middle omega_0, at most 6 % above it from 50 to 100 kHz. So the plate stays one
eigenproblem, symmetric (reciprocal) and with losses only (passive).
"""

from __future__ import annotations

from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.cache import remember
from touchd.twin.physics import legendre
from touchd.twin.physics.plate import size_m
from touchd.twin.physics.transducer import Layout, LoadedModes, loaded_modes, parameters_of

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

VERSION = 1
"""Version of the algorithm; increase it when the same mounting gives other modes, to invalidate files on disk."""
MIDDLE = 0.6
"""Middle of the band over the highest frequency: 75 of 125 kHz."""
_RIGID_HZ = 1.0
"""Frequencies of the rigid motions are multiples of it: equal ones would have no definite vectors."""


class Support(NamedTuple):
    """Springs, dashpots and mass per unit of area."""

    stiffness_n_m3: float = 0.0
    loss: float = 0.0
    """Loss factor of the stiffness."""
    dashpot_n_s_m3: float = 0.0
    mass_kg_m2: float = 0.0


EDGES = {
    # Silicone or polyurethane feet, E of 30 MPa at ultrasonic frequencies, 1100 kg/m^3: sqrt(E rho) = 0.18 MRayl
    # (Ferry, Viscoelastic Properties of Polymers: a soft rubber's modulus rises tenfold from rest to 100 kHz).
    "pads": Support(stiffness_n_m3=1e10, loss=0.3, dashpot_n_s_m3=1.8e5),
    # Double-sided acrylic foam tape, 1 mm, 720 kg/m^3, E of 30 MPa (3M, VHB technical data: tan delta near 1).
    "tape": Support(stiffness_n_m3=3e10, loss=1.0, dashpot_n_s_m3=1.5e5, mass_kg_m2=0.4),
    # An aluminium jaw: E / h = 70 GPa / 20 mm, with the loss of a joint without slip.
    "clamped": Support(stiffness_n_m3=3.5e12, loss=0.02),
}
"""What lies under an edge, by name."""
WIDTH_MM = {"pads": 8.0, "tape": 6.0, "clamped": 5.0}
"""Diameter of a pad, width of a strip."""
PADS_AN_EDGE = 3
PANE = Support(dashpot_n_s_m3=6e4, mass_kg_m2=1.75)
"""A display's 0.7 mm of glass under optically clear adhesive: the loss factor of the pair rises by 0.01."""

Edge = Literal["free", "pads", "tape", "clamped"]


class Attachment(BaseModel):
    """A rectangle, or the ellipse within it, of springs, dashpots and mass."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    x_mm: tuple[float, float]
    """From the left to the right."""
    y_mm: tuple[float, float]
    round: bool = False
    support: Support = Support()
    preload_n: float | None = Field(default=None, gt=0)
    """Force that presses it on the plate, if nothing glues it: what fingers add couples it more (`pressing`)."""

    @model_validator(mode="after")
    def _pressed_is_round(self) -> Self:
        if self.preload_n is not None and not self.round:
            raise ValueError("preload_n: only round attachments can be pressed")
        return self

    @property
    def middle_mm(self) -> tuple[float, float]:
        """Place of its middle."""
        return (self.x_mm[0] + self.x_mm[1]) / 2, (self.y_mm[0] + self.y_mm[1]) / 2


class Mounting(BaseModel):
    """What holds the plate; by default nothing."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    left: Edge = "free"
    right: Edge = "free"
    top: Edge = "free"
    """Where y is 0."""
    bottom: Edge = "free"
    pane: bool = False
    """Whether a display is bonded to the whole plate."""
    preload_n: float | None = Field(default=None, gt=0)
    """Of each pad along an edge, if nothing glues them."""
    attachments: tuple[Attachment, ...] = ()
    """Others."""

    def on(self, plate: Plate) -> tuple[Attachment, ...]:
        """Return all attachments to a plate."""
        found = list(self.attachments)
        size = plate.width_mm, plate.height_mm
        for side, axis, far in (("left", 0, 0), ("right", 0, 1), ("top", 1, 0), ("bottom", 1, 1)):
            kind = getattr(self, side)
            if kind == "free":
                continue
            width = WIDTH_MM[kind]
            across = (size[axis] - width, size[axis]) if far else (0.0, width)
            along = [(0.0, size[1 - axis])]
            if kind == "pads":
                middles = size[1 - axis] * (np.arange(PADS_AN_EDGE) + 0.5) / PADS_AN_EDGE
                along = [(middle - width / 2, middle + width / 2) for middle in middles.tolist()]
            for part in along:
                x, y = (part, across) if axis else (across, part)
                pad = kind == "pads"
                found.append(Attachment(
                    x_mm=x, y_mm=y, round=pad, support=EDGES[kind], preload_n=self.preload_n if pad else None
                ))  # fmt: skip
        if self.pane:
            found.append(Attachment(x_mm=(0, size[0]), y_mm=(0, size[1]), support=PANE))
        return tuple(found)


FREE = Mounting()
FOOT_MM, FOOT_IN_MM = 10.0, 12.0
"""Diameter of a foot, and how far in from both edges its middle is."""


def feet(width_mm: float, height_mm: float, preload_n: float | None = None) -> tuple[Attachment, ...]:
    """Return four rubber feet under a plate's corners; glued unless a force presses each."""
    half_mm = FOOT_MM / 2
    return tuple(
        Attachment(
            x_mm=(x_mm - half_mm, x_mm + half_mm), y_mm=(y_mm - half_mm, y_mm + half_mm), round=True,
            support=EDGES["pads"], preload_n=preload_n,
        )
        for x_mm in (FOOT_IN_MM, width_mm - FOOT_IN_MM) for y_mm in (FOOT_IN_MM, height_mm - FOOT_IN_MM)
    )  # fmt: skip


def mounted_modes(
    plate: Plate, layout: Layout, mounting: Mounting, loss: float, frequency_hz: float = 125e3
) -> LoadedModes:
    """Return the complex modes of a plate with discs and attachments, for use up to a frequency; cached on disk.

    The plate's loss factor is in them: use them with a loss of 0. Raises SimulationError if an attachment reaches over
    the edge, or as `loaded_modes`.
    """
    attachments = mounting.on(plate)
    key = parameters_of(plate, layout, frequency_hz) | {
        "mounting": [a.model_dump(exclude={"preload_n"}) for a in attachments], "loss": loss,
        "mounting version": VERSION,
    }  # fmt: skip

    def compute() -> dict[str, Floats]:
        return attach(
            loaded_modes(plate, layout, frequency_hz), plate, attachments, loss, MIDDLE * frequency_hz
        )._asdict()

    return LoadedModes(**remember("mounted", key, compute))


def attach(
    modes: LoadedModes, plate: Plate, attachments: tuple[Attachment, ...], loss: float, middle_hz: float
) -> LoadedModes:
    """Add attachments to a plate's modes, exactly within them; the result has complex modes of unit modal mass."""
    n, nx, ny = modes.w.shape
    w = modes.w.reshape(n, -1)
    middle = 2 * np.pi * middle_hz
    omega = modes.omega_rad_s.copy()
    rigid = np.count_nonzero(omega == 0)
    omega[:rigid] = 2 * np.pi * _RIGID_HZ * np.arange(1, rigid + 1)
    stiffness, mass = np.diag(omega**2 * (1 + 1j * loss)), np.eye(n, dtype=complex)
    for attachment in attachments:
        overlap = _overlap(modes.w, attachment, plate)
        s = attachment.support
        stiffness += (s.stiffness_n_m3 * (1 + 1j * s.loss) + 0.5j * middle * s.dashpot_n_s_m3) * overlap
        mass += (s.mass_kg_m2 - 0.5j / middle * s.dashpot_n_s_m3) * overlap
    squared, vectors = np.linalg.eig(np.linalg.solve(mass, stiffness))
    order = np.argsort(squared.real)
    squared, vectors = squared[order], vectors[:, order]
    vectors /= np.sqrt(np.einsum("ij,ij->j", vectors, mass @ vectors))
    return LoadedModes(np.sqrt(squared), (vectors.T @ w).reshape(n, nx, ny), vectors.T @ modes.discs)


def _overlap(w: Floats | Complex, attachment: Attachment, plate: Plate) -> Floats | Complex:
    """Return the integrals of products of two deflections w, (n, nx, ny), over a patch, m^2 w^2, shape (n, n)."""
    n, *counts = w.shape
    ranges, sizes = (attachment.x_mm, attachment.y_mm), size_m(plate)
    for (low, high), size in zip(ranges, sizes, strict=True):
        if not 0 <= low < high <= 1e3 * size + 1e-9:
            raise SimulationError(
                f"an attachment from {low:g} to {high:g} mm of {1e3 * size:g} mm", "mounting", "keep it on the plate"
            )
    middle, half = np.mean(ranges, axis=1) * 1e-3, np.diff(ranges, axis=1)[:, 0] * 5e-4
    if attachment.round:
        *unit, weight = legendre.disc_rule(4, 12)
        at_x, at_y = (
            legendre.values(m + h * u, size, count)
            for m, h, u, size, count in zip(middle, half, unit, sizes, counts, strict=True)
        )
        root = np.sqrt(np.pi * half.prod() * weight)
        deflection = root * np.einsum("kij,pi,pj->kp", w, at_x, at_y, optimize=True)
        return np.asarray(deflection @ deflection.T)
    gram = []
    for m, h, size, count in zip(middle, half, sizes, counts, strict=True):
        node, weight = np.polynomial.legendre.leggauss(count)  # exact for products of two
        at = legendre.values(m + h * node, size, count)
        gram.append((at * (h * weight)[:, None]).T @ at)
    return np.asarray((gram[0] @ w @ gram[1]).reshape(n, -1) @ w.reshape(n, -1).T)
