"""Behind a reverse proxy the page works under any path."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

STATIC = Path(__file__).parents[3] / "touchd/web/static"
ABSOLUTE = re.compile(
    r"""\b(?:src|href|action)["']?\s*[=:]\s*["'`]/|\b(?:import|from)\s*["'`]/|\burl\(\s*["']?/"""
    r"""|\b(?:fetch|post|import|URL|WebSocket|Worker|assign|replace|replaceState\([^()]*,)\s*\(?\s*["'`]/"""
)
"""Addresses that begin at the server's root."""


@pytest.mark.parametrize("name", sorted(path.name for path in STATIC.iterdir() if path.is_file()))
def test_relative(name: str) -> None:
    """No file of the page names an address that begins with a slash."""
    assert ABSOLUTE.findall((STATIC / name).read_text()) == []


@pytest.mark.parametrize(
    "line",
    [
        '<script src="/main.js">',
        "element('a', { href: '/live' })",
        "element('img', { src: `/picture/${name}` })",
        "await fetch('/replay')",
        "fetch(`/replay/frames?first=${index}`)",
        "post('/session', token)",
        "import { say } from '/dom.js';",
        "import '/dom.js';",
        "new URL('/live', document.baseURI)",
        "background: url(/icon.svg)",
    ],
)
def test_absolute_is_noticed(line: str) -> None:
    """One anywhere is found."""
    assert ABSOLUTE.search(line)
