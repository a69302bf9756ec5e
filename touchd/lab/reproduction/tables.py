"""The report's figures: ours beside the paper's."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from touchd import __version__
from touchd.evaluation.metrics import position_scores
from touchd.lab.reproduction import paper, plan
from touchd.lab.reproduction.experiments import Trial, keypad_scores, zone_accuracy
from touchd.lab.reproduction.paper import Reported
from touchd.lab.reproduction.report import Figures
from touchd.lab.reproduction.run import (
    CENTRAL_SEED,
    CIRCLE_HEADS,
    CIRCLE_SEED,
    HELD_OUT,
    OTHER_HELD_OUT_SEED,
    OTHER_SEED,
    SHIPPED,
    TRAINING_SEED,
    Results,
)
from touchd.training.report.template import Table

STATISTICS = ("rmse_mm", "mean_mm", "sd_mm", "median_mm", "p95_mm", "max_mm")
HEADINGS = ("RMSE", "mean", "sd", "median", "p95", "max")


def figures(results: Results, command: str) -> Figures:
    """Return all facts and tables of a run of `command`."""
    took_us = results.took_us
    keypad = keypad_scores(results.full[plan.keypad_name(1.0, plan.KEYPAD_SEEDS[0])].judged, results.layout)
    facts: dict[str, object] = {
        "version": __version__, "command": command, "source": _source(results), "given": results.given,
        "keys": len(results.layout.key), "seeds": len(plan.KEYPAD_SEEDS),
        "keypad_accuracy": round(keypad["accuracy"], 3), "key_to_key_errors": round(keypad["key_to_key_errors"]),
        "knn_ratio": round(took_us["kNN 1"] / took_us["network"]),
        "knn_saved_ms": round((took_us["kNN 1"] - took_us["kNN 0.2"]) / 1e3, 2),
    }  # fmt: skip
    plate = results.recording.meta.plate
    tables = {
        "full-plate": _heads(results.full, plate.size_mm),
        "central": _heads(results.central, (paper.CENTRAL_MM, paper.CENTRAL_MM)),
        "shares": _shares(results),
        "dictionaries": _dictionaries(results),
    }
    if not results.given:
        seeds = [f"{kind} {seed}" for kind, seed in HELD_OUT.items()]
        facts |= {
            "circle_seed": CIRCLE_SEED, "held_out": results.scale.held_out, "other_seed": OTHER_SEED,
            "held_out_seeds": ", ".join([*seeds, f"the other plate {OTHER_HELD_OUT_SEED}"]),
            "shipped": ", ".join(SHIPPED),
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
        f"finger on the full plate (seed {TRAINING_SEED}) and as many on its central 11 x 11 cm (seed {CENTRAL_SEED})"
    )


def _reported(value: Reported | None) -> str:
    if value is None:
        return "-"
    return f"{value.mean_mm:.1f} ± {value.sd_mm:.1f}"


def _heads(found: Mapping[str, Trial], size_mm: tuple[float, float]) -> Table:
    """Return the table of one area's heads."""
    rows = []
    for domain in plan.DOMAINS:
        for head in plan.HEADS:
            judged = found[plan.head_name(head, domain)].judged
            grid = int(head[2:]) if head != "R" else 0
            scores = position_scores(judged.error_mm)
            accuracy = f"{zone_accuracy(judged, grid, size_mm):.1%}" if grid else "-"
            perfect = f"{paper.perfect_mean_mm(size_mm[0], grid):.1f}" if grid and size_mm[0] == size_mm[1] else "-"
            rows.append(
                [f"{head}, {domain}", *(f"{scores[key]:.1f}" for key in STATISTICS), accuracy, perfect,
                 _reported(paper.HEADS.get((head, domain)))]
            )  # fmt: skip
    return Table(("head, domain", *HEADINGS, "zone accuracy", "perfect", "paper: mean ± sd"), rows)


