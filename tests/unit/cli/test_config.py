"""`touchd config` prints what is in effect, and nothing that could not be loaded."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from touchd.cli.config import command
from touchd.cli.main import main
from touchd.config.load import load
from touchd.config.render import render
from touchd.config.schema import DeviceSettings, Settings
from touchd.errors import ConfigError
from touchd.localization.model import default_model_path

KEY = '[[key]]\nname = "{}"\nx_mm = {}\ny_mm = 10\nwidth_mm = {}\nheight_mm = 20\n'

pytestmark = pytest.mark.usefixtures("own_settings")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "touchd.toml"
    path.write_text("[device]\nrate_hz = 60\n")
    return path


def test_effective(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It prints the defaults as changed by file and environment."""
    monkeypatch.setenv("TOUCHD_DEVICE__NAME", "door")
    result = CliRunner().invoke(command, ["--config", str(file)])
    assert result.exit_code == 0
    printed = tmp_path / "printed.toml"
    printed.write_text(result.output)
    monkeypatch.delenv("TOUCHD_DEVICE__NAME")
    assert load(printed) == Settings(device=DeviceSettings(rate_hz=60, name="door"))


@pytest.mark.parametrize("verb", ["input", "map", "screen off", "tuio", "web"])
@pytest.mark.parametrize("order", ["{verb} --config {file}", "--config {file} {verb}"])
def test_file_on_either_side(verb: str, order: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A verb takes the file before it or behind it."""
    missing = tmp_path / "none.toml"
    assert main(order.format(verb=verb, file=missing).split()) == ConfigError.exit_code
    assert f"{missing}: no such file" in capsys.readouterr().err


def test_retired(tmp_path: Path) -> None:
    """A key of an earlier version is named beside what is printed."""
    path = tmp_path / "touchd.toml"
    path.write_text("[realtime]\nnice = -10\n")
    result = CliRunner().invoke(command, ["--config", str(path)])
    assert (result.exit_code, result.stdout) == (0, render(Settings()))
    assert f"{path}: realtime.nice: a setting that is gone is ignored; instead: Nice=" in result.stderr


def test_file_before_verb(file: Path) -> None:
    """The file named before the verb counts, too."""
    assert "\nrate_hz = 60\n" in CliRunner().invoke(command, [], obj={"config": file}).output


def test_defaults(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`--default` prints the defaults and ignores file and environment."""
    monkeypatch.setenv("TOUCHD_DEVICE__NAME", "door")
    assert CliRunner().invoke(command, ["--default", "--config", str(file)]).output == render(Settings())


def test_wrong_file(tmp_path: Path) -> None:
    """A wrong file is explained, and nothing is printed."""
    result = CliRunner().invoke(command, ["--config", str(tmp_path / "nowhere.toml")])
    assert isinstance(result.exception, ConfigError)
    assert result.output == ""


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (None, "cannot be read"),
        ([(0, 500)], "beyond the plate of 200 x 200 mm: '0'"),
        ([(10, 50), (30, 50)], "'0' and '1' overlap"),
    ],
)
def test_wrong_layout(tmp_path: Path, keys: list[tuple[int, int]] | None, message: str) -> None:
    """Keys that do not fit the model's plate are named, and nothing is printed."""
    layout, file = tmp_path / "keys.toml", tmp_path / "touchd.toml"
    file.write_text(f'[keypad]\nlayout = "{layout}"\n[model]\npath = "{default_model_path()}"\n')
    if keys is not None:
        layout.write_text("".join(KEY.format(i, *key) for i, key in enumerate(keys)))
    result = CliRunner().invoke(command, ["--config", str(file)])
    assert isinstance(result.exception, ConfigError)
    assert message in str(result.exception)
    assert result.output == ""


def test_layout_before_a_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keys of a plate that has no model yet are taken, as the daemon takes them, unless they are wrong on any plate."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))  # no model is installed
    layout, file = tmp_path / "keys.toml", tmp_path / "touchd.toml"
    layout.write_text(KEY.format("far", 700, 20))
    for model in ("", tmp_path / "none.onnx"):
        file.write_text(f'[keypad]\nlayout = "{layout}"\n[model]\npath = "{model}"\n')
        result = CliRunner().invoke(command, ["--config", str(file)])
        assert (result.exit_code, result.stdout) == (0, render(load(file)))
    layout.write_text(KEY.format(1, 10, 50) + KEY.format(2, 30, 50))
    assert isinstance(CliRunner().invoke(command, ["--config", str(file)]).exception, ConfigError)


def test_keypad_without_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A keypad that could type nothing is a mistake; a model may bring its keys later."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))  # no model is installed
    file = tmp_path / "touchd.toml"
    file.write_text(f'[input]\nkeypad = true\n[model]\npath = "{default_model_path()}"\n')
    result = CliRunner().invoke(command, ["--config", str(file)])
    assert str(result.exception) == "input.keypad: there are no keys to type -> set keypad.layout"
    file.write_text("[input]\nkeypad = true\n")
    assert CliRunner().invoke(command, ["--config", str(file)]).exit_code == 0
