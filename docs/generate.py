"""Write the pages that are made from the code: settings, command line, exit codes and the shipped model's scores.

`python docs/generate.py` writes what is stale. With `--check` it only names it, and exits with 1 if there is any.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from click.testing import CliRunner

from touchd import cli, configtext, errors
from touchd.config import Settings
from touchd.model import Model

ROOT = Path(__file__).resolve().parent.parent
MODEL = ROOT / "models" / "regression.onnx"
WIDTH = 100
SCORES = {"rmse_mm": "RMSE", "median_mm": "median", "p95_mm": "95th percentile"}


def pages() -> dict[Path, str]:
    """Return every generated file with the text it shall have."""
    readme, troubleshooting = ROOT / "README.md", ROOT / "docs" / "troubleshooting.md"
    return {
        ROOT / "docs" / "configuration.md": configtext.markdown(),
        ROOT / "docs" / "cli.md": command_line(),
        ROOT / "deploy" / "touchd.toml": configtext.render(Settings()),
        readme: with_block(readme.read_text(), "results", results()),
        troubleshooting: with_block(troubleshooting.read_text(), "exit-codes", exit_codes()),
    }


def command_line() -> str:
    """Return the reference of the command line: the help of the daemon and of every verb."""
    lines = [
        "# Command line",
        "",
        "<!-- Generated from the commands' own help by docs/generate.py: do not edit. -->",
        "",
        "`touchd` without a verb is the daemon. Each failure has an exit status of its own: see",
        "[troubleshooting.md](troubleshooting.md#exit-status). Options of the daemon win over the",
        "[configuration](configuration.md).",
    ]
    for verb in ("", *sorted(cli.VERBS)):
        title = f"touchd {verb}".rstrip()
        lines += ["", f"## {title}", "", "```text", help_of(verb), "```"]
    return "\n".join(lines) + "\n"


def help_of(verb: str) -> str:
    """Return the help text of a verb, or of the daemon if it is empty."""
    arguments = [verb, "--help"] if verb else ["--help"]
    result = CliRunner().invoke(cli.touchd, arguments, prog_name="touchd", terminal_width=WIDTH)
    if result.exit_code:
        raise SystemExit(f"touchd {verb} --help fails: {result.exception!r}")
    return "\n".join(line.rstrip() for line in result.output.rstrip().splitlines())


def exit_codes() -> str:
    """Return the table of exit statuses, from the tree at the top of `touchd.errors`."""
    tree = re.findall(r"─ (\w+) +(\d+) +(.+)", errors.__doc__ or "")
    lines = ["| status | class | when, and what helps |", "|---|---|---|"]
    return "\n".join([*lines, *(f"| {status} | `{name}` | {text} |" for name, status, text in tree)])


def results() -> str:
    """Return the table of the shipped model's scores, as the model itself states them; empty without a model."""
    if not MODEL.is_file():
        return ""
    description = Model(MODEL).description
    scores = description.scores
    plate = description.plate
    size = f"{plate.width_mm:g} x {plate.height_mm:g} x {plate.thickness_mm:g} mm"
    lines = [
        f"| `models/{MODEL.name}`: {plate.material}, {size} | error of the position |",
        "|---|---|",
        *(f"| {name} | {scores[key]:.2f} mm |" for key, name in SCORES.items()),
        f"| touches scored, none of them seen in training | {scores['n']:.0f} |",
    ]
    if description.command:
        lines += ["", f"Made by `{description.command}`."]
    return "\n".join(lines)


def with_block(text: str, name: str, content: str) -> str:
    """Return a page with the content between the marks of a block replaced."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    before, rest = text.split(begin)
    _, after = rest.split(end)
    return f"{before}{begin}\n{content}{chr(10) if content else ''}{end}{after}"


def main(arguments: list[str]) -> int:
    """Write or check all pages, and return the exit status."""
    stale = [path for path, text in pages().items() if not path.is_file() or path.read_text() != text]
    if arguments == ["--check"]:
        for path in stale:
            print(f"{path.relative_to(ROOT)} is stale: run make docs", file=sys.stderr)
        return 1 if stale else 0
    if arguments:
        print("usage: python docs/generate.py [--check]", file=sys.stderr)
        return 2
    for path, text in pages().items():
        if path in stale:
            path.write_text(text)
            print(f"{path.relative_to(ROOT)} written")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
