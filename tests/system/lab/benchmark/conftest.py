"""A stored run, small and made up, for what only reads one."""

from __future__ import annotations

import pytest

from touchd.lab.benchmark.results import BareTimes, DaemonResult, EstimatorResult, Machine, Run, SkipResult, Touches
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import DEFAULT_PLATE


def estimator(
    name: str, p50_us: float, median_mm: float, group: str = "network", ratio: float = 2.0
) -> EstimatorResult:
    return EstimatorResult(
        name=name, group=group, p50_us=p50_us, p99_us=2 * p50_us, p999_us=3 * p50_us, max_us=4 * p50_us, ratio=ratio,
        floor_us=10.0, calls=1000, macs=453_000, bytes=1_500_000, touches=100, missed=0, rmse_mm=2 * median_mm,
        median_mm=median_mm, p95_mm=3 * median_mm,
    )  # fmt: skip


def cell(scene: str, rate_hz: float | None, p50_us: float = 100.0, ratio: float = 1.5) -> DaemonResult:
    return DaemonResult(
        scene=scene, rate_hz=rate_hz, to="subscriber" if rate_hz else "socket", frames=2000, p50_us=p50_us,
        p99_us=2 * p50_us, p999_us=3 * p50_us, max_us=9 * p50_us, handed_p50_us=p50_us / 2, handed_p99_us=p50_us,
        handed_p999_us=2 * p50_us, ratio=ratio, frames_per_s=rate_hz or 20_000.0, frames_per_cpu_s=25_000.0,
        cpu_share=0.04, rss_mb=100.0, gc_pauses=1, gc_longest_us=50.0, messages=2000, lost=0,
        skipped={"gate": 0.25, "tracking": 0.75}, inferred=0.0, start_s=0.4,
    )  # fmt: skip


@pytest.fixture
def run() -> Run:
    return Run(
        quick=False, seconds=100.0,
        machine=Machine(
            cpu="a processor", cores=2, caches="L1 32K", memory_gb=8.0, kernel="6.1", python="3.11", numpy="2.0",
            onnxruntime="1.20", touchd="0.1.0", load=0.1,
        ),
        touches=Touches(count=100, seed=210, finger="silicone", bound_mm=0.012),
        bare_us=BareTimes(p50=25.0, p99=30.0, p999=40.0),
        estimators=(
            estimator("regression", 45, 0.35), estimator("small", 21, 1.6), estimator("mine", 60, 0.4, "given"),
            estimator("atlas, tracking", 50, 0.03, "atlas"),
        ),
        left_out=("what is not there",),
        daemon=tuple(cell(scene, rate) for scene in ("idle", "moving") for rate in (125.0, 1000.0, None)),
        skips=(SkipResult(name="gate", scene="idle", with_us=5.0, without_us=11.0, saved=0.55, same="the same"),),
        day=None,
    )  # fmt: skip


@pytest.fixture(scope="session")
def plate() -> Instrument:
    return Instrument(DEFAULT_PLATE)
