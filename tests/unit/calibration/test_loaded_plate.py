"""Both ways to a loaded plate's answers agree with the definition, at any load."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchd.calibration.loaded_plate import Load, LoadedPlate
from touchd.calibration.reduced_plate import Complex, Floats, ReducedPlate, shape_of
from touchd.twin.physics.material import ElasticPlate, Material

GLASS = ElasticPlate(width_mm=40.0, height_mm=30.0, thickness_mm=5.0, elastic=Material(71e9, 0.22, 2490.0))
PLATE = ReducedPlate(GLASS, 60e3)
BARE = PLATE.solve(shape_of(GLASS))
NU: Complex = np.asarray(2 * np.pi * np.linspace(2e4, 6e4, 7) - 300j, np.complex128)
STIFF: Complex = np.asarray(1 + 0.01j * np.linspace(0.5, 1.5, 7), np.complex128)
DISCS = 2


def drawn(rng: np.random.Generator, vectors: int, dashpots: int, heaviest: float) -> tuple[Floats, Load]:
    """Return random vectors, and loads that change the plate's resonances."""
    springs, masses = 1e10 * rng.uniform(-0.2, 1, vectors), heaviest * rng.uniform(-0.2, 1, vectors)
    taken: Complex = np.asarray(1e9 * (rng.uniform(0, 1, (len(NU), dashpots)) + 1j), np.complex128)
    return rng.standard_normal((len(BARE.omega2), vectors)), Load(springs, masses, taken)


def defined(vectors: Floats, load: Load) -> Complex:
    """Return the answers (F, V, D) from the dynamic stiffness of all modes at each frequency."""
    found = []
    for nu, stiff, each in zip(NU, STIFF, load.at(STIFF, NU), strict=True):
        dynamic = np.diag(BARE.omega2 * stiff - nu**2) + (vectors * each) @ vectors.T
        found.append(vectors.T @ np.linalg.solve(dynamic, vectors[:, :DISCS]))
    return np.array(found)


@settings(deadline=None)
@given(st.integers(0, 2**32), st.integers(3, 40), st.integers(0, 3), st.sampled_from([1e-6, 1e-3]))
def test_both_ways(seed: int, vectors: int, dashpots: int, heaviest: float) -> None:
    shapes, load = drawn(np.random.default_rng(seed), vectors, dashpots, heaviest)
    expected = defined(shapes, load)
    for by_modes in (False, True):
        loaded = LoadedPlate(PLATE, BARE, shapes, load, STIFF, NU, DISCS, by_modes=by_modes)
        np.testing.assert_allclose(loaded.found, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
        again = np.einsum("nv,ndf->fvd", shapes, loaded.answers)
        np.testing.assert_allclose(again, expected, rtol=0, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("by_modes", [True, None])
def test_a_plate_without_modes(by_modes: bool | None) -> None:
    """A fit may try a hole that takes more mass than there is: it gets an answer and goes on."""
    shapes, load = drawn(np.random.default_rng(1), 20, 0, 1e-3)
    load = load._replace(masses=np.full(20, -0.5))
    loaded = LoadedPlate(PLATE, BARE, shapes, load, STIFF, NU, DISCS, by_modes=by_modes)
    expected = defined(shapes, load)
    np.testing.assert_allclose(loaded.found, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
