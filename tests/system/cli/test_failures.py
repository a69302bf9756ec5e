"""Every failure a user can cause ends in one line that says what, where and what to do, with a status of its own."""

from __future__ import annotations

import errno
import os
import re
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from tests.command_line import touchd
from tests.conftest import Scene
from tests.processes import ROOT, Ended
from tests.system.usb.backend import FakeBus, FakeDaq
from tests.system.usb.reader import INFO
from touchd import errors
from touchd.__main__ import open_streams
from touchd.cli import main as cli
from touchd.cli.main import VERBS, main, missing_extra
from touchd.cli.options import Number
from touchd.config.load import load
from touchd.errors import TouchdError
from touchd.files import state_folder
from touchd.recording.format import write


class World:
    """A folder with files that are wrong in every way."""

    def __init__(self, folder: Path, good: Path) -> None:
        self.folder = folder
        self.good = good
        with np.load(good) as arrays:
            self._arrays = dict(arrays)

    def broken(self, **changes: Any) -> Path:
        """The good recording with some keys replaced."""
        path = self.folder / "broken.npz"
        np.savez(path, **(self._arrays | changes))
        return path

    def plate(self) -> Path:
        """A PLATE.toml with nothing wrong."""
        return self.file(
            "PLATE.toml",
            "[plate]\nwidth_mm = 200\nheight_mm = 200\nthickness_mm = 5\nmaterial = 'glass'\n"
            "[discs]\ndiameter_mm = 6\nemitter_mm = [30, 100]\n"
            "receivers_mm = [[15, 15], [185, 20], [180, 185], [20, 170]]\n",
        )

    def pipe(self, name: str) -> Path:
        """A pipe that nobody writes to."""
        os.mkfifo(self.folder / name)
        return self.folder / name

    def file(self, name: str, content: str | bytes) -> Path:
        path = self.folder / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path


