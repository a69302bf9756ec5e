"""`python -m tests.system.bench.unrolled`: Gauss-Newton on the field atlas in NumPy against the same in an ONNX graph.

The graph holds the atlas' coefficients and takes a frame and a start to a place, a strength and the energy left, as
`touchd.localization.gauss_newton.Refiner.one` does. A node costs about a microsecond, however little it does, so that
there are as few as possible: powers and products come of one Pow or ReduceProd each, sums and scales of one MatMul.
What the graph leaves out, in its favour: it never stops early, has no mask for dead channels, and does not look for
gradients that vanish.
"""

from __future__ import annotations

import os

# ruff: noqa: E402 - one thread, before numpy is imported
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ[_name] = "1"

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
from numpy.typing import ArrayLike, NDArray
from onnx import TensorProto, helper, numpy_helper

from touchd.localization.atlas import Atlas
from touchd.localization.features import windowed_dft
from touchd.localization.gauss_newton import LONGEST_STEP_MM, Refiner
from touchd.localization.model import Model, _load, default_model_path
from touchd.localization.spline import _SPLINES, Lookup
from touchd.twin.simulate import simulate_touches

Array = NDArray[np.float32]
ROUNDS = 300
BATCH = 20
NETWORK_STEPS = 5
"""At touch-down, where the start is the network's."""


