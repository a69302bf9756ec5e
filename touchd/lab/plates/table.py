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
from numpy.typing import NDArray

from touchd.calibration.calibrate import Fitted, fit_recording, make_model
from touchd.errors import TouchdError
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.lab.plates.cases import CASES, Made, make
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


def errors_mm(made: Made, fitted: Fitted, finger: str, touches: int, seed: int) -> tuple[NDArray[np.float64], float]:
    """Place single touches all over the plate with the daemon's localizer.

    Return the errors, inf where none is found, shape (n,), and the share of frames in which one finger was found.
    """
    recording = simulate_touches(
        touches, seed=seed + 1, instrument=made.instrument, electronics=made.electronics, finger=finger
    )
    with tempfile.TemporaryDirectory() as folder:
        model = make_model(fitted, Path(folder) / "plate.onnx").model
        frames = touched_frames(recording)
        seen = see(find_with(model, model.atlas, frames), frames)
    error_mm = np.array([
        min((np.hypot(t.x_mm - x, t.y_mm - y) for t in each.found), default=np.inf)
        for each in seen for x, y in each.true_mm
    ])  # fmt: skip
    return error_mm, float(np.mean([len(each.found) == 1 for each in seen]))


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
    for finger in fingers if touches else ():
        error_mm, count_right = errors_mm(made, fitted, finger, touches, seed)
        result[finger] = {
            "median": float(np.median(error_mm)), "p95": float(np.quantile(error_mm, 0.95, method="higher")),
            "within_1": float(np.mean(error_mm < 1)), "count_right": count_right,
        }  # fmt: skip
    return result


def main() -> None:
    """Print a row for each plate named, by default for all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plates", nargs="*", default=list(CASES), help=", ".join(CASES))
    parser.add_argument("--touches", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fingers", nargs="+", default=FINGERS)
    asked = parser.parse_args()
    for name in asked.plates:
        sys.stdout.write(json.dumps(row(name, asked.touches, asked.seed, asked.fingers)) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
