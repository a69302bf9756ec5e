"""deploy/install.sh: a second run brings up to date, what an administrator wrote stays, and nothing is left behind.

The environment is a real one, by Debian's python3 and pip, under a folder that stands for `/`; only the packages that
touchd needs are left out, which would take a minute.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.needs import need
from tests.processes import ROOT

SCRIPT = ROOT / "deploy/install.sh"
MADE = {
    "opt/touchd", "etc/systemd/system/touchd.service", "etc/systemd/system/touchd-input.service",
    "etc/systemd/system/touchd-tuio.service", "etc/systemd/system/touchd-web.service",
    "etc/systemd/system/touchd-wizard.service", "etc/systemd/system/touchd-mapping.service",
    "etc/systemd/system/touchd-mapping.path",
    "etc/udev/rules.d/60-touchd.rules", "etc/sysusers.d/touchd.conf", "etc/tmpfiles.d/touchd.conf",
    "usr/local/bin/touchd",
}  # fmt: skip


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheels")
    pip = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "wheel", "--no-deps")
    subprocess.run([*pip, "--no-build-isolation", "--wheel-dir", folder, "."], check=True, cwd=ROOT)
    return folder


def run(root: Path, *options: object, code: int = 0) -> str:
    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment = {**own, "DESTDIR": str(root), "PIP_NO_DEPS": "1"}
    done = subprocess.run(["bash", SCRIPT, *map(str, options)], capture_output=True, text=True, env=environment)
    assert done.returncode == code, done.stderr
    return done.stdout + done.stderr


def files(root: Path) -> set[str]:
    """Everything but folders, the environment as one."""
    found = {str(path.relative_to(root)) for path in root.rglob("*") if not path.is_dir() or path.is_symlink()}
    return {"opt/touchd" if name.startswith("opt/touchd/") else name for name in found}


def test_life(tmp_path: Path, wheels: Path) -> None:
    """It installs, updates and removes, and keeps what an administrator wrote."""
    venv = subprocess.run(["/usr/bin/python3", "-c", "import ensurepip, venv"], capture_output=True)
    need(venv.returncode == 0, "Debian's python3 has no venv: apt install python3-venv")
    config = tmp_path / "etc/touchd/touchd.toml"
    run(tmp_path, "--wheels", wheels)
    first = files(tmp_path)
    assert first == MADE | {"etc/touchd/touchd.toml.default"}
    for name in (
        "touchd.service",
        "touchd-input.service",
        "touchd-tuio.service",
        "touchd-web.service",
        "touchd-wizard.service",
        "touchd-mapping.service",
        "touchd-mapping.path",
    ):
        unit = (tmp_path / "etc/systemd/system" / name).read_text()
        assert unit == (ROOT / "deploy" / name).read_text().replace("/usr/bin/touchd", "/opt/touchd/bin/touchd")
    assert os.readlink(tmp_path / "usr/local/bin/touchd") == "/opt/touchd/bin/touchd"
    examples = tmp_path / "opt/touchd/share/doc/touchd/examples"
    assert 'ExecStart=/opt/touchd/bin/touchd --audio ""' in (examples / "audio.conf").read_text()
    assert (examples / "realtime.conf").read_text() == (ROOT / "deploy/realtime.conf").read_text()
    # The environment names the place where it will be, not the one where it was made.
    script = (tmp_path / "opt/touchd/bin/touchd").read_text()
    assert script.startswith("#!/opt/touchd/bin/python")
    imported = "import touchd; print(touchd.__file__)"
    python = tmp_path / "opt/touchd/bin/python"
    said = subprocess.run(
        [python, "-I", "-c", imported], capture_output=True, text=True, cwd=tmp_path, check=True
    ).stdout
    assert said.startswith(str(tmp_path / "opt/touchd/lib"))

    config.write_text("# mine\n")
    (tmp_path / "opt/touchd/left-over").touch()
    run(tmp_path, "--wheels", wheels)
    assert files(tmp_path) == first | {"etc/touchd/touchd.toml"}
    assert config.read_text() == "# mine\n"
    assert not (tmp_path / "opt/touchd/left-over").exists()

    run(tmp_path, "--uninstall")
    assert files(tmp_path) == {"etc/touchd/touchd.toml", "etc/touchd/touchd.toml.default"}
    key = tmp_path / "etc/touchd/keys/server.key_secret"
    key.parent.mkdir()
    key.touch()
    run(tmp_path, "--uninstall", "--purge")
    assert files(tmp_path) == {"etc/touchd/keys/server.key_secret"}
    shutil.rmtree(key.parent)
    run(tmp_path, "--uninstall", "--purge")
    assert not config.parent.exists()


def test_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installation that fails leaves the old one."""
    (tmp_path / "opt/touchd/bin").mkdir(parents=True)
    (tmp_path / "opt/touchd/bin/touchd").write_text("the old one")
    monkeypatch.setenv("PYTHON", "/bin/false")
    assert "/bin/false is older than 3.11" in run(tmp_path, code=1)
    assert (tmp_path / "opt/touchd/bin/touchd").read_text() == "the old one"


@pytest.mark.parametrize("option", ["--uninstall", ""])
def test_one_at_a_time(tmp_path: Path, option: str) -> None:
    """A second one touches nothing while the first is at work."""
    half_made = tmp_path / "opt/touchd.new/bin/touchd"
    half_made.parent.mkdir(parents=True)
    half_made.touch()
    with subprocess.Popen(["flock", tmp_path / "opt", "sh", "-c", "echo; cat"], stdin=-1, stdout=-1) as first:
        assert first.stdout is not None
        first.stdout.readline()
        assert "another install.sh is at work" in run(tmp_path, *filter(None, [option]), code=1)
        assert files(tmp_path) == {"opt/touchd.new/bin/touchd"}
        first.communicate()
    run(tmp_path, "--uninstall")
    assert files(tmp_path) == set(), "what an interrupted one left behind"


def test_unknown_option(tmp_path: Path) -> None:
    """An unknown option is refused."""
    assert "unknown option --frobnicate" in run(tmp_path, "--frobnicate", code=1)
    assert files(tmp_path) == set()
