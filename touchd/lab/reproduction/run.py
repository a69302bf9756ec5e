"""Run the experiments and collect their results for the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from touchd.errors import ModelMissing
from touchd.evaluation.dataset import digest as dataset_digest
from touchd.evaluation.model_scores import Judgement
from touchd.jobs import Job, Shared, digest, run
from touchd.keypad import Layout
from touchd.lab.reproduction import plan
from touchd.lab.reproduction.experiments import Trial, judged, raced
from touchd.lab.reproduction.paper import CENTRAL_MM
from touchd.lab.reproduction.sets import central, simulated
from touchd.localization.model import default_model_path
from touchd.recording.data import Recording

SHIPPED = ("regression", "small", "int8", "grid10", "keypad")
HELD_OUT = {"silicone": 201, "human": 202, "noise": 203, "stale": 204}
"""Seeds of the held-out touches by kind, unused elsewhere."""
TRAINING_SEED, CENTRAL_SEED, OTHER_SEED, OTHER_HELD_OUT_SEED, CIRCLE_SEED = 1, 2, 3, 205, 206
CIRCLE_HEADS = ("C-5", "C-10", "R")

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Scale:
    """Extent of the computation; the paper's size by default."""

    touches: int = 6404
    other_touches: int = 5700
    held_out: int = 3000
    circle_frames: int = 900
    epochs: int | None = None


@dataclass(slots=True)
class Results:
    """All results, by the jobs' names."""

    scale: Scale
    layout: Layout
    recording: Recording
    given: bool
    """Whether the recording is the user's, not the twin's."""
    full: Mapping[str, Trial] = field(default_factory=dict)
    central: Mapping[str, Trial] = field(default_factory=dict)
    other: Mapping[str, Trial] = field(default_factory=dict)
    held_out: dict[tuple[str, str], Judgement] = field(default_factory=dict)
    """By model and kind of touches."""
    circle: dict[str, Judgement] = field(default_factory=dict)
    """By model."""
    took_us: dict[str, float] = field(default_factory=dict)


def reproduce(
    recording: Recording | None,
    layout: Layout,
    *,
    seed: int,
    scale: Scale,
    models: Path | None = None,
    progress: Progress,
    **how: Any,
) -> Results:
    """Run all experiments; `how` goes to `touchd.jobs.run`: workers, dask, cache.

    With a user's recording, experiments that need the twin are omitted.
    """
    given = recording is not None
    progress("simulating", 0, 1)
    touches = recording if recording is not None else simulated("silicone", scale.touches, TRAINING_SEED)
    middle = touches if recording is not None else simulated("central", scale.touches, CENTRAL_SEED)
    results = Results(scale, layout, touches, given)

    def batch(jobs: list[Job], recording: Recording) -> dict[str, Trial]:
        # Identify a recording by its content, not by its time.
        identity = digest([dataset_digest(recording), recording.meta.plate, recording.acquisition])
        return run(jobs, shared={"recording": Shared(recording, identity)}, progress=progress, **how)

    jobs = plan.head_jobs(seed, scale.epochs) + plan.keypad_jobs(seed, scale.epochs, layout)
    results.full = batch(jobs + plan.better_jobs(seed, scale.epochs, layout), touches)
    results.central = batch(plan.head_jobs(seed, scale.epochs), central(middle, CENTRAL_MM))
    paper_keypad = results.full[plan.keypad_name(1.0, plan.KEYPAD_SEEDS[0])].model
    progress("timing", 0, 1)
    results.took_us = raced(touches, paper_keypad, plan.SHARES, seed)
    if given:
        return results
    results.other = batch(plan.plate_jobs(seed, scale.epochs), simulated("other", scale.other_touches, OTHER_SEED))
    _judge(results, models or default_model_path().parent, progress)
    return results


def _judge(results: Results, models: Path, progress: Progress) -> None:
    """Score the shipped models and some of the trained ones on touches with seeds unseen in training."""
    paths = {name: (models / f"{name}.onnx") for name in SHIPPED}
    for path in paths.values():
        if not path.is_file():
            raise ModelMissing("no such model", str(path), "train it, or name the folder of the models: --models")
    shipped = {name: path.read_bytes() for name, path in paths.items()}
    shipped[plan.BETTER_KEYPAD] = results.full[plan.BETTER_KEYPAD].model
    other = {plan.OTHER_PLATE: results.other[plan.OTHER_PLATE].model}
    drawn = {head: results.full[plan.head_name(head, "frequency")].model for head in CIRCLE_HEADS}
    drawn["touchd"] = shipped["regression"]
    count = results.scale.held_out
    sets = [
        *((kind, count, seed, shipped) for kind, seed in HELD_OUT.items()),
        ("other", count, OTHER_HELD_OUT_SEED, other),
        ("circle", results.scale.circle_frames, CIRCLE_SEED, drawn),
    ]
    for number, (kind, size, seed, contenders) in enumerate(sets):
        progress("judging", number, len(sets))
        found = judged(contenders, simulated(kind, size, seed))
        if kind == "circle":
            results.circle = found
        else:
            results.held_out |= {(name, kind): data for name, data in found.items()}
    progress("judging", len(sets), len(sets))
