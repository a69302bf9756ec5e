"""A contact's kind is told where its size tells it, and not otherwise."""

from __future__ import annotations

import pytest

from touchd.localization.contact_size import kind_of
from touchd.touch import Face, Kind


@pytest.mark.parametrize(("size", "mean_mm2", "kind"), [
    (8.0, 22.0, "finger"), (8.0, 45.0, "thumb"), (8.0, 33.5, None), (0.2, None, "glove"), (1.0, None, None),
])  # fmt: skip
def test_kind(size: float, mean_mm2: float | None, kind: Kind | None) -> None:
    """Area tells a finger from a thumb, the amplitude a glove; between them no kind is told."""
    face = None if mean_mm2 is None else Face(mean_mm2, 1.0, 0.0, 1.0, 1.0)
    assert kind_of(size, face) == kind


def test_long_finger() -> None:
    """A face is as large as its area, not as its axes are long."""
    assert kind_of(8.0, Face(38.0, 24.0, 0.0, 1.0, 1.0)) == "finger"
