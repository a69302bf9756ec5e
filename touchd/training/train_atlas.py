"""Train a network and its field atlas on one labelled recording. Reads from top to bottom."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from touchd.errors import ModelMismatch, TrainingError
from touchd.evaluation.dataset import Split, digest, make_dataset, split
from touchd.localization.atlas import Atlas, atlas_path, save_atlas
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.training.data.inspection import freedom, inspect
from touchd.training.data.one_temperature import at_one_temperature
from touchd.training.field.dispersion import Dispersion, dispersion_of, fitted_note
from touchd.training.field.learn import Learned, learn_thoroughly
from touchd.training.field.make_atlas import Calibration, Trial, informative, make_atlas, signal_over_noise, try_atlas
from touchd.training.field.regression import Floats, touches_of
from touchd.training.network.export import put_model
from touchd.training.network.loop import Progress
from touchd.training.network.recipe import RECIPES
from touchd.training.train_network import Result, Say, train

AMPLE = 2.0
"""Touches for each degree of freedom: with 0.9, 1.4, 1.8, 2.3 and 4.6 the RMSE was 0.78, 0.47, 0.30, 0.22, 0.08 mm."""
HOPELESS = 0.5
"""With 0.7 it was 1.1 mm from starts at the truth: no better than a network's, and steeply rising."""
TRAINING_SHARE = 0.7


@dataclass(frozen=True, slots=True)
class AtlasResult:
    """A field atlas beside its network, and how well it does on touches that neither ever saw."""

    path: Path
    atlas: Atlas
    model: Model
    network: Result | None
    """Of the network's training; None for one that was there already."""
    learned: Learned
    dispersion: Dispersion
    parts: Split
    trial: Trial
    calibration: Calibration
    notes: list[str]
    """What the user should know."""
    duration_s: float

    @property
    def scores(self) -> dict[str, float]:
        """Of the test touches."""
        return self.atlas.description.scores


def train_atlas(
    recording: Recording,
    path: Path,
    network: Path | None = None,
    *,
    seed: int = 0,
    epochs: int | None = None,
    command: str = "",
    progress: Progress = lambda _what, _done, _all, _rmse_mm: None,
    warn: Say = lambda _note: None,
) -> AtlasResult:
    """Train a field atlas, and the network that it starts from, and write both: `plate.onnx`, `plate.atlas.npz`.

    Parameters
    ----------
    recording : Recording
    path : Path
        Of the network to write.
    network : Path, optional
        One trained on this recording before, to be used instead of training one; its split is used, `seed` is not.
    seed, epochs, command, progress, warn
        As of `touchd.training.train_network.train`.

    Raises
    ------
    ModelMismatch
        If the network was trained on another recording, or does not answer with positions.
    TrainingError, OutputError
    """
    started_s = time.monotonic()
    notes: list[str] = []

    def note(text: str) -> None:
        notes.append(text)
        warn(text)

    if network is not None:
        seed = _fitting(Model(network), network, recording).description.seed
    plain = make_dataset(recording)
    parts = split(len(plain), seed)
    steady, reference = at_one_temperature(recording, plain)
    touches = touches_of(steady, parts.train)
    dispersion = dispersion_of(steady, touches)
    audible = informative(signal_over_noise(touches_of(steady, parts.validation)))
    for text in check_density(touches.place_mm, float(dispersion.wavenumber_per_mm[audible[-1]])):
        note(text)
    learned = learn_thoroughly(
        touches, dispersion.wavenumber_per_mm, lambda done, steps: progress("field", done, steps, float("nan"))
    )

    trained: Result | None = None
    if network is None:
        trained = train(
            recording, path, RECIPES["atlas"], seed=seed, epochs=epochs, command=command, progress=progress, warn=note,
            field=learned.field,
        )  # fmt: skip
        model = trained.model
    else:
        if dispersion.fitted:
            note(fitted_note(plain.meta.plate))
        for text in inspect(recording, len(parts.train) / len(plain)):
            note(text)
        model = _copy(network, path)

    said = {
        "seed": seed,
        "command": command,
        "fitted": dispersion.fitted,
        "wavenumber_rad_m": tuple((dispersion.wavenumber_per_mm * 1e3).round(3).tolist()),
    }
    atlas, calibration = make_atlas(steady, reference, parts, learned, said)
    trial, scores = try_atlas(atlas, model, steady, plain, parts)
    rounded = {name: round(value, 4) for name, value in scores.items()}
    atlas = replace(atlas, description=atlas.description.model_copy(update={"scores": rounded}))
    save_atlas(atlas, atlas_path(path))
    seconds = time.monotonic() - started_s
    return AtlasResult(
        atlas_path(path), atlas, model, trained, learned, dispersion, parts, trial, calibration, notes, seconds
    )


def check_density(place_mm: Floats, wavenumber_per_mm: float) -> Iterator[str]:
    """Tell when touches (n, 2) for training are fewer than an atlas needs in its finest bin.

    Raises
    ------
    TrainingError
        If they are so few that it would place nothing.
    """
    least = freedom(place_mm, wavenumber_per_mm)
    have = len(place_mm)
    if have < HOPELESS * least:
        raise TrainingError(
            f"{have} touches for training: an atlas of this part of the plate has {least:.0f} degrees of freedom",
            fix=f"record {AMPLE * least / TRAINING_SHARE:.0f} touches or more, or train the recipe best",
        )
    if have < AMPLE * least:
        yield (
            f"{have} touches for training are fewer than {AMPLE:g} times the field's {least:.0f} degrees of freedom: "
            f"the atlas will be coarse; record {AMPLE * least / TRAINING_SHARE:.0f} or more"
        )


def _fitting(model: Model, path: Path, recording: Recording) -> Model:
    """Return the model if an atlas of this recording can start from it."""
    d = model.description
    if d.head != "regression" or d.domain != "frequency" or d.input != "residual":
        raise ModelMismatch(
            f"the recipe {d.name} gives no start for an atlas", str(path), "use a network of the recipe best or small"
        )
    if d.data_sha256 != digest(recording):
        raise ModelMismatch(
            "was trained on another recording than this",
            str(path),
            "name the recording that it was trained on, or train both anew: leave --network out",
        )
    return model


def _copy(network: Path, path: Path) -> Model:
    """Put a network where it is wanted, whole or not at all."""
    if path.exists() and path.samefile(network):
        return Model(path)
    return put_model(network.read_bytes(), path)
