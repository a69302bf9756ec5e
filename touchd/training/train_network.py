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

from touchd.errors import TrainingError
from touchd.evaluation.dataset import BASELINE_NOISE, Dataset, Split, make_dataset, split, thin
from touchd.evaluation.model_scores import Judgement, judge, scores
from touchd.keypad import Layout
from touchd.localization.model import Description, Model
from touchd.localization.model_file import put_model
from touchd.recording.data import Recording
from touchd.training.data.augment import Augmenter
from touchd.training.data.inspection import inspect
from touchd.training.data.synthetic import Synthesiser
from touchd.training.data.temperature import drift_directions
from touchd.training.field.dispersion import fitted_note, is_known
from touchd.training.field.error_scale import fit_scales
from touchd.training.field.few_touches import learn_field
from touchd.training.field.regression import Floats
from touchd.training.network.export import TOLERANCE, check_export, describe, make_graph
from touchd.training.network.loop import Curve, Epoch, Progress, fit
from touchd.training.network.network import Batch, PaperNetwork, PositionNetwork, Positions
from touchd.training.network.recipe import RECIPES, Recipe
from touchd.training.network.zones_and_keys import make_network

BATCH = 512  # fingers per step
SYNTHETIC = 0.8  # share of them drawn from the learned field; the rest are recorded touches
OTHERS = 256  # non-fingers per step
STEPS = 18  # least steps per epoch: two passes over 4,483 touches, the source paper's training part
LEARNING_RATE = 3e-3  # peak of the one-cycle schedule with AdamW
WEIGHT_DECAY = 0.01
PAPER_BATCH = 64
PAPER_LEARNING_RATE = 1e-3  # Adam's default; the paper states neither batch nor rate
GUESSED = 0.95  # warn if the RMSE exceeds this share of a constant answer's RMSE
LOUDER = (0.2, 0.6)
"""Noise relative to the median touch, by feature norms, at which sigma is calibrated beside the touches' own noise. On
the reference plate this is 50 and 40 dB below the untouched signal."""

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
    rounding: float
    """See `check_export`, on the test touches."""
    judged: Judgement
    """Estimates of the exported model for the test touches."""
    parts: Split
    duration_s: float


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
    command: str = "",
    progress: Progress = lambda _what, _done, _all, _rmse_mm: None,
    warn: Warn = lambda _note: None,
) -> Result:
    """Train a model by a recipe and write it as an ONNX file.

    Equal recording, seed and number of threads give an equal network. The file is written only after a complete
    training. It uses this `share` of the training part, for a learning curve; validation and test stay unchanged.
    `warn` receives each warning as soon as it arises. Raises TrainingError and OutputError.
    """
    started_s = time.monotonic()
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    _check_classes(recipe, grid, layout)
    data = make_dataset(recording, recipe.domain)
    parts = thin(split(len(data), seed), share)
    features = data.signal if recipe.paper else data.residual
    description = Description(
        name=recipe.name,
        head=recipe.head,
        domain=recipe.domain,
        input="signal" if recipe.paper else "residual",
        acquisition=data.acquisition,
        plate=data.meta.plate,
        grid=grid if recipe.head == "grid" else 0,
        layout=layout if recipe.head == "keypad" else None,
        data_sha256=data.sha256,
        command=command,
        seed=seed,
    )
    # Take every other row: adjacent rows share a frame, hence noise.
    drift = drift_directions(data.untouched[np.sort(parts.train)][::2])
    network = make_network(recipe, description, torch.from_numpy(drift))
    notes: list[str] = []

    def note(text: str) -> None:
        notes.append(text)
        warn(text)

    def validate() -> float:
        return network.rmse_mm(features[parts.validation], data.position_mm[parts.validation])

    for text in inspect(recording, len(parts.train) / len(data)):
        note(text)
    if recipe.paper:
        batches, steps = _paper_batches(data, parts, generator)
        optimiser = torch.optim.Adam(network.parameters(), lr=PAPER_LEARNING_RATE)
        curve = fit(network, batches, steps, optimiser, epochs or recipe.epochs, validate, progress)
    else:
        plate = data.meta.plate
        if not is_known(plate):
            note(fitted_note(plate))
        field = learn_field(data, parts.train, lambda done, all_: progress("field", done, all_, float("nan")))
        synthesiser = Synthesiser(field, plate.size_mm, generator, description.layout)
        augmenter = Augmenter(data, torch.from_numpy(parts.train), synthesiser, generator)
        batches, steps = _augmented_batches(augmenter, generator, others=isinstance(network, PositionNetwork))
        optimiser = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
        curve = fit(network, batches, steps, optimiser, epochs or recipe.epochs, validate, progress, peak=LEARNING_RATE)
        if isinstance(network, PositionNetwork) and network.noise_apart:
            held_out = torch.from_numpy(features[parts.validation])
            calibrate_sigma(network, augmenter, held_out, _positions(data, parts.validation))
    if isinstance(network, PaperNetwork):
        network.sigma_mm.fill_(validate() / np.sqrt(2))  # per axis

    test_mm = data.position_mm[parts.test]
    graph = make_graph(network, description)
    # The model's metadata contain its scores, so score a first export before writing the final one.
    with tempfile.TemporaryDirectory() as folder:
        model = put_model(graph.SerializeToString(), Path(folder) / "model.onnx")
        rounding = check_export(network, model, features[parts.test])
        judged = judge(model, features[parts.test], test_mm, data.noise_energy)
    if rounding > TOLERANCE:
        note(f"float32 rounding changes this network's answers by up to {rounding:.2g} mm")
    found = scores(judged)
    if found["rmse_mm"] > GUESSED * _guess_mm(data.position_mm[parts.train], test_mm):
        note("the model is no better than a constant position: it has learned nothing")
    describe(graph, description.model_copy(update={"scores": {name: round(value, 4) for name, value in found.items()}}))
    seconds = time.monotonic() - started_s
    return Result(put_model(graph.SerializeToString(), path), found, curve, notes, rounding, judged, parts, seconds)


