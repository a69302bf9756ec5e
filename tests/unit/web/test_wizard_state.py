"""What of the wizard's state pages get."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any, cast

import pytest
from starlette.requests import Request
from starlette.types import Message

from touchd.web import calibrate
from touchd.web.calibrate import without_places
from touchd.web.guards import Access
from touchd.web.hub import Hub
from touchd.web.site import Site


def test_where_a_finger_was_found_stays_with_the_wizard() -> None:
    """On a keypad the places of taps are a PIN, and a calibration may have been left running there."""
    tap = {"target_mm": [10.0, 20.0], "found_mm": [61.25, 83.5]}
    state = {"running": "taps", "taps": [tap], "last": {"ok": False, "reason": "beside", **tap}}
    told = without_places(state)
    assert "found_mm" not in json.dumps(told)
    assert "61.25" not in json.dumps(told)
    assert told["taps"] == [{"target_mm": [10.0, 20.0]}]
    assert told["last"] == {"ok": False, "reason": "beside", "target_mm": [10.0, 20.0]}
    assert without_places({"running": None, "last": None}) == {"running": None, "taps": [], "last": None}


@pytest.mark.parametrize("text", ["a\0b", "a\ud800", "é"])
def test_odd_characters(text: str, tmp_path: Path) -> None:
    """An answer of the wizard that repeats half of a surrogate pair reaches the page."""
    said = {"ok": False, "problem": f"{text}: is not there", "fix": "check the path"}

    async def wizard(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        assert json.loads(await reader.readline())["recording"] == text
        writer.write(json.dumps(said).encode() + b"\n")
        writer.close()

    async def receive() -> Message:
        return {"type": "http.request", "body": json.dumps({"do": "train", "recording": text}).encode()}

    async def ask() -> Any:
        site = Site(Access(8770), Hub("ipc:///nowhere"), wizard=tmp_path / "wizard")
        async with await asyncio.start_unix_server(wizard, site.wizard):
            return await calibrate._do(site, Request({"type": "http", "method": "POST", "headers": []}, receive))

    answer = asyncio.run(ask())
    assert (answer.status_code, answer.media_type) == (409, "application/json")
    assert json.loads(cast("bytes", answer.body)) == said
