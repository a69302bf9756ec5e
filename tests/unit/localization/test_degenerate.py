"""Where a contact's fit is badly conditioned: on a disc, at an edge, in line with the emitter, nearly round."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.fields import in_double
from tests.unit.localization.test_contact_model import as_bins, contact, contact_model
from touchd.localization import joint
from touchd.localization.fit import finish, sigmas_mm
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.model import Model, default_model_path
from touchd.twin.physics.transducer import default_layout
from touchd.twin.simulate import DEFAULT_PLATE

_ATLAS = Model(default_model_path()).atlas
assert _ATLAS is not None
ATLAS = _ATLAS
WIDE = in_double(ATLAS)
SINGLE, DOUBLE = contact_model(ATLAS), contact_model(WIDE)
LAYOUT = default_layout(DEFAULT_PLATE)
EX, EY = LAYOUT.emitter_mm
TISSUE = np.exp(0.4j)
LONG = [1.6 * TISSUE + 0.3, 1.6 * TISSUE - 0.3, 0.4]
ROUND = [1.6 * TISSUE + 1e-3, 1.6 * TISSUE, 1e-3]
PLACES: dict[str, tuple[list[tuple[float, float]], Sequence[complex]]] = {
    "emitter": ([LAYOUT.emitter_mm], LONG),
    "receiver": ([LAYOUT.receivers_mm[0]], LONG),
    "edge": ([(8.0, 120.0)], LONG),
    "corner": ([(8.0, 191.0)], LONG),
    "round": ([(120.0, 90.0)], ROUND),
    "in line with the emitter": ([(EX + 40.0, EY), (EX + 60.0, EY)], LONG),
    "either side of the emitter": ([(EX - 10.0, EY), (EX + 10.0, EY)], LONG),
}


def bins_of(places: list[tuple[float, float]], shape: Sequence[complex], noise: float) -> NDArray[np.complex128]:
    """Contacts of equal amplitude, and white noise of a deviation."""
    values = np.asarray(sum(contact(*place, 0.8 + 0.2j, shape, ATLAS) for place in places))
    rng = np.random.default_rng(3)
    noisy = values + noise * (rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape))
    return np.asarray(noisy, np.complex128)


@pytest.mark.parametrize("name", PLACES)
def test_place(name: str) -> None:
    """In float32 a contact lies where float64 puts it, to a twentieth of its standard error, and there it is."""
    places, shape = PLACES[name]
    clean = bins_of(places, shape, 0.0)
    noise = 1e-3 * math.sqrt(float(np.mean(np.abs(clean) ** 2)))
    values, starts = bins_of(places, shape, noise), [(x + 0.3, y - 0.2) for x, y in places]
    one, other = (
        finish(model.pieces(as_bins(values, kind), starts, noise**2, 8))
        for model, kind in ((SINGLE, np.float32), (DOUBLE, float))
    )
    for mine, its, place, sigma_mm in zip(
        one.positions_mm, other.positions_mm, places, sigmas_mm(other.fisher_information, noise**2), strict=True
    ):
        assert math.dist(mine, its) < max(0.05 * sigma_mm, 2e-3)
        assert math.dist(its, place) < max(5 * sigma_mm, 0.02)
    assert one.residual_energy == pytest.approx(other.residual_energy, rel=1e-2)


@pytest.mark.parametrize("name", ["in line with the emitter", "either side of the emitter"])
def test_two(name: str) -> None:
    """Two fingers' step on plain numbers is that of the general solution, and so is their standard error."""
    places, _ = PLACES[name]
    solver, bins = GaussNewton(WIDE), as_bins(bins_of(places, (0, 0, 0), 0.0))
    solver._load(bins)
    _, products = solver._products([(x + 0.3, y - 0.2) for x, y in places], ())
    two, several = joint._of_two(products), joint._of_several(products)
    for mine, its in zip(map(np.asarray, two), map(np.asarray, several), strict=True):
        np.testing.assert_allclose(mine, its, rtol=1e-8, atol=1e-9 * float(np.abs(its).max()))
    spread = np.linalg.inv(np.array(several.information)).diagonal()
    assert sigmas_mm(two.information, 1.0) == pytest.approx(np.sqrt([spread[:2].mean(), spread[2:].mean()]), rel=1e-6)
