"""Train the regression network on a labelled recording. Reads from top to bottom."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from touchd.evaluation.metrics import position_scores
from touchd.model import Description, Model
from touchd.recording import Recording
from touchd.training.augment import Augmenter, make_bank
from touchd.training.dataset import Dataset, Split, make_dataset, split
from touchd.training.export import check, export
from touchd.training.network import Regression

BATCH = 256
LEARNING_RATE = 2e-3  # the peak of a one-cycle schedule with Adam
WEIGHT_DECAY = 1e-4
SIGMA_SHARE = 0.05  # weight of the standard error's likelihood, of the order of the position's loss at the end
FINGER_SHARE = 0.05  # weight of the finger-or-not cross-entropy
EXPORT_TOLERANCE_MM = 1e-3  # float32 on two runtimes, summed in different orders

Progress = Callable[[int, int, float], None]
"""Told after each epoch: epochs done, epochs in all, validation RMSE in mm."""


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
    epochs: int = 150,
    command: str = "",
    progress: Progress = lambda _done, _all, _rmse_mm: None,
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
    plate = recording.meta.plate
    network = Regression(data.residual.shape[1], (plate.width_mm, plate.height_mm))
    curve_mm = _fit(network, data, parts, generator, epochs, progress)

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
    generator: torch.Generator,
    epochs: int,
    progress: Progress,
) -> list[float]:
    bank = make_bank(data, torch.from_numpy(parts.train), generator)
    augmenter = Augmenter(bank, generator)
    count = len(parts.train)
    steps = -(-count // BATCH)
    optimiser = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=epochs * steps)
    curve_mm: list[float] = []
    for epoch in range(epochs):
        network.train()
        for indices in torch.split(torch.randperm(count, generator=generator), BATCH):
            optimiser.zero_grad()
            loss = _loss(network, augmenter, indices, bank.position[indices])
            loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it unannotated
            optimiser.step()
            schedule.step()
        curve_mm.append(_scores(network, data, parts.validation)["rmse_mm"])
        progress(epoch + 1, epochs, curve_mm[-1])
    return curve_mm


def _loss(network: Regression, augmenter: Augmenter, indices: Tensor, target: Tensor) -> Tensor:
    """Return squared error of the position, likelihood of sigma, and cross-entropy of finger or not."""
    n = len(indices)
    features = torch.cat([augmenter.fingers(indices), augmenter.others(n)])
    position, log_sigma, logit = network.raw(features)
    error = position[:n] - target
    square_mm = (error.detach() * network.size_mm).square().mean(dim=1, keepdim=True)
    # The position is not bent to suit sigma: sigma only learns how large the errors are.
    sigma = log_sigma[:n].clamp(-5.0, 5.0)
    likelihood = (sigma + 0.5 * square_mm * torch.exp(-2 * sigma)).mean()
    truth = (torch.arange(2 * n) < n).float()[:, None]
    finger = nn.functional.binary_cross_entropy_with_logits(logit, truth)
    scale = 100.0  # errors of 1 % of the plate are of order 1: all three terms are then alike in size
    return (scale * error).square().mean() + SIGMA_SHARE * likelihood + FINGER_SHARE * finger


def _scores(network: Regression, data: Dataset, indices: np.ndarray) -> dict[str, float]:
    network.eval()
    with torch.inference_mode():
        position_mm, sigma_mm, confidence = network(torch.from_numpy(data.residual[indices]))
    error_mm = position_mm.numpy() - data.position_mm[indices]
    scores = position_scores(error_mm)
    scores["within_sigma"] = float((np.abs(error_mm) <= sigma_mm.numpy()).mean())
    scores["confident"] = float((confidence.numpy() >= 0.5).mean())
    return scores
