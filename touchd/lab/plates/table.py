"""Calibrate plates without a touch, and score simulated touches on them: `python -m touchd.lab.plates.table`."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchd.calibration.calibrate import Fitted, fit_recording, make_model
from touchd.calibration.physical_atlas import make_physical_atlas
from touchd.calibration.place_correction import widths_of
from touchd.calibration.soft_face import for_fingers
from touchd.calibration.taps import Taps, refine, taps_of
from touchd.errors import TouchdError
from touchd.evaluation.matching import match_frames
from touchd.evaluation.single_frames import TouchedFrames, find_with, see, touched_frames
from touchd.lab.arguments import within
from touchd.lab.plates.cases import CASES, Made, make
from touchd.localization.atlas import Atlas
from touchd.localization.model import Model
from touchd.twin.simulate import simulate_scene, simulate_touches

FRAMES = 1250
"""Ten seconds."""
TAPS = (20, 50, 200)
FINGERS = ("silicone", "robot")
"""A rigid silicone tip and a compliant one."""


def calibrate(made: Made, seed: int = 0) -> Fitted:
    """Fit a case to its untouched recording."""
    recording = simulate_scene(
        "idle", frames=FRAMES, instrument=made.instrument, seed=seed, electronics=made.electronics
    )
    return fit_recording(recording, made.said)


def scores(model: Model, atlas: Atlas | None, frames: TouchedFrames) -> dict[str, float]:
    """Place touches with the daemon's localizer.

    `less_scale` are the errors without the factor that all places share: the ruler's, which no untouched plate tells.
    `within_sigma` and `within_2_sigma` are the shares of those, per axis, that the standard errors claim.
    """
    matches = match_frames(see(find_with(model, atlas, frames), frames), reach_mm=np.inf)
    true, placed = frames.true_mm[:, 0].astype(float), matches.matched > 0
    found = np.full(true.shape, np.inf)
    found[placed] = matches.judged.position_mm
    error_mm = np.hypot(*(found - true).T)
    near_by = error_mm < 1
    scale = float((found[near_by] * true[near_by]).sum() / (true[near_by] ** 2).sum())
    less_mm = np.hypot(*(found / scale - true).T)
    sigmas = np.abs(found[placed] / scale - true[placed]) / matches.judged.sigma_mm[:, None]
    return {
        "median": float(np.median(error_mm)), "p95": float(np.quantile(error_mm, 0.95, method="higher")),
        "within_1": float(np.mean(near_by)), "count_right": float(np.mean(matches.contacts == 1)),
        "less_scale": float(np.median(less_mm)),
        "less_scale_p95": float(np.quantile(less_mm, 0.95, method="higher")),
        "within_sigma": float(np.mean(sigmas < 1)), "within_2_sigma": float(np.mean(sigmas < 2)),
    }  # fmt: skip


def tapped(
    made: Made, fitted: Fitted, model: Model, frames: dict[str, TouchedFrames], labels_mm: Sequence[float], seed: int,
    sets: int,
) -> list[dict[str, Any]]:  # fmt: skip
    """Score the same touches after 20, 50 and 200 taps, whose labels err by `labels_mm` per axis: means over sets."""
    assert model.atlas is not None
    found: list[dict[str, Any]] = []
    fit, plain = fitted.fit, make_physical_atlas(fitted.fit, fitted.noise_counts)
    for label_mm in labels_mm:
        drawn = [
            taps_of(simulate_touches(
                max(TAPS), seed=seed + 1000 + k, instrument=made.instrument, electronics=made.electronics,
                finger="fingertip", label_noise_mm=label_mm,
            ), model.atlas)
            for k in range(sets)
        ]  # fmt: skip
        for count in TAPS:
            each = []
            for taps in drawn:
                some = Taps(taps.label_mm[:count], taps.values[:count])
                atlas = for_fingers(refine(plain, some, 0, widths_of(fit)).atlas, fit)
                each.append({finger: scores(model, atlas, touches) for finger, touches in frames.items()})
            means = {
                finger: {score: float(np.mean([one[finger][score] for one in each])) for score in each[0][finger]}
                for finger in frames
            }
            found.append({"taps": count, "label_mm": label_mm, "sets": sets} | means)
    return found


def row(
    name: str, touches: int, seed: int = 0, fingers: Sequence[str] = FINGERS, labels_mm: Sequence[float] = (),
    sets: int = 1, solids: Path = Path(),
) -> dict[str, Any]:  # fmt: skip
    """Return one plate's row of the table; without touches only the fit."""
    made = make(name, seed, solids)
    started_s = time.process_time()
    try:
        fitted = calibrate(made, seed)
    except TouchdError as error:
        return {"plate": name, "verdict": type(error).__name__, "reasons": [str(error)]}
    fit = fitted.fit
    true, found = made.instrument.layout.centres_mm, fit.layout.centres_mm
    scale = float((found * true).sum() / (true**2).sum())
    result: dict[str, Any] = {
        "plate": name, "verdict": fit.verdict, "expected_mm": fit.expected_mm, "unexplained": fit.unexplained,
        "discs_mm": float(np.sqrt(np.mean((found / scale - true) ** 2))), "scale": scale - 1,
        "fit_s": time.process_time() - started_s, "reasons": fit.reasons,
    }  # fmt: skip
    if touches and fit.verdict != "poor":
        started_s = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            model = make_model(fitted, Path(folder) / "plate.onnx").model
        result["model_s"] = time.process_time() - started_s
        frames = {
            finger: touched_frames(simulate_touches(
                touches, seed=seed + 1, instrument=made.instrument, electronics=made.electronics, finger=finger
            ))
            for finger in fingers
        }  # fmt: skip
        result |= {finger: scores(model, model.atlas, each) for finger, each in frames.items()}
        if labels_mm:
            result["after_taps"] = tapped(made, fitted, model, frames, labels_mm, seed, sets)
    return result


def main() -> None:
    """Print a row for each plate named, by default for all but solid ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    every = [name for name, case in CASES.items() if not case.solid]
    parser.add_argument("plates", nargs="*", default=every, help=", ".join(CASES))
    parser.add_argument("--touches", type=within(int, 1), default=300)
    parser.add_argument(
        "--seed", type=within(int, 0), nargs="+", default=[0], help="what the ruler errs by, and the touches"
    )
    parser.add_argument("--fingers", nargs="+", default=FINGERS, choices=FINGERS)
    parser.add_argument(
        "--labels-mm", type=within(float, 0, 1000), nargs="+", default=[], help="also after taps with these errors"
    )
    parser.add_argument("--tap-sets", type=within(int, 1), default=1, help="sets of taps of each error")
    parser.add_argument("--solids", type=Path, default=Path(), help="folder of solid plates")
    asked = parser.parse_args()
    if unknown := set(asked.plates) - set(CASES):
        parser.error(f"there is no plate {unknown.pop()!r}; choose from {', '.join(CASES)}")
    for name in asked.plates:
        for seed in asked.seed:
            found = row(name, asked.touches, seed, asked.fingers, asked.labels_mm, asked.tap_sets, asked.solids)
            sys.stdout.write(json.dumps({"seed": seed} | found) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
