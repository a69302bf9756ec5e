"""`touchd map`: taps on the plate become the mapping in the configuration."""

from __future__ import annotations

import tomllib
from pathlib import Path

from tests.command_line import touchd
from tests.processes import end, started
from tests.system.bridges.rig import Daemon, daemon, down
from tests.unit.bridges.events import contact

TAPS = [(40.0, 30.0), (160.0, 30.5), (160.0, 90.0), (40.5, 90.0)]


def tap(bus: Daemon, id: int, x_mm: float, y_mm: float) -> None:  # noqa: A002 - the field's name
    bus.touch(down(id, x_mm, y_mm))
    bus.touch(contact(id, "up", x_mm, y_mm))


def test_taps_become_the_mapping(tmp_path: Path) -> None:
    """Four taps are written as the screen's rectangle with their residual; what cannot be one is refused."""
    config = tmp_path / "touchd.toml"
    config.write_text("# mine\n")
    with daemon(tmp_path) as bus:
        with started("--config", config, "map", "--bus", bus.address) as mapping:
            bus.wait()
            for n, at in enumerate(TAPS):
                tap(bus, n + 1, *at)
            ended = end(mapping)
        assert ended.code == 0, ended.err
        written = tomllib.loads(config.read_text())["input"]
        assert written["rotate"] == 0
        assert 0.0 < written["residual_mm"] < 1.0
        assert all(abs(a - b) < 1.0 for a, b in zip(written["screen_mm"], (25, 22.6, 150, 74.7), strict=True))
        assert config.read_text().startswith("# mine\n")
        before = config.read_text()
        with started("--config", config, "map", "--bus", bus.address) as mapping:
            bus.wait()
            for n, at in enumerate([TAPS[1], TAPS[0], *TAPS[2:]]):
                tap(bus, n + 11, *at)
            ended = end(mapping)
        assert ended.code == 92
        assert "in order" in ended.err
        assert config.read_text() == before


def test_says_why_no_touch_comes(tmp_path: Path) -> None:
    """Of a daemon that has lost its device it says so at once, and takes touches when they come."""
    with daemon(tmp_path) as bus, started("map", "--dry-run", "--bus", bus.address) as mapping:
        bus.wait()
        bus.health("lost")
        for n, at in enumerate(TAPS):
            tap(bus, n + 1, *at)
        ended = end(mapping)
    assert ended.code == 0, ended.err
    assert "waiting: the daemon is lost" in ended.err, "it reads as a failure otherwise"


def test_page(tmp_path: Path) -> None:
    """The page of crosses is a file for any browser."""
    page = tmp_path / "crosses.html"
    assert touchd("map", "--page", page, "--touches", "9").code == 0
    assert page.read_text().count("<i ") == 9
