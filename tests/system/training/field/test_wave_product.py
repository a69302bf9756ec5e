"""The field as a product of two waves, from touches too few to tell it as it stands."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.training.waves import Waves, touch
from touchd.training.data.inspection import degrees_of_freedom
from touchd.training.field.few_touches import CUT, FEW, basis_of, covariance, learn_by_waves, product_of
from touchd.training.field.learn import OUTER_ROUNDS, Field, Learner
from touchd.training.field.regression import Prior, Touches

SIZE_MM = 80.0
K = np.linspace(0.26, 0.3, 5)
FEW_TOUCHES = 150


class Emitted(Waves):
    """One emitter, whose wave all channels have in common."""

    def __init__(self, wavenumber_per_mm: np.ndarray, channels: int, seed: int) -> None:
        super().__init__(wavenumber_per_mm, channels, seed)
        self._angle[0] = self._angle[0, :, :1]
        self._size[0] = self._size[0, :, :1]


@pytest.fixture(scope="module")
def emitted() -> Emitted:
    return Emitted(K, 4, seed=5)


@pytest.fixture(scope="module")
def touches(emitted: Emitted) -> tuple[Touches, np.ndarray]:
    found = touch(emitted, FEW_TOUCHES, SIZE_MM, seed=6)
    assert FEW * degrees_of_freedom(found[0].position_mm, float(K[-1])) > FEW_TOUCHES, "few"
    return found


@pytest.fixture(scope="module")
def learned(touches: tuple[Touches, np.ndarray]) -> tuple[Field, list[tuple[int, int]]]:
    """The field that waves tell, and its progress."""
    told: list[tuple[int, int]] = []
    return learn_by_waves(touches[0], Prior(K), lambda done, steps: told.append((done, steps))), told


def unexplained(found: np.ndarray, truth: np.ndarray) -> float:
    """The share of the energy that no common complex factor of the found field (n, channels, bins) explains."""
    factor = (found.conj() * truth).sum() / np.square(np.abs(found)).sum()
    return float(np.square(np.abs(truth - factor * found)).sum() / np.square(np.abs(truth)).sum())


def inner(count: int) -> np.ndarray:
    return np.random.default_rng(7).uniform(8.0, SIZE_MM - 8.0, (count, 2))


def test_sums_of_its_functions_are_waves_of_the_covariance_at_the_touches_and_beside_them(
    touches: tuple[Touches, np.ndarray],
) -> None:
    position_mm = touches[0].position_mm
    basis = basis_of(position_mm, 0.3)
    np.testing.assert_allclose(basis.at(position_mm), basis.at_touches, atol=1e-6)
    everywhere = np.concatenate([position_mm, inner(100)])
    functions = basis.at(everywhere)
    expected = covariance(everywhere, everywhere, 0.3)
    missed = np.diag(expected - functions @ functions.T)
    assert missed[: len(position_mm)].max() < CUT + 1e-6
    assert missed.min() > -1e-6, "never more than there is"
    assert missed[len(position_mm) :].mean() < 0.02


def test_a_product_is_found_between_touches_from_one_bin_alone(
    emitted: Emitted, touches: tuple[Touches, np.ndarray]
) -> None:
    known, amplitude = touches
    basis = basis_of(known.position_mm, float(K[2]))
    product = product_of(basis, known.values[:, :, 2], amplitude.astype(np.complex64), known.noise)
    positions_mm = inner(200)
    missed = unexplained(product.at(positions_mm), emitted.at(positions_mm)[:, :, 2])
    print(f"unexplained: {missed:.4f} between touches, {product.left:.4f} of theirs")
    assert missed < 0.05
    assert product.left < 0.02


def test_going_on_from_a_product_explains_no_less(touches: tuple[Touches, np.ndarray]) -> None:
    known, amplitude = touches
    values, amplitudes = known.values[:, :, 2], amplitude.astype(np.complex64)
    first = product_of(basis_of(known.position_mm, float(K[2])), values, amplitudes, known.noise)
    again = product_of(first.basis, values, amplitudes, known.noise, first)
    assert again.left < 1.02 * first.left


def at_nodes(field: Field, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Places (m, 2) of some inner nodes, and the field there (m, channels, bins)."""
    grid = field.coefficients
    weight = np.array([1 / 6, 2 / 3, 1 / 6])
    places, values = [], []
    for row in range(6, grid.shape[0] - 6, step):
        for column in range(6, grid.shape[1] - 6, step):
            around = grid[row - 1 : row + 2, column - 1 : column + 2]
            pair = np.einsum("i,j,ijcpb->cpb", weight, weight, around)
            values.append(pair[:, 0] + 1j * pair[:, 1])
            places.append(np.array(field.origin_mm) + 2.5 * np.array([column, row]))
    return np.array(places), np.array(values)


def test_with_few_touches_of_unknown_amplitude_waves_tell_much_more_than_regression(
    emitted: Emitted, touches: tuple[Touches, np.ndarray], learned: tuple[Field, list[tuple[int, int]]]
) -> None:
    (known, amplitude), (waves, _) = touches, learned
    learner = Learner(known, Prior(K))
    plain = learner.draw(learner.converge(OUTER_ROUNDS))
    missed = []
    for field in (plain, waves):
        positions_mm, values = at_nodes(field, 2)
        missed.append(unexplained(values, emitted.at(positions_mm)))
    print(f"unexplained: regression {missed[0]:.3f}, waves {missed[1]:.3f}")
    assert missed[1] < missed[0] / 3
    assert np.corrcoef(waves.amplitude, np.abs(amplitude))[0, 1] > 0.9


def test_progress_is_told_to_its_end(learned: tuple[Field, list[tuple[int, int]]]) -> None:
    _, told = learned
    assert [done for done, _ in told] == list(range(1, len(told) + 1))
    assert told[-1][0] == told[-1][1]
