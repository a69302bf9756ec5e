"""Measure and draw what docs/numerics.md and docs/robustness.md show: some minutes in all, and the extra `train`.

    python -m docs.numerics [--keep FOLDER] [PART ...]

What is measured, and how, is in tests/scenes/numerics, which runs short versions of it. The training recording and the
networks of the paper's recipe are made in a temporary folder, or in one that is kept and used again.
"""

from __future__ import annotations

import importlib
import re
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from docs import measured
from tests.scenes.numerics import agreement, curves, degenerate, independence, limits, longruns
from tests.scenes.numerics.curvepage import ATLAS, NETWORK, PAPER, answer_table, draw, small, table
from tests.scenes.numerics.watch import frames_of, run
from touchd.evaluation.dataset import Dataset, digest, make_dataset, split, thin
from touchd.lab.benchmark.machine import this_machine
from touchd.localization.model import Model, default_model_path
from touchd.recording.data import Recording
from touchd.recording.format import read, write
from touchd.training.network.recipe import RECIPES
from touchd.twin.instrument import Instrument
from touchd.twin.scenes.catalogue import SCENES
from touchd.twin.simulate import DEFAULT_PLATE, simulate_scene, simulate_touches

ROOT = Path(__file__).resolve().parent.parent
PAGE, CURVES = ROOT / "docs" / "numerics.md", ROOT / "docs" / "robustness.md"

TRAINING_TOUCHES, TRAINING_SEED, PAPER_SEED = 6404, 1, 1
TOUCHES = 400
"""Of each point of a curve."""
NETWORK_TOUCHES, NETWORK_SEED = 1000, 7290
SCENE_SEED = 21
TAP_SEEDS = (31, 32)
TONE_LEVELS_DB = (-60.0, -50.0, -40.0, -20.0, 0.0)
IMAGE_LEVELS_DB = (-40.0, -30.0, -20.0, -10.0)
UPDATES = 100_000_000
FEWEST = (100, 200, 400)
"""Training touches from which only kNN, GCC and the paper's recipe are made."""


@dataclass
class Bench:
    """What the measurements need, made when it is first asked for."""

    folder: Path

    @cached_property
    def instrument(self) -> Instrument:
        """The default plate."""
        return Instrument(DEFAULT_PLATE)

    @cached_property
    def model(self) -> Model:
        """The shipped network and atlas."""
        return Model(default_model_path())

    @cached_property
    def training(self) -> Recording:
        """The recording that the shipped network and atlas were trained on."""
        path = self.folder / "training.npz"
        if not path.exists():
            write(path, simulate_touches(TRAINING_TOUCHES, seed=TRAINING_SEED, instrument=self.instrument))
        recording = read(path)
        if digest(recording) != self.model.description.data_sha256:
            raise SystemExit(f"{path} is not what the shipped network was trained on")
        return recording

    @cached_property
    def dataset(self) -> Dataset:
        """Its touches."""
        return make_dataset(self.training)

    def paper(self, touches: int) -> Model:
        """Return the paper's recipe trained on so many touches."""
        from touchd.training.train_network import train

        path = self.folder / f"paper-{touches}.onnx"
        if not path.exists():
            share = touches / len(split(len(self.dataset), PAPER_SEED).train)
            train(self.training, path, RECIPES["paper-regression"], seed=PAPER_SEED, share=share)
        return curves.trained_on(path)

    def contenders(self, touches: int | None = None) -> dict[str, curves.Contender]:
        """Return the ways to place a finger, those that learn quickly from so many of the training touches."""
        parts = split(len(self.dataset), 0)
        count = touches or len(parts.train)
        rows = thin(parts, count / len(parts.train)).train
        quick = {
            PAPER: curves.by_network(self.paper(count), refuses=False),
            "kNN": curves.by_dictionary(self.dataset, rows, "kNN"),
            "GCC": curves.by_dictionary(self.dataset, rows, "GCC"),
        }
        if touches is not None:
            return quick
        assert self.model.atlas is not None
        ours = {
            ATLAS: curves.by_atlas(self.model, self.model.atlas),
            NETWORK: curves.by_network(Model(default_model_path(), atlas=False)),
        }
        return ours | quick


