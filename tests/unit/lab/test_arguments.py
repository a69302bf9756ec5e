"""The numbers that a measuring tool is given are counted, or refused in one line."""

from __future__ import annotations

import argparse
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchd.lab.arguments import within
from touchd.lab.landings import main


def parsed(text: str) -> float | None:
    try:
        return within(float, 0.5, 2)(text)
    except argparse.ArgumentTypeError:
        return None


def meant(text: str) -> float | None:
    try:
        return float(text) if 0.5 <= float(text) <= 2 else None
    except ValueError:
        return None


@given(st.one_of(st.text(), st.floats().map(str), st.floats(0, 3).map(str)))
def test_within(text: str) -> None:
    """A text is a number of the range, or refused: NaN, too, which compares with nothing."""
    assert parsed(text) == meant(text)


@pytest.mark.parametrize("count", ["0", "-1", "1e3", str(10**30), str(math.nan)])
def test_landings_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], count: str) -> None:
    """The count of landings is refused before the twin computes its plate."""
    monkeypatch.setattr("sys.argv", ["landings", f"--count={count}"])
    with pytest.raises(SystemExit):
        main()
    assert f"{count!r} is no number from 1" in capsys.readouterr().err


def test_one_landing(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """One landing has a median; what has none, as the slow beside a quick one, has no line."""
    monkeypatch.setattr("sys.argv", ["landings", "--count=1"])
    main()
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("1 landings")
    assert len(said) in (4, 7)
    assert "nan" not in "".join(said)
