"""The experiments: functions of recordings that run on any worker and return plain data.

Each trains, or builds a dictionary, on the training part of a recording and is scored on the test part, which depends
only on the seed. A dictionary compares a frame with every recorded touch: it needs no training, but memory and time for
all of them, which is the source paper's argument against it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.evaluation.dataset import Dataset, complex_bins, make_dataset, split, thin
from touchd.evaluation.model_scores import Judgement, judge, key_scores, labels_of, zones_of
from touchd.keypad import Layout
from touchd.lab.benchmark.stopwatch import Stopwatch, spread
from touchd.localization.features import Domain
from touchd.localization.model import Model
from touchd.localization.model_file import put_model
from touchd.recording.data import Recording
from touchd.training.field.dispersion import frequencies
from touchd.training.network.recipe import RECIPES

Rows = NDArray[np.float32]

TIMED = 300
"""Number of touches located one by one to measure the time of one."""
LAGS_S = np.arange(-8, 9, 2) * 1e-6
"""Delays at which two signals are compared: up to two samples of the reference acquisition."""


class Nearest:
    """kNN with k = 1, as in the paper: the position of the nearest of recorded touches (n, inputs) at (n, 2) mm."""

    def __init__(self, features: Rows, position_mm: Rows) -> None:
        self._mean = features.mean(axis=0)  # less it, sums of squares are not much larger than their differences
        self._kept = features - self._mean
        self._energy = np.square(self._kept).sum(axis=1)
        self._position_mm = position_mm
        self.bytes = self._kept.nbytes

    def locate(self, features: Rows) -> Rows:
        """Return the positions (m, 2) in mm for features (m, inputs)."""
        distance2 = self._energy - 2 * (features - self._mean) @ self._kept.T  # less the energy of the frame
        return np.asarray(self._position_mm[distance2.argmin(axis=1)])


class Correlation:
    """GCC: the position of the recorded touch with the highest generalised cross-correlation.

    All bins have equal weight (phase transform, PHAT: Knapp and Carter, IEEE Trans. ASSP 24(4), 1976). The correlations
    of the channels are summed, and their peak is sought within `LAGS_S`.

    `features`, of shape (n, inputs), are the real and imaginary parts of the bins, channel by channel, and `f_hz`, of
    shape (bins,), the bins' frequencies.
    """

    def __init__(self, features: Rows, position_mm: Rows, channels: int, f_hz: NDArray[np.floating]) -> None:
        self._channels = channels
        self._position_mm = position_mm
        turn = np.exp(2j * np.pi * LAGS_S[:, None] * f_hz).astype(np.complex64)
        self._turns = np.tile(turn, channels)
        self._kept = self._whitened(features)
        self.bytes = self._kept.nbytes

    def locate(self, features: Rows) -> Rows:
        """Return the positions (m, 2) in mm for features (m, inputs)."""
        return np.asarray(self._position_mm[self.correlate(features).argmax(axis=1)])

    def correlate(self, features: Rows) -> Rows:
        """Return the correlation peak with each recorded touch, shape (m, n); 1 for an equal signal."""
        white = self._whitened(features)
        peak = np.full((len(white), len(self._kept)), -np.inf, np.float32)
        for turn in self._turns:
            np.maximum(peak, ((white * turn) @ self._kept.conj().T).real, out=peak)
        return peak

    def _whitened(self, features: Rows) -> NDArray[np.complex64]:
        bins = complex_bins(features, self._channels).reshape(len(features), -1)
        white = bins / np.maximum(np.abs(bins), np.finfo(np.float32).tiny)
        return np.asarray(white / np.sqrt(white.shape[1]), np.complex64)


class Trial(NamedTuple):
    """What an experiment found on the test part."""

    judged: Judgement
    model: bytes = b""
    """File of the trained model."""
    size_bytes: int = 0
    """Size of a dictionary."""


def trained(
    recording: Recording, *, recipe: str, grid: int = 0, layout: Layout | None = None, seed: int = 0,
    share: float = 1.0, epochs: int | None = None,
) -> Trial:  # fmt: skip
    """Train a network by a recipe on a share of the training part, and judge it on the test part."""
    from touchd.training.train_network import train

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        model = train(
            recording, path, RECIPES[recipe], grid=grid, layout=layout, seed=seed, share=share, epochs=epochs,
            command=f"touchd reproduce: {recipe}",
        ).model  # fmt: skip
        content = path.read_bytes()
    data = make_dataset(recording, model.description.domain, taper=model.description.taper)
    test = split(len(data), seed).test
    return Trial(judge(model, inputs_of(data, model)[test], data.position_mm[test], noise_energy=0.0), content)


def looked_up(recording: Recording, *, method: str, residual: bool, seed: int = 0, share: float = 1.0) -> Trial:
    """Locate the test part by a dictionary of the training part: `method` is "kNN" or "GCC".

    Features are the frames' spectra, as in the paper, or those of the residuals.
    """
    data = make_dataset(recording)
    parts = thin(split(len(data), seed), share)
    features = data.residual if residual else data.signal
    estimator = dictionary(data, features, parts.train, method)
    unknown = np.full(len(parts.test), np.nan)
    place_mm = estimator.locate(features[parts.test]).astype(np.float64)
    return Trial(Judgement(data.position_mm[parts.test], place_mm, unknown, unknown), size_bytes=estimator.bytes)


def dictionary(data: Dataset, features: Rows, train: NDArray[np.int64], method: str) -> Nearest | Correlation:
    """Return the estimator "kNN" or "GCC" with the training touches of a dataset."""
    if method == "kNN":
        return Nearest(features[train], data.position_mm[train])
    return Correlation(features[train], data.position_mm[train], data.acquisition.channels, frequencies(data))


def judged(models: Mapping[str, bytes], recording: Recording) -> dict[str, Judgement]:
    """Locate a recording's touches by each model, frame by frame."""
    sets: dict[Domain, Dataset] = {}
    found = {}
    for name, content in models.items():
        model = loaded(content)
        domain = model.description.domain
        if domain not in sets:
            sets[domain] = make_dataset(recording, domain)
        found[name] = judge(model, inputs_of(sets[domain], model), sets[domain].position_mm, noise_energy=0.0)
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
            took[f"{method} {share:g}"] = _median_us(lambda i: estimator.locate(data.signal[i : i + 1]), test)  # noqa: B023 - called at once
    return took