def float64(bench: Bench) -> str:
    """Compare every scene with float64."""
    assert bench.model.atlas is not None
    rows, rounding, early = [], [], []
    placed = elsewhere = 0
    for name in SCENES:
        scene = simulate_scene(name, seed=SCENE_SEED, instrument=bench.instrument)
        a = agreement.compared(scene, bench.model.atlas)
        rounding += a.rounding_mm
        early += a.truncation_mm
        placed, elsewhere = placed + a.contacts, elsewhere + len(a.begun_elsewhere_mm)
        median, p95, most = np.percentile(a.truncation_mm or [0.0], [50, 95, 100]).tolist()
        rows.append((
            name, a.frames, a.located, a.contacts, small(a.features), small(max(a.rounding_mm, default=0.0)),
            small(max(a.begun_elsewhere_mm, default=0.0)) if a.begun_elsewhere_mm else "", a.other,
            "yes" if a.same_events else "no", small(median), small(p95), small(most), f"{a.truncation_sigmas:.2f}",
        ))  # fmt: skip
    median, p95, most = np.percentile(early, [50, 95, 100]).tolist()
    summary = (
        f"\n\nIn all {placed:,} places: rounding {small(float(np.median(rounding)))} mm in the median and "
        f"{small(max(rounding))} mm at most; {elsewhere} of them begun elsewhere; truncation {small(median)} mm in the "
        f"median, {small(p95)} mm at the 95th percentile, {small(most)} mm at most."
    )
    heads = (
        "scene", "frames", "located", "places", "features, relative", "rounding mm, most", "begun elsewhere mm",
        "decided otherwise", "same events", "truncation mm, median", "p95", "most", "of sigma, most",
    )  # fmt: skip
    return table(heads, rows) + summary


def cut_up(bench: Bench) -> str:
    """Measure what precision, batch, threads and chunks change."""
    assert bench.model.atlas is not None
    recording = simulate_touches(NETWORK_TOUCHES, seed=NETWORK_SEED, instrument=bench.instrument)
    data = make_dataset(recording)
    found = agreement.networks(data.residual)
    found.append(agreement.atlas_shift(recording, bench.model.atlas))
    found += [
        agreement.NetworkShift(f"network, {s.name}", s.median_mm, s.p95_mm, s.most_mm)
        for s in independence.by_batch_and_threads(data.residual)
    ]
    rows = [(s.name, small(s.median_mm), small(s.p95_mm), small(s.most_mm)) for s in found]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = simulate_scene("two", seed=SCENE_SEED, instrument=bench.instrument)
        entire = independence.whole(scene, folder)
        pieces = list(independence.chunked(scene, folder, (1, 7, 64, 1000)))
        pieces += [
            (f"{n} BLAS thread{'s'[: n > 1]}", independence.with_blas_threads(folder / "whole.npz", n)) for n in (1, 2)
        ]
    for what, contacts in pieces:
        same = "0, to the bit" if contacts == entire else small(independence.farthest_mm(contacts, entire))
        rows.append((f"all events of `two`, {what}", "", "", same))
    return table((f"{NETWORK_TOUCHES} touches", "shift mm, median", "p95", "most"), rows)


def _cells(verdict: limits.Verdict) -> tuple[object, ...]:
    v = verdict
    assert v.not_finite == 0
    return (v.published, v.wrong + v.outside, v.unsure, f"{v.found} of {v.fingers}")


LIMIT_HEADS = ("published", "wrong", "beyond 5 sigma", "found")


def limit(bench: Bench) -> str:
    """Do what an ADC and a plate can do at most to taps, and count wrong touches."""
    scenes = [simulate_scene("tap", seed=seed, instrument=bench.instrument) for seed in TAP_SEEDS]
    groups: dict[tuple[str, str], limits.Verdict] = {}
    for case in limits.cases():
        for scene, seed in zip(scenes, TAP_SEEDS, strict=True):
            for moment, since in limits.moments(scene).items():
                found = limits.tried(scene, case, since=since, seed=seed, model=bench.model)
                name = f"{case.group}: {case.name}" if _is_alone(case) else case.group
                groups[name, moment] = groups.get((name, moment), limits.Verdict()) + found
    for level_db in IMAGE_LEVELS_DB:
        found = sum((limits.image(level_db, seed, bench.instrument) for seed in TAP_SEEDS), limits.Verdict())
        groups[f"the chirp's image: {level_db:g} dB", "from the start"] = found
    moments = list(limits.moments(scenes[0]))
    names = list(dict.fromkeys(name for name, _ in groups))
    rows = [
        (name, *(f"{v.published} / {v.wrong + v.outside} / {v.unsure} / {v.found} of {v.fingers}"
                 if (v := groups.get((name, moment))) else "" for moment in moments))
        for name in names
    ]  # fmt: skip
    return table(("what is done: published / wrong / beyond 5 sigma / found", *moments), rows)


