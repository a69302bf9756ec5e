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
from touchd.errors import TouchdError
from touchd.evaluation.matching import Seen
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.lab.plates.cases import CASES, Made, make
from touchd.localization.model import Model
from touchd.twin.simulate import simulate_scene, simulate_touches

FRAMES = 1250
"""Ten seconds."""
FINGERS = ("silicone", "robot")
"""A rigid silicone tip and a compliant one."""


def calibrate(made: Made, seed: int = 0) -> Fitted:
    """Fit a case to its untouched recording."""
    recording = simulate_scene(
        "idle", frames=FRAMES, instrument=made.instrument, seed=seed, electronics=made.electronics
    )
    return fit_recording(recording, made.said)


def scores(made: Made, model: Model, finger: str, touches: int, seed: int) -> dict[str, float]:
    """Place single touches all over the plate with the daemon's localizer.

    `less_scale` are the errors without the factor that all places share: the ruler's, which no untouched plate tells.
    """
    recording = simulate_touches(
        touches, seed=seed + 1, instrument=made.instrument, electronics=made.electronics, finger=finger
    )
    frames = touched_frames(recording)
    seen = see(find_with(model, model.atlas, frames), frames)
    true = np.array([each.true_mm[0] for each in seen])
    found = np.array([_nearest(each) for each in seen])
    error_mm = np.hypot(*(found - true).T)
    near = error_mm < 1
    scale = float((found[near] * true[near]).sum() / (true[near] ** 2).sum())
    less_mm = np.hypot(*(found / scale - true).T)
    return {
        "median": float(np.median(error_mm)), "p95": float(np.quantile(error_mm, 0.95, method="higher")),
        "within_1": float(np.mean(near)), "count_right": float(np.mean([len(each.found) == 1 for each in seen])),
        "less_scale": float(np.median(less_mm)),
        "less_scale_p95": float(np.quantile(less_mm, 0.95, method="higher")),
    }  # fmt: skip


def _nearest(seen: Seen) -> tuple[float, float]:
    """Return the touch found nearest the true one; infinity where none is."""
    x, y = seen.true_mm[0]
    near = min(seen.found, key=lambda t: np.hypot(t.x_mm - x, t.y_mm - y), default=None)
    return (near.x_mm, near.y_mm) if near else (np.inf, np.inf)


def row(name: str, touches: int, seed: int = 0, fingers: Sequence[str] = FINGERS) -> dict[str, Any]:
    """Return one plate's row of the table; without touches only the fit."""
    made = make(name, seed)
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
        result |= {finger: scores(made, model, finger, touches, seed) for finger in fingers}
    return result


def main() -> None:
    """Print a row for each plate named, by default for all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plates", nargs="*", default=list(CASES), help=", ".join(CASES))
    parser.add_argument("--touches", type=int, default=300)
    parser.add_argument("--seed", type=int, nargs="+", default=[0], help="what the ruler errs by, and the touches")
    parser.add_argument("--fingers", nargs="+", default=FINGERS)
    asked = parser.parse_args()
    for name in asked.plates:
        for seed in asked.seed:
            sys.stdout.write(json.dumps({"seed": seed} | row(name, asked.touches, seed, asked.fingers)) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
