"""The experiments: functions of recordings that run on any worker and return plain data.

Each trains, or builds a dictionary, on the training part of a recording and is scored on the test part, which depends
only on the seed.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import Dataset, make_dataset, split, thin
from touchd.keypad import Layout
from touchd.lab.dictionary import Correlation, Nearest
from touchd.localization.features import Domain, band_bins
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.training.network.recipe import RECIPES

Rows = NDArray[np.float32]
Data = dict[str, Any]

TIMED = 300
"""Number of touches located one by one to measure the time of one."""


def trained(
    recording: Recording,
    *,
    recipe: str,
    grid: int = 0,
    layout: Layout | None = None,
    seed: int = 0,
    share: float = 1.0,
    epochs: int | None = None,
) -> Data:
    """Train a network by a recipe on a share of the training part.

    Returns `place_mm` and `truth_mm` of the test part (n, 2), the estimated class (n,) of a classifier, the model as
    bytes, its scores, its learning curve and the training time.
    """
    from touchd.training.train_network import train

    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        result = train(
            recording, path, RECIPES[recipe], grid=grid, layout=layout, seed=seed, share=share, epochs=epochs,
            command=f"touchd reproduce: {recipe}",
        )  # fmt: skip
        model, found = path.read_bytes(), located(result.model, test_part(recording, result.model, seed))
    return found | {
        "model": model,
        "scores": result.scores,
        "curve_mm": result.curve_mm,
        "train_s": time.monotonic() - started,
    }


def looked_up(recording: Recording, *, method: str, residual: bool, seed: int = 0, share: float = 1.0) -> Data:
    """Locate the test part by a dictionary of the training part: `method` is "kNN" or "GCC".

    Features are the frames' spectra, as in the paper, or those of the residuals. Returns `place_mm` and `truth_mm` of
    the test part, and the dictionary's size in `bytes`.
    """
    data = make_dataset(recording)
    parts = thin(split(len(data), seed), share)
    features = data.residual if residual else data.signal
    estimator = dictionary(data, features, parts.train, method)
    return {
        "place_mm": estimator.locate(features[parts.test]),
        "truth_mm": data.position_mm[parts.test],
        "bytes": estimator.bytes,
    }


def dictionary(data: Dataset, features: Rows, train: NDArray[np.int64], method: str) -> Nearest | Correlation:
    """Return the estimator "kNN" or "GCC" with the training touches of a dataset."""
    if method == "kNN":
        return Nearest(features[train], data.position_mm[train])
    a = data.acquisition
    f_hz = band_bins(a) * a.sample_rate_hz / a.samples
    return Correlation(features[train], data.position_mm[train], a.channels, f_hz)


def judged(models: Mapping[str, bytes], recording: Recording) -> dict[str, Data]:
    """Locate a recording's touches by each model, frame by frame."""
    sets: dict[Domain, Dataset] = {}
    found = {}
    for name, content in models.items():
        model = loaded(content)
        domain = model.description.domain
        if domain not in sets:
            sets[domain] = make_dataset(recording, domain)
        found[name] = located(model, touches_of(sets[domain], model))
    return found


def raced(recording: Recording, model: bytes, shares: tuple[float, ...], seed: int = 0) -> dict[str, float]:
    """Return the median time of one touch, us: of the network, and of kNN and GCC by share of the training part.

    The estimators run one after the other in this process, on the same touches with precomputed features.
    """
    network = loaded(model)
    data = make_dataset(recording)
    parts = split(len(data), seed)
    inputs, test = inputs_of(data, network), parts.test[:TIMED]

    def one(i: int) -> None:
        network.features[0] = inputs[i]
        network.estimate()

    took = {"network": _median_us(one, test)}
    for method in ("kNN", "GCC"):
        for share in shares if method == "kNN" else (1.0,):
            estimator = dictionary(data, data.signal, thin(parts, share).train, method)
            took[f"{method} {share:g}"] = _median_us(partial(_locate_one, estimator, data.signal), test)
    return took


def test_part(recording: Recording, model: Model, seed: int) -> tuple[Rows, Rows]:
    """Return the model's features of the test part, and the positions."""
    features, place_mm = touches_of(make_dataset(recording, model.description.domain), model)
    test = split(len(features), seed).test
    return features[test], place_mm[test]


def touches_of(data: Dataset, model: Model) -> tuple[Rows, Rows]:
    """Return the model's features of a dataset's touches, and the positions."""
    return inputs_of(data, model), data.position_mm


def loaded(model: bytes) -> Model:
    """Load a model from the bytes of its file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        path.write_bytes(model)
        return Model(path)


def inputs_of(data: Dataset, model: Model) -> Rows:
    """Return the dataset's features (n, inputs) that the model expects."""
    return data.residual if model.description.input == "residual" else data.signal


def located(model: Model, touches: tuple[Rows, Rows]) -> Data:
    """Run a model on touches, given as features and positions."""
    features, truth_mm = touches
    outputs = model.run(features)
    found: Data = {"truth_mm": truth_mm}
    if "position_mm" in outputs:
        return found | {
            "place_mm": outputs["position_mm"],
            "confidence": outputs["confidence"],
        }
    winner = outputs["probability"].argmax(axis=1)
    return found | {"place_mm": centres_mm(model)[winner], "class": winner}


def centres_mm(model: Model) -> Rows:
    """Return the centre of each class of a grid or keypad model; the plate's centre for the class beside all keys."""
    d = model.description
    if d.layout is not None:
        middle = (d.plate.width_mm / 2, d.plate.height_mm / 2)
        return np.array([*(key.centre_mm for key in d.layout.key), middle], np.float32)
    rows, columns = np.divmod(np.arange(d.grid**2), d.grid)
    size_mm = [d.plate.width_mm / d.grid, d.plate.height_mm / d.grid]
    return np.asarray((np.stack([columns, rows], axis=1) + 0.5) * size_mm, np.float32)


def _locate_one(estimator: Nearest | Correlation, features: Rows, i: int) -> None:
    estimator.locate(features[i : i + 1])


def _median_us(locate: Callable[[int], object], touches: NDArray[np.int64]) -> float:
    """Return the median time of locating one touch."""
    took = []
    for i in touches:
        started = time.perf_counter_ns()
        locate(i)
        took.append(time.perf_counter_ns() - started)
    return float(np.median(took)) * 1e-3
