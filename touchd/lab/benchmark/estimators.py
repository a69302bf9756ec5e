"""The estimators of the benchmark: each maps the residual of one frame to a position."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray

from touchd.config.schema import Settings
from touchd.detection.detector import Detection
from touchd.frame import Acquisition
from touchd.lab.benchmark import graphs
from touchd.lab.benchmark.boundnetwork import BoundNetwork
from touchd.lab.benchmark.touches import RATE_HZ, Block
from touchd.localization.atlas import Atlas
from touchd.localization.atlas_localizer import FIRST_STEPS, FOLLOW_STEPS, AtlasLocalizer
from touchd.localization.features import band_bins, make_features, windowed_dft
from touchd.localization.model import Model
from touchd.outcome import Outcome
from touchd.touch import Touch

Array = NDArray[np.float32]
Place = tuple[float, float] | None
"""x and y, mm; None if the estimator finds no finger."""
NETWORKS = ("regression", "small", "int8", "grid10", "keypad", "time")
LOOK_UP_MACS = 72
"""Multiply-adds per feature of a Gauss-Newton step: 48 for the splines, 24 for the products."""
_NODES_READ = 16


def _nothing(*_: object) -> None:
    pass


@dataclass(slots=True)
class Estimator:
    """One way to a position, with its cost."""

    name: str
    group: str
    """Group of the comparison: network, route, dictionary, atlas or given."""
    locate: Callable[[Array], Place]
    """Maps a residual of shape (channels, samples) to a position; this call is timed."""
    macs: int
    """Upper limit of the multiply-adds."""
    bytes: int
    """Bytes of weights, tables or recorded touches read for one position."""
    rebase: Callable[[Block], object] = _nothing
    """Sets another untouched plate; not timed, because the daemon does it once a second."""
    prepare: Callable[[Array], object] = _nothing
    """Receives the residual of the preceding frame; not timed."""
    slow: bool = False
    """Whether to run one pass only."""
    remark: str = ""


def network(model: Model, graph: onnx.ModelProto, name: str, group: str = "network") -> Estimator:
    """Return a network with the daemon's features: the windowed DFT as a product, or the samples."""
    a = model.description.acquisition
    features = make_features(model.description.domain, a)
    into = model.features.reshape(features.shape)
    baseline, signal = np.zeros(a.shape, np.float32), np.zeros(a.shape, np.float32)

    def locate(residual: Array) -> Place:
        features.extract(residual, into)
        return model.estimate()[:2]

    def locate_by_signal(residual: Array) -> Place:
        np.add(residual, baseline, out=signal)
        features.extract(signal, into)
        return model.estimate()[:2]

    def rebase(block: Block) -> None:
        np.copyto(baseline, block.baseline)

    in_time = model.description.domain == "time"
    remark = {"grid": "answers with the middle of a zone", "keypad": "answers with the middle of a key"}
    table = 0 if in_time else windowed_dft(a).size
    return Estimator(
        name, group, locate if model.description.input == "residual" else locate_by_signal,
        graphs.multiply_adds(graph) + a.channels * table, graphs.weight_bytes(graph) + 4 * table, rebase,
        remark=remark.get(model.description.head, "takes samples, not a spectrum" if in_time else ""),
    )  # fmt: skip


def routes(model: Model, graph: onnx.ModelProto, folder: Path) -> Iterator[Estimator]:
    """Yield the default network with features computed otherwise, or computed in float64."""
    a = model.description.acquisition
    matrix = windowed_dft(a)
    macs, weights = graphs.multiply_adds(graph), graphs.weight_bytes(graph)
    whole = macs + a.channels * matrix.size

    # numpy.fft: window, transform of all bins, band cut out.
    window = np.hanning(a.samples).astype(np.float32)
    bins = band_bins(a)
    band, count = slice(int(bins[0]), int(bins[-1]) + 1), len(bins)
    into = model.features.reshape(a.channels, 2, count)

    def by_rfft(residual: Array) -> Place:
        spectrum = np.fft.rfft(residual * window)[:, band]
        into[:, 0], into[:, 1] = spectrum.real, spectrum.imag
        return model.estimate()[:2]

    # A real transform of length N takes about N log2 N multiply-adds.
    rfft_macs = round(a.channels * a.samples * (1 + math.log2(a.samples)))
    yield Estimator("regression, rfft", "route", by_rfft, macs + rfft_macs, weights + 4 * a.samples)

    inside = BoundNetwork(_write(graphs.with_features_inside(graph, a), folder / "inside.onnx"), rows=a.channels)
    place = inside.outputs["position_mm"]

    def in_graph(residual: Array) -> Place:
        inside.inputs[0] = residual
        inside()
        return place.item(0), place.item(1)

    yield Estimator("regression, DFT in the graph", "route", in_graph, whole, weights + 4 * matrix.size)

    double = BoundNetwork(_write(graphs.in_double(graph), folder / "double.onnx"))
    double_place, double_in = double.outputs["position_mm"], double.inputs.reshape(a.channels, -1)

    def in_double(residual: Array) -> Place:
        np.dot(residual.astype(np.float64), matrix, out=double_in)
        double()
        return double_place.item(0), double_place.item(1)

    yield Estimator("regression, float64", "route", in_double, whole, 2 * weights + 8 * matrix.size)


