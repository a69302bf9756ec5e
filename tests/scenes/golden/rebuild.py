"""Rebuild the checked-in results, of the shipped recording and of every scene of the twin: `make golden`."""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from tests.processes import through_the_bus
from tests.scenes.golden import scenes
from touchd.cli.demo import SESSION
from touchd.jobs import Job, run

GOLDEN = Path(__file__).parent / "session.jsonl"
COUNTERS = ("frames", "lost", "corrupt", "skipped", "inferred")


def received(folder: Path) -> list[dict[str, Any]]:
    """What a separate process receives of the shipped recording, without what depends on when it was played.

    Touches and keys, their times counted from the first, and of the health messages the last one's counters: how
    many there are depends on how fast the computer is.
    """
    daemon, listener = through_the_bus(folder, SESSION)
    if (daemon.code, listener.code, listener.err) != (0, 0, ""):
        raise RuntimeError(f"the daemon or the listener failed: {daemon.err}{listener.err}")
    *messages, last = listener.messages
    events = [message for message in messages if message["type"] != "health"]
    first_ns = events[0]["t_ns"]
    return [*(_timeless(event, first_ns) for event in events), {name: last[name] for name in COUNTERS}]


def _timeless(event: dict[str, Any], first_ns: int) -> dict[str, Any]:
    kept = {name: value for name, value in event.items() if name not in ("wall", "latency_us")}
    return kept | {"t_ns": event["t_ns"] - first_ns}


def _short(value: Any) -> Any:
    """Six digits are far more than the comparison asks for."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {name: _short(item) for name, item in value.items()}
    return [_short(item) for item in value] if isinstance(value, list) else value


def main() -> None:
    """Write the results again, on all cores."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    with tempfile.TemporaryDirectory(prefix="touchd-golden-") as folder:
        lines = [json.dumps(_short(event), separators=(",", ":")) for event in received(Path(folder))]
    GOLDEN.write_text("\n".join(lines) + "\n")
    print(f"{GOLDEN}: {len(lines) - 1} messages, {GOLDEN.stat().st_size / 1e3:.0f} kB")
    jobs = [Job(case, scenes.played, {"case": case}) for case in scenes.CASES]
    for case, found in run(jobs, progress=lambda case, done, of: print(f"{done} of {of}: {case}")).items():
        path = scenes.write(case, found)
        print(f"{path}: {len(found) - 1} events, {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
