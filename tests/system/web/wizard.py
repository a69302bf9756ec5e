"""A wizard that does nothing and says what it is told: a page's steps without daemon, frames and fit."""

from __future__ import annotations

import base64
import io
import json
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from touchd.calibration.calibrate import draw_expected, draw_residual, draw_response
from touchd.calibration.walk import target_mm
from touchd.calibration.wizard.state import NOTHING
from touchd.frame import Plate

PLATE = {
    "plate": {"width_mm": 200.4, "height_mm": 149.8, "thickness_mm": 5.01, "material": "glass", "edge": "free"},
    "discs": {
        "diameter_mm": 6.0, "emitter_mm": [100.2, 38.0],
        "receivers_mm": [[20.3, 19.6], [181.0, 24.2], [176.5, 131.4], [22.1, 126.0]],
    },
}  # fmt: skip
MIRRORED = (
    "whether the drawing is mirrored or turned by 180 degrees: tap the top left corner, and then the top right one"
)
GOOD = {
    "verdict": "good", "expected_mm": 0.139, "reasons": [], "undecided": [MIRRORED], "model": "plate.onnx",
    "report": "plate.report",
}  # fmt: skip
POOR: dict[str, Any] = {
    "verdict": "poor", "expected_mm": 2.1, "undecided": [], "model": None, "report": "plate.poor.report",
    "reasons": ["the fit leaves 12.0 % of the untouched response's energy",
                "channel 3 is dead: check its disc and cable",
                "receiver 2 may be 8.3 mm from where the drawing has it: measure it again"],
}  # fmt: skip
MAPPING = {"screen_mm": [20.4, 30.2, 160.1, 90.3], "rotate": 0, "residual_mm": 0.84}
_TAPS = [
    {"target_mm": (p := target_mm(n, 200.4, 149.8)), "found_mm": [p[0] + 0.4, p[1] - 0.3]} for n in range(13)
]  # fmt: skip
_TARGET = target_mm(13, 200.4, 149.8)
_FITTED = NOTHING | {"plate": PLATE, "untouched": True, "result": GOOD, "runs": "before"}
_X, _Y = np.meshgrid(np.linspace(-1, 1, 20), np.linspace(-1, 1, 20))
_EXPECTED = {
    "mm": (0.1 + 0.3 * (_X**4 + _Y**4)).round(3).tolist(),
    "median_mm": 0.139,
    "fitted_mm": 0.31,
    "top_mm": 0.62,
}
_TAPPING = _FITTED | {
    "running": "taps",
    "taps": _TAPS,
    "target_mm": _TARGET,
    "runs": "fitted",
    "before": "",
    "expected": _EXPECTED,
}
_WISH = {"recording": "/var/lib/touchd/wizard/touches.npz", "recipe": "atlas"}
_COMPARED = {
    "new": {"used": 13, "taps": 13, "scatter_mm": 0.61, "unexplained": 0.0034},
    "tried": {"used": 12, "taps": 13, "scatter_mm": 0.83, "unexplained": 0.0067},
    "old": {"used": 9, "taps": 13, "scatter_mm": 1.87, "unexplained": 0.0212},
}
STATES: dict[str, dict[str, Any]] = {
    "measures": NOTHING,
    "untouched": NOTHING | {"plate": PLATE, "running": "untouched", "share": 0.42},
    "finger": NOTHING | {"plate": PLATE, "running": "untouched", "note": "finger"},
    "fit": NOTHING | {"plate": PLATE, "untouched": True, "running": "fit", "share": 0.63, "note": "candidates"},
    "verdict": _FITTED,
    "poor": _FITTED | {"result": POOR},
    "screen": _FITTED | {"runs": "fitted"},
    "mapped": _FITTED | {"runs": "fitted", "mapping": MAPPING},
    "crosses": _FITTED | {"runs": "fitted", "running": "crosses", "cross": {"number": 2, "of": 4, "at": (0.9, 0.1)}},
    "cross-shown": _FITTED | {
        "runs": "fitted", "running": "crosses", "cross": {"number": 3, "of": 4, "at": (0.9, 0.9)},
    },
    "first-tap": _TAPPING | {"taps": [], "target_mm": target_mm(0, 200.4, 149.8)},
    "taps": _TAPPING | {"last": {"ok": True, "reason": "", "target_mm": _TAPS[-1]["target_mm"]},
                        "told": {"scatter_mm": 0.61, "repeats": 2, "off_mm": 0.7, "orientation": ""}},
    "ring-shown": _TAPPING | {
        "mapping": MAPPING, "target_mm": (60.0, 50.0),
        "last": {"ok": False, "reason": "unsteady", "target_mm": _TAPS[-1]["target_mm"]},
    },
    "missed": _TAPPING | {
        "last": {"ok": False, "reason": "light", "target_mm": [60.0, 60.0]}, "expected": None,
        "told": {"scatter_mm": None, "repeats": 0, "off_mm": 0.7, "orientation": "mirrored left to right"},
    },
    "train": NOTHING | {
        "running": "train", "share": 0.4, "note": "network", "training": _WISH,
        "log": ["warning: 250 touches are few: a finger is placed to 2 mm",
                *(f"network {n / 800:.0%} validation {2 - n / 300:.2f} mm" for n in range(290, 321))],
    },
    "trained": _FITTED | {"training": _WISH, "trained": {"scores": {"n": 450.0, "median_mm": 0.041}}},
    "untrainable": NOTHING | {
        "untrainable": "this needs torch, of the extra train -> in a clone of touchd: pip install '.[train]'",
    },
    "compared": _TAPPING | {"running": None, "runs": "earlier", "before": "b5", "compared": _COMPARED, "last": None},
    "fault": NOTHING | {"plate": PLATE, "untouched": True, "problem": "untouched.npz: the plate was touched",
                        "fix": "take everything off the plate, and listen again"},
}  # fmt: skip
"""By step what the wizard says at it."""


