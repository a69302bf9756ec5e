"""The training loop: when it stops, what it keeps, and that it never ends in numbers that are none."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from touchd.errors import TrainingError
from touchd.training.network import loop
from touchd.training.network.loop import Curve, fit
from touchd.training.network.network import Batch, PaperNetwork


def run(errors_mm: list[float], *, spoilt: bool = False, peak: float | None = None) -> tuple[Curve, list[Tensor]]:
    """Return the curve of a training with these validation errors, and the weights after each epoch."""
    torch.manual_seed(0)
    network = PaperNetwork(8, (200.0, 200.0))
    weights: list[Tensor] = []

    def epoch() -> Iterator[Batch]:
        features = torch.randn(16, 8) * (float("nan") if spoilt else 1.0)
        yield Batch(features, torch.rand(16, 2) - 0.5, torch.zeros(16, 1))

    def validate() -> float:
        weights.append(network.head.weight.detach().clone())
        return errors_mm[len(weights) - 1]

    optimiser = torch.optim.Adam(network.parameters())
    curve = fit(network, epoch, 1, optimiser, len(errors_mm), validate, lambda *_step: None, peak=peak)
    return curve, [*weights, network.head.weight.detach()]


def test_at_a_constant_rate_training_stops_when_nothing_improves_and_keeps_the_best_epoch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(loop, "PATIENCE", 3)
    curve, (*weights, result) = run([9.0, 5.0, 6.0, 5.5, 5.1, 1.0])
    assert (curve.validation_mm, curve.kept) == ([9.0, 5.0, 6.0, 5.5, 5.1], 2)
    assert torch.equal(result, weights[1])
    assert not torch.equal(result, weights[-1])


def test_a_better_epoch_restarts_the_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "PATIENCE", 2)
    curve, _ = run([9.0, 9.5, 8.0, 8.5, 7.0, 7.5])
    assert (len(curve.validation_mm), len(curve.loss), curve.kept) == (6, 6, 5)


def test_a_cycle_runs_to_its_end_and_keeps_its_last_epoch() -> None:
    curve, (*weights, result) = run([1.0, 5.0, 6.0, 7.0], peak=1e-3)
    assert curve.kept == 4
    assert torch.equal(result, weights[-1])


@pytest.mark.parametrize(
    "how", [lambda: run([1.0, 1.0], spoilt=True), lambda: run([1.0, float("nan")]), lambda: run([float("inf")])]
)
def test_a_training_that_diverges_ends_at_once_with_its_epoch(how: Callable[[], object]) -> None:
    with pytest.raises(TrainingError, match=r"diverged in epoch \d"):
        how()
