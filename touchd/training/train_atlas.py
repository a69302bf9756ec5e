"""Train a network and its field atlas on one labelled recording."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchd.errors import ModelMismatch, TrainingError
from touchd.evaluation.dataset import Split, digest, make_dataset, split
from touchd.evaluation.model_scores import Judgement, scores
from touchd.localization.atlas import Atlas, atlas_path, save_atlas
from touchd.localization.model import Model
from touchd.localization.model_file import put_model
from touchd.recording.data import Recording
from touchd.training.data.inspection import degrees_of_freedom, inspect
from touchd.training.data.temperature import at_one_temperature
from touchd.training.field.bins import TAPER, informative
from touchd.training.field.dispersion import dispersion_of, fitted_note, is_known
from touchd.training.field.learn import Learned, learn_thoroughly
from touchd.training.field.make_atlas import Calibration, make_atlas, signal_over_noise, try_atlas, with_field
from touchd.training.field.regression import Floats, touches_of
from touchd.training.network.loop import Progress
from touchd.training.network.recipe import RECIPES
from touchd.training.train_network import Result, Warn, train

AMPLE = 2.0
"""Touches per degree of freedom: with 0.9, 1.4, 1.8, 2.3 and 4.6 the RMSE was 0.78, 0.47, 0.30, 0.22, 0.08 mm."""
HOPELESS = 0.5
"""With 0.7 touches per degree of freedom the RMSE was 1.1 mm, even from true starts: no better than a network's."""
TRAINING_SHARE = 0.7


@dataclass(frozen=True, slots=True)
class AtlasResult:
    """A field atlas with its network, and their scores on the test touches."""

    path: Path
    atlas: Atlas
    model: Model
    network: Result | None
    """Result of training the network; None for a given network."""
    learned: Learned
    judged: Judgement
    """Estimates of the atlas for the test touches."""
    start_mm: Floats
    """Those of the network alone, shape (n, 2)."""
    parts: Split
    calibration: Calibration
    notes: list[str]
    """Warnings for the user."""
    duration_s: float

    @property
    def scores(self) -> dict[str, float]:
        """Scores on the test touches."""
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
    warn: Warn = lambda _note: None,
) -> AtlasResult:
    """Train a field atlas and its starting network, and write both: `plate.onnx`, `plate.atlas.npz`.

    `network` is one trained on this recording, instead of training one; its split replaces that of `seed`. For the
    other parameters see `touchd.training.train_network.train`. Raises ModelMismatch if the network was trained on
    another recording, or is no regression; TrainingError and OutputError.
    """
    started_s = time.monotonic()
    notes: list[str] = []

    def note(text: str) -> None:
        notes.append(text)
        warn(text)

    if network is not None:
        seed = _check_network(network, recording)
    plain = make_dataset(recording)
    parts = split(len(plain), seed)
    steady, reference = at_one_temperature(recording, make_dataset(recording, taper=TAPER))
    touches = touches_of(steady, parts.train)
    wavenumber_per_mm, fitted = dispersion_of(steady, touches), not is_known(plain.meta.plate)
    snr = signal_over_noise(touches_of(steady, parts.validation))
    kept = informative(snr, wavenumber_per_mm, plain.acquisition)
    for text in check_density(touches.position_mm, float(wavenumber_per_mm[kept[-1]])):
        note(text)

    def learn(what: str, part: NDArray[np.int64]) -> Learned:
        return learn_thoroughly(
            touches_of(steady, part), wavenumber_per_mm,
            lambda done, steps: progress(what, done, steps, float("nan")),
        )  # fmt: skip

    learned = learn("field", parts.train)
    again = learn("whole field", np.concatenate([parts.train, parts.validation]))

    trained: Result | None = None
    if network is None:
        trained = train(
            recording, path, RECIPES["atlas"], seed=seed, epochs=epochs, command=command, progress=progress, warn=note
        )
        model = trained.model
    else:
        if fitted:
            note(fitted_note(plain.meta.plate))
        for text in inspect(recording, len(parts.train) / len(plain)):
            note(text)
        model = put_model(network.read_bytes(), path)

    said = {
        "seed": seed,
        "command": command,
        "fitted": fitted,
        "wavenumber_rad_m": tuple((wavenumber_per_mm * 1e3).round(3).tolist()),
    }
    calibrated, calibration = make_atlas(steady, reference, parts, learned, kept, said)
    atlas = with_field(calibrated, steady, parts, learned, again)
    start_mm = np.asarray(model.run(plain.residual[parts.test])["position_mm"], np.float64)
    judged = try_atlas(atlas, steady, parts, start_mm)
    rounded = {name: round(value, 4) for name, value in scores(judged).items()}
    atlas = replace(atlas, description=atlas.description.model_copy(update={"scores": rounded}))
    save_atlas(atlas, atlas_path(path))
    seconds = time.monotonic() - started_s
    return AtlasResult(
        atlas_path(path), atlas, model, trained, learned, judged, start_mm, parts, calibration, notes, seconds
    )


def check_density(position_mm: Floats, wavenumber_per_mm: float) -> Iterator[str]:
    """Warn if the training touches (n, 2) are too few for the atlas' finest bin.

    Raises TrainingError if they are so few that the atlas could not locate a touch, or all at one place.
    """
    if not np.ptp(position_mm, axis=0).any():
        raise TrainingError(
            "all touches have one place", "contacts_mm", "write down where each was, or touch elsewhere"
        )
    least = degrees_of_freedom(position_mm, wavenumber_per_mm)
    have = len(position_mm)
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


def _check_network(path: Path, recording: Recording) -> int:
    """Return the seed of a network's split; raise ModelMismatch if it cannot start an atlas of this recording."""
    d = Model(path, atlas=False).description
    if d.head != "regression" or d.domain != "frequency" or d.input != "residual":
        raise ModelMismatch(
            f"the recipe {d.name} cannot start an atlas", str(path), "use a network of the recipe best or small"
        )
    if d.data_sha256 != digest(recording):
        raise ModelMismatch(
            "trained on another recording",
            str(path),
            "name the very recording that it was trained on (other computers round some counts of a simulation "
            "otherwise), or omit --network to train both",
        )
    return d.seed
