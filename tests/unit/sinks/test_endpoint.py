"""Where the bus is bound that nobody told where."""

from __future__ import annotations

import pytest

from touchd.config.schema import BusSettings
from touchd.sinks.endpoint import effective


@pytest.mark.parametrize(
    ("folder", "address", "group"),
    [
        ("", "tcp://127.0.0.1:5570", ""),
        ("/run/touchd", "ipc:///run/touchd/bus", "touchd-bus"),
        ("/run/touchd:/run/other", "ipc:///run/touchd/bus", "touchd-bus"),
    ],
)
def test_default(monkeypatch: pytest.MonkeyPatch, folder: str, address: str, group: str) -> None:
    """The service binds a file of its runtime folder for its group, any other daemon loopback; settings come first."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", folder)
    found = effective(BusSettings())
    assert (found.bind, found.ipc_group) == ((address,), group)
    assert effective(BusSettings(ipc_group="kiosk")).ipc_group == "kiosk"
    told = BusSettings(bind=("ipc:///tmp/bus",))
    assert effective(told) == told
