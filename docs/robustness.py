"""Measure and draw what docs/robustness.md shows: twenty minutes in all, and the extra `train`.

    python -m docs.robustness [--keep FOLDER] [PART ...]

Data and pictures go to docs/robustness/; `make docs` then puts the decisive rows on the page. What is measured, and
how, is in tests/scenes/numerics, which runs short versions of it. The training recording and the
networks of the paper's recipe are made in a temporary folder, or in one that is kept and used again.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from docs import measured
from tests.scenes.numerics import agreement, curves, degenerate, limits, longruns
from tests.scenes.numerics.curvepage import ATLAS, HEADINGS, NETWORK, PAPER, answer_rows, draw, small
from tests.scenes.numerics.watch import run
from tests.scenes.stages import frames_of
from touchd.evaluation.dataset import Dataset, digest, make_dataset, split, thin
from touchd.localization.model import Model, default_model_path
from touchd.recording.data import Recording
from touchd.recording.format import read, write
from touchd.training.network.recipe import RECIPES
from touchd.training.report.template import read_csv
from touchd.twin.instrument import Instrument
from touchd.twin.scenes.catalogue import SCENES
from touchd.twin.simulate import DEFAULT_PLATE, simulate_scene, simulate_touches

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "robustness.md"

TRAINING_TOUCHES, TRAINING_SEED, PAPER_SEED = 6404, 1, 1
TOUCHES = 400
"""Of each point of a curve."""
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
            write(path, simulate_touches(TRAINING_TOUCHES, seed=TRAINING_SEED, even=True, instrument=self.instrument))
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
        return Model(path, atlas=False)

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


def float64(bench: Bench) -> None:
    """Compare every scene with float64."""
    assert bench.model.atlas is not None
    rows: list[tuple[object, ...]] = []
    found: list[agreement.Agreement] = []
    for name in SCENES:
        scene = simulate_scene(name, seed=SCENE_SEED, instrument=bench.instrument)
        a = agreement.compared(scene, bench.model.atlas)
        found.append(a)
        rows.append((
            name, a.frames, a.located, a.contacts, small(a.features), small(max(a.rounding_mm, default=0.0)),
            small(max(a.begun_elsewhere_mm, default=0.0)) if a.begun_elsewhere_mm else "", a.other,
            "yes" if a.same_events else "no", *_spread(a.truncation_mm), f"{a.truncation_sigmas:.2f}",
        ))  # fmt: skip
    elsewhere = [mm for a in found for mm in a.begun_elsewhere_mm]
    rows.append((
        "all", *(sum(getattr(a, name) for a in found) for name in ("frames", "located", "contacts")),
        small(max(a.features for a in found)), small(max(mm for a in found for mm in a.rounding_mm)),
        small(max(elsewhere)) if elsewhere else "", sum(a.other for a in found),
        "yes" if all(a.same_events for a in found) else "no",
        *_spread([mm for a in found for mm in a.truncation_mm]), f"{max(a.truncation_sigmas for a in found):.2f}",
    ))  # fmt: skip
    headings = (
        "scene", "frames", "located", "places", "features_relative", "rounding_most_mm", "begun_elsewhere_mm",
        "decided_otherwise", "same_events", "truncation_median_mm", "truncation_p95_mm", "truncation_most_mm",
        "truncation_most_sigma",
    )  # fmt: skip
    measured.data(PAGE, "float64", headings, rows)


def _spread(lengths_mm: Sequence[float]) -> tuple[str, str, str]:
    median, p95, most = np.percentile(lengths_mm or [0.0], [50, 95, 100]).tolist()
    return small(median), small(p95), small(most)


def _cells(verdict: limits.Verdict) -> tuple[object, ...]:
    v = verdict
    assert v.not_finite == 0
    return (v.published, v.wrong + v.outside, v.unsure, v.found, v.fingers)


VERDICT = ("published", "wrong", "beyond_5_sigma", "found", "fingers")


def limit(bench: Bench) -> None:
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
    rows = [(*key, *_cells(verdict)) for key, verdict in groups.items()]
    measured.data(PAGE, "limit", ("input", "since", *VERDICT), rows)


def _is_alone(case: limits.Case) -> bool:
    return not case.group.startswith(("one channel", "two channels", "bursts"))


def tones(bench: Bench) -> None:
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
    measured.data(PAGE, "tones", ("each 1 kHz from 0.5 to 124.5", *VERDICT), rows)


def conditioning(bench: Bench) -> None:
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
    measured.data(PAGE, "conditioning", ("where", *VERDICT, "worst_mm"), rows)


def long(_bench: Bench) -> None:
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
    measured.data(PAGE, "long", ("what", "how_long", "measured", "bound"), rows)


def curve(axis: curves.Axis) -> Callable[[Bench], None]:
    """Return the part that measures one curve."""

    def part(bench: Bench) -> None:
        answers = curves.measured(axis, bench.contenders(), TOUCHES, bench.instrument)
        figure = draw([str(v) if isinstance(v, str) else v for v in axis.values], answers, axis.label, axis.title,
                      logarithmic=axis.logarithmic, reverse=axis.name == "noise")  # fmt: skip
        measured.picture(PAGE, figure, axis.name)
        measured.data(PAGE, axis.name, (axis.label, *HEADINGS), answer_rows(axis.values, answers))

    return part


def learning(bench: Bench) -> None:
    """Measure the error by training touches; the atlas' errors are those that `python -m docs.accuracy` measured."""
    other = importlib.import_module("docs.accuracy")  # by name: beside it lies a folder of that name
    test = simulate_touches(other.TOUCHES, seed=other.SEED, instrument=bench.instrument)
    data = make_dataset(test)
    atlas = {
        int(count): (float(median), float(p95))
        for count, _, median, p95 in read_csv(ROOT / "docs" / "accuracy" / "learning.csv").rows
    }
    counts = [*(n for n in FEWEST if n < min(atlas)), *atlas]
    answers: list[dict[str, curves.Answer]] = []
    for count in counts:
        answers.append({name: ask(test, data) for name, ask in bench.contenders(count).items()})
    known = {ATLAS: [atlas.get(count) for count in counts]}
    label = "training touches"
    figure = draw(counts, answers, label, "error by training touches", logarithmic=True, known=known)
    measured.picture(PAGE, figure, "learning")
    measured.data(PAGE, "learning", (label, *HEADINGS), answer_rows(counts, answers, known))


PARTS: dict[str, Callable[[Bench], None]] = {
    part.__name__: part for part in (float64, limit, tones, conditioning, long)
}
PARTS |= {axis.name: curve(axis) for axis in curves.AXES}
PARTS["learning"] = learning


def main() -> None:
    """Make the parts that are asked for, by default all."""
    with measured.asked(PAGE, __doc__ or "", PARTS, "the training recording and networks") as (folder, wanted):
        bench = Bench(folder)
        for name, part in wanted.items():
            part(bench)
            print(f"{name}: done", flush=True)


if __name__ == "__main__":
    main()
