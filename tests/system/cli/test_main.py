"""The command line as a process: what it imports, what it says where a package is missing, and a reader that leaves."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S, ROOT, Ended, environment
from touchd import errors
from touchd.cli.demo import SESSION
from touchd.cli.main import VERBS


def run(program: str, *arguments: object) -> Ended:
    """Run a program of a few lines in a Python of its own."""
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        capture_output=True, text=True, timeout=PATIENCE_S, cwd=ROOT, env=environment(),
    )  # fmt: skip
    return Ended(done.returncode, done.stdout, done.stderr)


@pytest.mark.parametrize(
    ("verb", "package", "extra"),
    [
        ("train", "torch", "train"),
        ("reproduce", "torch", "train"),
        ("train", "rich", "calibrate"),
        ("train", "scipy", "calibrate"),
        ("draw", "matplotlib", "calibrate"),
    ],
)
def test_missing_packages(verb: str, package: str, extra: str, tmp_path: Path) -> None:
    """A verb whose packages are missing says in one line what to install, and writes nothing."""
    program = f"""
import importlib.abc, sys
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] == {package!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
from touchd.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
    ended = run(program, verb, SESSION, "-o", tmp_path / ("new.onnx" if verb == "train" else "new.png"))
    assert ended.code == errors.MissingExtra.exit_code
    (line,) = ended.err.splitlines()
    assert line.startswith("touchd: ")
    assert package in line
    assert line.endswith(f" -> in a clone of touchd: {sys.executable} -m pip install '.[{extra}]'")
    assert list(tmp_path.iterdir()) == []


def test_help_imports_no_verb() -> None:
    """The help names every verb and imports none, so that the daemon starts without their weight."""
    program = """
import sys
from touchd.cli.main import VERBS, main
main(["--help"])
print(*[name for name in sys.modules if name.removeprefix("touchd.cli.") in VERBS])
"""
    *lines, imported = run(program).out.splitlines()
    assert imported == ""
    assert set(VERBS) <= {line.split()[0] for line in lines if line.startswith("  ") and line.split()}


def test_no_audio_without_its_option(tmp_path: Path) -> None:
    """A daemon that no option gives an audio interface loads nothing of one."""
    program = """
import sys
from touchd.cli.main import main
main(["--config", sys.argv[1], "--replay", sys.argv[2], "--speed", "max"])
print(*[name for name in sys.modules if "audio" in name])
"""
    config = tmp_path / "touchd.toml"
    config.write_text(f'[bus]\nbind = ["ipc://{tmp_path}/bus"]\n[control]\nsocket = ""\n')
    ended = run(program, config, SESSION)
    assert ended.code == 0, ended.err
    assert ended.out.splitlines() == [""]


def test_reader_leaves() -> None:
    """A reader that has had enough of the output is no failure, and nothing is said of it."""
    process = subprocess.Popen(
        f"{sys.executable} -m touchd config --default | head -n 1",
        shell=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, env=environment(),
    )  # fmt: skip
    out, err = process.communicate(timeout=PATIENCE_S)
    assert len(out.splitlines()) == 1
    assert err == ""
