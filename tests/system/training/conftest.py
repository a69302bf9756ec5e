"""A recording of few touches, on which a network is soon trained."""

from __future__ import annotations

from dataclasses import replace

import pytest

from touchd.recording.data import Recording


@pytest.fixture(scope="session")
def few(touches: Recording) -> Recording:
    cut = {name: getattr(touches, name)[:400] for name in ("frames", "sequence", "timestamp_ns", "contacts_mm")}
    return replace(touches, **cut, force_n=None, temperature_c=None)
