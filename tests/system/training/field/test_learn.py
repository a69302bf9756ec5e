"""The field between the recorded touches, and the touches drawn from it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import KNOWN
from touchd.evaluation.dataset import Dataset
from touchd.keypad import Key, Layout
from touchd.training.data.synthetic import BORDER_MM, Synthesiser
from touchd.training.field.learn import STEP_MM, Field

SIZE_MM = (200.0, 200.0)


def synthesiser(field: Field, seed: int = 0) -> Synthesiser:
    return Synthesiser(field, SIZE_MM, torch.Generator().manual_seed(seed))


def unlike(found: np.ndarray, truth: np.ndarray, dataset: Dataset) -> np.ndarray:
    """The share of each row's energy that no complex factor of the found one explains."""
    a = dataset.acquisition

    def as_complex(rows: np.ndarray) -> np.ndarray:
        parts = rows.reshape(len(rows), a.channels, 2, -1)
        values: np.ndarray = (parts[:, :, 0] + 1j * parts[:, :, 1]).reshape(len(rows), -1)
        values /= np.linalg.norm(values, axis=1, keepdims=True)
        return values

    product = np.abs(np.sum(as_complex(found).conj() * as_complex(truth), axis=1))
    share: np.ndarray = 1 - product**2
    return share


def test_it_predicts_touches_it_never_saw_better_than_their_nearest_neighbours(dataset: Dataset, field: Field) -> None:
    held_out = dataset.position_mm[KNOWN:]
    inside = ((held_out >= field.low_mm) & (held_out <= field.high_mm)).all(axis=1)
    position_mm, truth = held_out[inside], dataset.residual[KNOWN:][inside]
    predicted = synthesiser(field).at(torch.from_numpy(position_mm)).numpy()
    known = dataset.position_mm[:KNOWN]
    nearest = np.linalg.norm(position_mm[:, None] - known[None], axis=2).argmin(axis=1)
    mine = np.median(unlike(predicted, truth, dataset))
    its = np.median(unlike(dataset.residual[nearest], truth, dataset))
    print(f"unexplained energy: field {mine:.3f}, nearest neighbour {its:.3f}, of {inside.sum()} touches")
    assert mine < its / 2


def test_the_amplitudes_are_one_on_average_and_never_negative(field: Field) -> None:
    assert field.amplitude.shape == (KNOWN,)
    assert field.amplitude.mean() == pytest.approx(1, abs=0.2)
    assert field.amplitude.min() > 0


@pytest.fixture
def grid() -> Field:
    """A small field with coefficients of no meaning."""
    coefficients = np.random.default_rng(1).normal(size=(12, 14, 4, 2, 3)).astype(np.float32)
    return Field(coefficients, (-5.0, -5.0), (0.0, 0.0), (20.0, 15.0), np.ones(5, np.float32))


def test_at_a_node_it_is_what_the_splines_of_its_neighbours_add_up_to(grid: Field) -> None:
    """At a node the cubic B-splines weigh 1/6, 2/3 and 1/6: that is what the coefficients were filtered for."""
    made = synthesiser(grid)
    weight = np.array([1 / 6, 2 / 3, 1 / 6])
    for row, column in ((2, 2), (5, 7), (8, 11)):
        around = grid.coefficients[row - 1 : row + 2, column - 1 : column + 2]
        expected = np.einsum("i,j,ijabc->abc", weight, weight, around).reshape(-1)
        node_mm = torch.tensor([[-5.0 + column * STEP_MM, -5.0 + row * STEP_MM]])
        np.testing.assert_allclose(made.at(node_mm)[0].numpy(), expected, rtol=1e-4, atol=1e-5)


@given(st.floats(0.0, 20.0), st.floats(0.0, 15.0), st.floats(-3, 3))
def test_it_is_linear_in_the_coefficients_and_reproduces_a_plane(x_mm: float, y_mm: float, slope: float) -> None:
    rows, columns = np.mgrid[0:12, 0:14]
    plane = (slope * (columns * STEP_MM - 5.0) + (rows * STEP_MM - 5.0)).astype(np.float32)
    noise = np.random.default_rng(2).normal(size=plane.shape).astype(np.float32)
    place = torch.tensor([[x_mm, y_mm]], dtype=torch.float32)

    def at(coefficients: np.ndarray) -> float:
        field = Field(
            coefficients.reshape(12, 14, 1, 1, 1), (-5.0, -5.0), (0.0, 0.0), (20.0, 15.0), np.ones(1, np.float32)
        )
        return synthesiser(field).at(place).item()

    assert at(plane) == pytest.approx(slope * x_mm + y_mm, abs=1e-3)
    assert at(plane + 2 * noise) == pytest.approx(at(plane) + 2 * at(noise), abs=1e-3)


def test_touches_are_drawn_inside_the_touched_part_with_amplitudes_that_occurred(field: Field) -> None:
    residual, place = synthesiser(field).draw(2000)
    position_mm = (place + 0.5) * torch.tensor(SIZE_MM)
    assert (position_mm >= torch.tensor(field.low_mm) - 1e-3).all()
    assert (position_mm <= torch.tensor(field.high_mm) + 1e-3).all()
    quarter = (torch.tensor(field.high_mm) - torch.tensor(field.low_mm)) / 4
    assert (position_mm.std(dim=0) > quarter).all(), "all over it"
    amplitude = residual.norm(dim=1) / synthesiser(field).at(position_mm).norm(dim=1)
    nearest = (amplitude[:, None] - torch.from_numpy(field.amplitude)[None]).abs().min(dim=1).values
    assert nearest.max() < 2e-3
    again, _ = synthesiser(field).draw(2000)
    assert torch.equal(residual, again), "the same seed, the same touches"


def test_for_a_keypad_most_are_drawn_about_the_borders_of_keys(field: Field) -> None:
    key = Key(name="1", x_mm=90, y_mm=85, width_mm=24, height_mm=30)
    made = Synthesiser(field, SIZE_MM, torch.Generator().manual_seed(0), Layout(key=(key,)))
    _, place = made.draw(2000)
    position_mm = (place + 0.5) * torch.tensor(SIZE_MM)
    assert (position_mm >= torch.tensor(field.low_mm) - 1e-3).all()
    assert (position_mm <= torch.tensor(field.high_mm) + 1e-3).all()
    offset_mm = torch.stack(
        [position_mm[:, 0] - 90, 114 - position_mm[:, 0], position_mm[:, 1] - 85, 115 - position_mm[:, 1]]
    )
    at_border = (offset_mm.min(dim=0).values.abs() < 2 * BORDER_MM).float()
    assert at_border[:1400].mean() > 0.9
    assert at_border[1400:].mean() < 0.7
    each = (offset_mm.abs() < BORDER_MM)[:, :1400].float().mean(dim=1)
    assert (each > 0.1).all(), "all four borders"
