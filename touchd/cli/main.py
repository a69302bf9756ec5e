"""Command line: `touchd` runs the daemon, `touchd VERB` an offline job."""

from __future__ import annotations

import errno
import importlib
import os
import sys
import tempfile
import traceback
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from touchd import __version__
from touchd.cli.options import PATH, NumberRange, chosen, source_options
from touchd.cli.output import discard, say
from touchd.errors import ConfigError, MissingExtra, ModelMissing, OutputError, TouchdError
from touchd.files import CHECK
from touchd.service.signals import deliver, unwound

if TYPE_CHECKING:
    from touchd.config.schema import Settings

VERBS = {
    "audio-check": "Measure an audio interface.",
    "benchmark": "Measure run time, latency and position error.",
    "calibrate": "Make a model of a plate that nobody touches.",
    "check": "Judge a model on anybody's touches.",
    "config": "Print the effective configuration.",
    "demo": "Replay the shipped recording and summarise it.",
    "doctor": "Check the whole set-up.",
    "draw": "Plot a replayed session.",
    "evaluate": "Score a model on a labelled recording.",
    "gadget": "Act as a DAQ on a USB cable.",
    "input": "Be a touch screen for the desktop.",
    "keygen": "Make a CURVE key pair.",
    "listen": "Print the events of a running daemon.",
    "map": "Measure where the screen lies on the plate.",
    "model": "Install a model, or go back to the previous one.",
    "plan": "Draw the expected error of a layout of discs.",
    "quantise": "Quantise a model's weights to 8 bits.",
    "record": "Write frames to a file.",
    "reproduce": "Repeat the source paper's experiments.",
    "screen": "Tell the daemon that the screen is off or on.",
    "simulate": "Write a recording made by the digital twin.",
    "train": "Train a model on a labelled recording.",
    "tuio": "Send touches as TUIO 1.1.",
    "wizard": "Calibrate step by step, as touchd web asks.",
    "web": "Look at the plate in a browser.",
}
EXTRAS = {"torch": "train", "dask": "train", "distributed": "train", "scipy": "calibrate",
          "threadpoolctl": "calibrate", "onnx": "calibrate", "matplotlib": "calibrate", "rich": "calibrate",
          "jinja2": "calibrate", "nidaqmx": "ni", "alsaaudio": "audio", "starlette": "web", "uvicorn": "web",
          "websockets": "web"}  # fmt: skip
_FULL = (errno.ENOSPC, errno.EDQUOT)


