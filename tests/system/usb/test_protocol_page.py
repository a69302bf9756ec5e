"""Whoever writes firmware by the page has everything that is tested here."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from touchd.gadget import device as gadget
from touchd.sources import usb, usb_protocol
from touchd.sources.daq import WAITS

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "usb-protocol.md").read_text()
DENSE = "".join(PAGE.split())
CHECKLIST = ("ramp", "wrap", "full", "status")
VECTORS: dict[str, list[dict[str, Any]]] = json.loads(
    (Path(__file__).resolve().parents[2] / "vectors.json").read_text()
)


@pytest.mark.parametrize("kind", VECTORS)
def test_vectors(kind: str) -> None:
    """The page links all vectors, names the wrong ones, and has those of its checklist whole: of the long one header
    and CRC."""
    assert "(../tests/vectors.json)" in PAGE
    for vector in VECTORS[kind]:
        name = vector.get("name", vector.get("geometry", "status"))
        if kind == "corrupt":
            assert f"`{name}`" in PAGE
        elif name in CHECKLIST:
            assert (vector["hex"] if len(vector["hex"]) <= 200 else vector["hex"][:64]) in DENSE, vector
            assert vector.get("crc32", "") in PAGE


def test_requests() -> None:
    """The page explains every request, flag and command."""
    for request in usb_protocol.Request:
        assert f"| {request.value:#04x} {request.name} |" in PAGE
    for flag in usb_protocol.Flag:
        assert f"\n| {flag.value} | " in PAGE
    for command in gadget.COMMANDS:
        assert f"`{command}`" in PAGE


def test_numbers() -> None:
    """The page's numbers are those of the code."""
    for text in (
        f"within {usb.CONTROL_TIMEOUT_MS} ms",
        f"timeout of {WAITS.read_s * 1000:g} ms",
        f"every {WAITS.retry_s:g} to {WAITS.max_retry_s:g} s",
        f"has {gadget.BACKLOG})",
    ):
        assert text in PAGE
