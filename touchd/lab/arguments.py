"""Numbers on the command lines of the measuring tools."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

T = TypeVar("T", int, float)


def within(kind: Callable[[str], T], least: float, most: float = 1e9) -> Callable[[str], T]:
    """Return a type for argparse, which refuses a number out of a range, or NaN, in one line."""

    def parse(text: str) -> T:
        with suppress(ValueError):
            value = kind(text)
            if least <= value <= most:
                return value
        raise argparse.ArgumentTypeError(f"{text!r} is no number from {least:g} to {most:g}")

    return parse
