"""Train a model on a labelled recording, by a recipe. Reads from top to bottom."""

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
from touchd.training.network.export_check import TOLERANCE, Exactness, check_graph
from touchd.training.network.loop import Batches, Curve, Progress, fit
from touchd.training.network.network import PlainRegression, Regression
from touchd.training.network.objectives import Batch, Positions, make_task
from touchd.training.network.recipe import RECIPES, Recipe
from touchd.training.network.sigma_calibration import make_honest

BATCH = 512  # fingers a step
SYNTHETIC = 0.8  # of them, the share drawn from the learned field; the others are the recorded touches
OTHERS = 256  # and things that are no finger
STEPS = 18  # an epoch has at least: two passes over 4,483 touches, the source paper's training part
LEARNING_RATE = 3e-3  # the peak of a one-cycle schedule with AdamW
WEIGHT_DECAY = 0.01
PAPER_BATCH = 64
PAPER_LEARNING_RATE = 1e-3  # Adam's usual one; the paper names neither
GUESSED = 0.95  # an error above this share of that of a constant answer

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Result:
    """A trained model and how well it does on touches it never saw."""

    model: Model
    scores: dict[str, float]
    curve: Curve
    """The loss and the validation RMSE after each epoch."""
    notes: list[str]
    """What the user should know, such as that the field could not be learned."""
    exactness: Exactness
    """How far the exported model is from the trained network, on the test touches."""
    judged: Judgement
    """What the exported model says of the test touches."""
    parts: Split
    duration_s: float

    @property
    def curve_mm(self) -> list[float]:
        """Validation RMSE after each epoch."""
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
    warn: Say = lambda _note: None,
) -> Result:
    """Train a model by a recipe and write it as an ONNX file.

    The same recording, seed and number of threads give the same network. A `share` under 1 trains on so much of
    the training part, with validation and test unchanged, as a learning curve needs it. A `field` learned from the
    training part before is drawn from as it is. `patience` is that of `fit`;
    `warn` is told each note as soon as it is known. The file is written only if all went well.

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
    # Every other row: neighbours share a frame.
    drift = drift_directions(data.untouched[np.sort(parts.train)][::2])
    task = make_task(recipe, features.shape[1], plate, grid, layout, drift)
    notes: list[str] = []

    def note(text: str) -> None:
        notes.append(text)
        warn(text)

    for text in inspect(recording, len(parts.train) / len(data)):
        note(text)
    peak, augmenter = None, None
    if recipe.paper:
        batches = _paper_batches(data, parts, generator)
        optimiser = torch.optim.Adam(task.network.parameters(), lr=PAPER_LEARNING_RATE)
    else:
        keys = layout if recipe.head == "keypad" else None
        synthesiser = _synthesiser(data, parts, keys, generator, progress, note, field)
        bank = make_bank(data, torch.from_numpy(parts.train), generator)
        augmenter = Augmenter(bank, synthesiser, generator)
        batches = _augmented_batches(bank, augmenter, synthesiser, generator, others=task.wants_others)
        optimiser = torch.optim.AdamW(task.network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        peak = LEARNING_RATE

    def validate() -> float:
        return task.scores(features[parts.validation], data.position_mm[parts.validation])["rmse_mm"]

    curve = fit(
        task, batches, optimiser, epochs or recipe.epochs, validate, progress, peak=peak, patience=patience
    )  # fmt: skip
    if isinstance(task.network, PlainRegression):
        task.network.sigma_mm.fill_(validate() / np.sqrt(2))  # per axis
    elif isinstance(task.network, Regression) and task.network.noise_apart and augmenter is not None:
        held_out = torch.from_numpy(features[parts.validation])
        make_honest(task.network, augmenter, held_out, _positions(data, parts.validation))

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
        **task.description(),
    )
    test_mm = data.position_mm[parts.test]
    graph = make_graph(task.network, description)
    exactness = check_graph(task.network, graph, features[parts.test])
    if exactness.rounding > TOLERANCE:
        note(f"float32 rounds this network's answers by up to {exactness.rounding:.2g} mm")
    # The scores are those of the exported model, so it is asked before they can stand in it.
    with tempfile.TemporaryDirectory() as folder:
        judged = judge(
            write_model(graph, Path(folder) / "model.onnx"), features[parts.test], test_mm, data.noise_energy
        )
    found = task.scores(features[parts.test], test_mm) | scores(judged)
    if found["rmse_mm"] > GUESSED * _guess_mm(data.position_mm[parts.train], test_mm):
        note("the model places touches no better than the middle of all of them: it has learned nothing")
    describe(graph, description.model_copy(update={"scores": {name: round(value, 4) for name, value in found.items()}}))
    seconds = time.monotonic() - started_s
    return Result(write_model(graph, path), found, curve, notes, exactness, judged, parts, seconds)


def _guess_mm(known_mm: Positions, test_mm: Positions) -> float:
    """Return the RMSE of one who says the middle of the known touches whatever comes."""
    return float(np.sqrt(np.square(test_mm - known_mm.mean(axis=0)).sum(axis=1).mean()))


def _synthesiser(
    data: Dataset,
    parts: Split,
    layout: Layout | None,
    generator: torch.Generator,
    progress: Progress,
    note: Say,
    field: Field | None = None,
) -> Synthesiser | None:
    """Return the source of drawn touches, or None with a note where the field cannot be learned."""
    if data.domain != "frequency":
        note("in the time domain no field is learned: trained on the recorded touches alone")
        return None
    plate = data.meta.plate
    if not is_known(plate):
        note(fitted_note(plate))
    field = field or learn_field(data, parts.train, lambda done, all_: progress("field", done, all_, float("nan")))
    return Synthesiser(field, (plate.width_mm, plate.height_mm), generator, layout)


def _positions(data: Dataset, indices: NDArray[np.int64]) -> Tensor:
    """Return positions in plate sizes from the centre, shape (n, 2)."""
    plate = data.meta.plate
    return torch.from_numpy(data.position_mm[indices]) / torch.tensor([plate.width_mm, plate.height_mm]) - 0.5


def _augmented_batches(
    bank: Bank, augmenter: Augmenter, synthesiser: Synthesiser | None, generator: torch.Generator, *, others: bool
) -> Batches:
    """Return batches of drawn and recorded touches under all disturbances, and of what is no finger."""
    count = len(bank.residual)
    recorded = BATCH if synthesiser is None else round(BATCH * (1 - SYNTHETIC))
    steps = max(STEPS, 2 * -(-count // BATCH))
    own_noise = torch.zeros((BATCH, 1))  # what is drawn has none
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
    """Return batches of the recorded touches, each once an epoch, as the paper has them."""
    features = torch.from_numpy(data.signal[parts.train])
    position = _positions(data, parts.train)
    steps = max(1, len(features) // PAPER_BATCH)  # the few that are left over wait for another epoch

    def epoch() -> Iterator[Batch]:
        order = torch.randperm(len(features), generator=generator)
        for some in torch.split(order[: steps * PAPER_BATCH], PAPER_BATCH):
            yield Batch(features[some], position[some], torch.zeros((len(some), 1)))

    return Batches(steps, epoch)