@pytest.fixture(scope="session")
def good(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short recording with nothing wrong."""
    whole = scene("idle")
    path = tmp_path_factory.mktemp("good") / "good.npz"
    names = ("frames", "sequence", "timestamp_ns", "temperature_c")
    write(path, type(whole)(whole.meta, **{name: getattr(whole, name)[:40] for name in names}))
    return path


@pytest.fixture
def world(tmp_path: Path, good: Path) -> World:
    return World(tmp_path, good)


@pytest.fixture
def taken() -> Iterator[str]:
    """An address that another program holds."""
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        yield f"tcp://127.0.0.1:{holder.getsockname()[1]}"


def explained(ended: Ended, error: type[TouchdError], *words: str) -> None:
    """One line on standard error with what to do, the error's own status, and no traceback."""
    assert ended.code == error.exit_code, ended.err
    assert "touchd: " not in ended.out
    (line,) = ended.err.splitlines()
    assert line.startswith("touchd: ")
    assert re.fullmatch(r".+ -> \S.+", line)
    for word in words:
        assert word in line
    assert "Traceback" not in line


Arguments = Callable[[World], tuple[object, ...]]


def replay(make: Callable[[World], object]) -> Arguments:
    return lambda world: ("--replay", make(world), "--bind", f"ipc://{world.folder}/bus", "--speed", "max")


def configured(text: str | bytes) -> Arguments:
    return lambda world: ("--config", world.file("touchd.toml", text), "--replay", world.good)


def bound(*options: object) -> Arguments:
    return lambda world: ("--replay", world.good, "--speed", "max", *options)


CASES: dict[str, tuple[type[TouchdError], Arguments, tuple[str, ...]]] = {
    "a missing recording": (errors.RecordingMissing, replay(lambda w: w.folder / "nowhere.npz"), ("nowhere.npz",)),
    "a folder without chunks": (errors.RecordingMissing, replay(lambda w: w.folder), ("no numbered",)),
    "a truncated recording": (
        errors.RecordingTruncated,
        replay(lambda w: w.file("cut.npz", w.good.read_bytes()[:-5000])),
        ("cut.npz",),
    ),
    "a file that is no recording": (
        errors.RecordingTruncated,
        replay(lambda w: w.file("a.npz", "hello")),
        ("a.npz: is no .npz archive",),
    ),
    "a newer version": (
        errors.RecordingVersion,
        replay(lambda w: w.broken(version=2)),
        ("version 2", "upgrade touchd"),
    ),
    "another format": (errors.RecordingVersion, replay(lambda w: w.broken(format="other")), ("'other'",)),
    "frames of two axes": (
        errors.RecordingShape,
        replay(lambda w: w.broken(frames=np.zeros((40, 1000), np.int16))),
        ("(40, 1000)", "(n, channels, samples)"),
    ),
    "frames of another type": (
        errors.RecordingShape,
        replay(lambda w: w.broken(frames=np.zeros((40, 4, 250)))),
        ("float64", "int16"),
    ),
    "pickled objects": (
        errors.RecordingUnsafe,
        replay(lambda w: w.broken(sequence=np.array([{}] * 40, object))),
        ("sequence",),
    ),
    "a word for a number": (
        errors.RecordingValues,
        replay(lambda w: w.broken(temperature_c=np.full(40, np.nan, np.float32))),
        ("temperature_c", "frame 0"),
    ),
    "time that goes back": (
        errors.RecordingValues,
        replay(lambda w: w.broken(timestamp_ns=np.arange(40, 0, -1))),
        ("timestamp_ns",),
    ),
    "taps without labels": (
        errors.CalibrationError,
        lambda w: (
            "calibrate",
            w.good,
            "-o",
            w.folder / "m.onnx",
            "--taps",
            w.good,
            "--plate",
            w.plate(),
        ),
        ("contacts_mm", "record --label"),
    ),
    "a pipe for a configuration": (
        errors.ConfigError,
        lambda w: ("--config", w.pipe("touchd.toml"), "config"),
        ("touchd.toml", "not a regular file"),
    ),
    "a pipe for PLATE.toml": (
        errors.PlateFileInvalid,
        lambda w: ("plan", w.pipe("PLATE.toml")),
        ("PLATE.toml", "not a regular file"),
    ),
    "a wizard where no socket can be": (
        errors.OutputError,
        lambda w: ("wizard", "--socket", w.folder / "nowhere" / "socket", "--folder", w.folder / "state"),
        ("nowhere/socket", "--socket"),
    ),
    "picture of a card that cannot be written": (
        errors.OutputError,
        lambda w: ("audio-check", "-o", w.folder / "nowhere" / "card.png"),
        ("nowhere",),
    ),
    "a card that is not there": (errors.DeviceLost, lambda _: ("audio-check", "hw:99"), ("no hw:99", "plug it in")),
    "a card whose name a terminal obeys": (
        errors.ConfigError,
        lambda _: ("audio-check", "hw:0\n\x1b[2J"),
        ("audio.device", r"\x1b[2J"),
    ),
    "no card to check": (errors.ConfigError, lambda _: ("audio-check",), ("audio.device", "arecord -L")),
    "a missing model": (errors.ModelMissing, bound("--model", "nowhere.onnx"), ("nowhere.onnx",)),
    "no model": (
        errors.ModelInvalid,
        lambda w: ("--replay", w.good, "--model", w.file("bad.onnx", "hello")),
        ("bad.onnx",),
    ),
    "a model for other frames": (
        errors.ModelMismatch,
        replay(lambda w: w.broken(frames=np.zeros((40, 4, 200), np.int16))),
        ("(4, 250)", "(4, 200)", "touchd train"),
    ),
    "an address beyond loopback": (
        errors.InsecureBind,
        bound("--bind", "tcp://0.0.0.0:5570"),
        ("tcp://0.0.0.0:5570", "keygen"),
    ),
    "no address": (errors.BusError, bound("--bind", "tcp://127.0.0.1:99999"), ("tcp://127.0.0.1:99999",)),
    "nobody who listens": (
        errors.BusTimeout,
        lambda w: ("--replay", w.good, "--bind", f"ipc://{w.folder}/bus", "--await-subscriber", "0.01"),
        ("/bus",),
    ),
    "nobody who publishes": (
        errors.BusTimeout,
        lambda w: ("listen", f"ipc://{w.folder}/bus", "--timeout", "0.01"),
        ("/bus",),
    ),
    "an unknown key": (
        errors.ConfigError,
        configured("[tracker]\nconfirm_frame = 3"),
        ("touchd.toml", "did you mean tracker.confirm_frames?"),
    ),
    "a key out of range": (errors.ConfigError, configured("[health]\nperiod_s = -2"), ("health.period_s", "-2")),
    "invalid TOML": (errors.ConfigError, configured("[gate\n"), ("not valid TOML", "line 1")),
    "a missing configuration": (errors.ConfigError, bound("--config", "nowhere.toml"), ("nowhere.toml",)),
    "a bind that is no address": (errors.ConfigError, bound("--bind", "loopback"), ("'loopback'", "tcp://")),
    "a missing keypad": (
        errors.ConfigError,
        configured('[keypad]\nlayout = "nowhere.toml"'),
        ("nowhere.toml", "keypad.layout"),
    ),
    "no DAQ": (
        errors.DeviceLost,
        lambda w: ("record", "-o", w.folder / "a.npz", "--config", w.file("none.toml", '[device]\nserial = "none"')),
        ("plug it in", "--replay"),
    ),
    "no DAQ to calibrate": (
        errors.DeviceLost,
        lambda w: (
            "calibrate",
            *("-o", w.folder / "m.onnx", "--plate", w.plate()),
            *("--config", w.file("none.toml", '[device]\nserial = "none"\n[control]\nsocket = "none"')),
        ),
        ("plug it in, or name a RECORDING",),
    ),
    "a recording of a name too long for any": (
        errors.RecordingMissing,
        lambda _w: ("web", "--replay", "x" * 5000),
        ("check the path",),
    ),
    "an empty variable for a model": (errors.ModelMissing, bound("--model", ""), ("Is a directory", "check the path")),
    "a root folder for a model": (errors.ModelMissing, lambda _w: ("check", "/", "x.npz"), ("/: cannot be read",)),
    "a model of a name too long for any": (errors.ModelMissing, bound("--model", "x" * 5000), ("check the path",)),
    "two sources": (errors.SourceError, bound("--simulate", "tap"), ("--simulate",)),
    "an unknown scene": (errors.SimulationError, lambda _w: ("--simulate", "dance"), ("'dance'", "swipe")),
    "an output that is there": (
        errors.OutputError,
        lambda w: ("simulate", "idle", "-o", w.file("there.npz", "precious")),
        ("there.npz", "--force"),
    ),
    "a folder that is not there": (
        errors.OutputError,
        lambda w: ("record", "--replay", w.good, "-o", w.folder / "no" / "where.npz"),
        ("/no: ",),
    ),
    "a recording without truth": (
        errors.TrainingError,
        lambda w: ("train", w.good, "-o", w.folder / "new.onnx"),
        ("contacts_mm",),
    ),
    "a model's file by another name": (
        errors.OutputError,
        lambda w: ("train", w.good, "-o", w.folder / "model.txt"),
        ("model.txt", ".onnx"),
    ),
    "a demo without truth": (errors.RecordingValues, lambda w: ("demo", w.good), ("contacts_mm", "--replay")),
    "a speed for a live scene": (
        errors.SourceError,
        lambda _w: ("--simulate", "tap", "--speed", "2"),
        ("--speed 2", "max"),
    ),
    "truth asked of a recording without": (
        errors.RecordingValues,
        lambda w: ("evaluate", ROOT / "models/regression.onnx", w.good),
        ("contacts_mm",),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_failure(case: str, world: World) -> None:
    """A failure is one line with a status of its own."""
    error, arguments, words = CASES[case]
    explained(touchd(*arguments(world)), error, *words)


def test_address_in_use(world: World, taken: str) -> None:
    """An address in use is named."""
    explained(touchd("--replay", world.good, "--bind", taken), errors.AddressInUse, taken)


@pytest.mark.parametrize("verb", ["record", "calibrate"])
def test_busy_daq(verb: str, world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a DAQ that a daemon without a control socket uses, the remedy is the daemon's, not to plug it in."""
    (daq := FakeDaq(INFO)).claim_error = errno.EBUSY
    monkeypatch.setattr("touchd.sources.usb.libusb", lambda: FakeBus(daq))
    output = ("-o", world.folder / "m.onnx", "--plate", world.plate()) if verb == "calibrate" else (
        "-o", world.folder / "a.npz")  # fmt: skip
    config = world.file("touchd.toml", '[control]\nsocket = "none"')
    ended = touchd(verb, *output, "--config", config)
    explained(ended, errors.DeviceBusy, "another program uses it", "-> stop the daemon, or set control.socket")


def test_wrong_variable(world: World) -> None:
    """A wrong environment variable is named, with the right one."""
    ended = touchd("--replay", world.good, TOUCHD_TRACKER__CONFIRM_FRAME="3")
    explained(ended, errors.ConfigError, "TOUCHD_TRACKER__CONFIRM_FRAME", "did you mean TOUCHD_TRACKER__CONFIRM_FRAMES")


def test_all_problems(world: World) -> None:
    """All problems of a configuration are reported at once."""
    config = world.file("touchd.toml", "[tracker]\nreach = 3\n[gate]\nnoise_frames = 1\n")
    explained(touchd("--config", config), errors.ConfigError, "2 problems", "tracker.reach", "gate.noise_frames")


def test_output_kept(world: World) -> None:
    """An existing output stays as it was."""
    for *verb, name in (
        ("record", "--replay", world.good, "there.npz"),
        ("train", world.good, "there.onnx"),
        ("simulate", "idle", "there.npz"),
    ):
        there = world.file(str(name), "precious")
        assert touchd(*verb, "-o", there).code == errors.OutputError.exit_code
        assert there.read_bytes() == b"precious"


@pytest.mark.parametrize(
    "arguments",
    [
        ("draw", "nowhere.npz"),
        ("plan", "nowhere.toml"),
        ("evaluate", "nowhere.onnx", "nowhere.npz"),
        ("simulate", "idle", "--rig", "nowhere.toml"),
        ("reproduce", "nowhere.npz"),
        ("benchmark", "--from", "nowhere.json"),
    ],
)
def test_output_first(arguments: tuple[str, ...], world: World) -> None:
    """An output that cannot be written is refused before anything is read."""
    option = {"evaluate": "--plot", "benchmark": "--json"}.get(arguments[0], "-o")
    explained(touchd(*arguments, option, world.folder / "no" / "x.png"), errors.OutputError, "/no: ", "folder")


def test_plot_format(world: World) -> None:
    """A plot in a format that nothing writes is refused at once."""
    explained(touchd("draw", "nowhere.npz", "-o", world.folder / "x.npz"), errors.OutputError, "x.npz", ".png")


@pytest.mark.parametrize("how", ["--debug", "behind the verb", "TOUCHD_DEBUG"])
def test_debug(how: str, world: World) -> None:
    """With debugging the traceback comes before the line."""
    recording = world.folder / "nowhere.npz"
    cases: dict[str, tuple[tuple[object, ...], dict[str, Any]]] = {
        "--debug": (("--debug", "--replay", recording), {}),
        "behind the verb": (("demo", recording, "--debug"), {}),
        "TOUCHD_DEBUG": (("--replay", recording), {"TOUCHD_DEBUG": "1"}),
    }
    arguments, variables = cases[how]
    ended = touchd(*arguments, **variables)
    assert ended.code == errors.RecordingMissing.exit_code
    assert "Traceback (most recent call last)" in ended.err
    assert ended.err.splitlines()[-1].startswith(f"touchd: {world.folder}/nowhere.npz: ")


def all_errors(of: type[TouchdError] = TouchdError) -> Iterator[type[TouchdError]]:
    for error in of.__subclasses__():
        yield error
        yield from all_errors(error)


def test_statuses() -> None:
    """Every error has a status of its own."""
    codes = [TouchdError.exit_code, *(error.exit_code for error in all_errors())]
    assert len(codes) == len(set(codes))
    # 0 is success, 2 wrong use, 126 and above the shell's.
    assert all(code not in (0, 2) and code < 126 for code in codes)


@pytest.mark.parametrize("debug", [False, True])
def test_internal_error(debug: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """An error that nobody foresaw is called an internal error, and the line says where it comes from."""

    def fail(**_options: Any) -> None:
        raise ZeroDivisionError("by accident")

    monkeypatch.delenv("TOUCHD_DEBUG", raising=False)
    monkeypatch.setattr(cli.touchd, "callback", fail)
    monkeypatch.setattr(cli.touchd, "invoke", lambda _context: fail())
    assert main(["--debug"] if debug else []) == 1
    lines = capsys.readouterr().err.splitlines()
    expected = r"touchd: internal error: ZeroDivisionError\('by accident'\) in touchd/cli/main\.py, line \d+ -> "
    assert re.match(expected, lines[-1])
    assert ("Traceback (most recent call last):" in lines) == debug
    assert debug or len(lines) == 1


def test_full_output(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A full standard output is no internal error, and the process ends without another."""
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["config", "--default"]) == errors.OutputError.exit_code
        full.flush()
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("touchd: standard output: cannot be written (No space left on device) -> ")


def test_no_temporary_files(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A computer with no folder for temporary files is no fault of touchd: the remedy is named."""
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/nonexistent"])  # root may write everywhere
    assert main(["demo"]) == errors.OutputError.exit_code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("touchd: TMPDIR: no folder for temporary files can be written -> name a folder")


def test_full_temporary_files(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A full disk is named by the file that does not fit: it is not the standard output that is full."""

    def fail(_context: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "/tmp/touchd-x/bus")

    monkeypatch.setattr(cli.touchd, "invoke", fail)
    assert main([]) == errors.OutputError.exit_code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("touchd: /tmp/touchd-x/bus: cannot be written (No space left on device) -> ")


@pytest.mark.parametrize("stream", ["stdin", "stdout", "stderr"])
def test_closed_stream(stream: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A standard stream that was closed at the start is one on nothing; the others stay."""
    others = {name: getattr(sys, name) for name in ("stdin", "stdout", "stderr") if name != stream}
    monkeypatch.setattr(sys, stream, None)
    open_streams()
    assert all(getattr(sys, name) is other for name, other in others.items())
    with getattr(sys, stream) as opened:
        assert opened.read() == "" if stream == "stdin" else opened.write("a line\n")


def test_character_that_a_locale_lacks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard output has its escape, and a configuration printed there loads again."""
    printed = tmp_path / "touchd.toml"
    monkeypatch.setenv("TOUCHD_DEVICE__NAME", "10 €")
    with open(printed, "w", encoding="latin-1") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        open_streams()
        assert main(["config"]) == 0
    monkeypatch.delenv("TOUCHD_DEVICE__NAME")
    assert 'name = "10 \\u20ac"' in printed.read_text()
    assert load(printed).device.name == "10 €"


def test_no_home(monkeypatch: pytest.MonkeyPatch) -> None:
    """A user without a home folder is told which variables to set."""

    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", home)
    for name in ("STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(errors.ConfigError, match="set HOME"):
        state_folder("preroll")


def test_interrupted_import(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Ctrl-C while a library in C is imported is no internal error."""

    def imported(**_options: Any) -> None:
        raise ImportError("initialization failed") from KeyboardInterrupt()

    monkeypatch.setattr(cli.touchd, "invoke", lambda _context: imported())
    assert main([]) == 130
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("option", ["--n", "--seed"])
def test_a_number_that_is_too_large(option: str, world: World) -> None:
    """It is refused before PyTorch or the model's description fails of it."""
    ended = touchd("train", world.good, "-o", world.folder / "a.onnx", option, 10**30)
    assert ended.code == 2
    assert option in ended.err


def test_a_file_that_may_not_be_read(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """No option refuses it before the verb, which says what to do and has a status for it."""
    config = world.file("touchd.toml", "[health]\nperiod_s = 2")
    monkeypatch.setattr(os, "access", lambda *_arguments, **_options: False)
    assert touchd("config", "--config", config).code == 0
    for verb in ("", *VERBS):
        command = cli.touchd.get_command(click.Context(cli.touchd), verb) if verb else cli.touchd
        assert command is not None
        for option in command.params:
            assert not isinstance(option.type, click.Path) or option.type.exists or not option.type.readable, (
                option.name
            )


def test_wrong_use() -> None:
    """Wrong use has status 2 and shows the right one."""
    ended = touchd("--sped", "max")
    assert ended.code == 2
    assert ended.out == ""
    assert "--speed" in ended.err
    assert "Traceback" not in ended.err


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (("--speed", "2"), "--speed"),
        (("record", "-o", "a.npz", "--loop"), "--loop"),
        (("--replay", "a.npz", "record", "-o", "b.npz"), "--replay"),
        (("simulate", "tap", "-o", "a.npz", "--code", "12"), "--code"),
        (("simulate", "touches", "-o", "a.npz", "--keypad", "keys.toml"), "--keypad"),
    ],
)
def test_no_effect(arguments: tuple[str, ...], option: str, tmp_path: Path) -> None:
    """An option that has no effect is wrong use, and nothing is written."""
    ended = touchd(*arguments, cwd=tmp_path)
    assert ended.code == 2
    assert option in ended.err.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("speed", ["0", "-1", "nan", "inf", "fast"])
def test_impossible_speed(speed: str, capsys: pytest.CaptureFixture[str]) -> None:
    """An impossible speed is wrong use."""
    assert main(["--speed", speed, "--replay", "nowhere.npz"]) == 2
    assert "a number above 0, or max" in capsys.readouterr().err


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
def test_impossible_number(number: str, capsys: pytest.CaptureFixture[str]) -> None:
    """What is not a finite number is wrong use, of every option that takes a number."""
    assert main(["--await-subscriber", number, "--replay", "nowhere.npz"]) == 2
    assert "--await-subscriber" in capsys.readouterr().err
    context = click.Context(cli.touchd)
    for command in (cli.touchd, *(cli.touchd.get_command(context, verb) for verb in VERBS)):
        assert command is not None
        for option in command.params:
            if isinstance(option.type, click.types.FloatParamType):
                assert isinstance(option.type, Number), f"{command.name} {option.name}"
                with pytest.raises(click.BadParameter):
                    option.type.convert(number, option, context)


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_verb_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Every verb has a help of its own."""
    assert main([verb, "--help"]) == 0
    assert capsys.readouterr().out.startswith(f"Usage: touchd {verb} ")


@pytest.mark.parametrize(
    ("prefix", "fix"), [("/venv", "pip install '.[train]'"), (sys.base_prefix, "run `make setup` in a clone")]
)
def test_missing_extra(prefix: str, fix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing package is installed from a clone: into this environment, or a new one beside the system's Python."""
    monkeypatch.setattr(sys, "prefix", prefix)
    error = missing_extra(ModuleNotFoundError(name="torch.nn"))
    assert fix in error.fix
    assert "touchd[" not in str(error), "a package of that name on the index is not this one"
    with pytest.raises(ModuleNotFoundError):
        missing_extra(ModuleNotFoundError(name="unknown"))


def test_a_library_of_the_system_that_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A package that is there but does not load, as ALSA's without ALSA, is no internal error."""
    why = "libasound.so.2: cannot open shared object file"

    def imported(**_options: Any) -> None:
        raise ImportError(why, name="alsaaudio", path="alsaaudio.so")

    monkeypatch.setattr(cli.touchd, "invoke", lambda _context: imported())
    assert main([]) == errors.MissingExtra.exit_code
    said = capsys.readouterr().err
    assert f"({why}) -> install" in said
