"""Run the whole benchmark."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from touchd.errors import ModelMissing
from touchd.evaluation.cramer_rao import MOST_TOUCHES, median_distance_mm, position_covariance, twin_field
from touchd.lab.benchmark import daemon, skips
from touchd.lab.benchmark.estimators import NETWORKS, Estimator, atlases, network, race, shipped
from touchd.lab.benchmark.loop import BareNetwork, Loop, write_bare
from touchd.lab.benchmark.results import DaemonResult, Run, Touches, rounded, this_machine
from touchd.lab.benchmark.scenes import FINGER, SEED, WANTED, Block, held_out, make_loop
from touchd.lab.benchmark.stopwatch import middle, undisturbed
from touchd.localization.model import Model
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import DEFAULT_PLATE

Progress = Callable[[str, float], object]
"""Receives the current step and the share done."""

KEYPAD, KEYPAD_RATES_HZ = "keypad", (125.0, None)
REPEATS = 3
"""Runs at full speed, of which the one with the median ratio counts: the scheduler places threads differently."""
CELL_S = 3.0
"""Duration of the daemon's run at a steady rate."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Extent of the measurement."""

    touches: int = 1000
    passes: int = 5
    race_s: float = 30.0
    rates_hz: tuple[float | None, ...] = (125.0, 500.0, 1000.0, None)
    full_speed_s: float = 1.0
    repeated: tuple[str, ...] = tuple(WANTED)
    """Scenes that run `REPEATS` times at full speed."""
    skip_rounds: int = 60


QUICK = Scale(
    touches=200, passes=2, race_s=4.0, rates_hz=(None,), full_speed_s=0.8, repeated=("moving",), skip_rounds=20
)


def benchmark(models: Path, *, quick: bool, progress: Progress, also: Sequence[Path] = ()) -> Run:
    """Measure estimators, daemon and skips; `quick` in about 20 s: fewer touches, the daemon at full speed only.

    `models` is the folder of the networks, of which the default one may have an atlas beside it; or one model of the
    example plate, by its own acquisition. `also` are further networks for the example rig. Raises ModelMissing if a
    network's file does not exist; ModelMismatch if a network of `also` expects another acquisition; JobError if the
    daemon fails.
    """
    scale = QUICK if quick else Scale()
    begun_s = time.monotonic()
    machine = this_machine()
    progress("simulating touches", 0.0)
    alone = models.is_file()
    networks = [models] if alone else [shipped(models, name) for name in NETWORKS]
    scenes = {scene: networks[0] for scene in WANTED if scene != KEYPAD}
    if not alone:
        scenes[KEYPAD] = shipped(models, KEYPAD)
    instrument = Instrument(DEFAULT_PLATE, acquisition=Model(networks[0]).description.acquisition)
    blocks = held_out(scale.touches, instrument)
    with tempfile.TemporaryDirectory(prefix="touchd-benchmark-") as name:
        bare = write_bare(Path(name) / "bare.onnx")
        estimators = _estimators(networks, also, instrument)
        progress("estimators", 0.1)
        with undisturbed():
            bare_us, found = race(
                estimators, BareNetwork(bare), blocks, scale.passes, scale.race_s,
                lambda: progress("estimators", 0.2),
            )  # fmt: skip
        progress("simulating scenes", 0.4)
        loops = {scene: make_loop(scene, instrument) for scene in scenes}
        cells, beside = _cells(scenes, bare, scale, loops, progress)
    progress("skips", 0.9)
    with undisturbed():
        saved = skips.measure(loops, networks[0], scale.skip_rounds, found, lambda: progress("skips", 0.95))
    return Run(
        quick=quick, seconds=time.monotonic() - begun_s, machine=machine,
        touches=Touches(
            count=scale.touches, seed=SEED, finger=FINGER, bound_mm=None if quick else _bound_mm(blocks, instrument)
        ),
        bare_us=bare_us, estimators=tuple(found),
        left_out=("the daemon at steady rates, in a quick run",) if quick else (),
        daemon=tuple(cells), skips=tuple(saved), day=daemon.day(cells), **beside,
    )  # fmt: skip


def _estimators(networks: Sequence[Path], also: Sequence[Path], instrument: Instrument) -> list[Estimator]:
    """Return the networks, those with an atlas with it, and those of `also`, by their file names."""
    made: list[Estimator] = []
    for path in networks:
        model = Model(path)
        made.append(network(model, path.stem))
        if model.atlas is not None:
            made += atlases(model, model.atlas)
    for path in also:
        if not path.is_file():
            raise ModelMissing("no such model", str(path), "check --also")
        model = Model(path)
        model.check(instrument.acquisition)
        made.append(network(model, path.stem, "given"))
    return made


def _cells(
    models: dict[str, Path], bare: Path, scale: Scale, loops: dict[str, Loop], progress: Progress
) -> tuple[list[DaemonResult], dict[str, Any]]:
    """Run the daemon through every scene at every rate, with the scene's model; and see `daemon.tails`."""
    wanted = [
        (scene, rate_hz)
        for scene in loops for rate_hz in scale.rates_hz if scene != KEYPAD or rate_hz in KEYPAD_RATES_HZ
    ]  # fmt: skip
    cells: list[DaemonResult] = []
    beside: dict[str, Any] = {}
    for number, (scene, rate_hz) in enumerate(wanted):
        rate = "full speed" if rate_hz is None else f"{rate_hz:g} frames/s"
        progress(f"daemon: {scene}, {rate}", 0.4 + 0.5 * number / len(wanted))
        cell = partial(
            daemon.measure, scene, loops[scene], rate_hz, scale.full_speed_s if rate_hz is None else CELL_S,
            model=models[scene], bare=bare, folder=bare.parent,
        )  # fmt: skip
        if (scene, rate_hz) == daemon.TAIL:
            found, beside = daemon.tails(cell, CELL_S, bare.parent)
            cells.append(found)
        else:
            repeats = REPEATS if rate_hz is None and scene in scale.repeated else 1
            cells.append(middle([cell() for _ in range(repeats)], lambda found: found.ratio))
    return cells, beside


def _bound_mm(blocks: Sequence[Block], instrument: Instrument) -> float:
    """Return the Cramer-Rao bound of the median error, with the noise of these residuals."""
    noise = float(np.concatenate([block.noise for block in blocks]).std())
    some = [contact for block in blocks for contact in block.contacts][:MOST_TOUCHES]
    bound_mm = median_distance_mm(position_covariance(twin_field(instrument, some), instrument.acquisition, noise))
    return rounded(bound_mm, 3)
