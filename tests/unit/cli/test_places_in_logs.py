"""What the page's server and the wizard log says nothing of places."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
import structlog

from touchd.calibration.wizard import worker
from touchd.calibration.wizard.state import State
from touchd.cli.main import main
from touchd.web import server


@pytest.mark.parametrize("style", ["json", "console"])
@pytest.mark.parametrize("verb", ["wizard", "web"])
def test_internal_error(
    verb: str, style: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """An internal error is logged with its traceback, and without the places that its functions held."""

    def job(*_: object) -> Any:
        found_mm = (61.25, 83.5)
        raise ZeroDivisionError(len(found_mm))

    async def serve_wizard(one: worker.Worker, state: State, *_: object) -> None:
        one.answer({"do": "fit"})
        while state["running"]:
            await asyncio.sleep(0.01)

    def serve_web(*_: object, **_options: object) -> None:
        try:
            job()
        except ZeroDivisionError:
            structlog.get_logger().exception("the job failed", contacts_mm=[(61.25, 83.5)])

    monkeypatch.setattr(worker, "fit", job)
    monkeypatch.setattr(worker, "serve", serve_wizard)
    monkeypatch.setattr(server, "serve", serve_web)
    monkeypatch.setenv("TOUCHD_LOG__FORMAT", style)
    options = {"wizard": ["--folder", str(tmp_path)], "web": ["--bind", "127.0.0.1:0"]}
    assert main([verb, *options[verb]]) == 0
    said = "".join(capfd.readouterr())
    assert "the job failed" in said
    assert "ZeroDivisionError" in said
    assert "61.25" not in said
