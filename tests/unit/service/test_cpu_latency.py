"""The processors are kept awake while the plate is touched and frames come fast, and at no other time."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from structlog.testing import capture_logs

from touchd.service.realtime import CPU_LATENCY, Awake, permitted

MS_NS = 1_000_000


@pytest.fixture(scope="session")
def device(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("dev") / "cpu_dma_latency"
    file.touch()
    return file


def holders(path: Path) -> int:
    """How many of this process's files are that one."""
    held = 0
    for entry in os.scandir("/proc/self/fd"):
        try:
            held += os.readlink(entry.path) == str(path)
        except FileNotFoundError:  # that of the listing itself
            continue
    return held


def latency_us() -> int:
    """The least latency that anybody asks of the system now."""
    return int.from_bytes(CPU_LATENCY.read_bytes()[:4], "little", signed=True)


def test_a_finger_at_1000_frames_a_second_keeps_them_awake_until_it_lifts(device: Path) -> None:
    awake = Awake(500.0, device)
    for touched, held in ((False, 0), (True, 1), (True, 1), (False, 0), (True, 1)):
        awake.update(touched, MS_NS)
        assert (awake.held, holders(device)) == (bool(held), held)
    assert device.read_bytes() == bytes(4)
    awake.close()
    assert (awake.held, holders(device)) == (False, 0)


@pytest.mark.parametrize(
    ("from_hz", "rate_hz", "held"),
    [(500.0, 500, True), (500.0, 125, False), (500.0, 450, False), (120.0, 125, True), (0.0, 1000, False)],
)
def test_it_is_done_from_that_rate_on_and_never_at_0(device: Path, from_hz: float, rate_hz: int, held: bool) -> None:
    awake = Awake(from_hz, device)
    # A device's clock runs a little slow beside this one.
    awake.update(True, round(1.0003e9 / rate_hz))
    assert awake.held == held
    awake.close()


@given(st.lists(st.tuples(st.booleans(), st.integers(-(2**40), 2**40))))
def test_whatever_comes_nobody_is_kept_awake_for_an_untouched_plate(
    device: Path, steps: list[tuple[bool, int]]
) -> None:
    awake = Awake(500.0, device)
    touched = False
    for touched, period_ns in steps:
        awake.update(touched, period_ns)
        assert touched or not awake.held
        assert holders(device) == awake.held
    awake.close()


@pytest.mark.parametrize("path", ["/dev/nothing-there", "/dev/full"])
def test_a_refusal_is_logged_once_and_leaves_no_file_open(path: str) -> None:
    gc.collect()  # what another test has left open there
    before, awake = holders(Path(path)), Awake(500.0, Path(path))
    with capture_logs() as logs:
        for _ in range(5):
            awake.update(True, MS_NS)
    assert [(line["log_level"], line["event"]) for line in logs] == [("info", "processors may sleep between frames")]
    assert path in logs[0]["reason"]
    assert "60-touchd.rules" in logs[0]["fix"]
    assert (awake.held, holders(Path(path))) == (False, before)


@pytest.mark.skipif(not permitted(), reason="this user may not keep the processors awake, or they never sleep")
def test_the_kernel_takes_the_request_and_forgets_it() -> None:
    before_us = latency_us()
    awake = Awake(500.0)
    awake.hold()
    assert latency_us() == 0
    awake.close()
    assert latency_us() == before_us
