"""Run the experiments as jobs, and collect their results for the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from touchd.evaluation.dataset import digest as dataset_digest
from touchd.evaluation.model_scores import Judgement
from touchd.jobs import Job, Shared, digest, run
from touchd.keypad import Layout
from touchd.lab.benchmark.estimators import shipped
from touchd.lab.reproduction.experiments import Trial, judged, looked_up, raced, trained
from touchd.lab.reproduction.paper import CENTRAL_MM
from touchd.lab.reproduction.sets import central, simulated
from touchd.localization.model import default_model_path
from touchd.recording.data import Recording

DOMAINS = ("frequency", "time")
GRIDS = tuple(range(2, 11))
HEADS = ("R", *(f"C-{n}" for n in GRIDS))
SHARES = (1.0, 0.8, 0.6, 0.4, 0.2)
KEYPAD_RECIPE, PLATE_RECIPE = "keypad", "best"
"""Recipes compared with the paper's."""
KEYPAD_SEEDS = (0, 1, 2)
"""Seeds of the repeated keypad trainings and splits, because the differences there are small."""
BETTER_KEYPAD = f"keypad, {SHARES[-1]:.0%} of the touches"
OTHER_PLATE = "best, another plate"

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


def head_name(head: str, domain: str) -> str:
    """Return the name of a head's job."""
    return f"{head}, {domain}"


def keypad_name(share: float, seed: int) -> str:
    """Return the name of a keypad training."""
    return f"paper-keypad, {share:.0%}, seed {seed}"


def lookup_name(share: float, seed: int) -> str:
    """Return the name of a kNN look-up on a share of the touches."""
    return f"kNN, {share:.0%}, seed {seed}"


def dictionary_name(method: str, residual: bool) -> str:
    """Return the name of a look-up among all touches."""
    return f"{method} on {'residuals' if residual else 'spectra'}"


def head_jobs(seed: int, epochs: int | None) -> list[Job]:
    """Return the trainings of the paper's regression and grid networks, in both domains."""
    jobs = []
    for domain in DOMAINS:
        prefix = "paper" if domain == "frequency" else "time"
        for head in HEADS:
            grid = int(head[2:]) if head != "R" else 0
            recipe = f"{prefix}-grid" if grid else f"{prefix}-regression"
            arguments = {"recipe": recipe, "grid": grid, "seed": seed, "epochs": epochs}
            jobs.append(Job(head_name(head, domain), trained, arguments, ("recording",)))
    return jobs


def keypad_jobs(seed: int, epochs: int | None, layout: Layout) -> list[Job]:
    """Return the trainings of the keypad, ours on the smallest share, and the look-ups in dictionaries."""
    jobs = []

    def train(name: str, **arguments: Any) -> None:
        jobs.append(Job(name, trained, {"layout": layout, "epochs": epochs, **arguments}, ("recording",)))

    def look_up(name: str, **arguments: Any) -> None:
        jobs.append(Job(name, looked_up, arguments, ("recording",)))

    for share in SHARES:
        for more in KEYPAD_SEEDS:
            train(keypad_name(share, more), recipe="paper-keypad", seed=seed + more, share=share)
            look_up(lookup_name(share, more), method="kNN", residual=False, seed=seed + more, share=share)
    train(BETTER_KEYPAD, recipe=KEYPAD_RECIPE, seed=seed, share=SHARES[-1])
    for method in ("kNN", "GCC"):
        for residual in (False, True):
            look_up(dictionary_name(method, residual), method=method, residual=residual, seed=seed)
    return jobs


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
    progress("simulating", 0, 1)
    touches = middle = recording
    if touches is None or middle is None:
        touches = simulated("silicone", scale.touches, TRAINING_SEED)
        middle = simulated("central", scale.touches, CENTRAL_SEED)
    results = Results(scale, layout, touches, recording is not None)

    def batch(jobs: list[Job], recording: Recording) -> dict[str, Trial]:
        # Identify a recording by its content, not by its time.
        identity = digest([dataset_digest(recording), recording.meta.plate, recording.acquisition])
        return run(jobs, shared={"recording": Shared(recording, identity)}, progress=progress, **how)

    heads = head_jobs(seed, scale.epochs)
    results.full = batch(heads + keypad_jobs(seed, scale.epochs, layout), touches)
    results.central = batch(heads, central(middle, CENTRAL_MM))
    progress("timing", 0, 1)
    results.took_us = raced(touches, results.full[keypad_name(1.0, KEYPAD_SEEDS[0])].model, SHARES, seed)
    if results.given:
        return results
    arguments = {"recipe": PLATE_RECIPE, "epochs": scale.epochs, "seed": seed}
    other = simulated("other", scale.other_touches, OTHER_SEED)
    results.other = batch([Job(OTHER_PLATE, trained, arguments, ("recording",))], other)
    _judge(results, models or default_model_path().parent, progress)
    return results


def _judge(results: Results, models: Path, progress: Progress) -> None:
    """Score the shipped models and some of the trained ones on touches with seeds unseen in training."""
    ours = {name: shipped(models, name).read_bytes() for name in SHIPPED}
    ours[BETTER_KEYPAD] = results.full[BETTER_KEYPAD].model
    other = {OTHER_PLATE: results.other[OTHER_PLATE].model}
    drawn = {head: results.full[head_name(head, "frequency")].model for head in CIRCLE_HEADS}
    drawn["touchd"] = ours["regression"]
    count = results.scale.held_out
    sets = [
        *((kind, count, seed, ours) for kind, seed in HELD_OUT.items()),
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
