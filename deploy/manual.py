"""Write the manual page and the shell completions of touchd, from its commands.

usage: manual.py STAGE VERSION    STAGE is the folder that stands for /
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import click
from click.shell_completion import BashComplete, FishComplete, ShellComplete, ZshComplete

from touchd.cli.main import VERBS, touchd

HEAD = Path(__file__).parent / "debian" / "touchd.1"
COMPLETIONS: dict[str, type[ShellComplete]] = {
    "usr/share/bash-completion/completions/touchd": BashComplete,
    "usr/share/zsh/vendor-completions/_touchd": ZshComplete,
    "usr/share/fish/vendor_completions.d/touchd.fish": FishComplete,
}


def roff(text: str) -> str:
    """Return text as roff shows it."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-")
    return re.sub(r"(?m)^(?=[.'])", r"\\&", escaped)


def described(command: click.Command, context: click.Context) -> list[str]:
    """Return a command's paragraphs and options."""
    paragraphs = re.split(r"\n\s*\n", (command.help or "").strip())
    lines = ["\n.PP\n".join(roff(" ".join(paragraph.split())) for paragraph in paragraphs)]
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is not None and parameter.name != "help":
            lines += [".TP", f".B {roff(record[0])}", roff(" ".join(record[1].split()))]
    return lines


def page(version: str) -> str:
    """Return the manual page."""
    context = click.Context(touchd, info_name="touchd")
    lines = [".SH OPTIONS", *described(touchd, context), ".SH VERBS"]
    for verb in sorted(VERBS):
        command = touchd.get_command(context, verb)
        assert command is not None
        inner = click.Context(command, info_name=verb, parent=context)
        usage = " ".join(command.collect_usage_pieces(inner))
        lines += [f".SS touchd {verb} {roff(usage)}", *described(command, inner)]
    return HEAD.read_text().replace("@VERSION@", version).replace("@COMMANDS@", "\n".join(lines))


def main(stage: Path, version: str) -> None:
    """Write all files below a folder."""
    texts = {"usr/share/man/man1/touchd.1": page(version)}
    texts |= {name: shell(touchd, {}, "touchd", "_TOUCHD_COMPLETE").source() for name, shell in COMPLETIONS.items()}
    for name, text in texts.items():
        path = stage / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.rstrip() + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
