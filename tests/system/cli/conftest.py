"""A bus to listen to."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from touchd.config.schema import BusSettings
from touchd.sinks.zeromq import ZeromqSink


@pytest.fixture
def sink() -> Iterator[ZeromqSink]:
    sink = ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",)))
    yield sink
    sink.close()