class _Graph:
    """A graph being written: each call adds a node and returns its output's name."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, onnx.TensorProto] = {}

    def hold(self, value: ArrayLike, kind: Any = np.float32) -> str:
        tensor = numpy_helper.from_array(np.ascontiguousarray(value, kind))
        key = str((tensor.data_type, tuple(tensor.dims), tensor.raw_data))
        if key not in self.constants:
            tensor.name = f"c{len(self.constants)}"
            self.constants[key] = tensor
        return self.constants[key].name

    def __call__(self, kind: str, *inputs: str, **attributes: Any) -> str:
        name = f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name


# Rows of X, the Gram matrix's factor: real and imaginary parts of u, u_x, u_y and of the frame d.
_U, _X, _Y, _D = 0, 2, 4, 6
Form = dict[tuple[int, int], float]


def _re(a: int, b: int) -> Form:
    """Re(conj(a) b) from the Gram matrix of X."""
    return {(a, b): 1.0, (a + 1, b + 1): 1.0}


def _im(a: int, b: int) -> Form:
    return {(a, b + 1): 1.0, (a + 1, b): -1.0}


def _column(form: Form) -> Array:
    table = np.zeros((8, 8), np.float32)
    for at, value in form.items():
        table[at] = value
    return table.reshape(-1)


_ONE = _re(_D, _D)  # the frame is scaled to it
_UU, _UX, _UY, _UD = _re(_U, _U), (_re(_U, _X), _im(_U, _X)), (_re(_U, _Y), _im(_U, _Y)), (_re(_U, _D), _im(_U, _D))
_XD, _YD = (_re(_X, _D), _im(_X, _D)), (_re(_Y, _D), _im(_Y, _D))
# Products of linear forms of the Gram matrix, and the sums of them that are meant.
_FIRST = [
    (_re(_X, _X), _UU), (_UX[0], _UX[0]), (_UX[1], _UX[1]), (_re(_X, _Y), _UU), (_UX[0], _UY[0]), (_UX[1], _UY[1]),
    (_re(_Y, _Y), _UU), (_UY[0], _UY[0]), (_UY[1], _UY[1]), (_UD[0], _UD[0]), (_UD[1], _UD[1]),
    (_UD[0], _XD[0]), (_UD[1], _XD[1]), (_UD[0], _YD[0]), (_UD[1], _YD[1]),
    (_UU, _UU), (_UU, _UX[0]), (_UU, _UY[0]), (_ONE, _ONE),
]  # fmt: skip
_A, _B, _C, _P, _QX, _QY, _SQUARE, _LX, _LY, _UNIT = np.zeros((10, len(_FIRST)), np.float32)
_A[[0, 1, 2]] = _B[[3, 4, 5]] = _C[[6, 7, 8]] = 1, -1, -1
_P[[9, 10]] = _QX[[11, 12]] = _QY[[13, 14]] = 1
_SQUARE[15] = _LX[16] = _LY[17] = _UNIT[18] = 1
# With the right side times |u|^6 and the matrix times |u|^6 / |<u, d>|^2: right side, determinant, and the matrix.
_SECOND = [
    (_QX, _SQUARE), (_LX, _P), (_QY, _SQUARE), (_LY, _P), (_A, _C), (_B, _B), (_A, _UNIT), (_B, _UNIT), (_C, _UNIT),
    (_P, _UNIT),
]  # fmt: skip
_RX, _RY, _DET, _A2, _B2, _C2, _P2 = np.zeros((7, len(_SECOND)), np.float32)
_RX[[0, 1]] = _RY[[2, 3]] = _DET[[4, 5]] = 1, -1
_A2[6] = _B2[7] = _C2[8] = _P2[9] = 1
_THIRD = [(_C2, _RX), (_B2, _RY), (_A2, _RY), (_B2, _RX), (_P2, _DET)]
_MOVE_X, _MOVE_Y, _OF = np.array([[1, -1, 0, 0, 0], [0, 0, 1, -1, 0], [0, 0, 0, 0, 1]], np.float32)


def unrolled(atlas: Atlas, steps: int, *, samples: bool = False) -> onnx.ModelProto:
    """Return the graph of so many steps.

    Parameters
    ----------
    atlas : Atlas
    steps : int
    samples : bool
        Whether it takes a residual of shape (channels, samples) instead of features of shape (2, channels * bins),
        all real parts before all imaginary ones.

    Notes
    -----
    Further input: `start`, shape (2, 1), mm. Outputs: `place` (2, 1), mm; `strength` (1, 2); `left` (1, 1), of the
    frame's energy.
    """
    d, g = atlas.description, _Graph()
    rows, columns, size = atlas.coefficients.shape
    a, half = d.acquisition, size // 2
    by_part = atlas.coefficients.reshape(rows * columns, a.channels, 2, len(d.bins)).transpose(0, 2, 1, 3)
    unit = float(np.sqrt(np.square(by_part).sum(axis=(1, 2, 3)).mean()))  # products of ten stay within float32
    table = g.hold(by_part.reshape(-1, size) / unit)
    frame = "frame"
    if samples:
        dft = windowed_dft(a, np.array(d.bins)).reshape(a.samples, 2, -1).transpose(1, 0, 2)
        frame = g("Reshape", g("MatMul", frame, g.hold(dft)), g.hold([2, half], np.int64))
    loud = g("ReduceL2", frame, keepdims=1)
    frame = g("Div", frame, loud)

    def in_cells(mm: ArrayLike) -> NDArray[np.float64]:
        return np.asarray((np.asarray(mm) - np.array(d.origin_mm)) / d.step_mm)

    lookup = Lookup(atlas, np.zeros((3, size), np.float32))
    low, high = in_cells(lookup.low_mm), in_cells(lookup.high_mm)
    bounds = g.hold(low[:, None]), g.hold(high[:, None])
    origin = g.hold(np.array(d.origin_mm)[:, None])
    at = g("Mul", g("Sub", "start", origin), g.hold(1 / d.step_mm))
    at = g("Min", g("Max", at, bounds[0]), bounds[1])
    powers = g.hold(np.stack([np.tile(np.arange(4), 4), np.repeat(np.arange(4), 4)]))  # s^i t^j at 4 j + i
    derived = np.zeros((4, 4))
    derived[:3] = np.arange(1, 4)[:, None] * _SPLINES[1:]
    of_powers = [np.kron(y, x) for y, x in ((_SPLINES, _SPLINES), (_SPLINES, derived), (derived, _SPLINES))]
    splines = g.hold(np.stack(of_powers))
    nodes_of = g.hold(np.stack([np.ones(16), np.full(16, columns)]))
    neighbours = g.hold(np.add.outer(columns * np.arange(-1, 3), np.arange(-1, 3)).reshape(-1))

    def forms(pairs: list[Any], made: Callable[[Any], Array]) -> str:
        return g.hold(np.stack([np.stack([made(pair[k]) for pair in pairs], axis=1) for k in (0, 1)]))

    first, second, third = forms(_FIRST, _column), forms(_SECOND, np.asarray), forms(_THIRD, np.asarray)
    sixth = g.hold([8 * 8], np.int64), g.hold([6, half], np.int64)
    move_of, by = g.hold(np.stack([_MOVE_X, _MOVE_Y])[..., None]), g.hold(_OF[:, None])
    longest = g.hold(LONGEST_STEP_MM / d.step_mm)
    for _ in range(steps):
        cell = g("Floor", at)
        monomials = g("ReduceProd", g("Pow", g("Sub", at, cell), powers), axes=[0], keepdims=1)
        weights = g("MatMul", monomials, splines)
        index = g("Cast", g("Gemm", cell, nodes_of, neighbours, transA=1), to=TensorProto.INT32)
        field = g("MatMul", weights, g("Gather", table, index))
        x = g("Concat", g("Reshape", field, sixth[1]), frame, axis=0)
        gram = g("Reshape", g("Gemm", x, x, transB=1), sixth[0])
        one = g("ReduceProd", g("MatMul", gram, first), axes=[0], keepdims=0)
        two = g("ReduceProd", g("MatMul", one, second), axes=[0], keepdims=0)
        three = g("ReduceProd", g("MatMul", two, third), axes=[0], keepdims=0)
        step = g("Div", g("MatMul", three, move_of), g("MatMul", three, by))
        length = g("ReduceL2", step, keepdims=0)
        at = g("Add", at, g("Div", step, g("Max", g("Div", length, longest), g.hold(1.0))))
        at = g("Min", g("Max", at, bounds[0]), bounds[1])
    square = g("MatMul", gram, g.hold(_column(_UU)[:, None]))
    z = g("Div", g("MatMul", gram, g.hold(np.stack([_column(_UD[0]), _column(_UD[1])], axis=1))), square)
    # What the last step does to the strength: a complex division, unless it was shortened.
    along = g("MatMul", gram, g.hold(np.stack([_column(form) for form in (*_UX, *_UY)], axis=1)))
    change = g("Div", g("Gemm", step, g("Reshape", along, g.hold([2, 2], np.int64)), transA=1), square)
    change = g("Add", g("Where", g("Less", longest, length), g.hold(0.0), change), g.hold([[1.0, 0.0]]))
    row = g("Reshape", z, g.hold([1, 2], np.int64))
    products = g("Reshape", g("Gemm", row, change, transA=1), g.hold([1, 4], np.int64))
    quotient = g("MatMul", products, g.hold([[1, 0], [0, -1], [0, 1], [1, 0]]))
    z = g("Div", quotient, g("ReduceSumSquare", change, keepdims=1))
    strength = g("Mul", z, g("Mul", loud, g.hold(1 / unit)))
    # What is explained, and what the last step explains besides, likewise.
    right = g("MatMul", two, g.hold(np.stack([_RX, _RY], axis=1)))
    besides = g("Div", g("MatMul", right, step), g("Pow", square, g.hold(3.0)))
    besides = g("Where", g("Less", longest, length), g.hold(0.0), besides)
    explained = g("Add", g("Div", g("MatMul", one, g.hold(_P[:, None])), square), besides)
    left = g("Mul", g("Max", g("Sub", g.hold(1.0), explained), g.hold(0.0)), g("Mul", loud, loud))
    place = g("Add", g("Mul", at, g.hold(d.step_mm)), origin)
    outputs = {"place": place, "strength": strength, "left": left}
    for name, found in outputs.items():
        g.nodes.append(helper.make_node("Identity", [found], [name]))
    shape = list(a.shape) if samples else [2, half]
    graph = helper.make_graph(
        g.nodes, "gauss-newton",
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in (("frame", shape), ("start", [2, 1]))],
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, None) for n in outputs],
        list(g.constants.values()),
    )  # fmt: skip
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


class Unrolled:
    """The graph, loaded as `touchd.localization.model` loads a network: one thread, buffers bound once."""

    def __init__(self, atlas: Atlas, steps: int, *, samples: bool = False) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "unrolled.onnx"
            onnx.save(unrolled(atlas, steps, samples=samples), str(path))
            self._session = _load(path)
        a = atlas.description.acquisition
        self.frame: Array = np.zeros(a.shape if samples else (2, atlas.size // 2), np.float32)
        self.start: Array = np.zeros((2, 1), np.float32)
        self.place, self.strength, self.left = (np.zeros(n, np.float32) for n in (2, 2, 1))
        self._binding = self._session.io_binding()
        for name in ("frame", "start"):
            held = getattr(self, name)
            self._binding.bind_input(name, "cpu", 0, np.float32, held.shape, held.ctypes.data)
        for name, shape in (("place", (2, 1)), ("strength", (1, 2)), ("left", (1, 1))):
            self._binding.bind_output(name, "cpu", 0, np.float32, shape, getattr(self, name).ctypes.data)
        self._run = self._session.run_with_iobinding

    def one(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        """Return where the finger in `frame` is, from a place nearby."""
        self.start[0, 0], self.start[1, 0] = x_mm, y_mm
        self._run(self._binding)
        x, y = self.place.tolist()
        return x, y


class Touches(NamedTuple):
    """Frames of held-out touches, with where to begin."""

    residual: Array
    """Shape (n, channels, samples)."""
    features: Array
    """Shape (n, size), as the atlas orders them."""
    by_part: Array
    """Shape (n, 2, size / 2), as the graph takes them."""
    start_mm: NDArray[np.float64]


def touches(atlas: Atlas, count: int, seed: int = 4711, off_mm: float = 1.0) -> Touches:
    """Make touches that the atlas was not trained with, and starts beside them."""
    recording = simulate_touches(count, seed=seed)
    assert recording.contacts_mm is not None
    frames = recording.frames.astype(np.float32)
    residual = frames[1::2] - frames[0::2]
    d = atlas.description
    dft = windowed_dft(d.acquisition, np.array(d.bins)).astype(np.float32)
    features: Array = (residual @ dft).astype(np.float32).reshape(len(residual), -1)
    by_part: Array = features.reshape(len(residual), d.acquisition.channels, 2, -1).transpose(0, 2, 1, 3)
    start_mm = recording.contacts_mm[1::2, 0].astype(np.float64) + np.random.default_rng(seed).normal(
        0, off_mm, (count, 2)
    )
    return Touches(residual, features, np.ascontiguousarray(by_part.reshape(count, 2, -1)), start_mm)


Call = Callable[[int], object]


def _calls(model: Model, atlas: Atlas, data: Touches) -> dict[str, Call]:
    """What is compared, by name: each takes the number of a touch."""
    refiner, features = Refiner(atlas), data.features
    matrix = windowed_dft(atlas.description.acquisition, np.array(atlas.description.bins)).astype(np.float32)
    bins = refiner.frame.reshape(atlas.description.acquisition.channels, -1)
    starts = [(float(x), float(y)) for x, y in data.start_mm]
    calls: dict[str, Call] = {"bare network": lambda _i: model.infer()}

    def numpy_steps(steps: int, i: int) -> object:
        refiner.frame[:] = features[i]
        refiner.take()
        return refiner.one(*starts[i], steps)

    def numpy_from_samples(steps: int, i: int) -> object:
        np.dot(data.residual[i], matrix, out=bins)
        refiner.take()
        return refiner.one(*starts[i], steps)

    def graph_steps(graph: Unrolled, held: Array, i: int) -> object:
        graph.frame[:] = held[i]
        return graph.one(*starts[i])

    def bound(call: Callable[..., object], *first: object) -> Call:
        return lambda i: call(*first, i)

    for steps in (1, 2, 3):
        calls[f"NumPy, {steps} steps"] = bound(numpy_steps, steps)
        calls[f"graph, {steps} steps"] = bound(graph_steps, Unrolled(atlas, steps), data.by_part)
    calls["NumPy, DFT + 3 steps"] = bound(numpy_from_samples, 3)
    calls["graph, DFT + 3 steps"] = bound(graph_steps, Unrolled(atlas, 3, samples=True), data.residual)
    five = Unrolled(atlas, NETWORK_STEPS, samples=True)

    def network_then(call: Call) -> Call:
        def both(i: int) -> object:
            model.infer()
            return call(i)

        return both

    calls[f"NumPy, network + DFT + {NETWORK_STEPS}"] = network_then(bound(numpy_from_samples, NETWORK_STEPS))
    calls[f"graph, network + DFT + {NETWORK_STEPS}"] = network_then(bound(graph_steps, five, data.residual))
    return calls


def main() -> None:
    """Print what either costs, beside the bare network in alternation."""
    bare, model = Model(default_model_path(), atlas=False), Model(default_model_path())
    assert model.atlas is not None
    calls = _calls(bare, model.atlas, touches(model.atlas, BATCH * 8))
    times_us: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(ROUNDS):
        which = range(turn % 8 * BATCH, (turn % 8 + 1) * BATCH)
        for name, call in calls.items():
            stamps = [time.perf_counter_ns()]
            for i in which:
                call(i)
                stamps.append(time.perf_counter_ns())
            times_us[name].append(float(np.median(np.diff(stamps))) * 1e-3)
    network_us = np.array(times_us["bare network"])
    print(f"{'':28} {'median us':>10} {'x network':>10}")
    for name, found_us in times_us.items():
        print(f"{name:28} {np.median(found_us):10.1f} {np.median(np.array(found_us) / network_us):10.2f}")
    for steps in (1, 3):
        graph = unrolled(model.atlas, steps).graph
        print(f"graph of {steps} steps: {len(graph.node)} nodes")


if __name__ == "__main__":
    main()
