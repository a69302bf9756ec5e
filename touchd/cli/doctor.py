"""`touchd doctor`: check the whole set-up and print a remedy for each fault."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import click

from touchd.cli.main import missing_extra
from touchd.cli.options import PATH, NumberRange, config_option, json_option
from touchd.config.load import load
from touchd.config.schema import Settings
from touchd.doctor import checks, host
from touchd.doctor.checks import Finding, Sample
from touchd.doctor.screen import check_screen
from touchd.doctor.start import check_start, failure
from touchd.errors import BusError, CheckFailed, TouchdError
from touchd.localization.model import Model
from touchd.service.daemon import make_pipeline
from touchd.service.frame_feed import DaemonSource, open_running, rate_of
from touchd.service.log import configure
from touchd.service.models import settings_for
from touchd.sources.open import SourceChoice, open_source

_COLOURS = {"ok": "green", "warning": "yellow", "failure": "red"}


@click.command()
@click.option("--replay", type=PATH, help="Check the frames of a recording, not of the DAQ.")
@click.option("--simulate", metavar="SCENE", help="Check the frames of a twin's scene, not of the DAQ.")
@click.option("--ni", is_flag=True, help="Check the frames of NI hardware, not of the DAQ on USB.")
@click.option("--audio", metavar="DEVICE", help="Check the frames of an audio interface.")
@click.option("--seed", default=0, type=click.IntRange(min=0), help="Seed of a simulated scene.", show_default=True)
@click.option("--seconds", type=NumberRange(0.5), default=3.0, show_default=True, metavar="S",
              help="How many seconds of frames to take.")  # fmt: skip
@click.option("--reference", type=PATH, metavar="PATH",
              help="The training recording, or one of the untouched plate.  "
              "[default: MODEL.untouched.npz beside the model]")  # fmt: skip
@json_option
@click.option("--lines", "as_lines", is_flag=True, help="Print one JSON object a line, as each check ends.")
@config_option
def command(
    seconds: float, reference: Path | None, as_json: bool, as_lines: bool, config: Path | None, **source: Any
) -> None:
    """Check all that the daemon opens, the DAQ, its frames and the computer, a line for each check.

    A running daemon's frames are checked, by its own user or root; else stop it first: only one program at a time can
    read the DAQ. Do not touch the plate meanwhile. A warning and a failure name a remedy.
    """
    settings = load(config)
    choice = SourceChoice(**source, speed=float("inf"))
    configure(settings.log.model_copy(update={"level": "error"}))
    findings = []
    for finding in _examine(settings, choice, seconds, reference):
        findings.append(finding)
        if as_lines:
            click.echo(json.dumps(finding._asdict()))  # flushes
        elif not as_json:
            _print(finding)
    failures = sum(finding.level == "failure" for finding in findings)
    if as_json:
        click.echo(json.dumps({"failures": failures, "checks": [finding._asdict() for finding in findings]}, indent=1))
    if failures:
        raise CheckFailed(f"{failures} of {len(findings)} checks failed", fix="follow the remedy of each")


def _print(finding: Finding) -> None:
    level = click.style(f"{finding.level:8}", fg=_COLOURS[finding.level])
    click.echo(f"{level} {finding.check:12} {finding.text}")
    if finding.fix:
        click.echo(f"{'':21} -> {finding.fix}")


def _examine(settings: Settings, choice: SourceChoice, seconds: float, reference: Path | None) -> Iterator[Finding]:
    """Run the checks and yield each finding; a failure omits the checks that depend on it."""
    yield host.check_clock()
    running = None
    try:
        running = open_running(choice, settings)
    except BusError as error:
        yield Finding("daemon", "warning", f"{error.where}: {error.what}", error.fix)
    if running is None or running.description.source not in ("simulated", "replay"):
        settings = settings_for(settings, choice)
    parts, findings = check_start(settings, running=running is not None)
    yield from findings
    yield from check_screen(settings)
    if any(finding.check in ("model", "keypad") and finding.level == "failure" for finding in findings):
        return
    if running is None and choice.kind == "usb":
        device = host.examine(settings.device)
        yield from device
        if any(finding.level == "failure" for finding in device):
            return
    try:
        yield from _examine_frames(settings, choice, seconds, reference, parts.model, running)
    except TouchdError as error:
        yield failure("frames", error)
    except ImportError as error:
        yield failure("frames", missing_extra(error))


def _examine_frames(
    settings: Settings,
    choice: SourceChoice,
    seconds: float,
    reference: Path | None,
    model: Model | None,
    running: DaemonSource | None,
) -> Iterator[Finding]:
    source = running or open_source(choice, settings, model)
    with closing(source):
        rate_hz = rate_of(source, settings.device)
        # Made before frames are taken: it refuses what the daemon would refuse.
        pipeline = make_pipeline(source, settings, model) if model is not None else None
        sample = host.take(source, seconds)
    yield checks.check_rate(sample, rate_hz)
    yield checks.check_lost(sample)
    yield checks.check_dead(sample)
    yield checks.check_noise(sample)
    if (other_pane := checks.find_other_pane(sample)) is not None:
        yield other_pane
    yield checks.check_clipping(sample)
    if model is not None and pipeline is not None:
        yield _examine_baseline(sample, reference, model)
        spent_us = host.time_frames(sample, pipeline, settings.baseline.learn_frames, rate_hz)
        yield checks.check_time(spent_us, 1 / rate_hz)


def _examine_baseline(sample: Sample, reference: Path | None, model: Model) -> Finding:
    path = reference or model.path.with_suffix(".untouched.npz")
    if reference is None and not path.exists():
        return Finding(
            "baseline", "warning", "not compared: no reference recording of the untouched plate",
            f"give --reference TRAINING.npz; or keep one: touchd record -o {path.name} --seconds 1, beside the model",
        )  # fmt: skip
    return checks.check_baseline(sample, host.untouched(path, model))