class Wizard:
    """Says a state until another is shown."""

    def __init__(self) -> None:
        self.state = NOTHING
        self.asked: list[str] = []
        """Commands of the page."""
        self.saved: list[Any] = []
        """Measures that it sent."""
        self.refusal = ""
        """Why each command is refused; empty if none is."""
        self.ended = threading.Event()
        self.changed = threading.Condition()

    def forget(self) -> None:
        """Know nothing, as at the start."""
        with self.changed:
            self.state, self.asked, self.saved, self.refusal = dict(NOTHING), [], [], ""
            self.changed.notify_all()

    def show(self, name: str, **changes: Any) -> None:
        """Say the state of a step, with changes to it."""
        with self.changed:
            self.state = STATES[name] | {"step": name} | changes
            self.changed.notify_all()


@contextmanager
def wizard(path: Path) -> Iterator[Wizard]:
    """Listen at a socket until the block ends."""
    served = Wizard()

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            asked = json.loads(self.rfile.readline())
            if asked["do"] == "watch":
                self._watch()
            elif asked["do"] == "picture":
                self._say({"ok": True, "png": base64.b64encode(_picture(asked["name"])).decode()})
            else:
                served.asked.append(asked["do"])
                if asked["do"] == "measures":
                    served.saved.append(asked["plate"])
                self._say({"ok": not served.refusal, "problem": served.refusal})

        def _watch(self) -> None:
            said = None
            with served.changed:
                while not served.ended.is_set():
                    if served.state is not said:
                        said = served.state
                        self._say(said)
                    served.changed.wait()

        def _say(self, answer: dict[str, Any]) -> None:
            with suppress(BrokenPipeError):  # the page's server has ended
                self.wfile.write(json.dumps(answer).encode() + b"\n")

    with socketserver.ThreadingUnixStreamServer(str(path), Handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield served
        finally:
            served.ended.set()
            with served.changed:
                served.changed.notify_all()
            server.shutdown()
            thread.join()


@cache
def _picture(name: str) -> bytes:
    """Draw what a report shows, of numbers that look like it."""
    random = np.random.default_rng(1)
    time_s = np.arange(500) / 5e5
    measured = np.array([np.exp(-1500 * time_s) * np.sin(3e5 * time_s * (1 + 0.1 * n) + n) for n in range(4)])
    hz = np.linspace(0, 1.5e5, 200)
    left = 10 ** (-4 + np.exp(-(((hz - 75e3) / 4e4) ** 2)) + 0.2 * random.standard_normal((4, 200)))
    fit = SimpleNamespace(
        measured=measured, fitted=measured + 0.02 * random.standard_normal(measured.shape), residual=lambda: (hz, left),
        acquisition=SimpleNamespace(sample_rate_hz=5e5, chirp=SimpleNamespace(start_hz=30e3, stop_hz=100e3)),
    )  # fmt: skip
    fitted = cast("Any", SimpleNamespace(fit=fit))
    plate = Plate(width_mm=200.4, height_mm=149.8, thickness_mm=5.01)
    x, y = np.meshgrid(np.linspace(-1, 1, 41), np.linspace(-1, 1, 31))
    discs = np.array([PLATE["discs"]["emitter_mm"], *PLATE["discs"]["receivers_mm"]])  # type: ignore[misc]
    figure = {
        "response.png": lambda: draw_response(fitted), "residual.png": lambda: draw_residual(fitted),
        "expected-error.png": lambda: draw_expected(plate, {"": (0.1 + 0.1 * (x**4 + y**4), discs)}),
    }[name]()  # fmt: skip
    written = io.BytesIO()
    figure.savefig(written, dpi=80)
    return written.getvalue()
