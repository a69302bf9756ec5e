"""Training loop: run epochs until the schedule ends, or until validation stops improving."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch.optim.lr_scheduler import OneCycleLR

from touchd.errors import TrainingError
from touchd.training.network.network import Batch, Network

PATIENCE = 30
"""Epochs without a better validation RMSE that end a training at a constant rate."""

Progress = Callable[[str, int, int, float], None]
"""Receives each step: stage, steps done, steps in all, validation RMSE in mm (NaN before the first)."""

Epoch = Callable[[], Iterator[Batch]]
"""Returns the batches of one epoch."""


@dataclass(frozen=True, slots=True)
class Curve:
    """Loss and validation RMSE by epoch."""

    loss: list[float]
    """Mean over the epoch's batches."""
    validation_mm: list[float]
    """RMSE on the validation part, mm."""
    kept: int
    """Epoch whose weights were kept, counted from 1."""


def fit(
    network: Network,
    batches: Epoch,
    steps: int,
    optimiser: torch.optim.Optimizer,
    epochs: int,
    validate: Callable[[], float],
    progress: Progress,
    *,
    peak: float | None = None,
) -> Curve:
    """Train a network in place, by epochs of `steps` batches.

    With `peak`, the learning rate follows one cycle (Smith and Topin 2019) up to it and down to zero. A one-cycle
    training is best at its end, so it runs all epochs and keeps the last weights. Without `peak`, training stops after
    `PATIENCE` consecutive epochs without a better validation RMSE and keeps the best epoch's weights. Raises
    TrainingError if the loss or RMSE is not finite.
    """
    schedule = None if peak is None else OneCycleLR(optimiser, peak, total_steps=epochs * steps)
    curve, best = Curve([], [], 0), copy.deepcopy(network.state_dict())
    kept = 0
    for epoch in range(1, epochs + 1):
        network.train()
        total = torch.zeros(())
        for batch in batches():
            optimiser.zero_grad()
            loss = network.loss(batch)
            loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it unannotated
            optimiser.step()
            total += loss.detach()
            if schedule is not None:
                schedule.step()
        curve.loss.append(float(total) / steps)
        curve.validation_mm.append(validate())
        if not (math.isfinite(curve.loss[-1]) and math.isfinite(curve.validation_mm[-1])):
            raise TrainingError(
                f"training diverged in epoch {epoch}: loss {curve.loss[-1]:g}, "
                f"validation RMSE {curve.validation_mm[-1]:g} mm",
                "training",
                "check the recording for frames of extreme values, or try another --seed",
            )
        progress("network", epoch, epochs, curve.validation_mm[-1])
        if schedule is not None:
            kept = epoch
        elif curve.validation_mm[-1] < min(curve.validation_mm[:-1], default=math.inf):
            kept, best = epoch, copy.deepcopy(network.state_dict())
        elif epoch - kept >= PATIENCE:
            progress("network", epochs, epochs, curve.validation_mm[kept - 1])
            break
    if schedule is None:
        network.load_state_dict(best)
    return Curve(curve.loss, curve.validation_mm, kept)
