"""The pages tell the truth: generated ones are current, links lead somewhere, commands parse, examples run."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import onnx
import pytest
from click.testing import CliRunner
from matplotlib.image import imread
from onnx import TensorProto, helper

from tests.unit.test_house import FLOORS
from touchd.cli.main import VERBS, touchd
from touchd.client import Subscriber
from touchd.config.load import load
from touchd.config.schema import BusSettings, Settings
from touchd.errors import TouchdError
from touchd.event import Contact, HealthEvent, TouchEvent
from touchd.frame import Acquisition, Frame, Plate
from touchd.localization.model import METADATA_KEY, Description
from touchd.service.reload import RESTART_ONLY
from touchd.sinks.zeromq import ZeromqSink
from touchd.sources.source import EndOfStream, Source

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")] + sorted(DOCS.glob("*.md"))
PATIENCE_S = 60.0


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> list[tuple[str, str]]:
    """The fenced blocks of a page: language and text."""
    return re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE)


def prose(page: Path) -> str:
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def inline_code(page: Path) -> list[str]:
    return re.findall(r"`([^`\n]+)`", prose(page))


def shell_lines(page: Path) -> Iterator[str]:
    """What a reader would type: the lines of shell blocks, without prompt and with continued lines joined."""
    for language, text in blocks(page):
        if language in ("", "console", "sh", "bash"):
            for line in text.replace("\\\n", " ").splitlines():
                yield re.sub(r"^(\$ |# )", "", line)


def touchd_lines(page: Path) -> Iterator[str]:
    """Those that start touchd, from a path or not."""
    for line in shell_lines(page):
        if Path((line.split() or [""])[0]).name == "touchd":
            yield line


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def subclasses(cls: type[TouchdError]) -> Iterator[type[TouchdError]]:
    for child in cls.__subclasses__():
        yield child
        yield from subclasses(child)


# -- generated pages ---------------------------------------------------------------------------------


def test_generated_pages_are_current() -> None:
    check = subprocess.run([sys.executable, "-m", "docs.generate", "--check"], cwd=ROOT, capture_output=True, text=True)
    assert check.returncode == 0, check.stderr


def test_the_default_configuration_file_holds_the_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.upper().startswith("TOUCHD_")]:
        monkeypatch.delenv(name)
    assert load(ROOT / "deploy" / "touchd.toml") == Settings()


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_is_described(verb: str) -> None:
    assert re.search(rf"(?m)^- \*\*{verb}\*\*( `.*`)?: \w", (DOCS / "cli.md").read_text())


@pytest.mark.parametrize("error", list(subclasses(TouchdError)), ids=lambda error: error.__name__)
def test_every_failure_is_listed_with_its_exit_status(error: type[TouchdError]) -> None:
    page = (DOCS / "troubleshooting.md").read_text()
    assert re.search(rf"(?m)^- (.*[,;] )?{error.exit_code} `{error.__name__}`", page)


def test_readme_picture(tmp_path: Path) -> None:
    """The picture in the README is what its command draws today.

    Fonts differ between computers, and text is grey: only coloured pixels count, those of the contacts. Three in a
    hundred of them may differ, by antialiasing; what another model or pipeline draws differs in fifteen.
    """
    drawn = tmp_path / "session.png"
    (command,) = (code for code in inline_code(ROOT / "README.md") if code.startswith("touchd draw"))
    recording, shown = command.split()[2], command.split()[-1]
    result = CliRunner().invoke(touchd, ["draw", str(ROOT / recording), "-o", str(drawn)])
    assert result.exit_code == 0, result.output
    ours, theirs = (imread(path)[..., :3] for path in (drawn, ROOT / shown))
    assert ours.shape == theirs.shape
    coloured = (np.ptp(ours, axis=2) > 0.1) | (np.ptp(theirs, axis=2) > 0.1)
    differs = np.abs(ours - theirs).max(axis=2) > 0.1
    assert coloured.sum() > 5000
    assert differs[coloured].mean() < 0.03, "run make docs, and look at the picture"


def pictures(page: Path) -> set[Path]:
    return {page.parent / link for link in re.findall(r"\]\(([^)\s]+\.png)\)", prose(page))}


def test_every_picture_is_shown() -> None:
    """No picture in docs/ is left over."""
    assert set(DOCS.rglob("*.png")) == {picture.resolve() for page in PAGES for picture in pictures(page)}


PER_READER = ("integrator", "developer", "plate-maker", "lab")
MEASURED = ("accuracy", "robustness", "benchmarks", "reproduction")
WORDS_OF_A_PAGE = 1200


@pytest.mark.parametrize("reader", PER_READER)
def test_page_of_a_reader(reader: str) -> None:
    """Each reader's page is linked from the README, and short enough to be read to its end."""
    assert f"(docs/{reader}.md)" in (ROOT / "README.md").read_text()
    assert len((DOCS / f"{reader}.md").read_text().split()) <= WORDS_OF_A_PAGE


