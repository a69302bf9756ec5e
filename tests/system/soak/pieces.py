"""Pieces of a soak as jobs: on all cores; a run that was stopped goes on from the pieces that have ended."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from importlib import import_module
from typing import Any

from tests.processes import ROOT
from tests.system.soak.interpolated import Interpolated
from touchd.cli.progress import Bars
from touchd.jobs import Job, run
from touchd.localization.atlas import atlas_path
from touchd.localization.model import default_model_path
from touchd.twin.cache import parts_kept
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import DEFAULT_PLATE

Arguments = Mapping[str, Any]


def play_all(
    module: str, parts: Mapping[str, Sequence[Arguments]], workers: int | None
) -> Iterator[tuple[str, list[Any]]]:
    """Yield the name of each part once its pieces are played, and what the module's `job` has returned of each.

    The module is named, since the one that runs as a program is another to the processes.
    """
    job: Callable[..., Any] = import_module(module).job
    model = [default_model_path(), atlas_path(default_model_path())]
    code = sorted(path for folder in ("touchd", "tests") for path in (ROOT / folder).rglob("*.py"))
    judged = [path.read_bytes() for path in model + code]  # another one's pieces say nothing of this one
    with Bars() as bars, parts_kept("soak", [module, dict(parts), judged]) as kept:
        for part, pieces in parts.items():
            jobs = [Job(f"{part} {i}", job, arguments) for i, arguments in enumerate(pieces)]
            found = run(jobs, workers=workers, cache=kept, progress=partial(_advance, bars, part))
            yield part, list(found.values())


def _advance(bars: Bars, part: str, _name: str, done: int, pieces: int) -> None:
    bars.update(part, done, pieces)


@cache
def shared_instrument(*, interpolated: bool) -> Instrument:
    """The plate of a process."""
    return Interpolated(DEFAULT_PLATE) if interpolated else Instrument(DEFAULT_PLATE)
