"""The rooms of the package, and what each may import: no circle, no arrow upward."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from touchd.cli.main import EXTRAS, VERBS

PACKAGE = Path(__file__).resolve().parents[2] / "touchd"
FLOORS = (
    ("errors", "files", "child", "frame", "touch", "event", "outcome", "keypad", "jobs"),
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


STATEMENT = re.compile(r"^([ \t]*)((?:from \S+ )?import (?:\([^)]*\)|[^\n(]+))", re.MULTILINE)
"""An import, found by its text: whole files take seconds to parse."""


@cache
def statements(path: Path) -> list[ast.stmt]:
    """A file's imports, wherever in it."""
    return [ast.parse(text).body[0] for _, text in STATEMENT.findall(path.read_text())]


@cache
def at_once(path: Path) -> list[ast.stmt]:
    """A file's imports outside its functions."""
    return [ast.parse(text).body[0] for indent, text in STATEMENT.findall(path.read_text()) if not indent]


def modules(nodes: list[ast.stmt]) -> set[str]:
    """The modules that imports name, and what they take from them, which may be modules."""
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


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
        if library in map(room, modules(statements(path))):
            at.add(name)
    assert at
    assert {name for name in at if not name.startswith((home, "lab"))} == set()


PROJECT = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
DISTRIBUTIONS = {
    "alsaaudio": "pyalsaaudio", "annotated_types": "pydantic", "libusb_package": "libusb-package",
    "pydantic_core": "pydantic", "pydantic_settings": "pydantic-settings", "tornado": "distributed", "usb": "pyusb",
    "zmq": "pyzmq",
}  # fmt: skip
"""What brings a package of another name: itself, or what depends on it."""
VERB_EXTRAS = {
    "audio-check": ("calibrate", "audio"), "benchmark": ("calibrate",), "calibrate": ("calibrate",),
    "draw": ("calibrate",), "evaluate": ("calibrate",), "plan": ("calibrate",), "quantise": ("train",),
    "reproduce": ("train",), "train": ("train",), "web": ("web",), "wizard": ("calibrate",),
}  # fmt: skip
"""What a verb needs beside the base; the Debian package has all but `train`."""


def packages(found: set[str]) -> set[str]:
    """The distributions that have modules which are neither Python's nor touchd's."""
    tops = {room(name) for name in found} - sys.stdlib_module_names - {"touchd"}
    return {DISTRIBUTIONS.get(top, top) for top in tops}


def listed(extra: str = "") -> set[str]:
    """The distributions that pyproject.toml names for an extra, or for all."""
    lines = PROJECT["optional-dependencies"][extra] if extra else PROJECT["dependencies"]
    return {re.split("[=>]", line)[0] for line in lines}


def needed(verb: str) -> set[str]:
    """The distributions that a verb imports: by its module, anywhere in it, and by what that imports at once."""
    first = f"cli.{verb.replace('-', '_')}"
    seen, waiting, found = set(), [first], set()
    while waiting:
        name = waiting.pop()
        if name in NAMES and name not in seen:
            seen.add(name)
            named = modules(statements(NAMES[name]) if name == first else at_once(NAMES[name]))
            found |= packages(named)
            parts = [each.split(".")[1:] for each in named if room(each) == "touchd"]
            waiting += [".".join(each[: n + 1]) for each in parts for n in range(len(each))]
    return found


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_finds_its_packages(verb: str) -> None:
    """An installation with the extras that a verb needs, such as the Debian package, has all that it imports."""
    assert needed(verb) <= listed().union(*map(listed, VERB_EXTRAS.get(verb, ())))


def test_a_missing_package_is_explained() -> None:
    """Each package that is imported comes with the base, or the command line says with which extra."""
    everything = {name for path in NAMES.values() for name in modules(statements(path))}
    alone = {"h5py"}  # for a script of the lab, of the extra `dev`
    assert packages(everything) - listed() - alone <= {DISTRIBUTIONS.get(name, name) for name in EXTRAS}
    assert {name: extra for name, extra in EXTRAS.items() if DISTRIBUTIONS.get(name, name) not in listed(extra)} == {}


def test_touchd_starts_itself_in_one_way() -> None:
    """In the Debian package, only the launcher knows where touchd lies: `-m touchd` would not find it."""
    at = {name for name, path in NAMES.items() if "sys.executable" in path.read_text()}
    assert at == {"child", "cli.main", "lab.benchmark.steady"}, "one says it in a message, one starts another checkout"