@pytest.mark.parametrize("name", MEASURED)
def test_measured_page(name: str) -> None:
    """A measured page says that no finger on a real plate was measured, and shows only what one decides by."""
    page = (DOCS / f"{name}.md").read_text()
    assert re.search(r"\*\*(no|none of a) finger\s+on a\s+real plate", page, re.IGNORECASE)
    assert len(page.split()) <= WORDS_OF_A_PAGE


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_page_can_be_reached(page: Path) -> None:
    """Links lead to each page from the README."""
    reached, fresh = set(), {ROOT / "README.md"}
    while fresh:
        reached |= fresh
        links = {(at.parent / link).resolve() for at in fresh for link in re.findall(r"\]\(([^)#\s]+\.md)", prose(at))}
        fresh = links.intersection(PAGES) - reached
    assert page in reached


@pytest.mark.parametrize("room", [room for floor in FLOORS for room in floor])
def test_every_room_is_described(room: str) -> None:
    """Contributors find each room of the house."""
    house = (ROOT / "CONTRIBUTING.md").read_text().split("## The house")[1].split("## ")[0]
    assert re.search(rf"`{room}(\.py)?`", house)


@pytest.mark.parametrize("name", sorted(RESTART_ONLY))
def test_what_waits_for_a_restart_is_listed(name: str) -> None:
    """Integrators see which settings a reload does not take over."""
    (reload,) = re.findall(r"^\*\*Reload\*\*.*?^$", (DOCS / "integrator.md").read_text(), re.DOTALL | re.MULTILINE)
    assert f"`{name}`" in reload or f"`[{name}]`" in reload


RIDDLES = ("take note", "told of", "anew", "hand on", "by itself", "what it is", "so long", "whatever", "is none")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_plain_words(page: Path) -> None:
    """Pages speak plainly; what is generated from the code speaks as the code does."""
    if page.name in ("cli.md", "configuration.md"):
        return
    text = re.sub(r"<!-- (\S+):begin -->.*?<!-- \1:end -->", "", prose(page), flags=re.DOTALL).lower()
    assert [riddle for riddle in RIDDLES if re.search(rf"\b{riddle}\b", text)] == []


# -- references --------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{page.name}: {link}"
        assert not anchor or anchor in anchors(target), f"{page.name}: {link}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_make_target_exists(page: Path) -> None:
    targets = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for line in (*shell_lines(page), *inline_code(page)):
        words = line.split()
        if words[:1] == ["make"] and words[1:]:
            assert words[1] in targets, line


def parse(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let click parse a command line without running it."""
    monkeypatch.setattr(click.Command, "invoke", lambda _self, _ctx: None)
    arguments = shlex.split(line.split(" | ")[0], comments=True)
    touchd.main(args=arguments[1:], prog_name="touchd", standalone_mode=False)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_command_line_parses(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for line in touchd_lines(page):
        parse(line, monkeypatch)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_named_in_the_text_have_verbs_and_options_that_exist(
    page: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for code in inline_code(page):
        if code.split()[:1] == ["touchd"] and code.split()[1:]:
            try:
                parse(code, monkeypatch)
            except click.MissingParameter:
                pass  # the text need not name every argument
            except click.UsageError as error:
                pytest.fail(f"{code}: {error.format_message()}")


# -- examples ----------------------------------------------------------------------------------------


def python_block(page: Path) -> str:
    (block,) = (text for language, text in blocks(page) if language == "python")
    return block


def test_the_format_s_example_reads_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NumPy alone reads a recording, as the page of formats shows it."""
    (tmp_path / "session.npz").symlink_to(ROOT / "touchd" / "demo" / "session.npz")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(python_block(DOCS / "formats.md"), "formats.md", "exec"), names)
    assert names["counts"].ndim == 3
    assert names["meta"]["plate"]["width_mm"] == 200


def test_the_readme_s_subscriber_prints_touches(tmp_path: Path) -> None:
    sink = ZeromqSink(BusSettings(bind=("tcp://127.0.0.1:*",)))
    program = python_block(ROOT / "README.md")
    assert "Subscriber()" in program
    file = tmp_path / "subscriber.py"
    file.write_text(program.replace("Subscriber()", f'Subscriber("{sink.addresses[0]}")'))
    with subprocess.Popen([sys.executable, file], stdout=subprocess.PIPE, text=True) as listener:
        guard = threading.Timer(PATIENCE_S, listener.kill)
        guard.start()
        try:
            sink.wait_for_subscriber(PATIENCE_S)
            contacts = [Contact(7, "down", 12.34, 56.78, 0.5, 1.5, 0.99, 0.0, 0.0)]
            sink.publish(TouchEvent("plate", 1, 1, "2025-01-01T00:00:00.000000Z", 1, contacts), 0)
            assert listener.stdout is not None
            assert listener.stdout.readline() == "7 down 12.3 56.8 mm\n"
        finally:
            guard.cancel()
            listener.kill()
            sink.close()


RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
EXAMPLE = DOCS / "examples" / "pipe_daemon.py"


def frame_bytes(sequence: int) -> bytes:
    counts = np.full(RIG.shape, sequence, np.int16)
    return sequence.to_bytes(8, "little") + counts.astype("<i2").tobytes()


@pytest.fixture
def pipe_source() -> Iterator[tuple[Any, Any]]:
    """The example's source on a pipe, and the pipe's other end."""
    names: dict[str, Any] = {"__name__": "pipe_daemon"}
    exec(compile(EXAMPLE.read_text(), "pipe_daemon.py", "exec"), names)
    read_end, write_end = os.pipe()
    with open(read_end, "rb", buffering=0) as pipe, open(write_end, "wb", buffering=0) as device:
        yield names["PipeSource"](pipe, RIG), device


def test_the_example_source_keeps_the_promises_of_a_source(pipe_source: tuple[Any, Any]) -> None:
    source: Source = pipe_source[0]
    device = pipe_source[1]
    assert source.acquisition == RIG
    assert source.read(0.0) is None
    device.write(frame_bytes(7)[:1000])
    assert source.read(0.01) is None
    device.write(frame_bytes(7)[1000:] + frame_bytes(9))
    for sequence in (7, 9):
        frame = source.read(1.0)
        assert isinstance(frame, Frame)
        assert frame.sequence == sequence
        assert frame.counts.dtype == np.int16
        assert frame.counts.shape == RIG.shape
        assert (frame.counts == sequence).all()
        assert frame.received_ns - frame.t_ns == 1_000_000
    device.close()
    with pytest.raises(EndOfStream):
        source.read(1.0)
    source.close()
    source.close()
    with pytest.raises(EndOfStream):
        source.read(1.0)


def write_blind_model(path: Path) -> None:
    """Write the smallest model there is: it never sees a finger."""
    nodes = []
    for name, size in (("position_mm", 2), ("sigma_mm", 1), ("confidence", 1)):
        zeros = helper.make_tensor(f"zeros_{name}", TensorProto.FLOAT, (392, size), np.zeros(392 * size))
        nodes += [
            helper.make_node("Constant", [], [f"zeros_{name}"], value=zeros),
            helper.make_node("MatMul", ["features", f"zeros_{name}"], [name]),
        ]
    graph = helper.make_graph(
        nodes,
        "blind",
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, ("n", 392))],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, ("n", size))
            for name, size in (("position_mm", 2), ("sigma_mm", 1), ("confidence", 1))
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    description = Description(
        name="blind", head="regression", domain="frequency", input="residual",
        acquisition=RIG, plate=Plate(width_mm=200, height_mm=200),
    )  # fmt: skip
    helper.set_model_props(model, {METADATA_KEY: description.model_dump_json()})
    onnx.save(model, path)


def test_the_example_is_a_whole_daemon(tmp_path: Path) -> None:
    program, model = tmp_path / "pipe_daemon.py", tmp_path / "blind.onnx"
    program.write_text(EXAMPLE.read_text())
    write_blind_model(model)
    settings = {name: value for name, value in os.environ.items() if not name.upper().startswith("TOUCHD_")}
    with tempfile.TemporaryDirectory(prefix="touchd-") as folder:
        address = f"ipc://{folder}/bus"
        settings |= {"TOUCHD_BUS__BIND": address, "TOUCHD_MODEL__PATH": str(model)}
        with (
            subprocess.Popen([sys.executable, program], stdin=subprocess.PIPE, env=settings) as daemon,
            Subscriber(address, ("health",), PATIENCE_S) as events,
        ):
            guard = threading.Timer(PATIENCE_S, daemon.kill)
            guard.start()
            try:
                assert daemon.stdin is not None
                health = next(iter(events))
                for sequence in (*range(1, 11), *range(13, 41)):
                    daemon.stdin.write(frame_bytes(sequence))
                daemon.stdin.close()
                while not (isinstance(health, HealthEvent) and health.state == "stopping"):
                    health = next(events)
                assert (health.frames, health.lost, health.skipped["learning"]) == (38, 2, 32)  # learn_frames
                assert health.model == "blind"
                assert daemon.wait(PATIENCE_S) == 0
            finally:
                guard.cancel()
                daemon.kill()
