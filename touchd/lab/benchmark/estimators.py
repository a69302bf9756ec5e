"""Estimators map the residual of one frame to a position: time and score all of them on the same touches, in turns."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from touchd.config.schema import Settings
from touchd.detection.detection import Detection
from touchd.errors import ModelMissing
from touchd.evaluation.metrics import position_scores
from touchd.lab.benchmark.loop import PERIOD_NS
from touchd.lab.benchmark.results import BareTimes, EstimatorResult
from touchd.lab.benchmark.scenes import BLOCK, Block
from touchd.lab.benchmark.stopwatch import Stopwatch, floor_us, percentiles, ratio, spread
from touchd.localization.atlas import Atlas
from touchd.localization.atlas_localizer import AtlasLocalizer
from touchd.localization.features import Features, windowed_dft
from touchd.localization.following import FOLLOW_STEPS
from touchd.localization.landing import FIRST_STEPS
from touchd.localization.model import Model
from touchd.outcome import Outcome

Array = NDArray[np.float32]
Place = tuple[float, float] | None
"""x and y, mm; None if the estimator finds no finger."""
NETWORKS = ("regression", "small", "int8", "grid10", "keypad", "time")
LOOK_UP_MACS = 72
"""Multiply-adds per feature of a Gauss-Newton step: 48 for the splines, 24 for the products."""
_NODES_READ = 16
_PRODUCTS = ("Gemm", "MatMul", "MatMulInteger")
_REMARKS = {"grid": "answers with the middle of a zone", "keypad": "answers with the middle of a key"}


@dataclass(slots=True)
class Estimator:
    """One way to a position, with its cost, and what it did in a race."""

    name: str
    group: str
    """Group of the comparison: network, atlas or given."""
    locate: Callable[[Array], Place]
    """Maps a residual of shape (channels, samples) to a position; this call is timed."""
    macs: int
    """Upper limit of the multiply-adds."""
    bytes: int
    """Bytes of weights or tables read for one position."""
    rebase: Callable[[Block], object] = lambda _: None
    """Sets another untouched plate; not timed, because the daemon does it once a second."""
    prepare: Callable[[Array], object] = lambda _: None
    """Receives the residual of the preceding frame; not timed."""
    remark: str = ""
    watch: Stopwatch = field(default_factory=Stopwatch)
    beside: Stopwatch = field(default_factory=Stopwatch)
    """Times of the bare network in the same turns."""

    def batch(self, block: Block) -> list[Place]:
        """Locate the touches of a block, one by one."""
        clock, prepare, locate = time.perf_counter_ns, self.prepare, self.locate
        self.rebase(block)
        times_ns, places = [], []
        for before, residual in zip(block.before, block.residual, strict=True):
            prepare(before)
            begun_ns = clock()
            place = locate(residual)
            times_ns.append(clock() - begun_ns)
            places.append(place)
        self.watch.add(times_ns)
        return places

    def result(self, places: Sequence[Place], true_mm: NDArray[np.float64]) -> EstimatorResult:
        """Return times, and the errors of places against true positions (n, 2)."""
        found = np.array([place is not None for place in places])
        error_mm = np.array([place for place in places if place is not None]).reshape(-1, 2) - true_mm[found]
        scores = position_scores(error_mm)
        return EstimatorResult(
            name=self.name, group=self.group, remark=self.remark, **percentiles(spread(self.watch.times_us)),
            ratio=ratio(self.watch, self.beside), floor_us=floor_us(self.bytes), calls=len(self.watch.times_us),
            macs=self.macs, bytes=self.bytes, touches=len(found), missed=int((~found).sum()),
            rmse_mm=scores["rmse_mm"], median_mm=scores["median_mm"], p95_mm=scores["p95_mm"],
        )  # fmt: skip


def race(
    estimators: Sequence[Estimator], bare: Callable[[], object], blocks: Sequence[Block], passes: int, limit_s: float,
    tick: Callable[[], object] = lambda: None,
) -> tuple[BareTimes, list[EstimatorResult]]:  # fmt: skip
    """Time and score every estimator: each takes a block of touches, in turns with a batch of the bare network.

    No pass over the blocks starts after `limit_s`. `tick` is called after each block.
    """
    places: list[list[Place]] = [[] for _ in estimators]
    begun_s = time.monotonic()
    for number in range(passes):
        if number and time.monotonic() - begun_s > limit_s:
            break
        for block in blocks:
            for one, found in zip(estimators, places, strict=True):
                one.beside.time(bare, BLOCK)
                located = one.batch(block)
                if not number:
                    found += located
            tick()
    true_mm = np.concatenate([block.true_mm for block in blocks])
    bare_us = spread(np.concatenate([one.beside.times_us for one in estimators]))
    results = [one.result(found, true_mm) for one, found in zip(estimators, places, strict=True)]
    return BareTimes(p50=bare_us.p50, p99=bare_us.p99, p999=bare_us.p999), results


def network(model: Model, name: str, group: str = "network") -> Estimator:
    """Return a network with the daemon's features: the windowed DFT as a product, or the samples."""
    d = model.description
    a = d.acquisition
    features = Features(d.domain, a, taper=d.taper)
    into = model.features.reshape(features.shape)
    baseline, signal = np.zeros(a.shape, np.float32), np.zeros(a.shape, np.float32)

    by_signal = d.input == "signal"

    def locate(residual: Array) -> Place:
        features.extract(np.add(residual, baseline, out=signal) if by_signal else residual, into)
        return model.estimate()[:2]

    def rebase(block: Block) -> None:
        np.copyto(baseline, block.baseline)

    in_time = d.domain == "time"
    macs, weight_bytes = cost_of(onnx.load(model.path))
    table = 0 if in_time else windowed_dft(a).size
    return Estimator(
        name, group, locate, macs + a.channels * table, weight_bytes + 4 * table, rebase,
        remark=_REMARKS.get(d.head, "takes samples, not a spectrum" if in_time else ""),
    )  # fmt: skip


