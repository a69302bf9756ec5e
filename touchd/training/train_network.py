"""Train a model on a labelled recording by a recipe."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from touchd.evaluation.dataset import BASELINE_NOISE, Dataset, Split, make_dataset, split, thin
from touchd.evaluation.model_scores import Judgement, judge, scores
from touchd.keypad import Layout
from touchd.localization.model import Description, Model
from touchd.recording.data import Recording
from touchd.training.data.augment import Augmenter, Bank, make_bank
from touchd.training.data.drift_directions import drift_directions
from touchd.training.data.inspection import inspect
from touchd.training.data.synthetic import Synthesiser
from touchd.training.field.dispersion import fitted_note, is_known
from touchd.training.field.few_touches import learn_field
from touchd.training.field.learn import Field
from touchd.training.network.export import describe, make_graph, write_model
from touchd.training.network.export_check import TOLERANCE, ExportDifference, check_graph
from touchd.training.network.loop import Batches, Curve, Progress, fit
from touchd.training.network.network import PaperNetwork, PositionNetwork
from touchd.training.network.objectives import Batch, Positions, make_objective
from touchd.training.network.recipe import RECIPES, Recipe
from touchd.training.network.sigma_calibration import calibrate_sigma

BATCH = 512  # fingers per step
SYNTHETIC = 0.8  # share of them drawn from the learned field; the rest are recorded touches
OTHERS = 256  # non-fingers per step
STEPS = 18  # least steps per epoch: two passes over 4,483 touches, the source paper's training part
LEARNING_RATE = 3e-3  # peak of the one-cycle schedule with AdamW
WEIGHT_DECAY = 0.01
PAPER_BATCH = 64
PAPER_LEARNING_RATE = 1e-3  # Adam's default; the paper states neither batch nor rate
GUESSED = 0.95  # warn if the RMSE exceeds this share of a constant answer's RMSE

Warn = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Result:
    """A trained model and its scores on the test touches."""

    model: Model
    scores: dict[str, float]
    curve: Curve
    """Loss and validation RMSE by epoch."""
    notes: list[str]
    """Warnings for the user."""
    export_difference: ExportDifference
    """Differences between exported model and trained network, on the test touches."""
    judged: Judgement
    """Estimates of the exported model for the test touches."""
    parts: Split
    duration_s: float

    @property
    def curve_mm(self) -> list[float]:
        """Validation RMSE by epoch, mm."""
        return self.curve.validation_mm


def train(
    recording: Recording,
    path: Path,
    recipe: Recipe = RECIPES["best"],
    *,
    grid: int = 10,
    layout: Layout | None = None,
    seed: int = 0,
    epochs: int | None = None,
    share: float = 1.0,
    patience: int | None = None,
    command: str = "",
    field: Field | None = None,
    progress: Progress = lambda _what, _done, _all, _rmse_mm: None,
    warn: Warn = lambda _note: None,
) -> Result:
    """Train a model by a recipe and write it as an ONNX file.

    Equal recording, seed and number of threads give an equal network. The file is written only after a complete
    training.

    Parameters
    ----------
    share : float
        Share of the training part to use, for a learning curve; validation and test stay unchanged.
    field : Field, optional
        Field to draw touches from, learned from the training part; by default it is learned here.
    patience : int, optional
        See `fit`.
    warn : callable
        Receives each warning as soon as it arises.

    Raises
    ------
    TrainingError, OutputError
    """
    started_s = time.monotonic()
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    data = make_dataset(recording, recipe.domain)
    parts = thin(split(len(data), seed), share)
    plate = recording.meta.plate
    features = data.signal if recipe.paper else data.residual
    # Take every other row: adjacent rows share a frame, hence noise.
    drift = drift_directions(data.untouched[np.sort(parts.train)][::2])
    objective = make_objective(recipe, features.shape[1], plate, grid, layout, drift)
    notes: list[str] = []

    def note(text: str) -> None:
        notes.append(text)
        warn(text)

    for text in inspect(recording, len(parts.train) / len(data)):
        note(text)
    peak, augmenter = None, None
    if recipe.paper:
        batches = _paper_batches(data, parts, generator)
        optimiser = torch.optim.Adam(objective.network.parameters(), lr=PAPER_LEARNING_RATE)
    else:
        keys = layout if recipe.head == "keypad" else None
        synthesiser = _synthesiser(data, parts, keys, generator, progress, note, field)
        bank = make_bank(data, torch.from_numpy(parts.train), generator)
        augmenter = Augmenter(bank, synthesiser, generator)
        batches = _augmented_batches(bank, augmenter, synthesiser, generator, others=objective.wants_others)
        optimiser = torch.optim.AdamW(objective.network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        peak = LEARNING_RATE

    def validate() -> float:
        return objective.scores(features[parts.validation], data.position_mm[parts.validation])["rmse_mm"]

    curve = fit(
        objective, batches, optimiser, epochs or recipe.epochs, validate, progress, peak=peak, patience=patience
    )  # fmt: skip
    if isinstance(objective.network, PaperNetwork):
        objective.network.sigma_mm.fill_(validate() / np.sqrt(2))  # per axis
    elif isinstance(objective.network, PositionNetwork) and objective.network.noise_apart and augmenter is not None:
        held_out = torch.from_numpy(features[parts.validation])
        calibrate_sigma(objective.network, augmenter, held_out, _positions(data, parts.validation))

    description = Description(
        name=recipe.name,
        head=recipe.head,
        domain=recipe.domain,
        input="signal" if recipe.paper else "residual",
        acquisition=data.acquisition,
        plate=plate,
        data_sha256=data.sha256,
        command=command,
        seed=seed,
        **objective.description(),
    )
    test_mm = data.position_mm[parts.test]
    graph = make_graph(objective.network, description)
    export_difference = check_graph(objective.network, graph, features[parts.test])
    if export_difference.rounding > TOLERANCE:
        note(f"float32 rounding changes this network's answers by up to {export_difference.rounding:.2g} mm")
    # The model's metadata contain its scores, so score a first export before writing the final one.
    with tempfile.TemporaryDirectory() as folder:
        judged = judge(
            write_model(graph, Path(folder) / "model.onnx"), features[parts.test], test_mm, data.noise_energy
        )
    found = objective.scores(features[parts.test], test_mm) | scores(judged)
    if found["rmse_mm"] > GUESSED * _guess_mm(data.position_mm[parts.train], test_mm):
        note("the model is no better than a constant position: it has learned nothing")
    describe(graph, description.model_copy(update={"scores": {name: round(value, 4) for name, value in found.items()}}))
    seconds = time.monotonic() - started_s
    return Result(write_model(graph, path), found, curve, notes, export_difference, judged, parts, seconds)


def _guess_mm(known_mm: Positions, test_mm: Positions) -> float:
    """Return the RMSE of a constant answer: the mean training position."""
    return float(np.sqrt(np.square(test_mm - known_mm.mean(axis=0)).sum(axis=1).mean()))


def _synthesiser(
    data: Dataset,
    parts: Split,
    layout: Layout | None,
    generator: torch.Generator,
    progress: Progress,
    note: Warn,
    field: Field | None = None,
) -> Synthesiser | None:
    """Return the source of synthetic touches, or None with a note in the time domain, where no field is learned."""
    if data.domain != "frequency":
        note("the time domain has no field to learn: trained on the recorded touches alone")
        return None
    plate = data.meta.plate
    if not is_known(plate):
        note(fitted_note(plate))
    field = field or learn_field(data, parts.train, lambda done, all_: progress("field", done, all_, float("nan")))
    return Synthesiser(field, (plate.width_mm, plate.height_mm), generator, layout)


def _positions(data: Dataset, indices: NDArray[np.int64]) -> Tensor:
    """Return positions relative to the plate's centre, in units of its size, shape (n, 2)."""
    plate = data.meta.plate
    return torch.from_numpy(data.position_mm[indices]) / torch.tensor([plate.width_mm, plate.height_mm]) - 0.5


