"""The Debian package's launcher, on this checkout: only its own line says where touchd and its packages lie."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S, ROOT, environment


@pytest.fixture
def launcher(tmp_path: Path) -> Path:
    text = (ROOT / "deploy/debian/launcher").read_text()
    places = f"{str(ROOT)!r}, {sysconfig.get_path('purelib')!r}"
    path = tmp_path / "touchd"
    path.write_text(text.replace('append("/usr/lib/touchd")', f"extend([{places}])"))
    assert path.read_text() != text
    return path


def test_the_demo_finds_touchd_again(launcher: Path, tmp_path: Path) -> None:
    """A verb that starts touchd passes on where its packages lie."""
    own = {name: value for name, value in environment().items() if name != "PYTHONPATH"}
    python = Path(sys.executable).resolve()  # the environment's would find all without the launcher
    line: list[str | Path] = [python, "-IS", launcher, "demo", "--json", "--speed", "max"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=PATIENCE_S, cwd=tmp_path, env=own)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["frames"] > 0


def test_a_spawned_process_may_import_the_launcher(launcher: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As `multiprocessing` does, which starts the benchmark's daemon."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert "run" in runpy.run_path(str(launcher), run_name="__mp_main__")
