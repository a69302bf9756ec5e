"""What an examination by the page looks at."""

from __future__ import annotations

import io
import time
import zipfile

import pytest

from touchd.web.check import _own_bus, _zip


@pytest.mark.parametrize("address", ["ipc:///run/touchd/bus", "tcp://127.0.0.1:5571", "tcp://[::1]:5571"])
def test_own_bus(address: str) -> None:
    """The doctor examines the bus that the page shows."""
    assert _own_bus(address) == {"TOUCHD_BUS__BIND": f'["{address}"]'}


@pytest.mark.parametrize("address", [None, "tcp://10.0.0.7:5570", "tcp://plate.example:5570"])
def test_far_bus(address: str | None) -> None:
    """The doctor keeps to the configured bus if the page shows another computer's: no daemon here could bind that."""
    assert _own_bus(address) == {}


@pytest.mark.parametrize("year", [1970, 2026, 2200])
def test_bundle_by_a_wrong_clock(year: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A computer without a clock battery, after a power cut, has a support bundle, too."""
    monkeypatch.setattr(time, "localtime", lambda *_: time.struct_time((year, 1, 2, 3, 4, 5, 0, 2, 0)))
    with zipfile.ZipFile(io.BytesIO(_zip({"log.txt": "what was said" * 99}))) as archive:
        assert archive.read("touchd-support/log.txt") == b"what was said" * 99
        assert archive.infolist()[0].compress_size < 99