def dictionaries(features: Array, place_mm: Array, acquisition: Acquisition) -> Iterator[Estimator]:
    """Yield kNN (k = 1) and GCC on recorded touches: features (n, inputs), positions (n, 2)."""
    from touchd.lab.dictionary import LAGS_S, Correlation, Nearest

    matrix = windowed_dft(acquisition).astype(np.float32)
    f_hz = band_bins(acquisition) * acquisition.sample_rate_hz / acquisition.samples
    row = np.empty((1, features.shape[1]), np.float32)
    into = row.reshape(acquisition.channels, -1)
    nearest = Nearest(features, place_mm)
    correlation = Correlation(features, place_mm, acquisition.channels, f_hz)

    def asking(estimator: Nearest | Correlation) -> Callable[[Array], Place]:
        def locate(residual: Array) -> Place:
            np.dot(residual, matrix, out=into)
            x_mm, y_mm = estimator.locate(row)[0].tolist()
            return x_mm, y_mm

        return locate

    own = acquisition.channels * matrix.size
    yield Estimator("kNN", "dictionary", asking(nearest), own + features.size, nearest.bytes, slow=True)
    # A complex multiply-add is four real ones, and a feature is half a complex number.
    gcc = own + 2 * features.size * len(LAGS_S)
    yield Estimator("GCC", "dictionary", asking(correlation), gcc, correlation.bytes, slow=True)


def atlases(model: Model, atlas: Atlas, graph: onnx.ModelProto) -> Iterator[Estimator]:
    """Yield the field atlas at touch-down, starting from the network's position, and while tracking."""
    a = model.description.acquisition
    settings = Settings.model_validate({"skip": {"still": False}})
    localizer = AtlasLocalizer(model, atlas, settings, None)
    live = np.ones(a.channels, bool)
    baseline = np.zeros(a.shape, np.float32)
    time_ns = itertools.count(0, round(1e9 / RATE_HZ)).__next__

    def find(residual: Array) -> Place:
        detection = Detection(Outcome.TOUCHED, time_ns(), 0.0, 0.0, 0.0, residual, residual, baseline, live)
        return _only(localizer.localize(detection, alive=False).touches)

    def rebase(block: Block) -> None:
        # The mean of n frames contains a share of their noise; another frame differs from it by more.
        n = len(block.untouched)
        np.copyto(baseline, block.baseline)
        localizer.update(block.baseline, block.untouched * np.float32(math.sqrt((n + 1) / (n - 1))))

    def follow(before: Array) -> None:
        localizer.reset()
        find(before)

    def forget(_before: Array) -> None:
        localizer.reset()

    own = a.channels * a.samples * 2 * len(atlas.description.bins)
    table = 4 * a.samples * 2 * len(atlas.description.bins)
    step_macs, step_bytes = LOOK_UP_MACS * atlas.size, 4 * _NODES_READ * atlas.size
    matrix = windowed_dft(a)
    yield Estimator(
        "atlas, touch-down", "atlas", find,
        own + a.channels * matrix.size + graphs.multiply_adds(graph) + FIRST_STEPS * step_macs,
        table + 4 * matrix.size + graphs.weight_bytes(graph) + FIRST_STEPS * step_bytes,
        rebase, forget, remark="network, then Gauss-Newton",
    )  # fmt: skip
    yield Estimator(
        "atlas, tracking", "atlas", find,
        own + FOLLOW_STEPS * step_macs, table + FOLLOW_STEPS * step_bytes,
        rebase, follow, remark="Gauss-Newton from 0.8 mm away, no network",
    )  # fmt: skip


def bare(folder: Path) -> BoundNetwork:
    """Return the paper's network with random weights, the reference of all times."""
    runner = BoundNetwork(_write(graphs.bare_network(), folder / "bare.onnx"))
    runner.inputs[...] = np.random.default_rng(0).standard_normal(runner.inputs.shape)
    return runner


def _only(touches: tuple[Touch, ...]) -> Place:
    """Return the position of the touch with the smallest sigma."""
    if not touches:
        return None
    best = min(touches, key=lambda touch: touch.sigma_mm)
    return best.x_mm, best.y_mm


def _write(graph: onnx.ModelProto, path: Path) -> Path:
    path.write_bytes(graph.SerializeToString())
    return path