def _augmented_batches(
    bank: Bank, augmenter: Augmenter, synthesiser: Synthesiser | None, generator: torch.Generator, *, others: bool
) -> Batches:
    """Return batches of synthetic and recorded touches with all disturbances, and of non-fingers if `others`."""
    count = len(bank.residual)
    recorded = BATCH if synthesiser is None else round(BATCH * (1 - SYNTHETIC))
    steps = max(STEPS, 2 * -(-count // BATCH))
    own_noise = torch.zeros((BATCH, 1))  # synthetic touches have no noise of their own
    own_noise[:recorded] = BASELINE_NOISE**0.5

    def epoch() -> Iterator[Batch]:
        for _ in range(steps):
            some = torch.randint(count, (recorded,), generator=generator)
            residual, position = bank.residual[some], bank.position[some]
            if synthesiser is not None:
                drawn, place = synthesiser.draw(BATCH - recorded)
                residual, position = torch.cat([residual, drawn]), torch.cat([position, place])
            fingers, noise = augmenter.fingers(residual, own_noise)
            yield Batch(torch.cat([fingers, augmenter.others(OTHERS)]) if others else fingers, position, noise)

    return Batches(steps, epoch)


def _paper_batches(data: Dataset, parts: Split, generator: torch.Generator) -> Batches:
    """Return batches of the recorded touches, each touch once per epoch, as in the paper."""
    features = torch.from_numpy(data.signal[parts.train])
    position = _positions(data, parts.train)
    steps = max(1, len(features) // PAPER_BATCH)  # drop the incomplete batch; the order changes each epoch

    def epoch() -> Iterator[Batch]:
        order = torch.randperm(len(features), generator=generator)
        for some in torch.split(order[: steps * PAPER_BATCH], PAPER_BATCH):
            yield Batch(features[some], position[some], torch.zeros((len(some), 1)))

    return Batches(steps, epoch)
