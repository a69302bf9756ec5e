"""What is no finger brings no contact and hides none: minutes of `make ghosts` in which it once did."""

from __future__ import annotations

import pytest

from tests.system.soak.ghosts import judge
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


def test_after_a_tone_has_ended_taps_are_found_as_before(instrument: Instrument) -> None:
    """Of two minutes full of tones; the gate once took the end of one for wide noise, and missed 33 taps of 40."""
    both = [judge("interference", seed, instrument) for seed in (2, 18)]
    print([(found.missed, found.touches) for found in both])
    assert sum(found.missed for found in both) <= 4
    assert [found.strays for found in both] == [[], []]


@pytest.mark.parametrize(("name", "seed"), [("drop", 4), ("palm", 18)])
def test_neither_drops_nor_palms_are_fingers(name: str, seed: int, instrument: Instrument) -> None:
    """Of a drop the phase tells, though it scatters at 50 dB; of palms what no few points explain."""
    found = judge(name, seed, instrument)
    print(f"{name} {seed}: {found.missed} of {found.touches} missed")
    assert found.strays == []
    assert found.missed == 0
