"""Run the whole benchmark."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import onnx

from touchd.errors import ModelMissing
from touchd.evaluation.cramer_rao import median_bound_mm
from touchd.evaluation.dataset import make_dataset, noise_of, split
from touchd.lab.benchmark import daemon, skips, tail
from touchd.lab.benchmark.estimators import NETWORKS, Estimator, atlases, bare, dictionaries, network, routes
from touchd.lab.benchmark.loop import Loop
from touchd.lab.benchmark.machine import this_machine
from touchd.lab.benchmark.race import race
from touchd.lab.benchmark.results import DaemonResult, EstimatorResult, Run, SkipResult, Touches, rounded
from touchd.lab.benchmark.scenes import WANTED, make_loop
from touchd.lab.benchmark.stopwatch import middle, undisturbed
from touchd.lab.benchmark.touches import FINGER, SEED, UNTOUCHED, HeldOut, held_out
from touchd.localization.model import Model
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import DEFAULT_PLATE, simulate_touches

Progress = Callable[[str, float], object]
"""Receives the current step and the share done."""

DICTIONARY_SEED = 1
"""Seed of the touches that the shipped networks were trained on."""
KEYPAD = "keypad"
REPEATS = 3
"""Runs at full speed, of which the one with the median ratio counts: the scheduler places threads differently."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Extent of the measurement."""

    touches: int = 1000
    passes: int = 5
    race_s: float = 30.0
    dictionary: int = 6404
    rates_hz: tuple[float | None, ...] = (125.0, 500.0, 1000.0, None)
    keypad_rates_hz: tuple[float | None, ...] = (125.0, None)
    cell_s: float = 3.0
    full_speed_s: float = 1.0
    repeated: tuple[str, ...] = tuple(WANTED)
    """Scenes that run `REPEATS` times at full speed."""
    skip_rounds: int = 60
    bound: bool = True


QUICK = Scale(
    touches=200, passes=2, race_s=4.0, dictionary=0, rates_hz=(None,), keypad_rates_hz=(None,),
    full_speed_s=0.8, repeated=("moving",), skip_rounds=20, bound=False,
)  # fmt: skip


def benchmark(models: Path, *, quick: bool, progress: Progress, also: Sequence[Path] = ()) -> Run:
    """Measure estimators, daemon and skips.

    Parameters
    ----------
    models : Path
        Folder of the networks; the default one may have an atlas beside it.
    quick : bool
        Measure in about 20 s: fewer touches, no kNN and GCC, the daemon at full speed only.
    progress : callable
    also : sequence of Path
        Further networks for the example rig.

    Raises
    ------
    ModelMissing
        A network's file does not exist.
    ModelMismatch
        A network expects another acquisition.
    JobError
        The daemon fails.
    """
    scale = QUICK if quick else Scale()
    begun_s = time.monotonic()
    machine = this_machine()
    progress("simulating touches", 0.0)
    instrument = Instrument(DEFAULT_PLATE)
    held = held_out(scale.touches, instrument)
    with tempfile.TemporaryDirectory(prefix="touchd-benchmark-") as name:
        folder = Path(name)
        runner = bare(folder)
        estimators = _estimators(models, folder, scale, instrument) + list(_given(also, instrument))
        progress("estimators", 0.1)
        with undisturbed():
            bare_us, found = race(
                estimators, runner, held.blocks, scale.passes, scale.race_s,
                lambda: progress("estimators", 0.2),
            )  # fmt: skip
        loops = {}
        for scene in WANTED:
            progress("simulating scenes", 0.4)
            loops[scene] = make_loop(scene, instrument)
        cells, tails = _cells(models, folder, scale, loops, progress)
    saved = _skips(models, loops, found, scale, progress)
    bound_mm = rounded(_bound_mm(held, instrument), 3) if scale.bound else None
    left_out = () if scale.dictionary else ("kNN and GCC, in a quick run",)
    return Run(
        quick=quick, seconds=rounded(time.monotonic() - begun_s, 3), machine=machine,
        touches=Touches(count=held.count, seed=SEED, finger=FINGER, bound_mm=bound_mm), bare_us=bare_us,
        estimators=tuple(found), left_out=left_out, daemon=tuple(cells),
        bus_us=tails.bus_us if tails else None, held_up_us=tails.held_up_us if tails else None,
        apart=tails.apart if tails else None, asleep=tails.asleep if tails else None, skips=tuple(saved),
        day=daemon.day(cells),
    )  # fmt: skip