def _check_classes(recipe: Recipe, grid: int, layout: Layout | None) -> None:
    """Raise TrainingError if a grid has fewer than 2 zones per side, or a keypad has no layout."""
    if recipe.head == "keypad" and layout is None:
        raise TrainingError("a keypad recipe needs a layout", "--layout", "name a TOML file of keys")
    if recipe.head == "grid" and grid < 2:
        raise TrainingError(f"a grid of {grid} x {grid} zones has one class", "--n", "use 2 or more")


def _guess_mm(known_mm: Positions, test_mm: Positions) -> float:
    """Return the RMSE of a constant answer: the mean training position."""
    return float(np.sqrt(np.square(test_mm - known_mm.mean(axis=0)).sum(axis=1).mean()))


def _positions(data: Dataset, indices: NDArray[np.int64]) -> Tensor:
    """Return positions relative to the plate's centre, in units of its size, shape (n, 2)."""
    return torch.from_numpy(data.position_mm[indices]) / torch.tensor(data.meta.plate.size_mm) - 0.5


def _augmented_batches(augmenter: Augmenter, generator: torch.Generator, *, others: bool) -> tuple[Epoch, int]:
    """Return epochs of synthetic and recorded touches with all disturbances, and of non-fingers if `others`."""
    count = len(augmenter.residual)
    recorded = round(BATCH * (1 - SYNTHETIC))
    steps = max(STEPS, 2 * -(-count // BATCH))
    own_noise = torch.zeros((BATCH, 1))  # synthetic touches have no noise of their own
    own_noise[:recorded] = BASELINE_NOISE**0.5

    def epoch() -> Iterator[Batch]:
        for _ in range(steps):
            some = torch.randint(count, (recorded,), generator=generator)
            drawn, place = augmenter.synthesiser.draw(BATCH - recorded)
            fingers, noise = augmenter.fingers(torch.cat([augmenter.residual[some], drawn]), own_noise)
            features = torch.cat([fingers, augmenter.others(OTHERS)]) if others else fingers
            yield Batch(features, torch.cat([augmenter.position[some], place]), noise)

    return epoch, steps


def _paper_batches(data: Dataset, parts: Split, generator: torch.Generator) -> tuple[Epoch, int]:
    """Return epochs of the recorded touches, each touch once, as in the paper."""
    features = torch.from_numpy(data.signal[parts.train])
    position = _positions(data, parts.train)
    steps = max(1, len(features) // PAPER_BATCH)  # drop the incomplete batch; the order changes each epoch

    def epoch() -> Iterator[Batch]:
        order = torch.randperm(len(features), generator=generator)
        for some in torch.split(order[: steps * PAPER_BATCH], PAPER_BATCH):
            yield Batch(features[some], position[some], torch.zeros((len(some), 1)))

    return epoch, steps


def calibrate_sigma(network: PositionNetwork, augmenter: Augmenter, residual: Tensor, position: Tensor) -> None:
    """Scale a network's two sigma outputs so that 68 % of the errors per axis lie within sigma.

    Training shows the network more disturbances than most plates have, so its sigma is too large. The two scales are
    fitted on held-out touches, at their own noise and at higher noise, half of them with another finger's amplitude:
    residuals (n, inputs) at positions (n, 2) relative to the plate's centre, in units of its size.
    """
    own = augmenter.own_noise(residual)
    levels = [1.0, *(louder / own for louder in LOUDER if 0 < own < louder / 1.1)]
    predictions = [_predict(network, *augmenter.held_out(residual, level), position) for level in levels]
    error_mm, sigma_mm, noise_mm = predictions[-1]
    # Relative to the errors, so that the search does not depend on what the outputs were before.
    units = [np.median(error_mm) / (np.median(part) or 1.0) for part in (sigma_mm, noise_mm)]

    def ratios(sigma_scale: float, noise_scale: float) -> list[Floats]:
        a, b = sigma_scale * units[0], noise_scale * units[1]
        return [error_mm / np.hypot(a * sigma_mm, b * noise_mm) for error_mm, sigma_mm, noise_mm in predictions]

    scales = np.array(fit_scales(ratios)) * units
    with torch.no_grad():
        network.log_error.bias.add_(torch.from_numpy(np.log(scales)))


def _predict(network: PositionNetwork, features: Tensor, noise: Tensor, position: Tensor) -> tuple[Floats, ...]:
    """Return the absolute error per axis (n, 2), and sigma (n, 1) without noise and due to the noise present, mm."""
    with torch.inference_mode():
        position_mm, sigma_mm, _, noise_mm = network.eval()(features)
        error_mm = (position_mm - network.truth_mm(position)).abs()
    return tuple(part.double().numpy() for part in (error_mm, sigma_mm, noise_mm * noise))
