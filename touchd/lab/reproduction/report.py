"""The report: our figures beside the paper's, as a page in Markdown and as files beside its plots."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from touchd import __version__
from touchd.evaluation.metrics import position_scores
from touchd.evaluation.model_scores import Judgement
from touchd.files import replacing
from touchd.lab.reproduction import paper, run
from touchd.lab.reproduction.experiments import Trial, keypad_scores, zone_accuracy
from touchd.lab.reproduction.run import CIRCLE_HEADS, HELD_OUT, Results
from touchd.training.report.template import Table, read_csv, render, write_csv

TEMPLATE = Path(__file__).with_name("report.md.j2")
SHOWN_HEADS, SHOWN_SHARES = ("R, frequency", "C-10, frequency"), ("100%", "20%")
SHARES = ("share", "network", "kNN", "paper: network", "paper: kNN")
STATISTICS = ("rmse_mm", "mean_mm", "sd_mm", "median_mm", "p95_mm", "max_mm")
HEADINGS = ("RMSE", "mean", "sd", "median", "p95", "max")
PAPER = "paper: mean ± sd"


class Figures(NamedTuple):
    """What a report says: facts by name, and whole tables by name."""

    facts: dict[str, object]
    tables: dict[str, Table]


def page(found: Figures, folder: str) -> str:
    """Return the page, with its plots and whole tables in `folder` beside it: of each table the decisive rows."""
    tables = found.tables
    shown = {
        "heads": _shown_heads(tables["full-plate"], tables["central"]),
        "shares": tables["shares"].pick(SHOWN_SHARES, SHARES),
    }
    if "circle" in tables:
        shown["circle"] = tables["circle"].pick(columns=("model", "mean", "sd", PAPER))
        shown["beaten"] = tables["beaten"]
    return render(
        TEMPLATE, pictures=folder, paper=paper, **found.facts,
        **{name: table.markdown() for name, table in shown.items()},
    )  # fmt: skip


def _shown_heads(full: Table, central: Table) -> Table:
    """Return the heads that decide, on both areas."""
    columns = ("head, domain", "mean", "sd", "perfect", PAPER)
    rows = []
    for ours, theirs in zip(full.pick(SHOWN_HEADS, columns).rows, central.pick(SHOWN_HEADS, columns).rows, strict=True):
        rows.append([ours[0], *(f"{mean} ± {sd}, {best}" for _, mean, sd, best, _ in (ours, theirs)), ours[-1]])
    heading = "mean ± sd, perfect"
    return Table(("head, domain", f"full plate: {heading}", f"central 11 x 11 cm: {heading}", PAPER), rows)


def store(found: Figures, folder: Path) -> None:
    """Write facts and tables into a folder."""
    text = json.dumps(found.facts, indent=1, ensure_ascii=False)
    with replacing(folder / "facts.json") as file:
        file.write(text.encode() + b"\n")
    for name, table in found.tables.items():
        write_csv(folder / f"{name}.csv", table)


def load(folder: Path) -> Figures:
    """Read what `store` wrote."""
    tables = {path.stem: read_csv(path) for path in folder.glob("*.csv")}
    return Figures(json.loads((folder / "facts.json").read_text("utf-8")), tables)


def figures(results: Results, command: str) -> Figures:
    """Return all facts and tables of a run of `command`."""
    took_us = results.took_us
    keypad = keypad_scores(results.full[run.keypad_name(1.0, run.KEYPAD_SEEDS[0])].judged, results.layout)
    facts: dict[str, object] = {
        "version": __version__, "command": command, "source": _source(results), "given": results.given,
        "keys": len(results.layout.key), "seeds": len(run.KEYPAD_SEEDS),
        "keypad_accuracy": round(keypad["accuracy"], 3), "key_to_key_errors": round(keypad["key_to_key_errors"]),
        "knn_ratio": round(took_us["kNN 1"] / took_us["network"]),
    }  # fmt: skip
    tables = {
        "full-plate": _heads(results.full, results.recording.meta.plate.size_mm),
        "central": _heads(results.central, (paper.CENTRAL_MM, paper.CENTRAL_MM)),
        "shares": _shares(results),
        "dictionaries": _dictionaries(results),
    }
    if not results.given:
        seeds = [f"{kind} {seed}" for kind, seed in HELD_OUT.items()]
        facts |= {
            "circle_seed": run.CIRCLE_SEED, "held_out": results.scale.held_out,
            "held_out_seeds": ", ".join([*seeds, f"the other plate {run.OTHER_HELD_OUT_SEED}"]),
        }  # fmt: skip
        tables |= {"circle": _circle(results), "beaten": _beaten(results), "models": _details(results)}
    return Figures(facts, tables)


def _source(results: Results) -> str:
    plate = results.recording.meta.plate
    size = f"{plate.width_mm:g} x {plate.height_mm:g} x {plate.thickness_mm:g} mm"
    if results.given:
        return f"a given recording of a {plate.material} plate, {size}"
    return (
        f"the digital twin's reference plate ({plate.material}, {size}): {results.scale.touches} touches of a silicone "
        f"finger on the full plate (seed {run.TRAINING_SEED}) and as many on its central 11 x 11 cm "
        f"(seed {run.CENTRAL_SEED})"
    )


def _statistics(judged: Judgement, digits: int) -> list[str]:
    scores = position_scores(judged.error_mm)
    return [f"{scores[key]:.{digits}f}" for key in STATISTICS]


def _reported(value: paper.Reported | None) -> str:
    return "-" if value is None else f"{value.mean_mm:.1f} ± {value.sd_mm:.1f}"


def _heads(found: Mapping[str, Trial], size_mm: tuple[float, float]) -> Table:
    """Return the table of one area's heads."""
    rows = []
    for domain in run.DOMAINS:
        for head in run.HEADS:
            judged = found[run.head_name(head, domain)].judged
            grid = int(head[2:]) if head != "R" else 0
            accuracy = f"{zone_accuracy(judged, grid, size_mm):.1%}" if grid else "-"
            perfect = f"{paper.perfect_mean_mm(size_mm[0], grid):.1f}" if grid and size_mm[0] == size_mm[1] else "-"
            reported = _reported(paper.HEADS.get((head, domain)))
            rows.append([f"{head}, {domain}", *_statistics(judged, 1), accuracy, perfect, reported])
    return Table(("head, domain", *HEADINGS, "zone accuracy", "perfect", PAPER), rows)


