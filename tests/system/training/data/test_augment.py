"""What is added to the recorded touches: each disturbance where and as the instrument would add it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.conftest import KNOWN
from touchd.evaluation.dataset import Dataset
from touchd.training.data import augment
from touchd.training.data.augment import Augmenter
from touchd.training.data.synthetic import Synthesiser
from touchd.training.field.learn import Field

NONE = torch.zeros(KNOWN, 1)
"""No noise of the touches' own."""


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make(dataset: Dataset, field: Field, seed: int, noise: float = 1.0, tones: float = 1.0) -> Augmenter:
    """With noise and tones of this level, relative to the recording's."""
    generator = seeded(seed)
    made = Augmenter(dataset, torch.arange(KNOWN), Synthesiser(field, (200.0, 200.0), generator), generator, pool=512)
    made.noise *= noise
    made.power *= noise**2
    made.tones *= tones
    return made


@pytest.fixture
def augmenter(dataset: Dataset, field: Field) -> Augmenter:
    return make(dataset, field, 1)


def test_it_draws_from_the_touches_that_were_named_and_no_other(dataset: Dataset, augmenter: Augmenter) -> None:
    np.testing.assert_array_equal(augmenter.residual.numpy(), dataset.residual[:KNOWN])
    position_mm = (augmenter.position.numpy() + 0.5) * 200
    np.testing.assert_allclose(position_mm, dataset.position_mm[:KNOWN], atol=1e-3)
    assert augmenter.neighbours.max() < KNOWN
    assert torch.equal(augmenter.neighbours[:, 0], torch.arange(KNOWN)), "each touch is its own nearest"


def test_its_noise_is_the_recordings_in_features(dataset: Dataset, augmenter: Augmenter) -> None:
    """White noise of variance s^2 has the energy s^2 sum(hanning^2) in each windowed bin."""
    expected = dataset.noise**2 * np.sum(np.hanning(dataset.acquisition.samples) ** 2) * dataset.residual.shape[1] / 2
    assert augmenter.noise.square().sum(dim=1).mean().item() == pytest.approx(expected, rel=0.05)


def test_tones_have_unit_norm(augmenter: Augmenter) -> None:
    np.testing.assert_allclose(augmenter.tones.norm(dim=1), 1, atol=1e-4)


def test_an_augmented_finger_is_still_at_its_place(augmenter: Augmenter) -> None:
    """Its direction stays nearer to its own touch than to any that is far away."""
    residual = augmenter.residual
    fingers, _ = augmenter.fingers(residual, NONE)
    assert fingers.shape == residual.shape
    assert torch.isfinite(fingers).all()
    assert not torch.equal(fingers, residual)
    own = torch.nn.functional.cosine_similarity(fingers, residual)
    other = torch.nn.functional.cosine_similarity(fingers, residual.roll(KNOWN // 2, dims=0))
    assert own.median() > 0.7
    assert other.abs().median() < 0.4


def test_the_noise_that_is_told_is_the_noise_that_was_added(dataset: Dataset, field: Field) -> None:
    """The same draws without noise and tones give the same fingers less their noise."""
    noisy_augmenter, silent = make(dataset, field, 5), make(dataset, field, 5, noise=0.0, tones=0.0)
    rows = torch.arange(KNOWN).repeat(20)
    none = torch.zeros(len(rows), 1)
    noisy, told = noisy_augmenter.fingers(silent.residual[rows], none)
    clean, nothing = silent.fingers(silent.residual[rows], none)
    assert not nothing.any()
    added = (noisy - clean).norm(dim=1, keepdim=True) / noisy.norm(dim=1, keepdim=True)
    # Told is what is expected of such noise, and of four channels one is louder than another.
    assert (told / added).log().abs().median() < 0.1
    assert (told.square().sum() / added.square().sum()).item() == pytest.approx(1, abs=0.1)


def test_noise_of_a_recorded_touch_grows_with_the_touch(dataset: Dataset, field: Field) -> None:
    first, second = (make(dataset, field, 5, tones=0.0) for _ in range(2))
    one, without = first.fingers(first.residual, NONE)
    two, told = second.fingers(first.residual, NONE + 1)
    assert torch.equal(one, two)
    assert (told > without).all()


def test_held_out_touches_have_the_noise_that_was_asked_for_and_half_are_another_fingers(
    augmenter: Augmenter,
) -> None:
    residual = augmenter.residual
    own, noise = augmenter.held_out(residual, 1.0)
    louder, louder_noise = augmenter.held_out(residual, 10.0)
    same = (own == residual).all(dim=1)
    assert torch.equal(same, torch.arange(KNOWN) % 2 == 0)
    typical = (noise * own.norm(dim=1, keepdim=True) / residual.norm(dim=1).median()).mean().item()
    assert typical == pytest.approx(augmenter.own_noise(residual), rel=1e-3)
    added = (louder - own)[same].square().sum(dim=1) / louder[same].square().sum(dim=1)
    assert added.sum().item() == pytest.approx(0.99 * louder_noise[same].square().sum().item(), rel=0.1)


@pytest.mark.parametrize("n", [1, 7, 384])
def test_as_many_others_are_drawn_as_were_asked_for(n: int, augmenter: Augmenter) -> None:
    others = augmenter.others(n)
    assert others.shape == (n, augmenter.residual.shape[1])
    assert torch.isfinite(others).all()


def test_the_same_seed_draws_the_same(dataset: Dataset, field: Field) -> None:
    one, two = make(dataset, field, 3), make(dataset, field, 3)
    assert torch.equal(one.fingers(one.residual, NONE)[0], two.fingers(one.residual, NONE)[0])
    assert torch.equal(one.others(50), two.others(50))


def test_what_is_no_finger_is_further_out_of_phase_than_any_finger() -> None:
    assert augment.FINGER_PHASE < augment.OTHER_PHASE
