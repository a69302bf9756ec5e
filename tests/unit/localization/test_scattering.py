"""Several contacts in steady state: what they send to each other is told, and taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fields import BINS, RIG, in_double, scattering, yielding
from tests.fields import look_up as defined
from touchd.localization.atlas import Atlas
from touchd.localization.contact_model import ContactModel
from touchd.localization.fit import Bins, finish
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.loading import MOST_SIZE
from touchd.localization.scattering import Scattering
from touchd.localization.spline import ContactField
from touchd.training.field.place import FieldMap, yields_of

Touch = tuple[float, float, complex]
PLACES = st.tuples(st.floats(8, 110), st.floats(8, 80))
AMPLITUDES = st.builds(lambda size, lead: size * np.exp(1j * lead), st.floats(0, 4), st.floats(-1, 1))
TOUCHES = st.lists(st.builds(lambda at, z: (*at, complex(z)), PLACES, AMPLITUDES), min_size=1, max_size=5)
ATLASES = {"real": scattering(), "complex": scattering(lossy=True)}


def under(atlas: Atlas, x_mm: float, y_mm: float) -> np.ndarray:
    """Each mode's deflection, from the splines' definition."""
    assert atlas.modes
    step_mm, x0_mm, y0_mm = atlas.modes.grid_mm
    rows, columns, _ = atlas.modes.shapes.shape

    def of(at: float, count: int) -> np.ndarray:
        apart = np.abs(at - np.arange(count))
        return np.asarray(np.where(apart < 1, 2 / 3 - apart**2 + apart**3 / 2, np.maximum(2 - apart, 0.0) ** 3 / 6))

    along = of((y_mm - y0_mm) / step_mm, rows), of((x_mm - x0_mm) / step_mm, columns)
    return np.asarray(np.einsum("r,c,rcn->n", *along, atlas.modes.shapes))


def added(atlas: Atlas, touches: list[Touch]) -> np.ndarray:
    """By the definition: the plate's response with all contacts, less what each changes alone, mode by mode."""
    modes = atlas.modes
    assert modes
    shapes = [under(atlas, x, y) for x, y, _ in touches]
    lines = np.empty((RIG.channels, len(modes.loads)), complex)
    for f, load in enumerate(modes.loads):

        def heard(each: list[int], f: int = f, load: complex = load) -> np.ndarray:
            stiff = np.diag(1 / modes.receptance[:, f])
            for k in each:
                stiff = stiff + load * touches[k][2] * np.outer(shapes[k], shapes[k])
            return np.asarray(modes.discs[:, 1:].T @ np.linalg.solve(stiff, modes.discs[:, 0]))

        every, free = heard(list(range(len(touches)))), heard([])
        lines[:, f] = every - free - sum((heard([k]) - free for k in range(len(touches))), np.zeros(RIG.channels))
    lines *= modes.heard
    return np.asarray((np.concatenate([lines.real, lines.imag], axis=1) @ modes.to_bins).ravel())


@pytest.mark.parametrize("kind", ATLASES)
@given(TOUCHES)
def test_what_contacts_add_to_each_other(kind: str, touches: list[Touch]) -> None:
    """It is the response of the loaded plate, less that of each contact alone: of one to five, of any weight."""
    atlas = in_double(ATLASES[kind])
    expected = added(atlas, touches)
    found = {
        dtype: Scattering(atlas if dtype is np.float64 else ATLASES[kind]).of(
            [(x, y) for x, y, _ in touches], [z for *_, z in touches]
        )
        for dtype in (np.float64, np.float32)
    }
    np.testing.assert_allclose(found[np.float64], expected, rtol=1e-6, atol=1e-7)
    assert found[np.float32].dtype == np.float32
    np.testing.assert_allclose(found[np.float32], expected, atol=1e-2 + 1e-3 * np.abs(expected).max())


