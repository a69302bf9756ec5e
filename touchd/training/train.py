"""Train the regression network on a labelled recording. Reads from top to bottom."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from touchd.evaluation.metrics import position_scores
from touchd.model import Description, Model
from touchd.recording import Recording
from touchd.training.augment import Augmenter, make_bank
from touchd.training.dataset import Dataset, Split, make_dataset, split
from touchd.training.export import check, export
from touchd.training.field import learn_field
from touchd.training.network import Regression
from touchd.training.synthetic import Synthesiser

BATCH = 512  # fingers a step
SYNTHETIC = 0.8  # of them, the share drawn from the learned field; the others are the recorded touches
OTHERS = 384  # and things that are no finger
LEARNING_RATE = 3e-3  # the peak of a one-cycle schedule with AdamW
WEIGHT_DECAY = 0.01
SPREAD_BINS = 0.75  # of the target histograms: the HL-Gauss paper's choice
WITHIN_SIGMA = 0.683  # of the errors of either axis: what a standard error means for Gaussian ones
FINGER_SHARE = 0.5  # weight of the finger-or-not cross-entropy
EXPORT_TOLERANCE_MM = 1e-3  # float32 on two runtimes, summed in different orders

Progress = Callable[[str, int, int, float], None]
"""Told of each step: what is done, steps done, steps in all, validation RMSE in mm (NaN before the first)."""


@dataclass(frozen=True, slots=True)
class Result:
    """A trained model and how well it does on touches it never saw."""

    model: Model
    scores: dict[str, float]
    curve_mm: list[float]
    """Validation RMSE after each epoch."""


def train_regression(
    recording: Recording,
    path: Path,
    *,
    seed: int = 0,
    epochs: int = 300,
    command: str = "",
    progress: Progress = lambda _what, _done, _all, _rmse_mm: None,
) -> Result:
    """Train the paper's regression trunk on normalised residuals and write it as an ONNX file.

    The same recording, seed and number of threads give the same network.

    Raises
    ------
    TrainingError, OutputError
    """
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    data = make_dataset(recording)
    parts = split(len(data), seed)
    field = learn_field(data, parts.train, lambda done, all_: progress("field", done, all_, float("nan")))
    plate = recording.meta.plate
    size_mm = (plate.width_mm, plate.height_mm)
    network = Regression(data.residual.shape[1], size_mm)
    curve_mm = _fit(network, data, parts, Synthesiser(field, size_mm, generator), generator, epochs, progress)

    scores = _scores(network, data, parts.test)
    description = Description(
        name="regression",
        head="regression",
        domain=data.domain,
        input="residual",
        acquisition=data.acquisition,
        plate=plate,
        data_sha256=data.sha256,
        command=command,
        seed=seed,
        scores={name: round(value, 4) for name, value in scores.items()},
    )
    model = export(network, description, path)
    check(network, model, data.residual[parts.test], EXPORT_TOLERANCE_MM)
    return Result(model, scores, curve_mm)


def _fit(
    network: Regression,
    data: Dataset,
    parts: Split,
    synthesiser: Synthesiser,
    generator: torch.Generator,
    epochs: int,
    progress: Progress,
) -> list[float]:
    bank = make_bank(data, torch.from_numpy(parts.train), generator)
    augmenter = Augmenter(bank, synthesiser, generator)
    count = len(parts.train)
    recorded = round(BATCH * (1 - SYNTHETIC))
    steps = -(-count // BATCH) * 2
    optimiser = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=epochs * steps)
    curve_mm: list[float] = []
    for epoch in range(epochs):
        network.train()
        for _ in range(steps):
            some = torch.randint(count, (recorded,), generator=generator)
            drawn, place = synthesiser.draw(BATCH - recorded)
            fingers = augmenter.fingers(torch.cat([bank.residual[some], drawn]))
            optimiser.zero_grad()
            loss = _loss(network, fingers, augmenter.others(OTHERS), torch.cat([bank.position[some], place]))
            loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it unannotated
            optimiser.step()
            schedule.step()
        curve_mm.append(_scores(network, data, parts.validation)["rmse_mm"])
        progress("network", epoch + 1, epochs, curve_mm[-1])
    return curve_mm


def _loss(network: Regression, fingers: Tensor, others: Tensor, target: Tensor) -> Tensor:
    """Return cross-entropy of the position, likelihood of sigma, and cross-entropy of finger or not."""
    n = len(fingers)
    votes, log_sigma, logit = network.raw(torch.cat([fingers, others]))
    votes = votes[:n]
    position = -(network.targets(target, SPREAD_BINS) * votes.log_softmax(dim=2)).sum(dim=2).mean()
    error_mm = (network.place_mm(votes.detach()) - (target + 0.5) * network.size_mm).abs()
    sigma = _pinball((error_mm + 1e-3).log() - log_sigma[:n], WITHIN_SIGMA)
    truth = (torch.arange(n + len(others)) < n).float()[:, None]
    finger = nn.functional.binary_cross_entropy_with_logits(logit, truth)
    return position + sigma + FINGER_SHARE * finger


def _pinball(excess: Tensor, share: float) -> Tensor:
    """Return the loss that is least where this share of the excesses is negative (Koenker and Bassett 1978).

    Unlike the likelihood of a Gaussian it is not ruled by the few touches placed in the wrong lobe.
    """
    return torch.maximum(share * excess, (share - 1) * excess).mean()


def _scores(network: Regression, data: Dataset, indices: NDArray[np.int64]) -> dict[str, float]:
    network.eval()
    with torch.inference_mode():
        position_mm, sigma_mm, confidence = network(torch.from_numpy(data.residual[indices]))
    error_mm = position_mm.numpy() - data.position_mm[indices]
    scores = position_scores(error_mm)
    scores["within_sigma"] = float((np.abs(error_mm) <= sigma_mm.numpy()).mean())
    scores["confident"] = float((confidence.numpy() >= 0.5).mean())
    return scores
