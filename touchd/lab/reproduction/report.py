"""The report of a reproduction: the template `report.md`, with the paper's figure beside each of ours."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from touchd import __version__
from touchd.lab import template
from touchd.lab.reproduction import paper, plan
from touchd.lab.reproduction.experiments import Data
from touchd.lab.reproduction.paper import Reported
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
from touchd.lab.reproduction.scores import distance_mm, error_scores, keypad_scores, zone_accuracy

TEMPLATE = Path(__file__).with_name("report.md")
STATISTICS = ("rmse_mm", "mean_mm", "sd_mm", "median_mm", "p95_mm", "max_mm")
HEADINGS = ("RMSE", "mean", "sd", "median", "p95", "max")
TWIN_ONLY = ("circle_seed", "circle", "circle_folder", "held_out", "held_out_seeds", "other_held_out_seed",
             "other_seed", "beaten", "beaten_folder", "shipped", "models")  # fmt: skip
"""Fields of what is measured on the twin alone."""


def report(results: Results, folder: str, command: str) -> str:
    """Return the page, with the pictures in `folder` beside it."""
    fields = _head(results, command) | {"folder": folder} | _heads(results) | _keypad(results)
    fields |= {
        "dictionaries": _dictionaries(results),
        "inconsistencies": "\n".join(f"- {text}" for text in paper.INCONSISTENCIES),
    }
    twin = dict.fromkeys(TWIN_ONLY) if results.given else _circle(results, folder) | _beaten(results, folder)
    return template.filled(TEMPLATE, fields | twin)


def _head(results: Results, command: str) -> dict[str, object]:
    plate = results.recording.meta.plate
    size = f"{plate.width_mm:g} x {plate.height_mm:g} x {plate.thickness_mm:g} mm"
    if results.given:
        what = f"a given recording of a {plate.material} plate, {size}"
    else:
        what = (
            f"the digital twin's reference plate ({plate.material}, {size}): {results.scale.touches} touches of a "
            f"silicone finger on the full plate (seed {TRAINING_SEED}) and as many on its central 11 x 11 cm (seed "
            f"{CENTRAL_SEED})"
        )
    return {"version": __version__, "command": command, "what": what}


def _reported(value: Reported | None) -> str:
    if value is None:
        return "-"
    return f"{value.mean_mm:.1f} ± {value.sd_mm:.1f}"


def _heads(results: Results) -> dict[str, object]:
    plate = results.recording.meta.plate
    return {
        "full": _heads_table(results.full, (plate.width_mm, plate.height_mm)),
        "central": _heads_table(results.central, (paper.CENTRAL_MM, paper.CENTRAL_MM)),
        "c10_accuracy": f"{paper.C10_ACCURACY:.0%}",
    }


def _heads_table(found: Mapping[str, Data], size_mm: tuple[float, float]) -> str:
    rows = []
    for domain in plan.DOMAINS:
        for head in plan.HEADS:
            data = found[plan.head_name(head, domain)]
            grid = int(head[2:]) if head != "R" else 0
            scores = error_scores(data)
            accuracy = f"{zone_accuracy(data, grid, size_mm):.1%}" if grid else "-"
            perfect = f"{paper.perfect_mean_mm(size_mm[0], grid):.1f}" if grid and size_mm[0] == size_mm[1] else "-"
            rows.append(
                [f"{head}, {domain}", *(f"{scores[key]:.1f}" for key in STATISTICS), accuracy, perfect,
                 _reported(paper.HEADS.get((head, domain)))]
            )  # fmt: skip
    return template.table(("head, domain", *HEADINGS, "zone accuracy", "perfect", "paper: mean ± sd"), rows)


def _keypad(results: Results) -> dict[str, object]:
    layout, took = results.layout, results.took_us
    scores = keypad_scores(results.full[plan.keypad_name(1.0, plan.KEYPAD_SEEDS[0])], layout)
    rows = []
    for share in plan.SHARES:
        network, knn = (
            [keypad_scores(results.full[name(share, seed)], layout)["accuracy"] for seed in plan.KEYPAD_SEEDS]
            for name in (plan.keypad_name, lambda share, seed: plan.lookup_name("kNN", share, seed))
        )
        reported = paper.KEYPAD_LEARNING.get(share)
        rows.append([
            f"{share:.0%}", _mean(network), _mean(knn),
            f"{reported[0]:.0%}" if reported else "-", f"{reported[1]:.0%}" if reported else "-",
            f"{took['network']:.0f}", f"{took[f'kNN {share:g}']:.0f}",
        ])  # fmt: skip
    headings = ("share", "network", "kNN", "paper: network", "paper: kNN", "network, us", "kNN, us")
    return {
        "keys": len(layout.key),
        "keypad_accuracy": f"{scores['accuracy']:.1%}",
        "key_to_key": f"{scores['key_to_key_errors']:.0f}",
        "paper_keypad": f"{paper.KEYPAD_ACCURACY:.0%}",
        "paper_matrix": f"{paper.KEYPAD_MATRIX_ACCURACY:.1%}",
        "seeds": len(plan.KEYPAD_SEEDS),
        "shares": template.table(headings, rows),
        "knn_slower": f"{took['kNN 1'] / took['network']:.0f}",
        "paper_knn_slower": paper.KNN_SLOWER,
        "knn_saved": f"{(took['kNN 1'] - took['kNN 0.2']) / 1e3:.2f}",
        "paper_keypad_ms": paper.KEYPAD_MS,
    }


def _mean(values: list[float]) -> str:
    return f"{np.mean(values):.1%} ± {np.std(values):.1%}"


def _dictionaries(results: Results) -> str:
    rows = []
    for method in ("kNN", "GCC"):
        for residual in (False, True):
            data = results.full[plan.dictionary_name(method, residual)]
            scores = error_scores(data)
            keypad = keypad_scores(data, results.layout)
            rows.append([
                plan.dictionary_name(method, residual), *(f"{scores[key]:.2f}" for key in STATISTICS),
                f"{keypad['accuracy']:.1%}", f"{data['bytes'] / 1e6:.1f}",
                f"{results.took_us[f'{method} 1']:.0f}",
            ])  # fmt: skip
    return template.table(("estimator", *HEADINGS, "keypad", "dictionary, MB", "one touch, us"), rows)


def _circle(results: Results, folder: str) -> dict[str, object]:
    rows = []
    for name in (*CIRCLE_HEADS, "touchd"):
        scores = error_scores(results.circle[name])
        said = "over 10, sd 5.4" if name == "C-5" else _reported(paper.CIRCLE.get(name))
        rows.append([name, *(f"{scores[key]:.1f}" for key in STATISTICS), said])
    return {
        "circle_seed": CIRCLE_SEED,
        "circle": template.table(("model", *HEADINGS, "paper: mean ± sd"), rows),
        "circle_folder": folder,
    }


def _beaten(results: Results, folder: str) -> dict[str, object]:
    held = results.held_out
    mean = {key: error_scores(data)["mean_mm"] for key, data in held.items()}
    keypad = keypad_scores(held["keypad", "silicone"], results.layout)
    fifth = keypad_scores(held[plan.BETTER_KEYPAD, "silicone"], results.layout)
    rows = [
        ["mean error", "4.4 mm", "0.7 mm", f"{mean['regression', 'silicone']:.2f} mm"],
        ["human finger, trained on silicone only", "4.7 mm", "1.1 mm", f"{mean['regression', 'human']:.2f} mm"],
        ["keypad: accuracy, key-to-key errors", "97 %, 0", "99.5 %, 0",
         f"{keypad['accuracy']:.2%}, {keypad['key_to_key_errors']:.0f}"],
        ["keypad from 20 % of the data", "89 %", "97 %", f"{fifth['accuracy']:.2%}"],
        ["noise 20 dB worse", "-", "4 mm", f"{mean['regression', 'noise']:.2f} mm"],
        ["baseline stale by 1 K", "-", "1.5 mm", f"{mean['regression', 'stale']:.2f} mm"],
        [f"a plate never seen, from {results.scale.other_touches} touches", "-", "1 mm",
         f"{mean[plan.OTHER_PLATE, 'other']:.2f} mm"],
    ]  # fmt: skip
    details = []
    for (name, kind), data in held.items():
        scores = error_scores(data)
        # A zone of a grid is no key, and the layout is not laid over the other plate.
        keyed = kind != "other" and not name.startswith("grid")
        keys = keypad_scores(data, results.layout)["accuracy"] if keyed else None
        details.append([
            name, kind, *(f"{scores[key]:.2f}" for key in STATISTICS), f"{(distance_mm(data) > 5).mean():.2%}",
            "-" if keys is None else f"{keys:.2%}",
        ])  # fmt: skip
    return {
        "held_out": results.scale.held_out,
        "held_out_seeds": ", ".join(f"{kind} {seed}" for kind, seed in HELD_OUT.items()),
        "other_held_out_seed": OTHER_HELD_OUT_SEED,
        "other_seed": OTHER_SEED,
        "beaten": template.table(("mean error or accuracy", "paper on its rig", "asked for", "touchd"), rows),
        "beaten_folder": folder,
        "shipped": ", ".join(SHIPPED),
        "models": template.table(("model", "touches", *HEADINGS, "over 5 mm", "keys"), details),
    }