class Verbs(click.Group):
    """Imports a verb's module when the verb runs, so that the daemon starts fast."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        """Return all verbs' names."""
        return sorted(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - click's signature
        """Return a verb's command, or None for an unknown name."""
        if cmd_name not in VERBS:
            return None
        command: click.Command = importlib.import_module(f"touchd.cli.{cmd_name.replace('-', '_')}").command
        command.name, command.short_help = cmd_name, VERBS[cmd_name]
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's signature
        """Write the list of verbs without importing their modules."""
        with formatter.section("Verbs"):
            formatter.write_dl(sorted(VERBS.items()))


@click.group(cls=Verbs, invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--config", "config", type=PATH, help="Configuration file (TOML).")
@source_options
@click.option("--bind", multiple=True, metavar="ADDRESS", help="Publish at tcp:// or ipc:// ADDRESS; repeatable.")
@click.option("--model", type=PATH, help="Model (ONNX).  [default: the installed one]")
@click.option("--print", "echo", is_flag=True, help="Print each event as a line of JSON, too.")
@click.option(
    "--await-subscriber",
    type=NumberRange(0),
    default=0.0,
    metavar="SECONDS",
    help="Wait up to SECONDS for a subscriber to touches first.",
)
@click.option("--debug", is_flag=True, help="Print tracebacks, and log at level debug.")
@click.version_option(__version__, prog_name="touchd")
@click.pass_context
def touchd(
    ctx: click.Context,
    /,
    config: Path | None,
    bind: tuple[str, ...],
    model: Path | None,
    echo: bool,
    await_subscriber: float,
    debug: bool,
    **source: Any,
) -> None:
    """Locate touches on a plate by ultrasound and publish them.

    Without a verb this is the daemon: it reads frames, locates touches, and publishes events over ZeroMQ. It reads from
    the USB DAQ, which may be plugged in later, unless an option names another source.
    """
    ctx.obj = {"debug": debug or bool(os.environ.get("TOUCHD_DEBUG")), "config": config}
    if ctx.invoked_subcommand is not None:
        given = [name for name in ctx.params if ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE]
        if unused := [p.opts[0] for p in ctx.command.params if p.name in given and p.name not in ctx.obj]:
            before = f"before {ctx.invoked_subcommand}"
            raise click.UsageError(f"no effect {before}: {', '.join(unused)}; put it behind, or leave it out")
        deliver()  # they end a verb
        ctx.with_resource(unwound())  # a daemon has a handler of its own
        return
    import structlog

    from touchd.config.load import Retired, empty_file, load
    from touchd.files import is_missing
    from touchd.service.daemon import run
    from touchd.service.log import configure

    log = structlog.get_logger()

    def warn(key: Retired) -> None:
        log.warning("a setting that is gone is ignored", where=key.where, instead=key.instead)

    choice = chosen(source)
    overrides: dict[str, Any] = {}
    if bind:
        overrides["bus"] = {"bind": bind}
    if model:
        if is_missing(model):  # a path in the configuration may wait for its file, uncalibrated
            raise ModelMissing("no such model", str(model), "check the path")
        overrides["model"] = {"path": model}
    if debug:
        overrides["log"] = {"level": "debug"}
    retired: list[Retired] = []
    settings = load(config, overrides, retired.append)
    configure(settings.log)
    for key in retired:
        warn(key)

    def reread() -> Settings:
        nonlocal settings
        before, settings = settings, load(config, overrides, warn)
        if settings != before and (empty := empty_file(config)):
            log.warning(
                "the configuration file is empty or gone, its settings are reset", file=str(empty),
                fix="put it back, and reload",
            )  # fmt: skip
        return settings

    run(settings, choice, echo=echo, await_subscriber_s=await_subscriber, read_settings=reread)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit status; `touchd.errors` lists the status of each error."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if "--debug" in arguments:  # it may stand behind the verb, too
        arguments = ["--debug", *(argument for argument in arguments if argument != "--debug")]
    debug = "--debug" in arguments or bool(os.environ.get("TOUCHD_DEBUG"))
    try:
        result = touchd.main(args=arguments, prog_name="touchd", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except click.ClickException as error:
        error.show()
        return ConfigError.exit_code if isinstance(error, click.FileError) else error.exit_code
    except (click.Abort, KeyboardInterrupt):
        return 130
    except TouchdError as error:
        return _explain(error, debug)
    except Exception as error:
        if _interrupted(error):
            return 130
        with suppress(ImportError):  # of no extra
            error = missing_extra(error) if isinstance(error, ImportError) else error
        return _explain(error, debug)


def _interrupted(error: BaseException | None) -> bool:
    """Return whether an error comes of Ctrl-C: a library in C that it met at its import says ImportError."""
    return error is not None and (
        isinstance(error, KeyboardInterrupt) or _interrupted(error.__cause__ or error.__context__)
    )


def missing_extra(error: ImportError) -> MissingExtra:
    """Return what to do about a package that is missing or does not load; raise the error if it is of no extra."""
    extra = EXTRAS.get((error.name or "").partition(".")[0])
    if extra is None:
        raise error
    if not isinstance(error, ModuleNotFoundError):  # a library of the system's is missing
        what = f"{error.name}, of the extra {extra}, does not load ({error})"
        return MissingExtra(what, fix="install the system's library that it names")
    # Only from a clone: the name on the public index is not this project's. Debian's own Python refuses packages.
    fix = f"in a clone of touchd: {sys.executable} -m pip install '.[{extra}]'"
    if sys.prefix == sys.base_prefix:
        fix = "the Debian package cannot hold it: run `make setup` in a clone of touchd, and use its .venv/bin/touchd"
    return MissingExtra(f"this needs {error.name}, of the extra {extra}", fix=fix)


def _explain(error: Exception, debug: bool) -> int:
    """Print the error in one line, after its traceback if `debug`, and return the exit status."""
    if debug:
        traceback.print_exception(error)
    if isinstance(error, OSError):
        error = _unwritable(error)
    if isinstance(error, TouchdError):
        say(f"touchd: {error}", err=True)
        return error.exit_code
    fix = "run again with --debug and report what it prints"
    say(f"touchd: internal error: {error!r}{_place(error)} -> {fix}", err=True)
    return 1


def _place(error: Exception) -> str:
    """Return which line of touchd an error comes from: an error that does not come again leaves no more than that."""
    package = Path(__file__).parents[1]
    own = [each for each in traceback.extract_tb(error.__traceback__) if package in Path(each.filename).parents]
    return f" in {Path(own[-1].filename).relative_to(package.parent)}, line {own[-1].lineno}" if own else ""


def _unwritable(error: OSError) -> Exception:
    """Return what to do about a printed line or a temporary file that cannot be written: others have an OutputError."""
    if error.filename is None:
        try:
            tempfile.gettempdir()
        except OSError:
            fix = "name a folder that this user may write to: TMPDIR=FOLDER"
            return OutputError("no folder for temporary files can be written", "TMPDIR", fix)
    if error.errno not in _FULL:
        return error
    if error.filename is not None:
        return OutputError(f"cannot be written ({error.strerror})", os.fsdecode(error.filename), CHECK)
    try:
        sys.stdout.flush()
    except OSError:
        discard(sys.stdout)
    return OutputError(
        f"cannot be written ({error.strerror})", "standard output", "check where it leads, and its space"
    )
