"""The estimators of the benchmark: each maps the residual of one frame to a position."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from touchd.config.schema import Settings
from touchd.detection.detection import Detection
from touchd.lab.benchmark.loop import PERIOD_NS
from touchd.lab.benchmark.scenes import Block
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


def _nothing(*_: object) -> None:
    pass


@dataclass(slots=True)
class Estimator:
    """One way to a position, with its cost."""

    name: str
    group: str
    """Group of the comparison: network, atlas or given."""
    locate: Callable[[Array], Place]
    """Maps a residual of shape (channels, samples) to a position; this call is timed."""
    macs: int
    """Upper limit of the multiply-adds."""
    bytes: int
    """Bytes of weights or tables read for one position."""
    rebase: Callable[[Block], object] = _nothing
    """Sets another untouched plate; not timed, because the daemon does it once a second."""
    prepare: Callable[[Array], object] = _nothing
    """Receives the residual of the preceding frame; not timed."""
    remark: str = ""


def network(model: Model, name: str, group: str = "network") -> Estimator:
    """Return a network with the daemon's features: the windowed DFT as a product, or the samples."""
    d = model.description
    a = d.acquisition
    features = Features(d.domain, a, taper=d.taper)
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

    in_time = d.domain == "time"
    remark = {"grid": "answers with the middle of a zone", "keypad": "answers with the middle of a key"}
    macs, weight_bytes = cost_of(onnx.load(model.path))
    table = 0 if in_time else windowed_dft(a).size
    return Estimator(
        name, group, locate if d.input == "residual" else locate_by_signal,
        macs + a.channels * table, weight_bytes + 4 * table, rebase,
        remark=remark.get(d.head, "takes samples, not a spectrum" if in_time else ""),
    )  # fmt: skip


def atlases(model: Model, atlas: Atlas) -> Iterator[Estimator]:
    """Yield the field atlas at touch-down, starting from the network's position, and while tracking."""
    a = model.description.acquisition
    settings = Settings.model_validate({"skip": {"still": False}})
    localizer = AtlasLocalizer(model, atlas, settings, None)
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

    def forget(_before: Array) -> None:
        localizer.reset()

    own = a.channels * a.samples * 2 * len(atlas.description.bins)
    table = 4 * a.samples * 2 * len(atlas.description.bins)
    step_macs, step_bytes = LOOK_UP_MACS * atlas.size, 4 * _NODES_READ * atlas.size
    first = network(model, "")
    yield Estimator(
        "atlas, touch-down", "atlas", find,
        own + first.macs + FIRST_STEPS * step_macs, table + first.bytes + FIRST_STEPS * step_bytes,
        rebase, forget, remark="network, then Gauss-Newton",
    )  # fmt: skip
    yield Estimator(
        "atlas, tracking", "atlas", find,
        own + FOLLOW_STEPS * step_macs, table + FOLLOW_STEPS * step_bytes,
        rebase, follow, remark="Gauss-Newton from 0.8 mm away, no network",
    )  # fmt: skip


def cost_of(graph: onnx.ModelProto) -> tuple[int, int]:
    """Return the multiply-adds of the matrix products for one row of features, and the bytes of all constants."""
    constants = {tensor.name: tensor for tensor in graph.graph.initializer}
    for node in graph.graph.node:
        if node.op_type == "Constant" and node.attribute[0].name == "value":
            constants[node.output[0]] = node.attribute[0].t
    products = (node.input[1] for node in graph.graph.node if node.op_type in _PRODUCTS)
    macs = sum(math.prod(constants[name].dims) for name in products if name in constants)
    return macs, sum(numpy_helper.to_array(tensor).nbytes for tensor in constants.values())
