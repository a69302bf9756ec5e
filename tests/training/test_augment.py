"""What is added to the recorded touches: each disturbance where and as the instrument would add it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.training.conftest import KNOWN
from touchd.training import augment
from touchd.training.augment import Augmenter, Bank, make_bank
from touchd.training.dataset import Dataset
from touchd.training.field import Field
from touchd.training.synthetic import Synthesiser


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make(bank: Bank, field: Field, seed: int) -> Augmenter:
    generator = seeded(seed)
    return Augmenter(bank, Synthesiser(field, (200.0, 200.0), generator), generator)


@pytest.fixture(scope="module")
def bank(dataset: Dataset) -> Bank:
    return make_bank(dataset, torch.arange(KNOWN), seeded(), pool=512)


@pytest.fixture
def augmenter(bank: Bank, field: Field) -> Augmenter:
    return make(bank, field, 1)


def test_a_bank_holds_the_touches_that_were_named_and_no_other(dataset: Dataset, bank: Bank) -> None:
    np.testing.assert_array_equal(bank.residual.numpy(), dataset.residual[:KNOWN])
    place_mm = (bank.position.numpy() + 0.5) * 200
    np.testing.assert_allclose(place_mm, dataset.position_mm[:KNOWN], atol=1e-3)
    assert bank.neighbours.max() < KNOWN
    assert torch.equal(bank.neighbours[:, 0], torch.arange(KNOWN)), "each touch is its own nearest"


def test_its_noise_is_the_recordings_in_features(dataset: Dataset, bank: Bank) -> None:
    """White noise of variance s^2 has the energy s^2 sum(hanning^2) in each windowed bin."""
    samples = dataset.acquisition.samples
    expected = dataset.noise**2 * np.sum(np.hanning(samples) ** 2) * bank.channels * bank.bins
    assert bank.noise.square().sum(dim=1).mean().item() == pytest.approx(expected, rel=0.05)


def test_tones_have_unit_norm(bank: Bank) -> None:
    np.testing.assert_allclose(bank.tones.norm(dim=1), 1, atol=1e-4)


def test_an_augmented_finger_is_still_at_its_place(bank: Bank, augmenter: Augmenter) -> None:
    """Its direction stays nearer to its own touch than to any that is far away."""
    residual = bank.residual
    fingers = augmenter.fingers(residual)
    assert fingers.shape == residual.shape
    assert torch.isfinite(fingers).all()
    assert not torch.equal(fingers, residual)
    own = torch.nn.functional.cosine_similarity(fingers, residual)
    other = torch.nn.functional.cosine_similarity(fingers, residual.roll(KNOWN // 2, dims=0))
    assert own.median() > 0.7
    assert other.abs().median() < 0.4


@pytest.mark.parametrize("n", [1, 7, 384])
def test_as_many_others_are_drawn_as_were_asked_for(n: int, augmenter: Augmenter, bank: Bank) -> None:
    others = augmenter.others(n)
    assert others.shape == (n, bank.residual.shape[1])
    assert torch.isfinite(others).all()


def test_the_same_seed_draws_the_same(bank: Bank, field: Field) -> None:
    one, two = make(bank, field, 3), make(bank, field, 3)
    assert torch.equal(one.fingers(bank.residual), two.fingers(bank.residual))
    assert torch.equal(one.others(50), two.others(50))


def test_what_is_no_finger_is_further_out_of_phase_than_any_finger() -> None:
    assert augment.FINGER_PHASE < augment.OTHER_PHASE