def _is_alone(case: limits.Case) -> bool:
    return not case.group.startswith(("one channel", "two channels", "bursts"))


def tones(bench: Bench) -> str:
    """Add a tone at every frequency to taps."""
    scene = simulate_scene("tap", seed=TAP_SEEDS[0], instrument=bench.instrument)
    rows = []
    for level_db in TONE_LEVELS_DB:
        inside, outside = limits.Verdict(), limits.Verdict()
        for case in limits.tones(level_db):
            found = limits.tried(scene, case, seed=TAP_SEEDS[0], model=bench.model)
            if 50 < float(case.name.split()[0]) < 100:
                inside += found
            else:
                outside += found
        rows += [
            (f"{level_db:g} dB, within the band", *_cells(inside)),
            (f"{level_db:g} dB, outside", *_cells(outside)),
        ]
    return table(("tones, each 1 kHz from 0.5 to 124.5", *LIMIT_HEADS), rows)


def conditioning(bench: Bench) -> str:
    """Touch the plate where a fit is badly conditioned."""
    assert bench.model.atlas is not None
    edge = degenerate.on_the_edge(bench.instrument)
    places = {
        "in a node of the field": degenerate.in_nodes(bench.model.atlas),
        "at the edge, the contact touches it": edge[:-4],
        "4 mm beside the middle of a disc": [(x + 4, y) for x, y in degenerate.on_discs(bench.instrument)],
        "in the middle of a disc": degenerate.on_discs(bench.instrument),
        "in a corner, 6 mm from both edges": degenerate.corners(bench.instrument, 6.0),
        "in a corner, 5 mm from both edges": degenerate.corners(bench.instrument, 5.0),
        "in a corner, the contact touches both": edge[-4:],
    }
    rows = []
    for name, chosen in places.items():
        for kind in ("silicone", "human"):
            if kind == "human" and name.endswith(("it", "both", "edges")):
                continue  # a human contact is larger than that
            taps = degenerate.taps_at(chosen, bench.instrument, kind=kind)
            verdict = limits.judge(taps, run(frames_of(taps), model=bench.model))
            worst = f"{verdict.worst_mm:.2f}" if verdict.published else ""
            rows.append((f"{name}, {kind}", *_cells(verdict), worst))
    return table(("where", *LIMIT_HEADS, "worst mm"), rows)


def denormals(_bench: Bench) -> str:
    """Time denormals in alternation with ordinary numbers."""
    return table(
        ("what", "time, ratio to ordinary numbers"),
        [(slow.what, f"{slow.ratio:.2f}") for slow in degenerate.slowdowns(turns=1000)],
    )


def long(_bench: Bench) -> str:
    """Run long what is carried on from frame to frame."""
    rng = np.random.default_rng(3)
    rows: list[tuple[object, ...]] = []
    for rate_hz in (125.0, 1000.0):
        for what, spread in (("constant full scale", 0), ("50 noisy frames, again and again", 16)):
            inputs = 32_700 + rng.integers(-spread, spread + 1, (50 if spread else 1, *longruns.SHAPE))
            found = longruns.resting_baseline(
                rate_hz, inputs.astype(np.int16), np.zeros(longruns.SHAPE, np.float32)
            )  # fmt: skip
            rows.append((
                f"baseline, {rate_hz:g} frames/s, {what}: distance from the exact mean, counts",
                f"for ever; its state repeats itself from update {found.updates:,} on", small(found.off),
                small(found.bound),
            ))  # fmt: skip
    gate = longruns.long_gate(UPDATES)
    rows.append(
        ("gate: mean and variance, relative", f"{gate.updates:,} updates", small(gate.relative), small(gate.bound))
    )
    noise = longruns.long_noise(300_000)
    rows.append(
        ("noise of the bins, relative", f"{noise.updates:,} updates", small(noise.relative), small(noise.bound))
    )
    for skew in (-100e-6, 40e-6):
        error_us = np.array([error for _, _, error in longruns.year_of_clock(120.0, skew=skew)]) * 1e-3
        drift = abs(float(error_us[-20_000:].mean() - error_us[2000:22_000].mean()))
        rows.append((
            f"device's clock, {skew * 1e6:+.0f} ppm: mean error in the last month beside the first, us",
            "a year, a frame every 2 minutes", small(drift), "20",
        ))  # fmt: skip
    return table(("what", "how long", "measured", "bound"), rows)