def _shares(results: Results) -> Table:
    layout = results.layout
    rows = []
    for share in plan.SHARES:
        network, knn = (
            [keypad_scores(results.full[name(share, seed)].judged, layout)["accuracy"] for seed in plan.KEYPAD_SEEDS]
            for name in (plan.keypad_name, plan.lookup_name)
        )
        reported = paper.KEYPAD_LEARNING.get(share)
        rows.append([
            f"{share:.0%}", _mean(network), _mean(knn),
            f"{reported[0]:.0%}" if reported else "-", f"{reported[1]:.0%}" if reported else "-",
            f"{results.took_us['network']:.0f}", f"{results.took_us[f'kNN {share:g}']:.0f}",
        ])  # fmt: skip
    return Table(("share", "network", "kNN", "paper: network", "paper: kNN", "network, us", "kNN, us"), rows)


def _mean(values: list[float]) -> str:
    return f"{np.mean(values):.1%} ± {np.std(values):.1%}"


def _dictionaries(results: Results) -> Table:
    rows = []
    for method in ("kNN", "GCC"):
        for residual in (False, True):
            trial = results.full[plan.dictionary_name(method, residual)]
            scores = position_scores(trial.judged.error_mm)
            keypad = keypad_scores(trial.judged, results.layout)
            rows.append([
                plan.dictionary_name(method, residual), *(f"{scores[key]:.2f}" for key in STATISTICS),
                f"{keypad['accuracy']:.1%}", f"{trial.size_bytes / 1e6:.1f}",
                f"{results.took_us[f'{method} 1']:.0f}",
            ])  # fmt: skip
    return Table(("estimator", *HEADINGS, "keypad", "dictionary, MB", "one touch, us"), rows)


def _circle(results: Results) -> Table:
    rows = []
    for name in (*CIRCLE_HEADS, "touchd"):
        scores = position_scores(results.circle[name].error_mm)
        said = "over 10, sd 5.4" if name == "C-5" else _reported(paper.CIRCLE.get(name))
        rows.append([name, *(f"{scores[key]:.1f}" for key in STATISTICS), said])
    return Table(("model", *HEADINGS, "paper: mean ± sd"), rows)


def _beaten(results: Results) -> Table:
    held = results.held_out
    mean = {key: judged.distance_mm.mean() for key, judged in held.items()}
    keypad = keypad_scores(held["keypad", "silicone"], results.layout)
    fifth = keypad_scores(held[plan.BETTER_KEYPAD, "silicone"], results.layout)
    rows = [
        ["mean error", "4.4 mm", f"{mean['regression', 'silicone']:.2f} mm"],
        ["human finger, trained on silicone only", "4.7 mm", f"{mean['regression', 'human']:.2f} mm"],
        ["keypad: accuracy, key-to-key errors", "97 %, 0",
         f"{keypad['accuracy']:.2%}, {keypad['key_to_key_errors']:.0f}"],
        ["keypad from 20 % of the data", "89 %", f"{fifth['accuracy']:.2%}"],
        ["noise 20 dB worse", "-", f"{mean['regression', 'noise']:.2f} mm"],
        ["baseline stale by 1 K", "-", f"{mean['regression', 'stale']:.2f} mm"],
        [f"a plate never seen, from {results.scale.other_touches} touches", "-",
         f"{mean[plan.OTHER_PLATE, 'other']:.2f} mm"],
    ]  # fmt: skip
    return Table(("mean error or accuracy", "paper on its rig", "touchd"), rows)


def _details(results: Results) -> Table:
    details = []
    for (name, kind), judged in results.held_out.items():
        scores = position_scores(judged.error_mm)
        # A grid has zones instead of keys, and the layout does not fit the other plate.
        keyed = kind != "other" and not name.startswith("grid")
        keys = keypad_scores(judged, results.layout)["accuracy"] if keyed else None
        details.append([
            name, kind, *(f"{scores[key]:.2f}" for key in STATISTICS), f"{(judged.distance_mm > 5).mean():.2%}",
            "-" if keys is None else f"{keys:.2%}",
        ])  # fmt: skip
    return Table(("model", "touches", *HEADINGS, "over 5 mm", "keys"), details)
