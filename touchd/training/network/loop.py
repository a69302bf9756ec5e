"""The training loop: epochs of batches, until the schedule ends or nothing improves any more."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch.optim.lr_scheduler import OneCycleLR

from touchd.errors import TrainingError
from touchd.training.network.objectives import Batch, Task

PATIENCE = 30
"""Epochs without a better validation RMSE after which a training at a constant rate ends."""

Progress = Callable[[str, int, int, float], None]
"""Told of each step: what is done, steps done, steps in all, validation RMSE in mm (NaN before the first)."""


@dataclass(frozen=True, slots=True)
class Batches:
    """What a network is shown in an epoch."""

    steps: int
    epoch: Callable[[], Iterator[Batch]]


@dataclass(frozen=True, slots=True)
class Curve:
    """How a training went, epoch by epoch."""

    loss: list[float]
    """Mean over the batches of the epoch."""
    validation_mm: list[float]
    """RMSE on the validation part."""
    kept: int
    """The epoch, counted from 1, whose weights are the result."""


def fit(
    task: Task,
    batches: Batches,
    optimiser: torch.optim.Optimizer,
    epochs: int,
    validate: Callable[[], float],
    progress: Progress,
    *,
    peak: float | None = None,
    patience: int | None = None,
) -> Curve:
    """Train the task's network in place.

    With a `peak`, the rate follows one cycle (Smith and Topin 2019) up to it and down to nothing. Such a training
    gets best in its last epochs, so it runs to its end, and the last weights are the result. Without, it stops after
    `patience` epochs in a row without a better validation RMSE, and the best epoch's weights are the result.

    Raises
    ------
    TrainingError
        If patience is asked of a cycle, or the loss or the RMSE is no number.
    """
    if peak is not None and patience is not None:
        raise TrainingError(
            "a one-cycle schedule gets best in its last epochs: stopping early would cut them off",
            "patience",
            "leave it out, and ask for fewer epochs",
        )
    schedule = None if peak is None else OneCycleLR(optimiser, peak, total_steps=epochs * batches.steps)
    curve, best = Curve([], [], 0), copy.deepcopy(task.network.state_dict())
    kept = 0
    for epoch in range(1, epochs + 1):
        task.network.train()
        total = torch.zeros(())
        for batch in batches.epoch():
            optimiser.zero_grad()
            loss = task.loss(batch)
            loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it unannotated
            optimiser.step()
            total += loss.detach()
            if schedule is not None:
                schedule.step()
        curve.loss.append(float(total) / batches.steps)
        curve.validation_mm.append(validate())
        if not (math.isfinite(curve.loss[-1]) and math.isfinite(curve.validation_mm[-1])):
            raise TrainingError(
                f"the training diverged in epoch {epoch}: its loss is {curve.loss[-1]:g}, "
                f"its validation RMSE {curve.validation_mm[-1]:g} mm",
                "training",
                "look for frames of extreme values in the recording, or try another --seed",
            )
        progress("network", epoch, epochs, curve.validation_mm[-1])
        if schedule is not None:
            kept = epoch
        elif curve.validation_mm[-1] < min(curve.validation_mm[:-1], default=math.inf):
            kept, best = epoch, copy.deepcopy(task.network.state_dict())
        elif epoch - kept >= (patience or PATIENCE):
            progress("network", epochs, epochs, curve.validation_mm[kept - 1])
            break
    if schedule is None:
        task.network.load_state_dict(best)
    return Curve(curve.loss, curve.validation_mm, kept)
