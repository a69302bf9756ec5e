"""A running daemon's configuration that loses its file, or the file its content, is warned of."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from touchd.cli.main import main
from touchd.config import load
from touchd.config.schema import Settings

pytestmark = pytest.mark.usefixtures("own_settings")


def unlink(path: Path) -> None:
    path.unlink()


def empty(path: Path) -> None:
    path.write_text("")


@pytest.mark.parametrize("lose", [unlink, empty])
def test_reset(lose: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings that are reset since the file is empty or gone bring one warning; other changes bring none."""
    path = load.DEFAULT_PATH
    path.parent.mkdir()
    path.write_text("[device]\nrate_hz = 60\n")
    warned: list[int] = []

    def run(settings: Settings, _choice: object, *, read_settings: Callable[[], Settings], **_: object) -> None:
        assert settings.device.rate_hz == 60

        def reload() -> Settings:
            with capture_logs() as lines:
                found = read_settings()
            warned.append(sum(line.get("file") == str(path) for line in lines))
            return found

        path.write_text("[device]\nrate_hz = 50\n")
        assert reload().device.rate_hz == 50
        lose(path)
        assert reload() == reload() == Settings()

    monkeypatch.setattr("touchd.service.daemon.run", run)
    assert main([]) == 0
    assert warned == [0, 1, 0]
