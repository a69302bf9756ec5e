"""The rooms of the package, and what each may import: no circle, no arrow upward."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "touchd"
FLOORS = (
    ("errors", "files", "frame", "touch", "event", "outcome", "keypad", "jobs"),
    ("config", "recording"),
    ("detection", "tracking", "sinks", "twin", "audio"),
    ("localization", "client"),
    ("sources", "pipeline", "bridges"),
    ("service",),
    ("doctor", "gadget"),
    ("evaluation",),
    ("training", "calibration"),
    ("lab", "web", "cli"),
)
"""From the ground up. A room may import from a lower floor, and from a room that stands before it on its own."""
ONLY = {
    "sinks": {"errors", "files", "event", "config"},
    "client": {"errors", "event", "config", "sinks"},
    "bridges": {"errors", "event", "config", "client"},
    "tracking": {"errors", "event", "touch", "config", "keypad"},
    "twin": {"errors", "files", "frame", "recording", "jobs"},
    "detection": {"errors", "frame", "config", "outcome"},
    "pipeline": {
        "frame",
        "touch",
        "event",
        "outcome",
        "keypad",
        "config",
        "detection",
        "tracking",
        "localization",
    },
}
"""Rooms that may know less than their floor allows."""
LONGEST_LINES = 300
MOST_ROOMS, MOST_FLOORS, MOST_FILES = 30, 10, 14
Arrows = dict[str, set[str]]


def files() -> Iterator[tuple[str, Path]]:
    """Each module's dotted name below the package, and its file."""
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


NAMES = dict(files())


STATEMENT = re.compile(r"^[ \t]*((?:from \S+ )?import (?:\([^)]*\)|[^\n(]+))", re.MULTILINE)
"""An import, found by its text: whole files take seconds to parse."""


@cache
def statements(path: Path) -> list[ast.stmt]:
    """A file's imports, wherever in it."""
    return [ast.parse(text).body[0] for text in STATEMENT.findall(path.read_text())]


@cache
def imports(path: Path) -> set[str]:
    """The modules of the package that a file imports, wherever in it."""
    found = set()
    for node in statements(path):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "touchd":
            module = node.module.removeprefix("touchd").removeprefix(".")
            for alias in node.names:
                full = f"{module}.{alias.name}".removeprefix(".")
                found.add(full if full in NAMES else module)
        elif isinstance(node, ast.Import):
            found |= {a.name.removeprefix("touchd.") for a in node.names if a.name.startswith("touchd.")}
    return found - {""}


def room(name: str) -> str:
    return name.split(".")[0]


def rooms() -> Arrows:
    """What each room imports from others; the package's own face and `__main__`, three lines, are no rooms."""
    arrows: Arrows = {}
    for name, path in NAMES.items():
        if name not in ("", "__main__"):
            arrows.setdefault(room(name), set()).update(room(other) for other in imports(path))
    return {name: others - {name} for name, others in arrows.items()}


def circles(arrows: Arrows) -> list[list[str]]:
    """Rooms or modules that import each other, by Kahn's algorithm: those that cannot be put in an order."""
    left = {name: set(others) for name, others in arrows.items()}
    while free := [name for name, others in left.items() if not others & left.keys()]:
        for name in free:
            del left[name]
    return [[name, *sorted(others & left.keys())] for name, others in left.items()]


def heights(arrows: Arrows) -> dict[str, int]:
    """The floor of each room: one above the highest that it imports."""
    found: dict[str, int] = {}

    def height(name: str) -> int:
        if name not in found:
            found[name] = 1 + max((height(other) for other in arrows[name]), default=0)
        return found[name]

    for name in arrows:
        height(name)
    return found


def test_no_room_imports_from_a_higher_floor() -> None:
    """Each room knows only what stands below it."""
    order = [name for floor in FLOORS for name in floor]
    arrows = rooms()
    assert sorted(arrows) == sorted(order), "each room has its place in FLOORS"
    rank = {name: number for number, name in enumerate(order)}
    upward = [(name, other) for name, others in arrows.items() for other in others if rank[other] > rank[name]]
    assert upward == []


@pytest.mark.parametrize("name", ONLY)
def test_some_rooms_know_less(name: str) -> None:
    """Sinks and the client know events and configuration, the stages before localization not localization, and the
    pipeline neither sources nor sinks."""
    assert rooms()[name] <= ONLY[name]


def test_no_circle() -> None:
    """Neither rooms nor modules import each other in a circle."""
    assert circles(rooms()) == []
    assert circles({name: imports(path) - {name} for name, path in NAMES.items()}) == []


def test_size() -> None:
    """The house stays small enough to be known."""
    arrows = rooms()
    floors = max(heights(arrows).values())
    count = sum(map(len, arrows.values()))
    beside = [path.name for path in PACKAGE.glob("*.py")]
    print(f"{len(arrows)} rooms on {floors} floors, {count} arrows; {len(beside)} files beside the folders")
    assert len(arrows) <= MOST_ROOMS
    assert floors <= MOST_FLOORS
    assert len(beside) <= MOST_FILES


def test_no_module_is_longer_than_one_sitting() -> None:
    """A module does one thing."""
    lengths = {name: len(path.read_text().splitlines()) for name, path in NAMES.items()}
    longest = max(lengths, key=lengths.__getitem__)
    print(f"{sum(lengths.values())} lines in {len(lengths)} modules; the longest is {longest}: {lengths[longest]}")
    assert lengths[longest] <= LONGEST_LINES


def test_usb_stays_in_its_modules() -> None:
    """A source takes decoded frames: of `sources`, only the modules named `usb` know the protocol's bytes."""
    others = [name for name in NAMES if name.startswith("sources.") and not name.startswith("sources.usb")]
    knowing = {name for name in others if any(other.startswith("sources.usb") for other in imports(NAMES[name]))}
    assert knowing == {"sources.open"}, "which opens the DAQ on USB"


HOMES = [("usb", "sources.usb"), ("nidaqmx", "sources.ni"), ("alsaaudio", "audio.alsa"), ("torch", "training")]


@pytest.mark.parametrize(("library", "home"), HOMES)
def test_hardware_and_heavy_libraries_have_one_home(library: str, home: str) -> None:
    """The daemon starts without what it does not use."""
    at = set()
    for name, path in NAMES.items():
        for node in statements(path):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(each.split(".")[0] == library for each in names):
                at.add(name)
    assert at
    assert {name for name in at if not name.startswith((home, "lab"))} == set()
