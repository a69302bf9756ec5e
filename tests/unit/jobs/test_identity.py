"""What a job's result depends on has one digest, and nothing else changes it."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.jobs import Job, digest, run
from touchd.jobs.job import code_digest

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=8,
)


@given(plain, plain)
def test_plain_values(one: Any, other: Any) -> None:
    """Two values have the same digest only if they are written alike."""

    def written(value: Any) -> str:
        if isinstance(value, dict):
            return f"dict {sorted((key, written(item)) for key, item in value.items())}"
        return repr([written(item) for item in value] if isinstance(value, list) else value)

    assert (digest(one) == digest(other)) == (written(one) == written(other))


@dataclass
class Point:
    x_mm: float
    y_mm: float


def test_arrays_and_dataclasses() -> None:
    """Arrays and dataclasses are digested by content; what has no canonical form is refused."""
    a = np.arange(6.0).reshape(2, 3)
    assert digest(a) == digest(a.copy(order="F"))
    assert len({digest(v) for v in (a, a.T, a.ravel(), a.astype(np.float32), a + 1e-9)}) == 5
    assert digest(Point(1.0, 2.0)) == digest(Point(1.0, 2.0)) != digest(Point(2.0, 1.0))
    with pytest.raises(TypeError, match="Shared"):
        digest(object())


def test_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The code of a job is all of touchd and of its own package, wherever they are installed."""
    for place in ("here", "there"):
        (tmp_path / place / "somebody").mkdir(parents=True)
        for name in ("__init__", "job"):
            (tmp_path / place / "somebody" / f"{name}.py").write_text("X = 1")

    def now(place: str) -> str:
        importlib.invalidate_caches()
        code_digest.cache_clear()
        with monkeypatch.context() as patch:
            patch.syspath_prepend(str(tmp_path / place))
            return code_digest("somebody.job")

    before = now("here")
    assert now("there") == before
    (tmp_path / "there" / "somebody" / "deep.py").write_text("X = 2")
    assert now("there") != before == now("here")
    assert code_digest("touchd.jobs.job") != before


def test_functions() -> None:
    """A job's function is one that a worker can import."""
    with pytest.raises(TypeError, match="can be imported"):
        Job("nameless", lambda: 1, {})


def test_names() -> None:
    """Two jobs of one run have different names."""
    with pytest.raises(ValueError, match="same name"):
        run([Job("digest", digest, {"value": i}) for i in range(2)], workers=1)
