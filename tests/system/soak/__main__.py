"""`python -m tests.system.soak`: a million frames at full speed, and ten minutes at 1000 a second, with figures."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ[_name] = "1"

import numpy as np  # noqa: E402 - after its threads are limited

from tests.system.soak.rig import Result, complaints, run  # noqa: E402 - as above
from touchd.config.schema import LogSettings  # noqa: E402 - as above
from touchd.lab.arguments import within  # noqa: E402 - as above
from touchd.localization.model import Model, default_model_path  # noqa: E402 - as above
from touchd.service.log import configure  # noqa: E402 - as above


def report(what: str, result: Result) -> list[str]:
    """Print a run's figures, and return what is wrong with it."""
    sent, found, tally = result.sent, result.found, result.source.tally
    p50, p99, p999 = np.percentile(found.latency_us, (50, 99, 99.9))
    lines = {
        "frames": f"{found.frames} in {result.seconds:.0f} s, {found.frames / result.seconds:.0f}/s; "
        f"{result.events} messages",
        "processed twice": f"{found.twice}",
        "corrupt": f"{tally.corrupt} of {sent.corrupt} sent",
        "lost": f"{tally.lost} of {sent.skipped} left out",
        "test patterns": f"{sum(tally.withheld.values())} of {sent.tests} sent",
        "behind": f"{tally.behind} dropped, {tally.late} late",
        "unplugged": f"{sent.unplugged} times",
        "memory": f"{found.rss_kb[len(found.rss_kb) // 5]} kB after a fifth, at most {max(found.rss_kb)} kB later",
        "latency": f"p50 {p50:.0f} us, p99 {p99:.0f} us, p99.9 {p999:.0f} us, max {max(found.latency_us):.0f} us",
    }
    print(what)
    for name, text in lines.items():
        print(f"  {name:16} {text}")
    wrong = complaints(result)
    for line in wrong:
        print(f"  WRONG: {line}")
    return wrong


def main() -> int:
    """Run both, and return 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=within(int, 0), default=1_000_000, help="at full speed")
    parser.add_argument("--seconds", type=within(int, 0, 1_000_000), default=600, help="at 1000 frames a second")
    arguments = parser.parse_args()
    configure(LogSettings(level="error"))  # each fault is logged; the figures are what is wanted
    model = Model(default_model_path())
    wrong = []
    with tempfile.TemporaryDirectory() as folder:
        if arguments.frames:
            wrong += report("full speed", run(arguments.frames, float("inf"), Path(folder), model))
        if arguments.seconds:
            wrong += report("1000 frames/s", run(1000 * arguments.seconds, 1000.0, Path(folder), model))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
