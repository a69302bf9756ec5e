"""What the measured daemon's process plays and runs beside it: a scene to and fro, and the bare network."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, cycle, pairwise
from math import inf, sqrt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchd.frame import Acquisition, Counts, Frame
from touchd.localization.model import _load as open_session  # so that both share the session options
from touchd.sources.source import EndOfStream, Source

PERIOD_NS = 8_000_000
"""Frame period in the frames' own time at full speed, as at 125 frames/s."""
BURST_EVERY, BURST = 250, 10
"""At full speed, `BURST` bare runs follow every `BURST_EVERY` frames."""
WIDTHS = (392, 400, 300, 200, 100, 2)
"""Of the source paper's regression network, Bahrami et al. 2022: 357,000 multiply-adds."""
OPSET, IR_VERSION = 17, 8


@dataclass(frozen=True, slots=True)
class Loop:
    """A scene to play: a lead-in once, then the rest to and fro."""

    acquisition: Acquisition
    frames: NDArray[np.int16]
    """Shape (n, channels, samples)."""
    lead: int
    """Number of lead-in frames."""

    def counts(self) -> Iterator[Counts]:
        """Yield the lead-in, then the rest to and fro without end."""
        lead, there = list(self.frames[: self.lead]), list(self.frames[self.lead :])
        return chain(lead, cycle([*there, *there[-2:0:-1]]))


class LoopSource(Source):
    """A source that delivers the frames of a loop when due; the lead-in comes at once.

    An infinite `rate_hz` is full speed; `seconds` count after the lead-in. `between` is called every `BURST_EVERY`
    frames at full speed, and its time is excluded; `begun` is called before the first frame after the lead-in.
    """

    def __init__(
        self, loop: Loop, rate_hz: float, seconds: float, between: Callable[[], object] = lambda: None,
        begun: Callable[[], object] = lambda: None,
    ) -> None:  # fmt: skip
        self.acquisition = loop.acquisition
        self.lead = loop.lead
        self._paced = rate_hz != inf
        self._period_ns = round(1e9 / rate_hz) if self._paced else PERIOD_NS
        self._seconds = seconds
        self._between, self._begun = between, begun
        self._counts = loop.counts()
        self._number = 0
        self._start_ns = self._end_ns = 0
        self._next_burst = 0
        self._open = True
        self.apart_ns = 0
        """Time spent in `between`."""

    def read(self, timeout_s: float) -> Frame | None:  # noqa: ARG002 - the next frame is due before any timeout
        """Return the next frame when it is due; raise EndOfStream once the duration is over."""
        number, now_ns = self._number, time.monotonic_ns()
        if not self._open:
            raise EndOfStream
        if number in (0, self.lead):
            if number == self.lead:
                self._begun()
                now_ns = time.monotonic_ns()
                self._end_ns = now_ns + round(self._seconds * 1e9)
                self._next_burst = number  # so that a run of few frames has one, too
            self._start_ns = now_ns - max(number, self.lead) * self._period_ns
        if number >= self.lead:
            if now_ns >= self._end_ns:
                raise EndOfStream
            if self._paced:
                due_ns = self._start_ns + number * self._period_ns
                while now_ns < due_ns:
                    time.sleep((due_ns - now_ns) * 1e-9)
                    now_ns = time.monotonic_ns()
            elif number >= self._next_burst:
                self._next_burst = number + BURST_EVERY
                self._between()
                now_ns, before_ns = time.monotonic_ns(), now_ns
                self.apart_ns += now_ns - before_ns
        self._number = number + 1
        return Frame(next(self._counts), number, self._start_ns + number * self._period_ns, now_ns)

    def close(self) -> None:
        """End the stream."""
        self._open = False


class BareNetwork:
    """The source paper's regression network with random weights, the unit of all run times; call it to run it once.

    It runs on one thread, with buffers bound once, as the daemon runs its own.
    """

    def __init__(self, path: Path) -> None:
        self._session = open_session(path)
        self._binding = self._session.io_binding()
        self._features = np.random.default_rng(0).standard_normal((1, WIDTHS[0])).astype(np.float32)
        self.position_mm: NDArray[np.float32] = np.zeros((1, WIDTHS[-1]), np.float32)
        for bind, name, buffer in (
            (self._binding.bind_input, "features", self._features),
            (self._binding.bind_output, "position_mm", self.position_mm),
        ):
            bind(name, "cpu", 0, np.float32, buffer.shape, buffer.ctypes.data)

    def __call__(self) -> None:
        """Run the network once."""
        self._session.run_with_iobinding(self._binding)


def write_bare(path: Path) -> Path:
    """Write the bare network; its run time does not depend on the weights.

    Batch normalisations are folded into the linear layers, as in every exported network.
    """
    from onnx import numpy_helper, parser  # would count as memory of the measured daemon

    rng = np.random.default_rng(0)
    nodes, weights, name = [], [], "features"
    for stage, (inputs, outputs) in enumerate(pairwise(WIDTHS)):
        weight = rng.standard_normal((outputs, inputs)) * sqrt(2 / inputs)
        weights += [
            numpy_helper.from_array(weight.astype(np.float32), f"weight{stage}"),
            numpy_helper.from_array(np.full(outputs, 0.1, np.float32), f"bias{stage}"),
        ]
        product = f"product{stage}" if stage < len(WIDTHS) - 2 else "position_mm"
        nodes.append(f"{product} = Gemm <transB = 1> ({name}, weight{stage}, bias{stage})")
        name = f"stage{stage}"
        if product != "position_mm":
            nodes.append(f"{name} = Relu ({product})")
    model = parser.parse_model(
        f'<ir_version: {IR_VERSION}, opset_import: ["": {OPSET}]> bare (float[n, {WIDTHS[0]}] features) => '
        f"(float[n, {WIDTHS[-1]}] position_mm) {{ {' '.join(nodes)} }}"
    )
    model.graph.initializer.extend(weights)
    path.write_bytes(model.SerializeToString())
    return path