def _estimators(models: Path, folder: Path, scale: Scale, instrument: Instrument) -> list[Estimator]:
    made: list[Estimator] = []
    for name in NETWORKS:
        path = _path(models, name)
        model, graph = Model(path), onnx.load(path)
        made.append(network(model, graph, name))
        if name == NETWORKS[0]:
            made += routes(model, graph, folder)
            if model.atlas is not None:
                made += atlases(model, model.atlas, graph)
    if scale.dictionary:
        data = make_dataset(simulate_touches(scale.dictionary, seed=DICTIONARY_SEED, instrument=instrument))
        train = split(len(data), 0).train
        made += dictionaries(data.residual[train], data.position_mm[train], data.acquisition)
    return made


def _given(also: Sequence[Path], instrument: Instrument) -> Iterator[Estimator]:
    """Yield the networks of --also, by their file names."""
    for path in also:
        if not path.is_file():
            raise ModelMissing("no such model", str(path), "check --also")
        model = Model(path)
        model.check(instrument.acquisition)
        yield network(model, onnx.load(path), path.stem, "given")


def _cells(
    models: Path, folder: Path, scale: Scale, loops: dict[str, Loop], progress: Progress
) -> tuple[list[DaemonResult], tail.Tails | None]:
    """Run the daemon through every scene at every rate, and the bus alone."""
    wanted = [
        (scene, rate_hz)
        for scene in loops
        for rate_hz in (scale.keypad_rates_hz if scene == KEYPAD else scale.rates_hz)
    ]
    cells: list[DaemonResult] = []
    tails = None
    for number, (scene, rate_hz) in enumerate(wanted):
        rate = "full speed" if rate_hz is None else f"{rate_hz:g} frames/s"
        progress(f"daemon: {scene}, {rate}", 0.4 + 0.5 * number / len(wanted))
        cell = partial(
            daemon.measure, scene, loops[scene], rate_hz, scale.full_speed_s if rate_hz is None else scale.cell_s,
            model=_path(models, KEYPAD if scene == KEYPAD else NETWORKS[0]), bare=folder / "bare.onnx", folder=folder,
        )  # fmt: skip
        if (scene, rate_hz) == tail.TAIL:
            tails = tail.measure(cell, scale.cell_s, folder)
            cells.append(tails.cell)
        else:
            repeats = REPEATS if rate_hz is None and scene in scale.repeated else 1
            cells.append(middle([cell() for _ in range(repeats)], lambda found: found.ratio))
    return cells, tails


def _skips(
    models: Path, loops: dict[str, Loop], found: list[EstimatorResult], scale: Scale, progress: Progress
) -> list[SkipResult]:
    progress("skips", 0.9)
    path = _path(models, NETWORKS[0])
    atlas = Model(path).atlas
    with undisturbed():
        saved = skips.measure(loops, path, scale.skip_rounds, lambda: progress("skips", 0.95))
        if atlas is not None:
            saved.append(skips.bins(atlas, scale.skip_rounds))
    tracking = skips.tracking({one.name: one for one in found})
    return saved if tracking is None else [*saved, tracking]


def _bound_mm(held: HeldOut, instrument: Instrument) -> float:
    """Return the Cramer-Rao bound of the median error, with the noise of these residuals."""
    truth, frames = held.recording.contacts_mm, held.recording.frames
    assert truth is not None  # the twin labels its scenes
    untouched = frames[(truth[:, :, 0] != truth[:, :, 0]).all(axis=1)]
    return median_bound_mm(held.recording, instrument, noise_of(untouched) * (1 + 1 / UNTOUCHED) ** 0.5)


def _path(models: Path, name: str) -> Path:
    path = models / f"{name}.onnx"
    if not path.is_file():
        raise ModelMissing("no such model", str(path), "train it, or name the folder of the models: --models")
    return path
