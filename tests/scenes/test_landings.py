"""How soon a fingertip that lands is told: `python -m touchd.lab.landings` plays a thousand."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.config.schema import Settings
from touchd.lab.landings import landings


@pytest.mark.parametrize(("idle_hz", "median_s", "most_s"), [(125.0, 0.012, 0.020), (50.0, 0.020, 0.035)])
def test_first_contact_to_down(idle_hz: float, median_s: float, most_s: float) -> None:
    """From a contact of 3 mm^2 to `down`, at 125 frames a second, also where the untouched plate has 50; landings take
    20 to 120 ms."""
    made, others = landings(10, 125.0, idle_hz, 4020, Settings())
    late_s = np.array([one.down_s - one.first_s for one in made])
    print(f"from {idle_hz:g} frames/s: median {np.median(late_s):.4f} s, at most {late_s.max():.4f} s")
    assert others == 0, "each finger is one contact"
    assert all(one.gate_s <= one.found_s <= one.down_s for one in made)
    assert np.median(late_s) < median_s
    assert np.sort(late_s)[-2] < most_s, "all but one"
