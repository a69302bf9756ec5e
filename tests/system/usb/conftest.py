"""A DAQ in memory, and a source on it that is always closed."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.system.usb.backend import FakeBus, FakeDaq
from tests.system.usb.reader import INFO, QUICK, Reader
from touchd.config.schema import DeviceSettings
from touchd.frame import Acquisition
from touchd.sources.daq import Waits
from touchd.sources.live import DaqSource
from touchd.sources.usb import open_usb
from touchd.sources.usb_stream import acquisition_of


@pytest.fixture
def daq() -> FakeDaq:
    return FakeDaq(INFO)


@pytest.fixture
def bus(daq: FakeDaq) -> FakeBus:
    return FakeBus(daq)


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    yield
    assert not [thread for thread in threading.enumerate() if thread.name == "touchd-daq"]


@pytest.fixture
def read(bus: FakeBus) -> Iterator[Callable[..., Reader]]:
    """Open a source on the bus, with these settings; it soon notices that it is closed."""
    opened: list[DaqSource] = []

    def open_source(
        acquisition: Acquisition | None = None, check: Callable[[Acquisition], None] = lambda _: None,
        waits: Waits = QUICK, **settings: Any,
    ) -> Reader:  # fmt: skip
        chosen = DeviceSettings(**{"stall_s": 5.0, **settings})
        source = open_usb(chosen, acquisition or acquisition_of(INFO), check, backend=bus, waits=waits)
        opened.append(source)
        return Reader(source)

    yield open_source
    for source in opened:
        source.close()
        source.close()
