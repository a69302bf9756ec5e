"""What a loaded plate answers to its discs, from the modes of the free one.

There are two ways, which agree but for rounding. By vectors: with the receptances on the free plate between all vectors
along which it is loaded, the loaded one follows from Woodbury's identity, a matrix of their number at each frequency.
By modes: a plate that carries springs and masses has modes of its own, as its loss factor is the springs' too, for an
eigenproblem of as many unknowns as the free one has modes; only what dashpots take is left to the identity. That is
quicker where few modes carry much.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from touchd.calibration.reduced_plate import BareModes, Complex, Floats, ReducedPlate
from touchd.twin.physics.plate import modes_of

_FEW = 6
"""Times the number of vectors: with fewer modes a plate is solved by its own."""
_ABSENT = 1e-9
"""A vector with this share of its largest value in a class of modes is absent there."""


class Load(NamedTuple):
    """What V vectors load a plate with, per mass of the plate."""

    springs: Floats
    """With the plate's loss factor, 1/s^2, shape (V,)."""
    masses: Floats
    """Shape (V,)."""
    dashpots: Complex
    """Of the last E vectors, 1/s^2, shape (F, E)."""

    def at(self, stiff: Complex, nu_rad_s: Complex) -> Complex:
        """Return the whole load at F frequencies, 1/s^2, shape (F, V); `stiff` (F,) is 1 + i loss."""
        found = stiff[:, None] * self.springs - nu_rad_s[:, None] ** 2 * self.masses
        found[:, found.shape[1] - self.dashpots.shape[1] :] += self.dashpots
        return np.asarray(found)


class LoadedPlate:
    """Answers of a plate, loaded along V vectors, to the first D of them at F complex angular frequencies.

    Parameters
    ----------
    plate : ReducedPlate
    bare : BareModes
        Of the free plate: n of them.
    vectors : array of shape (n, V)
        In these modes.
    load : Load
    stiff, nu_rad_s : complex arrays of shape (F,)
        The factor 1 + i loss, and the frequencies.
    discs : int
        D.
    by_modes : bool, optional
        Whether to solve for the loaded plate's modes; by default where that is quicker. There are none where a fit's
        masses are negative and more than the plate's: then it is solved by vectors.
    """

    found: Complex
    """What each vector finds of the answers, shape (F, V, D)."""

    def __init__(
        self, plate: ReducedPlate, bare: BareModes, vectors: Floats, load: Load, stiff: Complex, nu_rad_s: Complex,
        discs: int, *, by_modes: bool | None = None,
    ) -> None:  # fmt: skip
        n, V = vectors.shape
        own = _own_modes(bare, vectors, load) if (n < _FEW * V if by_modes is None else by_modes) else None
        self._turn = own.turns[0] if own else None
        self._H = 1 / ((own or bare).omega2[:, None] * stiff - nu_rad_s**2)  # (n, F)
        if self._turn is None:
            free = _mutual(plate.to_classes(vectors), plate.to_classes(self._H))
            self._vectors = vectors
            self._forces = _solved(_resisted(load.at(stiff, nu_rad_s), free), np.eye(V, discs)[None])
            self.found = free @ self._forces
            return
        vectors = self._turn.T @ vectors
        self._moved = self._H[:, None] * vectors[:, :discs, None]
        if load.dashpots.any():
            ends = vectors[:, V - load.dashpots.shape[1] :]
            met = heard(ends.T, self._moved).transpose(2, 0, 1)
            resisted = _resisted(load.dashpots, _mutual([ends], [self._H]))
            self._moved -= self._driven(ends, _solved(resisted, load.dashpots[:, :, None] * met))
        self.found = np.ascontiguousarray(heard(vectors.T, self._moved).transpose(2, 0, 1))

    @cached_property
    def answers(self) -> Complex:
        """The answers in the free plate's modes, shape (n, D, F)."""
        return self._driven(self._vectors, self._forces) if self._turn is None else heard(self._turn, self._moved)

    def _driven(self, vectors: Floats, forces: Complex) -> Complex:
        """Return what forces (F, k, D) along k vectors move, in the modes that are solved for, shape (n, D, F)."""
        F, k, D = forces.shape
        by_vector = np.ascontiguousarray(forces.transpose(1, 2, 0)).reshape(k, D * F)
        return self._H[:, None] * times(vectors, by_vector).reshape(-1, D, F)


def heard(shapes: Floats, answers: Complex) -> Complex:
    """Return what k vectors (k, n) find of answers (n, D, F), shape (k, D, F)."""
    return times(shapes, answers.reshape(len(answers), -1)).reshape(-1, *answers.shape[1:])


def times(real: Floats, other: Complex) -> Complex:
    """Return a real matrix (k, n) times a complex one (n, m): with both parts side by side one real product does."""
    return np.asarray((real @ np.ascontiguousarray(other).view(float)).view(complex))


def _own_modes(bare: BareModes, vectors: Floats, load: Load) -> BareModes | None:
    """Return the modes of a plate with springs and masses, in those of the free one; None if it has none."""
    stiffness, mass = ((vectors * each) @ vectors.T for each in (load.springs, load.masses))
    diagonal = np.diag_indices(len(mass))
    stiffness[diagonal] += bare.omega2
    mass[diagonal] += 1
    try:
        omega2, turn = modes_of(stiffness, mass)
    except np.linalg.LinAlgError:
        return None
    return BareModes(omega2, [turn])


def _solved(system: Complex, loads: Floats | Complex) -> Complex:
    """Return the forces (F, V, D) that solve systems (F, V, V) with loads (F, V, D), or the same for all."""
    return np.asarray(np.linalg.solve(system, loads), np.complex128)


def _resisted(load: Complex, mutual: Complex) -> Complex:
    """Return the unit matrix and loads (F, V) times receptances (F, V, V)."""
    found = load[:, :, None] * mutual
    found.reshape(len(found), -1)[:, :: load.shape[1] + 1] += 1  # in place: it is the largest array of a fit
    return np.asarray(found)


def _mutual(classes: Sequence[Floats], kernels: Sequence[Complex]) -> Complex:
    """Return the receptance between any two vectors, shape (F, V, V), from their values (n, V) and 1 / (..) (n, F).

    An edge's vectors have a parity: on a free plate half of them are zero in each class of modes.
    """
    V, F = classes[0].shape[1], kernels[0].shape[1]
    one, other = np.triu_indices(V)
    found = np.zeros((len(one), F), dtype=complex)
    largest = np.max([np.abs(own).max(axis=0) for own in classes if len(own)], axis=0)
    for own, kernel in zip(classes, kernels, strict=True):
        there = np.abs(own).max(axis=0) > _ABSENT * largest
        pairs = np.flatnonzero(there[one] & there[other])
        found[pairs] += times((own[:, one[pairs]] * own[:, other[pairs]]).T, kernel)
    whole = np.empty((F, V, V), dtype=complex)
    whole[:, one, other] = whole[:, other, one] = found.T
    return whole