def curve(axis: curves.Axis) -> Callable[[Bench], str]:
    """Return the part that measures one curve."""

    def part(bench: Bench) -> str:
        answers = curves.measured(axis, bench.contenders(), TOUCHES, bench.instrument)
        figure = draw([str(v) if isinstance(v, str) else v for v in axis.values], answers, axis.label, axis.title,
                      logarithmic=axis.logarithmic, reverse=axis.name == "noise")  # fmt: skip
        return picture(figure, axis.name, axis.title) + "\n\n" + answer_table(axis.label, axis.values, answers)

    return part


def learning(bench: Bench) -> str:
    """Measure the error by training touches; what the atlas makes of as many is taken from docs/accuracy.md."""
    other = importlib.import_module("docs.accuracy")  # by name: beside it lies a folder of that name
    test = simulate_touches(other.TOUCHES, seed=other.SEED, instrument=bench.instrument)
    data = make_dataset(test)
    atlas = atlas_learning((ROOT / "docs" / "accuracy.md").read_text())
    counts = [*(n for n in FEWEST if n < min(atlas)), *atlas]
    answers: list[dict[str, curves.Answer]] = []
    for count in counts:
        found = {name: ask(test, data) for name, ask in bench.contenders(count).items()}
        answers.append(found)
    known = {ATLAS: [atlas.get(count) for count in counts]}
    figure = draw(counts, answers, "training touches", "error by training touches", logarithmic=True, known=known)
    return picture(figure, "learning", "error by training touches") + "\n\n" + answer_table(
        "training touches", counts, answers, known
    )  # fmt: skip


def atlas_learning(page: str) -> dict[int, tuple[float, float]]:
    """Return median and 95th percentile by training touches, as `python -m docs.accuracy learning` wrote them."""
    block = page.split("<!-- learning:begin -->")[1].split("<!-- learning:end -->")[0]
    rows = re.findall(r"^\| (\d+) \| [\d.]+ \| ([\d.]+) \| ([\d.]+) \|", block, re.MULTILINE)
    return {int(count): (float(median), float(p95)) for count, median, p95 in rows}


def picture(figure: Figure, name: str, caption: str) -> str:
    """Save a picture, and return what the page says of it."""
    return measured.picture(CURVES, figure, name, caption[0].upper() + caption[1:])


PARTS: dict[str, Callable[[Bench], str]] = {
    part.__name__: part for part in (float64, cut_up, limit, tones, conditioning, denormals, long)
}
CURVE_PARTS: dict[str, Callable[[Bench], str]] = {axis.name: curve(axis) for axis in curves.AXES}
CURVE_PARTS["learning"] = learning


def main() -> None:
    """Make the parts that are asked for, by default all."""
    parts = PARTS | CURVE_PARTS
    with measured.asked(PAGE, __doc__ or "", parts, "the training recording and networks") as (folder, wanted):
        bench = Bench(folder)
        for name, part in wanted.items():
            started_s = time.monotonic()
            content = part(bench)
            took = f"\n\n`python -m docs.numerics {name}`, {time.monotonic() - started_s:.0f} s."
            measured.fill(CURVES if name in CURVE_PARTS else PAGE, name, content + took)
            print(f"{name}: {took.strip()}", flush=True)
        measured.fill(PAGE, "machine", f"Made on: {this_machine().line()}.")


if __name__ == "__main__":
    main()