def loaded(model: bytes) -> Model:
    """Load a model from the bytes of its file."""
    with tempfile.TemporaryDirectory() as folder:
        return put_model(model, Path(folder) / "model.onnx")


def inputs_of(data: Dataset, model: Model) -> Rows:
    """Return the dataset's features (n, inputs) that the model expects."""
    return data.residual if model.description.input == "residual" else data.signal


def zone_accuracy(judged: Judgement, grid: int, size_mm: tuple[float, float]) -> float:
    """Return the share of touches in the right zone, on a grid over a plate of this size."""
    true, found = (zones_of(each, grid, np.array(size_mm)) for each in (judged.true_mm, judged.position_mm))
    return float((true == found).mean())


def keypad_scores(judged: Judgement, layout: Layout) -> dict[str, float]:
    """Return accuracy and key-to-key errors; models without keys estimate the key under their position."""
    found = labels_of(judged.position_mm, layout) if judged.found_class is None else judged.found_class
    return key_scores(found, labels_of(judged.true_mm, layout), len(layout.key))


def _median_us(locate: Callable[[int], object], touches: NDArray[np.int64]) -> float:
    """Return the median time of locating one touch."""
    watch = Stopwatch()
    for i in touches.tolist():
        watch.time(partial(locate, i), 1)
    return spread(watch.times_us).p50
