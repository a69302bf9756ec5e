"""Places at which a fit is badly conditioned, and numbers so small that a processor may slow down over them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray
from onnx import numpy_helper

from tests.scenes.numerics import reference
from touchd.localization.atlas import Atlas
from touchd.localization.model import default_model_path
from touchd.recording.data import Recording
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import force_of
from touchd.twin.scenes.timeline import Stage, still
from touchd.twin.simulate import recording_of, stream

Place = tuple[float, float]
RATE_HZ = 125.0
AREA_MM2 = {"silicone": 20.0, "human": 60.0}
RADIUS_MM = 2.6
"""Of a silicone contact of that area, and a little more: no contact reaches over the edge."""


def on_discs(instrument: Instrument) -> list[Place]:
    """The middle of each transducer."""
    layout = instrument.layout
    return [(x, y) for x, y in (layout.emitter_mm, *layout.receivers_mm)]


def on_the_edge(instrument: Instrument) -> list[Place]:
    """Contacts that touch the edge, along all four sides and in the corners."""
    w, h, m = instrument.plate.width_mm, instrument.plate.height_mm, RADIUS_MM
    sides = [(s * w, y) for s in (0.25, 0.5, 0.8) for y in (m, h - m)]
    sides += [(x, s * h) for s in (0.25, 0.5, 0.8) for x in (m, w - m)]
    return [*sides, *corners(instrument, m)]


def corners(instrument: Instrument, margin_mm: float) -> list[Place]:
    """The four places so far from two edges."""
    w, h, m = instrument.plate.width_mm, instrument.plate.height_mm, margin_mm
    return [(m, m), (w - m, m), (m, h - m), (w - m, h - m)]


def in_nodes(atlas: Atlas, count: int = 10, apart_mm: float = 12.0) -> list[Place]:
    """The places within the touched part where the field is weakest over all bins together: there it says least."""
    d = atlas.description
    x_mm, y_mm = (np.arange(d.low_mm[i] + 5, d.high_mm[i] - 5, d.step_mm) for i in (0, 1))
    grid = [(float(x), float(y)) for y in y_mm for x in x_mm]
    energy = np.array([float(np.sum(np.abs(reference.field(atlas, *place)[0]) ** 2)) for place in grid])
    found: list[Place] = []
    for k in np.argsort(energy):
        if all(np.hypot(grid[k][0] - x, grid[k][1] - y) > apart_mm for x, y in found):
            found.append(grid[k])
        if len(found) == count:
            break
    return found


def taps_at(places: list[Place], instrument: Instrument, *, seed: int = 0, kind: str = "silicone") -> Recording:
    """A tap of 0.24 s at each of these places, one after the other."""
    each, first = 0.6, 0.8
    n = round((first + each * len(places) + 0.3) * RATE_HZ)
    rng = np.random.default_rng(seed)
    stage = Stage(instrument.plate, RATE_HZ, np.arange(n), np.full(n, REFERENCE_C), rng, Electronics())
    force = float(force_of(kind, np.array(AREA_MM2[kind])))
    for number, place in enumerate(places):
        start = first + each * number
        stage.lay(kind, start, start + 0.24, still(*place), force_n=force)
    return recording_of(stage, instrument, np.concatenate(list(stream(stage, instrument, seed))))


# -- denormals ----------------------------------------------------------------------------------------------------


def with_small_weights(share: float, scale: float, folder: Path) -> Path:
    """The shipped network with a share of its large weights made so many times smaller."""
    model = onnx.load(default_model_path())
    rng = np.random.default_rng(1)
    for tensor in model.graph.initializer:
        weight = numpy_helper.to_array(tensor)
        if weight.dtype == np.float32 and weight.size > 500:
            small = np.where(rng.uniform(size=weight.shape) < share, weight * np.float32(scale), weight)
            tensor.CopyFrom(numpy_helper.from_array(small, tensor.name))
    path = folder / "small.onnx"
    path.write_bytes(model.SerializeToString())
    return path


def flushed(path: Path, features: NDArray[np.float32], *, flush: bool) -> dict[str, NDArray[np.float32]]:
    """A network's outputs, its denormals as they are or taken for zeros by the processor."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry("session.set_denormal_as_zero", str(int(flush)))
    session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    outputs = session.run(None, {session.get_inputs()[0].name: features})
    return dict(zip([output.name for output in session.get_outputs()], outputs, strict=True))