@given(st.floats(1, 100))
def test_palm(times: float) -> None:
    """What is larger than a finger can be scatters as the largest finger."""
    at, model = [(30.0, 40.0), (70.0, 50.0)], Scattering(ATLASES["real"])
    most = model.of(at, [MOST_SIZE + 0j, 1j])
    np.testing.assert_allclose(model.of(at, [times * MOST_SIZE + 0j, 1j]), most, rtol=1e-4, atol=1e-2)


def frame(*fingers: Touch) -> Bins:
    """A frame of fingers with their own weights, and of what they add to each other's fields."""
    atlas = in_double(scattering())
    bins = added(atlas, list(fingers))
    shares = FieldMap(atlas, yields_of(atlas))
    for x, y, z in fingers:
        share = shares.at(np.array([[x, y]]))[0, 0]
        value = np.asarray(defined(atlas, x, y)[0]).reshape(RIG.channels, -1) / (1 + (abs(z) - 1) * share)
        bins = bins + np.stack([(z * value).real, (z * value).imag], axis=1).ravel()
    return Bins(bins, None, float(bins @ bins))


TWO = ((40.0, 30.0, 1.6 + 0.2j), (80.0, 60.0, 2.1 - 0.1j))
THREE = (*TWO, (30.0, 70.0, 0.8 + 0j))


@pytest.mark.parametrize("fingers", [TWO, THREE], ids=["two", "three"])
def test_fingers(fingers: tuple[Touch, ...]) -> None:
    """They are placed as if each were alone, and next to nothing of them is left."""
    bins, near = frame(*fingers), [(x + 0.3, y - 0.2) for x, y, _ in fingers]
    known, unknown = in_double(scattering()), replace(in_double(scattering()), modes=None)
    off_mm, left = {}, {}
    for atlas in (known, unknown):
        solver = GaussNewton(atlas)
        fit = solver.fit_several(bins, near, 4)
        for _ in range(12):  # what they add is that of where they were
            fit = solver.fit_several(bins, fit.positions_mm, 4)
        off_mm[atlas] = max(
            np.hypot(x - at[0], y - at[1]) for (x, y, _), at in zip(fingers, fit.positions_mm, strict=True)
        )
        rest = solver.residual(bins, fit)
        assert float(rest @ rest) == pytest.approx(fit.residual_energy, rel=0.1, abs=1e-4 * bins.energy)
        left[atlas] = fit.residual_energy / bins.energy
    assert off_mm[known] < 0.05
    assert off_mm[known] < off_mm[unknown] / 10
    assert left[known] < left[unknown] / 100


def test_contacts_of_any_shape() -> None:
    """Where their shapes are fitted too, what they add is no shape's."""
    bins, atlas = frame(*TWO), in_double(scattering())
    model = ContactModel(atlas, ContactField(atlas, np.zeros((3, atlas.size))))
    at = [(x + 0.1, y - 0.1) for x, y, _ in TWO]
    for _ in range(4):
        fit = finish(model.pieces(bins, at, 1e-9 * bins.energy, 8))
        at = list(fit.positions_mm)
    assert at[0] == pytest.approx(TWO[0][:2], abs=0.01)
    assert at[1] == pytest.approx(TWO[1][:2], abs=0.01)
    assert fit.residual_energy < 1e-4 * bins.energy


def test_bins_left_out() -> None:
    """A channel that is silent stays silent."""
    mask = np.ones((RIG.channels, 2, len(BINS)))
    mask[2] = 0
    bins = Bins(frame(*TWO).vector * mask.ravel(), mask.ravel(), 1.0)
    rest, taken = Scattering(in_double(scattering())).take_out(bins, [(40.0, 30.0), (80.0, 60.0)], [1.6, 2.1])
    assert np.all(rest.vector.reshape(mask.shape)[2] == 0)
    assert np.any(taken)


def test_without_modes_nothing_is_taken_out() -> None:
    """Fits of atlases that do not know them stay as they are."""
    bins = frame(*TWO)
    fit = GaussNewton(in_double(yielding())).fit_several(bins, [(40.0, 30.0), (80.0, 60.0)], 2)
    assert fit.scattered is None
