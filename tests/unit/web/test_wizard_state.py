"""What of the wizard's state pages get."""

from __future__ import annotations

import json

from touchd.web.calibrate import without_places


def test_where_a_finger_was_found_stays_with_the_wizard() -> None:
    """On a keypad the places of taps are a PIN, and a calibration may have been left running there."""
    tap = {"target_mm": [10.0, 20.0], "found_mm": [61.25, 83.5]}
    state = {"running": "taps", "taps": [tap], "last": {"ok": False, "reason": "beside", **tap}}
    told = without_places(state)
    assert "found_mm" not in json.dumps(told)
    assert "61.25" not in json.dumps(told)
    assert told["taps"] == [{"target_mm": [10.0, 20.0]}]
    assert told["last"] == {"ok": False, "reason": "beside", "target_mm": [10.0, 20.0]}
    assert without_places({"running": None, "last": None}) == {"running": None, "taps": [], "last": None}