def atlases(model: Model, atlas: Atlas) -> Iterator[Estimator]:
    """Yield the field atlas at touch-down, starting from the network's position, and while tracking."""
    a = model.description.acquisition
    localizer = AtlasLocalizer(model, atlas, Settings.model_validate({"skip": {"still": False}}), None)
    live = np.ones(a.channels, bool)
    baseline = np.zeros(a.shape, np.float32)
    time_ns = itertools.count(0, PERIOD_NS).__next__

    def find(residual: Array) -> Place:
        detection = Detection(Outcome.TOUCHED, time_ns(), 0.0, 0.0, 0.0, residual, residual, baseline, live)
        touches = (localizer.follow(detection) or localizer.localize(detection, alive=False)).touches
        if not touches:
            return None
        best = min(touches, key=lambda touch: touch.sigma_mm)
        return best.x_mm, best.y_mm

    def rebase(block: Block) -> None:
        np.copyto(baseline, block.baseline)
        localizer.update(block.baseline, block.noise)

    def follow(before: Array) -> None:
        localizer.reset()
        find(before)

    own = a.channels * a.samples * 2 * len(atlas.description.bins)
    table = 4 * a.samples * 2 * len(atlas.description.bins)
    step_macs, step_bytes = LOOK_UP_MACS * atlas.size, 4 * _NODES_READ * atlas.size
    first = network(model, "")
    yield Estimator(
        "atlas, touch-down", "atlas", find,
        own + first.macs + FIRST_STEPS * step_macs, table + first.bytes + FIRST_STEPS * step_bytes,
        rebase, lambda _before: localizer.reset(), remark="network, then Gauss-Newton",
    )  # fmt: skip
    yield Estimator(
        "atlas, tracking", "atlas", find,
        own + FOLLOW_STEPS * step_macs, table + FOLLOW_STEPS * step_bytes,
        rebase, follow, remark="Gauss-Newton from 0.8 mm away, no network",
    )  # fmt: skip


def shipped(models: Path, name: str) -> Path:
    """Return the file of a network in a folder of models; ModelMissing if there is none."""
    path = models / f"{name}.onnx"
    if not path.is_file():
        raise ModelMissing("no such model", str(path), "train it, or name the folder of the models: --models")
    return path


def cost_of(graph: onnx.ModelProto) -> tuple[int, int]:
    """Return the multiply-adds of the matrix products for one row of features, and the bytes of all constants."""
    constants = {tensor.name: tensor for tensor in graph.graph.initializer}
    for node in graph.graph.node:
        if node.op_type == "Constant" and node.attribute[0].name == "value":
            constants[node.output[0]] = node.attribute[0].t
    products = (node.input[1] for node in graph.graph.node if node.op_type in _PRODUCTS)
    macs = sum(math.prod(constants[name].dims) for name in products if name in constants)
    return macs, sum(numpy_helper.to_array(tensor).nbytes for tensor in constants.values())
