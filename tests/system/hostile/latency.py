"""`python -m tests.system.hostile.latency`: how old touches are with and without each attack on the bus, alternated.

For a machine that is otherwise idle. Each attack has a daemon of its own; quiet and attacked spells take turns, and the
attackers end with their spell. It returns 1 if the oldest touch of the attacked spells is more than 50 ms older than
that of the quiet ones.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.system.hostile.bus import Daemon, Honest, attack
from touchd.lab.arguments import within

MOST_LATER_MS = 50.0
ATTACKS = {
    "long-topics": (10_700, 4), "small-topics": (670_000, 1), "tiny-topics": (10_000, 4), "messages": (1_000_000, 1),
    "same-topic": (500_000, 1), "pings": (300_000, 1), "idle": (1100, 1), "silent": (60, 1), "reconnects": (4000, 1),
}  # fmt: skip
"""How much of each, by how many strangers."""


def measure(name: str, spells: int, seconds: float) -> float:
    """Print the ages of touches in both kinds of spell, and return by how much the attacked ones are older, ms."""
    number, strangers = ATTACKS[name]
    ages_s: dict[str, list[float]] = {"quiet": [], "attacked": []}
    with tempfile.TemporaryDirectory() as folder:
        daemon = Daemon(Path(folder), f"ipc://{folder}/bus")
        honest = Honest(daemon.address)
        try:
            assert honest.hears_more(30), daemon.log.read_text()
            for _ in range(spells):
                honest.ages_s.clear()
                time.sleep(seconds)
                ages_s["quiet"] += honest.ages_s
                honest.ages_s.clear()
                with attack(daemon, name, number, strangers):
                    time.sleep(seconds)
                    ages_s["attacked"] += honest.ages_s
                time.sleep(1.0)  # the strangers are gone, and what they left is cleared up
        finally:
            honest.close()
            daemon.process.kill()
            daemon.process.wait()
    oldest_ms = []
    for spell, ages in ages_s.items():
        percentiles = np.percentile(np.array(ages or [np.inf]) * 1e3, (50, 90, 99, 99.9, 100))  # inf: no touch came
        print(f"{name:14} {spell:9} {len(ages):7d} " + " ".join(f"{value:8.2f}" for value in percentiles), flush=True)
        oldest_ms.append(float(percentiles[-1]))
    return oldest_ms[1] - oldest_ms[0]


def main() -> int:
    """Measure all attacks, and return 1 if one makes a touch late."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("attacks", nargs="*", default=list(ATTACKS), help=f"of {', '.join(ATTACKS)}")
    parser.add_argument("--spells", type=within(int, 1), default=5, help="of each kind")
    parser.add_argument("--seconds", type=within(float, 0.1), default=5.0, help="of a spell, at least")
    arguments = parser.parse_args()
    print(f"{'attack':14} {'spells':9} {'touches':>7} {'p50':>8} {'p90':>8} {'p99':>8} {'p99.9':>8} {'max':>8} ms")
    later_ms = {name: measure(name, arguments.spells, arguments.seconds) for name in arguments.attacks}
    name = max(later_ms, key=lambda name: later_ms[name])
    print(f"oldest touch of an attack against the oldest without: {later_ms[name]:+.1f} ms at most ({name})")
    return 1 if later_ms[name] > MOST_LATER_MS else 0


if __name__ == "__main__":
    sys.exit(main())
