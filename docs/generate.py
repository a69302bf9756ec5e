"""Write the pages made from code and data: settings, command line, exit codes, scores, tables of the measured pages.

`python -m docs.generate` writes what is stale. With `--check` it only names it, and exits with 1 if there is any.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click
import onnx

from docs import settings
from docs.tables import BLOCKS
from touchd import errors
from touchd.cli import main as cli
from touchd.config import render as configtext
from touchd.config.schema import Settings
from touchd.lab.benchmark import page as benchmarks
from touchd.lab.benchmark import results as runs
from touchd.lab.benchmark.estimators import cost_of
from touchd.lab.reproduction import report as reproduction
from touchd.localization.model import Model

ROOT = Path(__file__).resolve().parent.parent
MODELS = ROOT / "models"
MODEL = MODELS / "regression.onnx"
CARD = ("n", "rmse_mm", "mean_mm", "sd_mm", "median_mm", "p95_mm", "max_mm", "within_sigma", "confident", "accuracy",
        "key_to_key_errors")  # fmt: skip
SHOWN, WHOLE = ("full", "status", "ramp", "wrap"), 200
"""Test vectors on the page, and the hex digits up to which one is whole there."""
SCORES = {"rmse_mm": "RMSE", "median_mm": "median", "p95_mm": "95th percentile"}


def pages() -> dict[Path, str]:
    """Return every generated file with the text it shall have."""
    readme, troubleshooting = ROOT / "README.md", ROOT / "docs" / "troubleshooting.md"
    protocol = ROOT / "docs" / "usb-protocol.md"
    return {
        ROOT / "docs" / "configuration.md": settings.page(),
        ROOT / "docs" / "cli.md": command_line(),
        ROOT / "deploy" / "touchd.toml": configtext.render(Settings()),
        readme: with_block(readme.read_text(), "results", results()),
        MODELS / "README.md": model_cards((MODELS / "README.md").read_text()),
        protocol: with_block(protocol.read_text(), "vectors", vectors()),
        troubleshooting: with_block(troubleshooting.read_text(), "exit-codes", exit_codes()),
        ROOT / "docs" / "benchmarks.md": benchmarks.page(runs.load(ROOT / "docs" / "benchmarks.json")),
        ROOT / "docs" / "reproduction.md": reproduction.page(
            reproduction.load(ROOT / "docs" / "reproduction"), "reproduction"
        ),
        **{page: measured(page) for page in BLOCKS},
    }


def measured(page: Path) -> str:
    """Return a measured page with the tables of its data files filled in."""
    text = page.read_text()
    for block in BLOCKS[page]:
        text = with_block(text, block.__name__, block())
    return text


def command_line() -> str:
    """Return the reference of the command line: the daemon's help, and of each verb what it does and must have."""
    lines = [
        "# Command line",
        "",
        "<!-- Generated from the commands' own help by docs/generate.py: do not edit. -->",
        "",
        "`touchd` without a verb is the daemon, which reads the DAQ unless an option names another source. `--help`",
        "lists the options, of a verb too. Each failure has an [exit status](troubleshooting.md#exit-status).",
        "",
        f"- **touchd** `{daemon_options()}`",
    ]
    for verb in sorted(cli.VERBS):
        with click.Context(cli.touchd, info_name="touchd") as above:
            command = cli.touchd.get_command(above, verb)
            assert command is not None
            summary = " ".join((command.help or "").split("\n\n")[0].split())
            takes = synopsis(command, above)
            lines.append(f"- **{verb}**{f' `{takes}`' if takes else ''}: {summary}")
    return "\n".join(lines) + "\n"


def daemon_options() -> str:
    """Return the options of the daemon, as it is written."""
    context = click.Context(cli.touchd, info_name="touchd")
    options = (each for each in cli.touchd.params if isinstance(each, click.Option))
    return " ".join(f"[{written(option, context)}]" for option in options)


def written(option: click.Option, context: click.Context) -> str:
    """Return an option with what it takes."""
    name = option.opts[0] + ("" if option.is_flag else f" {option.make_metavar(context)}")
    return name.removesuffix(" RANGE")


def synopsis(command: click.Command, above: click.Context) -> str:
    """Return what follows a verb: its own verbs, or the options that it must have, and its arguments."""
    context = click.Context(command, parent=above, info_name=command.name)
    if isinstance(command, click.Group):
        return " | ".join(
            f"{name} {synopsis(each, context)}".rstrip()
            for name in command.list_commands(context)
            if (each := command.get_command(context, name)) is not None
        )
    words = []
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            words += [written(parameter, context)] * parameter.required
    arguments = (parameter for parameter in command.params if isinstance(parameter, click.Argument))
    return " ".join((*words, *(argument.make_metavar(context) for argument in arguments)))


