"""A network's standard errors hold on touches that it never saw, whatever its heads said before."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from tests.conftest import KNOWN, TOUCHES
from touchd.evaluation.dataset import Dataset
from touchd.training.data.augment import Augmenter
from touchd.training.data.synthetic import Synthesiser
from touchd.training.field.learn import Field
from touchd.training.network.network import PositionNetwork
from touchd.training.train_network import LOUDER, calibrate_sigma


@pytest.fixture(scope="module")
def augmenter(dataset: Dataset, field: Field) -> Augmenter:
    return made(dataset, field)


def made(dataset: Dataset, field: Field, noise: float = 1.0) -> Augmenter:
    generator = torch.Generator().manual_seed(1)
    synthesiser = Synthesiser(field, (200.0, 200.0), generator)
    augmenter = Augmenter(dataset, torch.arange(KNOWN), synthesiser, generator, pool=512)
    augmenter.noise *= noise
    augmenter.power *= noise**2
    return augmenter


@pytest.fixture(scope="module")
def network(dataset: Dataset) -> PositionNetwork:
    """It has seen a few hundred steps of the touches, and its errors are centimetres."""
    torch.manual_seed(2)
    network = PositionNetwork(dataset.residual.shape[1], (200.0, 200.0), (64, 32))
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    features, position = held(dataset, slice(0, KNOWN))
    for _ in range(200):
        votes, _, _ = network.train().raw(features)
        loss = -(network.targets(position) * votes.log_softmax(dim=2)).sum(dim=2).mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it unannotated
        optimiser.step()
    with torch.no_grad():
        network.log_error.weight.zero_()
        network.log_error.bias.copy_(torch.tensor([0.0, 2.0]))  # about 1 mm, and 7 mm of noise as strong as the touch
    return network.eval()


def held(dataset: Dataset, part: slice) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(dataset.residual[part]), torch.from_numpy(dataset.position_mm[part]) / 200 - 0.5


def honest(network: PositionNetwork, dataset: Dataset, field: Field, sigma: float, noise: float) -> PositionNetwork:
    """The network with its heads off by these factors, made honest."""
    mine = copy.deepcopy(network)
    with torch.no_grad():
        mine.log_error.bias.add_(torch.tensor([sigma, noise]).log())
    calibrate_sigma(mine, made(dataset, field), *held(dataset, slice(KNOWN, TOUCHES)))
    return mine


@pytest.mark.parametrize(("sigma", "noise"), [(5.0, 5.0), (0.2, 3.0), (3.0, 0.2)])
def test_what_the_heads_said_before_is_no_matter(
    sigma: float, noise: float, network: PositionNetwork, dataset: Dataset, field: Field
) -> None:
    one, other = (honest(network, dataset, field, *scales).log_error.bias for scales in ((1.0, 1.0), (sigma, noise)))
    np.testing.assert_allclose(one.detach(), other.detach(), atol=0.05)


def test_68_percent_of_the_errors_are_within_sigma_in_the_touches_own_noise_and_in_louder(
    network: PositionNetwork, dataset: Dataset, field: Field, augmenter: Augmenter
) -> None:
    mine = honest(network, dataset, field, 4.0, 4.0)
    residual, position = held(dataset, slice(KNOWN, TOUCHES))
    shares = []
    for level in (1.0, *(louder / augmenter.own_noise(residual) for louder in LOUDER)):
        features, noise = augmenter.held_out(residual, level)
        with torch.inference_mode():
            position_mm, sigma_mm, _, noise_mm = mine(features)
        error_mm = (position_mm - mine.truth_mm(position)).abs()
        shares.append((error_mm <= torch.hypot(sigma_mm, noise_mm * noise)).float().mean().item())
    print("within sigma: " + ", ".join(f"{share:.0%}" for share in shares))
    assert np.mean(shares) == pytest.approx(0.683, abs=0.05)
    assert all(0.55 < share < 0.8 for share in shares)


def test_a_recording_without_noise_tells_nothing_of_it(
    network: PositionNetwork, dataset: Dataset, field: Field
) -> None:
    mine, (residual, position) = copy.deepcopy(network), held(dataset, slice(KNOWN, TOUCHES))
    silent = made(dataset, field, noise=0.0)
    calibrate_sigma(mine, silent, residual, position)
    features, _ = silent.held_out(residual, 1.0)
    with torch.inference_mode():
        position_mm, sigma_mm, _, noise_mm = mine(features)
    error_mm = (position_mm - mine.truth_mm(position)).abs()
    assert (error_mm <= sigma_mm).float().mean().item() == pytest.approx(0.683, abs=0.1)
    assert torch.isfinite(noise_mm).all()
