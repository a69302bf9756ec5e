"""Bridges serve touches also where what they print cannot be written."""

from __future__ import annotations

import signal
import sys

import pytest

from touchd.bridges.bridge import Down, Output
from touchd.cli.bridge import serve
from touchd.config.schema import InputSettings


class Idle(Output):
    """Has seen the bus for a moment: then it is enough."""

    topics = ("touch",)
    closed = False

    def show(self, down: Down, t_ns: int) -> None: ...

    def idle(self, now_ns: int) -> None:  # noqa: ARG002 - of the protocol
        signal.raise_signal(signal.SIGTERM)

    def close(self) -> None:
        self.closed = True


def test_full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bridge whose log goes to a full disk is a touch screen all the same."""
    output = Idle()
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        serve("ipc:///nowhere", InputSettings(), output, "a touch screen")
    assert output.closed