def _shares(results: Results) -> Table:
    layout = results.layout
    rows = []
    for share in run.SHARES:
        network, knn = (
            [keypad_scores(results.full[name(share, seed)].judged, layout)["accuracy"] for seed in run.KEYPAD_SEEDS]
            for name in (run.keypad_name, run.lookup_name)
        )
        reported = [f"{accuracy:.0%}" for accuracy in paper.KEYPAD_LEARNING.get(share, ())]
        rows.append([
            f"{share:.0%}", *(f"{np.mean(each):.1%} ± {np.std(each):.1%}" for each in (network, knn)),
            *(reported or ["-", "-"]),
            f"{results.took_us['network']:.0f}", f"{results.took_us[f'kNN {share:g}']:.0f}",
        ])  # fmt: skip
    return Table((*SHARES, "network, us", "kNN, us"), rows)


def _dictionaries(results: Results) -> Table:
    rows = []
    for method in ("kNN", "GCC"):
        for residual in (False, True):
            name = run.dictionary_name(method, residual)
            trial = results.full[name]
            rows.append([
                name, *_statistics(trial.judged, 2), f"{keypad_scores(trial.judged, results.layout)['accuracy']:.1%}",
                f"{trial.size_bytes / 1e6:.1f}", f"{results.took_us[f'{method} 1']:.0f}",
            ])  # fmt: skip
    return Table(("estimator", *HEADINGS, "keypad", "dictionary, MB", "one touch, us"), rows)


def _circle(results: Results) -> Table:
    rows = []
    for name in (*CIRCLE_HEADS, "touchd"):
        said = "over 10, sd 5.4" if name == "C-5" else _reported(paper.CIRCLE.get(name))
        rows.append([name, *_statistics(results.circle[name], 1), said])
    return Table(("model", *HEADINGS, PAPER), rows)


def _beaten(results: Results) -> Table:
    held = results.held_out
    mean = {key: f"{judged.distance_mm.mean():.2f} mm" for key, judged in held.items()}
    keypad = keypad_scores(held["keypad", "silicone"], results.layout)
    fifth = keypad_scores(held[run.BETTER_KEYPAD, "silicone"], results.layout)
    rows = [
        ["mean error", "4.4 mm", mean["regression", "silicone"]],
        ["human finger, trained on silicone only", "4.7 mm", mean["regression", "human"]],
        ["keypad: accuracy, key-to-key errors", "97 %, 0",
         f"{keypad['accuracy']:.2%}, {keypad['key_to_key_errors']:.0f}"],
        ["keypad from 20 % of the data", "89 %", f"{fifth['accuracy']:.2%}"],
        ["noise 20 dB worse", "-", mean["regression", "noise"]],
        ["baseline stale by 1 K", "-", mean["regression", "stale"]],
        [f"a plate never seen, from {results.scale.other_touches} touches", "-", mean[run.OTHER_PLATE, "other"]],
    ]  # fmt: skip
    return Table(("mean error or accuracy", "paper on its rig", "touchd"), rows)


def _details(results: Results) -> Table:
    rows = []
    for (name, kind), judged in results.held_out.items():
        # A grid has zones instead of keys, and the layout does not fit the other plate.
        keyed = kind != "other" and not name.startswith("grid")
        keys = f"{keypad_scores(judged, results.layout)['accuracy']:.2%}" if keyed else "-"
        rows.append([name, kind, *_statistics(judged, 2), f"{(judged.distance_mm > 5).mean():.2%}", keys])
    return Table(("model", "touches", *HEADINGS, "over 5 mm", "keys"), rows)
