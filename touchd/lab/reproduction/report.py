"""The report as Markdown: the paper's figure beside each of ours."""

from __future__ import annotations

import numpy as np

from touchd import __version__
from touchd.lab.reproduction import paper, plan
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

STATISTICS = ("rmse_mm", "mean_mm", "sd_mm", "median_mm", "p95_mm", "max_mm")
HEADINGS = ("RMSE", "mean", "sd", "median", "p95", "max")


def report(results: Results, folder: str, command: str) -> str:
    """Return the page, with the pictures in `folder` beside it."""
    parts = [_head(results, command), _heads(results, folder), _keypad(results, folder), _dictionaries(results)]
    if not results.given:
        parts += [_circle(results, folder), _beaten(results, folder)]
    parts.append(_inconsistencies())
    return "\n\n".join(parts) + "\n"


def table(headings: tuple[str, ...], rows: list[list[str]]) -> str:
    """Return a Markdown table, the first column to the left and all others to the right."""
    lines = ["| " + " | ".join(headings) + " |", "|---" + "|---:" * (len(headings) - 1) + "|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _head(results: Results, command: str) -> str:
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
    return (
        "# The paper, reproduced and beaten\n\n"
        f"<!-- Written by touchd reproduce, version {__version__}: do not edit. -->\n\n"
        f"Made by `{command}`. The source is Bahrami, Moriot, Masson and Grondin, *Machine Learning for Touch "
        "Localization on Ultrasonic Wave Touchscreen*, Sensors 22:3183, 2022 (arXiv 2202.08947); its figures come from "
        f"a rig of its own, ours from {what}. Touches are split into 70 % for training, 20 % for validation and 10 % "
        "for the test; unless it says otherwise, a figure is of the test touches. RMSE is sqrt(mean of the squared "
        "distance); mean, sd, median, p95 and max are statistics of the distance. All errors are in mm."
    )


def _reported(value: Reported | None) -> str:
    if value is None:
        return "-"
    return f"{value.mean_mm:.1f} ± {value.sd_mm:.1f}"


def _heads(results: Results, folder: str) -> str:
    plate = results.recording.meta.plate
    lines = [
        "## Regression and grids",
        "",
        "The paper's networks, trained by its recipe: spectra or samples as they are, batch normalisation, dropout of "
        "0.3, Adam, until 120 epochs are over or the validation no longer gets better. `perfect` is the mean error of "
        "a classifier that never errs, for touches uniform over the area. The paper does not say where its touches "
        "lay: see [what does not add up](#what-does-not-add-up-in-the-paper).",
    ]
    areas = (
        ("the full plate", results.full, (plate.width_mm, plate.height_mm)),
        ("the central 11 x 11 cm", results.central, (paper.CENTRAL_MM, paper.CENTRAL_MM)),
    )
    for name, found, size_mm in areas:
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
        lines += [
            "", f"### On {name}", "",
            table(("head, domain", *HEADINGS, "zone accuracy", "perfect", "paper: mean ± sd"), rows),
        ]  # fmt: skip
    lines += [
        "",
        f"Of C-10 the paper reports a zone accuracy of {paper.C10_ACCURACY:.0%}. It gives C-3 to C-9 as a curve only.",
        "",
        f"![Mean error by the number of zones]({folder}/heads.png)",
    ]
    return "\n".join(lines)


def _keypad(results: Results, folder: str) -> str:
    layout = results.layout
    matrix_data = results.full[plan.keypad_name(1.0, plan.KEYPAD_SEEDS[0])]
    scores = keypad_scores(matrix_data, layout)
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
            f"{results.took_us['network']:.0f}", f"{results.took_us[f'kNN {share:g}']:.0f}",
        ])  # fmt: skip
    took = results.took_us
    return "\n".join([
        "## The keypad",
        "",
        f"{len(layout.key)} keys and L, the zone around them (`touchd/keypads/phone.toml`, or what --layout named), by "
        f"the paper's network of 100 and 50 units on the full plate: accuracy {scores['accuracy']:.1%}, "
        f"{scores['key_to_key_errors']:.0f} touches of a key taken for another key. The paper: "
        f"{paper.KEYPAD_ACCURACY:.0%} in the text, {paper.KEYPAD_MATRIX_ACCURACY:.1%} by its matrix, no key-to-key "
        "error.",
        "",
        f"![Confusion matrix of the keypad]({folder}/keypad.png)",
        "",
        f"### Network against kNN (k = 1), by the share of the training touches; means over {len(plan.KEYPAD_SEEDS)} "
        "seeds",
        "",
        table(("share", "network", "kNN", "paper: network", "paper: kNN", "network, us", "kNN, us"), rows),
        "",
        f"kNN takes {took['kNN 1'] / took['network']:.0f} times as long as the network for one touch (the paper: "
        f"{paper.KNN_SLOWER}); with 20 % of the touches it saves {(took['kNN 1'] - took['kNN 0.2']) / 1e3:.2f} ms (the "
        "paper: 2.58 ms). The times are of one process, one after the other, on one thread; the paper's keypad took "
        f"{paper.KEYPAD_MS} ms.",
        "",
        f"![Accuracy of the keypad by the share of the training touches]({folder}/learning.png)",
    ])  # fmt: skip


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
    return "\n".join([
        "## The estimators that the paper argues against",
        "",
        "kNN (k = 1) and generalised cross-correlation (GCC, phase transform, delays up to 8 us) look a touch up among "
        "all recorded ones. They need no training, but all of that memory is read for each touch. On spectra as the "
        "paper takes them, and on residuals against the untouched plate:",
        "",
        table(("estimator", *HEADINGS, "keypad", "dictionary, MB", "one touch, us"), rows),
    ])  # fmt: skip


