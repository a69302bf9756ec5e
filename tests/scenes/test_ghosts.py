"""What is no finger brings no contact: minutes of `make ghosts` in which there once were some."""

from __future__ import annotations

import pytest

from tests.soak.ghosts import judge
from touchd.twin.instrument import Instrument


@pytest.mark.parametrize(
    ("name", "seed"), [("idle", 1), ("drift", 34), ("drift", 58), ("interference", 33), ("interference", 7)]
)
def test_neither_jitter_nor_drift_nor_tones_are_fingers_on_the_emitter(
    name: str, seed: int, instrument: Instrument
) -> None:
    """A trigger that comes late delays all channels alike, as a faint finger on the emitter would."""
    found = judge(name, seed, instrument)
    print(f"{name} {seed}: {found.missed} of {found.touches} missed")
    assert found.strays == []
