"""Jobs give the same results wherever they run, are kept as they end, and fail in words."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.jobs_to_run import MANY, always_die, fail, lines, noted, numbered, refuse, spectrum
from tests.processes import PATIENCE_S, ROOT, environment
from touchd.errors import JobError, OutputError, TrainingError
from touchd.jobs import Job, Shared, run
from touchd.jobs.identity import code_digest, digest
from touchd.jobs.store import Store

WINDOW = np.hanning(300)
SPECTRA = [Job(f"spectrum {seed}", spectrum, {"seed": seed}, ("window",)) for seed in range(4)]


def test_results_agree_to_the_bit_whatever_the_number_of_workers() -> None:
    one = run(SPECTRA, workers=1, shared={"window": WINDOW})
    two = run(SPECTRA, workers=2, shared={"window": WINDOW})
    assert list(one) == list(two) == [job.name for job in SPECTRA]
    for name in one:
        np.testing.assert_array_equal(one[name], two[name])


def test_what_is_kept_is_not_computed_again(tmp_path: Path) -> None:
    log, cache = tmp_path / "log", tmp_path / "cache"
    told: list[tuple[str, int, int]] = []
    first = run(numbered(log, 3), workers=1, cache=cache)
    more = run(numbered(log, 5), workers=1, cache=cache, progress=lambda *step: told.append(step))
    assert list(first.values()) == [0, 1, 4]
    assert list(more.values()) == [0, 1, 4, 9, 16]
    assert lines(log) == [0, 1, 2, 3, 4]
    assert [done for _, done, _ in told] == [1, 2, 3, 4, 5]
    assert cache.stat().st_mode & 0o777 == 0o700


def test_other_arguments_or_another_shared_object_are_another_job(tmp_path: Path) -> None:
    job = SPECTRA[:1]
    window = run(job, workers=1, shared={"window": WINDOW}, cache=tmp_path / "cache")
    other = run(job, workers=1, shared={"window": WINDOW**2}, cache=tmp_path / "cache")
    assert not np.array_equal(window["spectrum 0"], other["spectrum 0"])
    assert len(list((tmp_path / "cache").iterdir())) == 2


def test_a_digest_of_ones_own_decides_whether_a_shared_object_is_the_same(tmp_path: Path) -> None:
    results = [
        run(SPECTRA[:1], workers=1, shared={"window": Shared(window, "today's")}, cache=tmp_path / "cache")
        for window in (WINDOW, WINDOW**2)
    ]
    np.testing.assert_array_equal(results[0]["spectrum 0"], results[1]["spectrum 0"])


@pytest.mark.parametrize("damage", [b"", b"touchd job 1\n", b"no result at all" * 20, None])
def test_a_damaged_file_is_computed_again(
    tmp_path: Path, damage: bytes | None, capsys: pytest.CaptureFixture[str]
) -> None:
    log, cache = tmp_path / "log", tmp_path / "cache"
    run(numbered(log, 1), workers=1, cache=cache)
    (file,) = cache.iterdir()
    file.write_bytes(file.read_bytes()[:-1] if damage is None else damage)
    assert run(numbered(log, 1), workers=1, cache=cache) == {"square 0": 0}
    assert "damaged" in capsys.readouterr().out
    run(numbered(log, 1), workers=1, cache=cache)
    assert lines(log) == [0, 0]


def test_a_folder_in_which_others_may_write_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    with pytest.raises(OutputError, match="chmod 700"):
        Store(tmp_path)


def test_a_folder_that_cannot_be_written_costs_no_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert run(numbered(tmp_path / "log", 2), workers=1, cache=tmp_path / "file" / "cache")["square 1"] == 1
    assert capsys.readouterr().out.count("cannot be kept") == 1


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return b"Z" not in Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()[:1]


def children(pid: int) -> list[int]:
    return [
        int(part) for task in Path(f"/proc/{pid}/task").iterdir() for part in (task / "children").read_text().split()
    ]


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_a_run_that_is_killed_goes_on_where_it_was_and_leaves_no_worker(tmp_path: Path, end: signal.Signals) -> None:
    log, cache = tmp_path / "log", tmp_path / "cache"
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.jobs_to_run", log, cache], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        text=True, cwd=ROOT, env=environment(),
    )  # fmt: skip
    with process:
        assert process.stdout is not None
        for _ in range(2):
            process.stdout.readline()
        workers = children(process.pid)
        assert len(workers) >= 2
        process.send_signal(end)
        try:
            process.wait(PATIENCE_S)
        finally:
            process.kill()
        # A pipe is at its end when the last process that holds it has gone, or is about to.
        process.stdout.read()
    deadline = time.monotonic() + PATIENCE_S
    while any(alive(worker) for worker in workers):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    kept = len([path for path in cache.iterdir() if path.suffix == ".result"])
    assert 2 <= kept < MANY
    before = len(lines(log))
    assert list(run(numbered(log, MANY, 0.2), workers=1, cache=cache).values()) == [i * i for i in range(MANY)]
    assert len(lines(log)) - before == MANY - kept


@pytest.mark.parametrize("error", [None, ZeroDivisionError])
def test_an_interrupt_amid_what_holds_locks_comes_when_they_are_released(error: type[Exception] | None) -> None:
    did = []

    def hold_a_lock() -> None:
        signal.raise_signal(signal.SIGINT)
        did.append("whole")
        if error is not None:
            raise error

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        _uninterrupted(hold_a_lock)()
    assert did == ["whole"]
    assert signal.getsignal(signal.SIGINT) == before


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failure_names_the_job_and_what_ran_beside_it_is_kept(tmp_path: Path, workers: int) -> None:
    log, cache = tmp_path / "log", tmp_path / "cache"
    jobs = [*numbered(log, 2), Job("hopeless", fail, {"x": 7}), *numbered(log, 40, 0.01)[2:]]
    with pytest.raises(JobError, match="hopeless: ZeroDivisionError: 7 by nothing"):
        run(jobs, workers=workers, cache=cache)
    assert {0, 1} <= set(lines(log))
    assert len(list(cache.iterdir())) == len(lines(log)) < 40


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_touchds_own_is_raised_as_it_is(workers: int) -> None:
    with pytest.raises(TrainingError, match="recording: 3 touches -> record more"):
        run([Job(f"{x}", refuse, {"x": 3}) for x in range(2)], workers=workers)


def test_a_worker_that_is_killed_is_explained(tmp_path: Path) -> None:
    with pytest.raises(JobError, match=r"deadly.*killed.*what is finished is kept"):
        run([*numbered(tmp_path / "log", 3), Job("deadly", always_die, {})], workers=2, cache=tmp_path / "cache")


def test_a_worker_with_other_source_code_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("touchd.jobs.code_digest", lambda _module: "another")
    with pytest.raises(JobError, match="another source code"):
        run(numbered(tmp_path / "log", 1), workers=1)
    assert not (tmp_path / "log").exists()


def test_only_functions_that_a_worker_can_import_are_jobs() -> None:
    with pytest.raises(TypeError, match="can be imported"):
        Job("nameless", lambda: 1, {})


def test_names_are_unique(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="same name"):
        run(numbered(tmp_path / "log", 1) * 2)


# -- what a result depends on ------------------------------------------------------------------------

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)


@given(plain, plain)
def test_values_have_the_same_digest_only_if_they_are_written_alike(one: Any, other: Any) -> None:
    def written(value: Any) -> str:
        if isinstance(value, dict):
            return f"dict {sorted((key, written(item)) for key, item in value.items())}"
        return repr([written(item) for item in value] if isinstance(value, list) else value)

    assert (digest(one) == digest(other)) == (written(one) == written(other))


@dataclass
class Point:
    x_mm: float
    y_mm: float


def test_arrays_and_dataclasses_are_digested_by_content() -> None:
    a = np.arange(6.0).reshape(2, 3)
    assert digest(a) == digest(a.copy(order="F"))
    assert len({digest(v) for v in (a, a.T, a.ravel(), a.astype(np.float32), a + 1e-9)}) == 5
    assert digest(Point(1.0, 2.0)) == digest(Point(1.0, 2.0)) != digest(Point(2.0, 1.0))
    with pytest.raises(TypeError, match="Shared"):
        digest(object())


def test_the_code_of_a_job_is_all_that_its_module_imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "somebody"
    package.mkdir()
    for name, text in {
        "__init__": "",
        "job": "def f():\n from . import deep",
        "deep": "X = 1",
        "other": "X = 1",
    }.items():
        (package / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))

    def now() -> str:
        code_digest.cache_clear()
        return code_digest("somebody.job")

    before = now()
    (package / "other.py").write_text("X = 2")
    assert now() == before
    (package / "deep.py").write_text("X = 2")
    assert now() != before
    assert noted.__module__ == "tests.jobs_to_run"
