"""What an examination by the page looks at."""

from __future__ import annotations

import pytest

from touchd.web.check import _own_bus


@pytest.mark.parametrize("address", ["ipc:///run/touchd/bus", "tcp://127.0.0.1:5571", "tcp://[::1]:5571"])
def test_own_bus(address: str) -> None:
    """The doctor examines the bus that the page shows."""
    assert _own_bus(address) == {"TOUCHD_BUS__BIND": f'["{address}"]'}


@pytest.mark.parametrize("address", [None, "tcp://10.0.0.7:5570", "tcp://plate.example:5570"])
def test_far_bus(address: str | None) -> None:
    """The doctor keeps to the configured bus if the page shows another computer's: no daemon here could bind that."""
    assert _own_bus(address) == {}
