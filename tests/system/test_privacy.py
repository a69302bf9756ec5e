"""Nothing of this computer is told to anybody."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.processes import PATIENCE_S, environment


def test_identifier(tmp_path: Path) -> None:
    """The inference engine makes no identifier of this computer."""
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    variables = {name: value for name, value in environment(**home).items() if name != "ORT_DISABLE_TELEMETRY"}
    subprocess.run(
        [sys.executable, "-c", "import touchd.localization.model"], check=True, timeout=PATIENCE_S, env=variables
    )
    assert list(tmp_path.rglob("*")) == []
