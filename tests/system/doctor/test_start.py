"""The doctor names what keeps the daemon from starting: both open the same parts by the same code."""

from __future__ import annotations

import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from pydantic.fields import FieldInfo

from tests.command_line import touchd
from tests.extremes import accepted
from touchd.cli.demo import SESSION
from touchd.config.render import fields
from touchd.config.schema import Settings
from touchd.doctor.start import check_start
from touchd.errors import CheckFailed, TouchdError
from touchd.localization.model import default_model_path
from touchd.service import daemon
from touchd.service.daemon import open_parts
from touchd.sources.open import SourceChoice

Tables = dict[str, dict[str, Any]]
KEY = '[[key]]\nname = "{}"\nx_mm = {}\ny_mm = 10\nwidth_mm = {}\nheight_mm = 20\n'


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """A folder with what the set-ups name."""
    (tmp_path / "empty.key_secret").touch(0o600)
    (tmp_path / "open.key_secret").touch(0o644)
    (tmp_path / "big.toml").write_text(KEY.format("1", 0, 500))
    (tmp_path / "over.toml").write_text(KEY.format("1", 10, 50) + KEY.format("2", 30, 50))
    (tmp_path / "text").write_text("text")
    shutil.copy(default_model_path(), tmp_path / "m.onnx")
    (tmp_path / "m.atlas.npz").write_text("text")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as taken:
        taken.bind(str(tmp_path / "taken"))
        taken.listen()
        yield tmp_path


SETUPS: dict[str, tuple[str, Callable[[Path], Tables]]] = {
    "no ONNX": ("model", lambda f: {"model": {"path": f / "text"}}),
    "another atlas": ("model", lambda f: {"model": {"path": f / "m.onnx"}}),
    "address in use": ("bus", lambda f: {"bus": {"bind": [f"ipc://{f}/taken"]}}),
    "one address twice": ("bus", lambda f: {"bus": {"bind": [f"ipc://{f}/bus"] * 2}}),
    "no folder of the bus": ("bus", lambda f: {"bus": {"bind": [f"ipc://{f}/no/bus"]}}),
    "no group of the bus": ("bus", lambda _: {"bus": {"ipc_group": "nosuchgroup"}}),
    "insecure": ("bus", lambda _: {"bus": {"bind": ["tcp://0.0.0.0:0"]}}),
    "no key": ("bus", lambda f: {"bus": {"curve_secret_key": f / "no.key_secret"}}),
    "an empty key": ("bus", lambda f: {"bus": {"curve_secret_key": f / "empty.key_secret"}}),
    "a key open to all": ("bus", lambda f: {"bus": {"curve_secret_key": f / "open.key_secret"}}),
    "no control group": ("control", lambda f: {"control": {"socket": f / "c", "group": "nosuchgroup"}}),
    "no control folder": ("control", lambda f: {"control": {"socket": f / "no" / "c"}}),
    "control is a file": ("control", lambda f: {"control": {"socket": f / "text"}}),
    "control in use": ("control", lambda f: {"control": {"socket": f / "taken"}}),
    "no layout": ("keypad", lambda f: {"keypad": {"layout": f / "no.toml"}}),
    "keys beyond the plate": ("keypad", lambda f: {"keypad": {"layout": f / "big.toml"}}),
    "keys that overlap": ("keypad", lambda f: {"keypad": {"layout": f / "over.toml"}}),
}


def settings_of(folder: Path, tables: Tables) -> Settings:
    bus = {"bind": [f"ipc://{folder}/bus"], **tables.get("bus", {})}
    return Settings.model_validate({**tables, "bus": bus})


@pytest.mark.parametrize("name", SETUPS)
def test_refused(folder: Path, name: str) -> None:
    """What the daemon refuses is a failure of that part, in the same words, and no other part fails."""
    check, tables = SETUPS[name]
    settings = settings_of(folder, tables(folder))
    with pytest.raises(TouchdError) as refusal, ExitStack() as stack:
        open_parts(settings, stack)
    _, findings = check_start(settings, listen_s=0.05)
    assert [finding.check for finding in findings if finding.level == "failure"] == [check]
    (failed,) = (finding for finding in findings if finding.check == check)
    assert refusal.value.what in failed.text
    assert failed.fix == refusal.value.fix


def test_good(folder: Path) -> None:
    """A good set-up passes, and leaves nothing open: the daemon opens the same afterwards."""
    settings = settings_of(folder, {"control": {"socket": folder / "c"}})
    for _ in range(2):
        parts, findings = check_start(settings)
        assert {(finding.check, finding.level) for finding in findings} == {
            ("bus", "ok"), ("control", "ok"), ("model", "ok"),
        }  # fmt: skip
        assert parts.model is not None
    with ExitStack() as stack:
        open_parts(settings, stack)


@pytest.mark.parametrize("name", ["no ONNX", "insecure", "no control group", "keys that overlap"])
def test_before_the_source(folder: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrong setting is refused before the source opens, whose plate may take many seconds to compute."""
    monkeypatch.setattr(daemon, "open_source", lambda *_: pytest.fail("the source was opened"))
    _, tables = SETUPS[name]
    with pytest.raises(TouchdError):
        daemon.run(settings_of(folder, tables(folder)), SourceChoice(simulate="tap"))


def test_command(folder: Path) -> None:
    """`touchd doctor` fails where `touchd` does."""
    config = folder / "touchd.toml"
    config.write_text(f'[bus]\nbind = ["ipc://{folder}/bus"]\n[control]\nsocket = "{folder}/no/c"\n')
    options = ("--config", config, "--replay", SESSION)
    assert touchd(*options, "--speed", "max").code == 10
    ended = touchd("doctor", *options)
    assert ended.code == CheckFailed.exit_code
    assert "failure  control" in ended.out


def test_no_driver(folder: Path) -> None:
    """`touchd doctor --ni` says what an NI rig lacks on this computer."""
    config = folder / "touchd.toml"
    config.write_text(f'[bus]\nbind = ["ipc://{folder}/bus"]\n')
    ended = touchd("doctor", "--config", config, "--ni")
    assert ended.code == CheckFailed.exit_code
    assert "failure  frames" in ended.out
    assert "Traceback" not in ended.err


OPENED = [
    pytest.param(table, key, field, id=f"{table}.{key}")
    for table, key, field in fields()
    if table in ("bus", "control", "keypad") or (table, key) == ("model", "path")
]


@pytest.mark.parametrize(("table", "key", "field"), OPENED)
def test_any_value(folder: Path, table: str, key: str, field: FieldInfo) -> None:
    """Any value that the configuration takes is opened, or refused with an error that says what to do."""
    for settings in accepted(table, key, field):
        bus = settings.bus.model_copy(update={"bind": (f"ipc://{folder}/bus",)} if key != "bind" else {})
        _, findings = check_start(settings.model_copy(update={"bus": bus}), listen_s=0.01)
        assert all(finding.fix for finding in findings if finding.level != "ok")