def vectors() -> str:
    """Return the test vectors that the protocol's checklist names, and what the others test."""
    kinds = json.loads((ROOT / "tests" / "vectors.json").read_text())
    lines = []
    for kind in ("info", "status", "frames"):
        for vector in kinds[kind]:
            name = vector.get("name", vector.get("geometry", kind))
            if name in SHOWN:
                shown = vector["hex"] if len(vector["hex"]) <= WHOLE else vector["hex"][:64]
                says = [vector.get("says"), f"CRC {vector['crc32']}" if "crc32" in vector else None]
                lines.append(": ".join([f"{kind}, {name}", *filter(None, says)]))
                lines += [f"    {shown[at : at + 96]}" for at in range(0, len(shown), 96)]
    wrong = ", ".join(f"`{vector['name']}`" for vector in kinds["corrupt"])
    return "\n".join(["```text", *lines, "```", "", f"Must not pass, each `ramp` with one mistake: {wrong}."])


def exit_codes() -> str:
    """Return the exit statuses, a line for each branch of the tree of `touchd.errors`."""
    lines = []
    for error in by_status(errors.TouchdError):
        cause = (error.__doc__ or "").removesuffix(".").partition(":")[0]
        line = f"- {error.exit_code} `{error.__name__}`: {cause[0].lower()}{cause[1:]}"
        below = ", ".join(f"{each.exit_code} `{each.__name__}`" for each in by_status(error))
        lines.append(f"{line}; {below}" if below else line)
    return "\n".join(lines)


def by_status(error: type[errors.TouchdError]) -> list[type[errors.TouchdError]]:
    """Return the classes right below one of the tree."""
    return sorted(error.__subclasses__(), key=lambda each: each.exit_code)


def results() -> str:
    """Return the table of the shipped model's scores, as it and its atlas state them."""
    model = Model(MODEL)
    assert model.atlas is not None
    alone, placed, plate = model.description.scores, model.atlas.description.scores, model.description.plate
    size = f"{plate.width_mm:g} x {plate.height_mm:g} x {plate.thickness_mm:g} mm"
    lines = [
        f"| `models/{MODEL.name}`: {plate.material}, {size} | network alone | with its field atlas |",
        "|---|---|---|",
        *(f"| {name} | {alone[key]:.2f} mm | {placed[key]:.3f} mm |" for key, name in SCORES.items()),
        f"| touches | {alone['n']:.0f} | {placed['n']:.0f} |",
    ]
    return "\n".join(lines)


def model_cards(text: str) -> str:
    """Return the page of the models with the facts of each, as the models themselves state them, filled in."""
    for path in sorted(MODELS.glob("*.onnx")):
        text = with_block(text, path.stem, model_card(path))
    return text


def model_card(path: Path) -> str:
    """Return the table of one model's facts."""
    d = Model(path).description
    plate = f"{d.plate.material}, {d.plate.width_mm:g} x {d.plate.height_mm:g} x {d.plate.thickness_mm:g} mm"
    a = d.acquisition
    facts = {
        "head, input": f"{d.head}, {d.input} in the {d.domain} domain, {d.inputs} features",
        "plate": f"{plate}; {a.channels} channels of {a.samples} samples at {a.sample_rate_hz / 1e3:g} kHz",
        "made by": f"`{d.command}`"
        + (f", then `touchd quantise` to {d.precision}" if d.precision != "float32" else ""),
        "training recording": f"sha256 {d.data_sha256[:16]}... of frames and truth",
        "size": f"{path.stat().st_size / 1e3:.0f} kB, {cost_of(onnx.load(path))[0] / 1e3:.1f} k multiply-adds",
        "on the test touches": ", ".join(f"{key} {d.scores[key]:.4g}" for key in CARD if key in d.scores),
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in facts.items())])


def with_block(text: str, name: str, content: str) -> str:
    """Return a page with the content between the marks of a block replaced."""
    begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
    before, rest = text.split(begin)
    _, after = rest.split(end)
    return f"{before}{begin}\n{content}\n{end}{after}"


def main(arguments: list[str]) -> int:
    """Write or check all pages, and return the exit status."""
    stale = [path for path, text in pages().items() if not path.is_file() or path.read_text() != text]
    if arguments == ["--check"]:
        for path in stale:
            print(f"{path.relative_to(ROOT)} is stale: run make docs", file=sys.stderr)
        return 1 if stale else 0
    if arguments:
        print("usage: python -m docs.generate [--check]", file=sys.stderr)
        return 2
    for path, text in pages().items():
        if path in stale:
            path.write_text(text)
            print(f"{path.relative_to(ROOT)} written")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
