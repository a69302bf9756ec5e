"""Runs a recording through the pipeline and writes what came of each frame: a process of `replay`'s own.

usage: python -c "from touchd.web.replayed import main; main(RECORDING, FOLDER, CONFIG)"
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
from msgspec.json import encode

from touchd.config.load import load
from touchd.event import Contact
from touchd.service.daemon import feed_description, make_pipeline
from touchd.service.messages import Messages, all_but_spectra
from touchd.service.runner import frames_of
from touchd.sources.open import SourceChoice
from touchd.sources.replay import ReplaySource

_TOLD = 250
"""Progress is printed after as many frames."""


def main(recording: str, folder: str, config: str) -> None:
    """Write a line of JSON for each frame, where each begins, and a summary; print the number of frames done."""
    settings = load(Path(config) if config else None)
    source = ReplaySource(Path(recording), speed=float("inf"))
    pipeline = make_pipeline(source, settings, notify=lambda _reason, _fields: None)
    described = feed_description(source, settings, SourceChoice(replay=Path(recording)), pipeline)
    plate = Messages(settings, all_but_spectra).plate(described, pipeline.layout, 0)
    alive: list[Contact] = []
    offsets, counts, first_ns = [0], [], None
    with closing(source), (Path(folder) / "frames.jsonl").open("wb") as out:
        for frame in filter(None, frames_of(source)):
            first_ns = frame.t_ns if first_ns is None else first_ns
            result = pipeline.process(frame)
            contacts = result.contacts or alive  # none are due where nothing has changed
            alive = [c for c in contacts if c.phase != "up"]
            line = {
                "frame": frame.sequence, "t_s": round((frame.t_ns - first_ns) * 1e-9, 6),
                "outcome": result.outcome.name.lower(), "contacts": contacts, "truth": source.truth(),
            }  # fmt: skip
            offsets.append(offsets[-1] + out.write(encode(line) + b"\n"))
            counts.append(len(alive))
            if len(counts) % _TOLD == 0:
                print(len(counts), flush=True)
    np.save(Path(folder) / "offsets.npy", np.array(offsets, np.int64))
    # Where the number of fingers changes: the first frame, and the number from there on.
    changes = [(n, count) for n, count in enumerate(counts) if n == 0 or count != counts[n - 1]]
    summary = {"plate": plate, "frames": len(counts), "fingers": changes}
    (Path(folder) / "summary.json").write_bytes(encode(summary))
