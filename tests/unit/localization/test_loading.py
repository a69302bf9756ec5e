"""A light and a heavy finger have fields of their own where the plate yields, and are placed with them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fields import BINS, RIG, Field, in_double, make_atlas, yielding
from tests.fields import look_up as defined
from touchd.localization.contact_model import ContactModel
from touchd.localization.fit import Bins, finish
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.loading import MOST_SIZE
from touchd.localization.spline import ContactField, Spline
from touchd.training.field.place import yields_of

STEP = 1e-4
SIZES = st.floats(0, 6)
PLACES = st.tuples(st.floats(8, 110), st.floats(8, 80))


ATLAS = yielding()


def share(x_mm: float, y_mm: float) -> np.ndarray:
    """By the splines' definition, shape (bins,)."""
    d = ATLAS.description
    u, v = (x_mm - d.origin_mm[0]) / d.step_mm, (y_mm - d.origin_mm[1]) / d.step_mm
    nodes = yields_of(ATLAS)[:, :, 0]

    def of(at: float, count: int) -> np.ndarray:
        apart = np.abs(at - np.arange(count))
        return np.asarray(np.where(apart < 1, 2 / 3 - apart**2 + apart**3 / 2, np.maximum(2 - apart, 0.0) ** 3 / 6))

    return np.asarray(np.einsum("r,c,rcb->b", of(v, nodes.shape[0]), of(u, nodes.shape[1]), nodes))


def loaded(x_mm: float, y_mm: float, size: float) -> np.ndarray:
    """The field of a touch over its amplitude, shape (channels, bins): a reference."""
    value = np.asarray(defined(ATLAS, x_mm, y_mm)[0]).reshape(RIG.channels, -1)
    return np.asarray(value / (1 + (min(size, MOST_SIZE) - 1) * share(x_mm, y_mm)))


def evaluated(x_mm: float, y_mm: float, size: float, dtype: type) -> tuple[tuple[float, float], np.ndarray]:
    """Where the spline was looked up, and the field and its slopes there."""
    into: np.ndarray = np.zeros((3, ATLAS.size), dtype)
    spline = Spline(ATLAS if dtype is np.float32 else in_double(ATLAS), into)
    at = spline.at(x_mm, y_mm, size)
    real, imaginary = into.reshape(3, 2, RIG.channels, -1).swapaxes(0, 1)
    return at, real + 1j * imaginary


@pytest.mark.parametrize(("dtype", "atol"), [(np.float32, 2.0), (np.float64, 1e-6)])
@given(PLACES, SIZES)
def test_field(dtype: type, atol: float, place_mm: tuple[float, float], size: float) -> None:
    """It is the reference's over 1 + (A - 1) s, and so are its slopes."""
    (x, y), (field, by_x, by_y) = evaluated(*place_mm, size, dtype)
    np.testing.assert_allclose(field, loaded(x, y, size), atol=atol)
    slopes = [
        (loaded(x + dx, y + dy, size) - loaded(x - dx, y - dy, size)) / (2 * STEP)
        for dx, dy in ((STEP, 0.0), (0.0, STEP))
    ]
    np.testing.assert_allclose([by_x, by_y], slopes, atol=max(atol, 1e-2))


@given(PLACES)
def test_reference_touch(place_mm: tuple[float, float]) -> None:
    """Of amplitude 1 it is the atlas' own field: of points, of shapes, and their derivatives."""
    one, other = ATLAS, make_atlas(Field())
    found = []
    for atlas in (one, other):
        points, faces, block = (
            np.zeros(shape, np.float32) for shape in ((3, one.size), (3, one.size), (2, 10, one.size // 2))
        )
        Spline(atlas, points).at(*place_mm)
        contacts = ContactField(atlas, faces)
        contacts.of_shape(*place_mm, (0.1j, -2 + 1j, -1 + 0j, 0.3 + 0j))
        contacts.derivatives(*place_mm, block)
        found.append((points, faces, block))
    for mine, its in zip(*found, strict=True):
        np.testing.assert_allclose(mine, its, rtol=1e-5, atol=1e-3)


def frame(*fingers: tuple[float, float, complex]) -> Bins:
    bins = sum((z * loaded(x, y, abs(z)) for x, y, z in fingers), np.zeros((RIG.channels, len(BINS)), complex))
    vector = np.stack([bins.real, bins.imag], axis=1).ravel()
    return Bins(vector, None, float(vector @ vector))


@given(PLACES, st.floats(0.05, 2), st.floats(-1, 1))
def test_one_finger(place_mm: tuple[float, float], size: float, lead_rad: float) -> None:
    """A finger of any weight is placed where it is, and nothing of it is left."""
    bins, solver = frame((*place_mm, size * np.exp(1j * lead_rad))), GaussNewton(in_double(ATLAS))
    fit = solver.fit_one(bins, place_mm[0] + 0.4, place_mm[1] - 0.3, 8)
    assert fit.positions_mm[0] == pytest.approx(place_mm, abs=2e-2)
    assert abs(fit.amplitudes[0]) == pytest.approx(size, rel=2e-2)
    left = solver.residual(bins, fit)
    assert left @ left < 1e-3 * bins.energy


def test_two_fingers() -> None:
    """A light one beside a heavy one: each has the field of its own weight."""
    bins = frame((40.0, 30.0, 0.1 + 0.05j), (80.0, 60.0, 2.5j))
    fit = GaussNewton(in_double(ATLAS)).fit_several(bins, [(40.3, 29.8), (79.8, 60.3)], 8)
    assert fit.positions_mm[0] == pytest.approx((40, 30), abs=5e-3)
    assert fit.positions_mm[1] == pytest.approx((80, 60), abs=5e-3)
    assert fit.residual_energy < 1e-3 * bins.energy


@pytest.mark.parametrize("size", [0.1, 2.5])
def test_contact_of_any_shape(size: float) -> None:
    """Where its shape is fitted too, a finger has the field of its weight: nothing is left for a shape to explain."""
    bins, atlas = frame((50.0, 40.0, complex(size))), in_double(ATLAS)
    model = ContactModel(atlas, ContactField(atlas, np.zeros((3, atlas.size))))
    fit = finish(model.pieces(bins, [(50.2, 39.9)], 1e-9 * bins.energy, 8))
    assert fit.positions_mm[0] == pytest.approx((50, 40), abs=5e-3)
    assert fit.residual_energy < 1e-4 * bins.energy
