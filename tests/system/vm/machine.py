"""A Debian of its own in an emulated machine: made once, handed files, booted, and asked what it saw."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from tests.needs import need, need_tool
from tests.processes import ROOT

HERE = Path(__file__).parent
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
BOOT_S = 2400
Found = dict[str, str]


def made(kind: str) -> Path:
    """The folder of a machine, `vm` or `kiosk`; older versions of it are removed."""
    need(os.geteuid() == 0, "making the machine's disk needs root")
    for tool, package in (("qemu-system-x86_64", "qemu-system-x86"), ("mmdebstrap", "mmdebstrap")):
        need_tool(tool, package)
    kept = CACHE / f"touchd-{kind}"
    kept.mkdir(parents=True, exist_ok=True)
    recipe = HERE / "image.sh"
    path = kept / hashlib.sha256(recipe.read_bytes()).hexdigest()[:16]
    if not path.is_dir():
        for older in kept.iterdir():
            shutil.rmtree(older)
        began_s = time.monotonic()
        done = subprocess.run(["bash", recipe, path, kind], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        print(f"the machine was made in {time.monotonic() - began_s:.0f} s")
    return path


def handed_in(folder: Path, script: Path, *files: Path) -> Path:
    """Put the package, the script that the machine runs and its files into a folder."""
    folder.chmod(0o755)
    built = subprocess.run(
        ["bash", ROOT / "deploy/build-deb.sh", sys.executable], capture_output=True, text=True, cwd=ROOT
    )
    assert built.returncode == 0, built.stderr
    # Not compressed, and compiled: an emulated processor would unpack, and then compile, for minutes.
    plain = folder / "plain"
    subprocess.run(["dpkg-deb", "--raw-extract", ROOT / built.stdout.split()[-1], plain], check=True)
    for shared in ("doc/touchd/examples/listen.py", "man/man1/touchd.1.gz", "bash-completion/completions/touchd"):
        assert (plain / "usr/share" / shared).is_file(), "the machine's dpkg leaves documentation out"
    library = plain / "usr/lib/touchd"
    compiling = [sys.executable, "-m", "compileall", "-q", "-j", "0", "-p", "/usr/lib/touchd"]
    subprocess.run([*compiling, "-s", str(library), str(library)], check=True)
    subprocess.run(["dpkg-deb", "--root-owner-group", "-Znone", "--build", plain, folder], check=True)
    shutil.rmtree(plain)
    shutil.copy(script, folder / "run.sh")
    for file in files:
        shutil.copy(file, folder)
    return folder


def boot(image: Path, host: Path, logs: tuple[str, ...], *options: str, limit_s: int = BOOT_S) -> Found:
    """Let the machine run its script; what it found, by name. Its logs are printed."""
    began_s = time.monotonic()
    command = ["timeout", str(limit_s), "bash", str(HERE / "boot.sh"), str(image), str(host), *options]
    done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    print(f"the machine ran for {time.monotonic() - began_s:.0f} s")
    names = ("console.log", "out.log", "journal.log", *logs)
    texts = [path.read_text(errors="replace") for name in names if (path := host / name).exists()]
    log = "\n".join([done.stderr, *texts])
    print(log)
    assert (host / "status").exists(), f"the machine did not come to its end: {log}"
    lines = (host / "found.txt").read_text().splitlines()
    return {name: value.strip() for name, _, value in (line.partition(" ") for line in lines)}