def _circle(results: Results, folder: str) -> str:
    rows = []
    for name in (*CIRCLE_HEADS, "touchd"):
        scores = error_scores(results.circle[name])
        reported = paper.CIRCLE.get(name)
        said = "-" if reported is None else _reported(reported)
        said = "over 10, sd 5.4" if name == "C-5" else said
        rows.append([name, *(f"{scores[key]:.1f}" for key in STATISTICS), said])
    return "\n".join([
        "## A human finger draws a circle",
        "",
        f"On models that were trained with the silicone finger alone (seed {CIRCLE_SEED}; each frame by itself, "
        "without tracker). `touchd` is the network that ships.",
        "",
        table(("model", *HEADINGS, "paper: mean ± sd"), rows),
        "",
        f"![The circle as each model sees it]({folder}/circle.png)",
    ])  # fmt: skip


def _beaten(results: Results, folder: str) -> str:
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
    seeds = ", ".join(f"{kind} {seed}" for kind, seed in HELD_OUT.items())
    return "\n".join([
        "## Beaten: the networks that ship",
        "",
        f"On {results.scale.held_out} touches of each kind, simulated with seeds that no training saw ({seeds}, the "
        f"other plate {OTHER_HELD_OUT_SEED}). The network has no more multiply-adds than the paper's regression "
        "network. `noise` is 40 dB below the signal instead of 60; in `stale` the plate is 1 K warmer than its "
        "baseline; the other plate is of glass, 170 x 240 x 4 mm, with its transducers elsewhere (trained with seed "
        f"{OTHER_SEED}).",
        "",
        table(("mean error or accuracy", "paper on its rig", "asked for", "touchd"), rows),
        "",
        f"![Share of touches by error]({folder}/errors.png)",
        "",
        "### Each model on each kind of touches",
        "",
        "A grid answers with the middle of a zone, and a keypad with that of a key, so their distances say little; the "
        "last column is the share of touches whose key is the right one.",
        "",
        table(("model", "touches", *HEADINGS, "over 5 mm", "keys"), details),
        "",
        f"What each costs is in `models/README.md`: {', '.join(SHIPPED)}.",
    ])  # fmt: skip


def _inconsistencies() -> str:
    return "\n".join(["## What does not add up in the paper", "", *(f"- {text}" for text in paper.INCONSISTENCIES)])
