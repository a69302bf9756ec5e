"""`touchd calibrate`: make a model of a plate from its untouched response."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from touchd.cli.options import PATH, NumberRange, check_model_output, config_option, json_option
from touchd.errors import DeviceLost, PlatePoor

if TYPE_CHECKING:
    from touchd.calibration.calibrate import Fitted
    from touchd.calibration.plate_file import PlateFile
    from touchd.config.schema import Settings
    from touchd.recording.data import Recording
    from touchd.sources.open import SourceChoice

_STEPS = 100
JOINTS = ("disc stiffer", "disc bead")
"""Names of parameters that the report alone shows begin so: there are four a disc."""


@click.command()
@click.argument("recording", type=PATH, required=False)
@click.option("-o", "--output", type=PATH, required=True, help="The model to write (.onnx).")
@click.option(
    "--plate", "plate_file", type=PATH, required=True, metavar="PLATE.toml",
    help="What you measured of plate and discs.",
)  # fmt: skip
@click.option(
    "--taps", "taps_file", type=PATH, metavar="RECORDING",
    help="Taps at roughly known places (contacts_mm): they turn the drawing, and correct places and field.",
)  # fmt: skip
@click.option("--ni", is_flag=True, help="Without RECORDING: take frames from NI hardware.")
@click.option("--audio", metavar="DEVICE", help="Without RECORDING: take frames from an audio interface.")
@click.option("--simulate", metavar="SCENE", help="Without RECORDING: take frames from a scene of the digital twin.")
@click.option("--seconds", type=NumberRange(1.0), default=10.0, show_default=True, metavar="S",
              help="Without RECORDING: how many seconds of frames to take.")  # fmt: skip
@json_option
@click.option("--lines", "as_lines", is_flag=True, help="Print one JSON object a line: progress, then the result.")
@click.option("--no-report", is_flag=True, help="Write no report.")
@click.option("--force", is_flag=True, help="Write the model of a poor fit, too.")
@config_option
@click.pass_context
def command(
    ctx: click.Context,
    /,
    recording: Path | None,
    output: Path,
    plate_file: Path,
    taps_file: Path | None,
    ni: bool,
    audio: str | None,
    simulate: str | None,
    seconds: float,
    as_json: bool,
    as_lines: bool,
    no_report: bool,
    force: bool,
    config: Path | None,
) -> None:
    """Fit plate and discs to RECORDING, ten seconds of the untouched plate, and write a model.

    Without RECORDING the frames come from the daemon that runs with a control socket, or else from the DAQ. No touch is
    needed. Beside the model lie its field atlas, .atlas.npz, a reference for `touchd doctor`, .untouched.npz, and a
    folder named .report. A model that was there is kept, as .previous.onnx. A poor fit writes no model, and exits with
    a status of its own.
    """
    from touchd.calibration.calibrate import fit_recording, make_model, write_calibration_report
    from touchd.calibration.plate_file import read_plate_file
    from touchd.calibration.taps import check_alike, labelled
    from touchd.calibration.untouched import check_geometry
    from touchd.cli.progress import Bars
    from touchd.config.load import load
    from touchd.recording.format import read
    from touchd.sources.open import SourceChoice
    from touchd.training.report.report import PAGE

    check_model_output(output)
    if recording is not None and (ni or simulate or audio is not None):
        raise click.UsageError("name a RECORDING or a source, not both")
    idle = [name for name in ("seconds", "config") if ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE]
    if recording is not None and idle:
        raise click.UsageError(f"no effect on a RECORDING: {', '.join(f'--{name}' for name in idle)}; leave it out")
    said = read_plate_file(plate_file)
    taps = read(taps_file) if taps_file else None
    if taps is not None:
        labelled(taps)  # refused before frames are taken
        check_geometry(taps, said, "--taps")
    if recording is not None:
        frames = read(recording)
    else:
        choice = SourceChoice(simulate=simulate, speed=float("inf") if simulate else 1.0, ni=ni, audio=audio)
        frames = _take(load(config), choice, said, seconds)
    if taps is not None:
        check_alike(taps, frames.acquisition)
    given = recording.name if recording else ""
    line = f"touchd calibrate {given} -o {output.name} --plate {plate_file.name}".replace("  ", " ")
    with Bars() as bars:

        def update(stage: str, share: float) -> None:
            if as_lines:
                click.echo(json.dumps({"stage": stage, "share": round(share, 3)}))
            else:
                bars.update(stage, round(_STEPS * share), _STEPS)

        fitted = fit_recording(frames, said, update)
        poor = fitted.fit.verdict == "poor"
        made = None if poor and not force else make_model(fitted, output, taps=taps, command=line, progress=update)
        fitted = made.fitted if made else fitted
    folder = None if no_report else write_calibration_report(fitted, made, output)
    found = _result(fitted, output if made else None, folder)
    if made and (refined := made.refined):
        found["taps"] = {
            "taps": refined.taps, "used": refined.used, "orientation": refined.orientation or "as drawn",
            "scatter_mm": refined.scatter_mm, "moved_mm": refined.moved_mm, "unexplained": refined.unexplained,
            "lack_stays": refined.lack_stays,
        }  # fmt: skip
    click.echo(json.dumps(found) if as_json or as_lines else _text(found, PAGE))
    if poor:
        what = "the fit is poor" if made else "the fit is poor, no model is written"
        raise PlatePoor(what, str(output), "; ".join(fitted.fit.reasons) or "see the report")


def _take(settings: Settings, choice: SourceChoice, said: PlateFile, seconds: float) -> Recording:
    """Take frames of a source, as a recording."""
    from touchd.doctor.host import take
    from touchd.recording.data import Recording
    from touchd.service.frame_feed import open_running, rate_of
    from touchd.sources.open import open_source
    from touchd.sources.recorder import describe

    try:
        source = open_running(choice, settings) or open_source(choice, settings)
    except DeviceLost as error:  # whose remedy is of the verbs that have --replay
        raise DeviceLost(error.what, error.where, "plug it in, or name a RECORDING or --simulate SCENE") from error
    click.echo(f"taking {seconds:g} s of frames: do not touch the plate", err=True)
    with closing(source):
        sample = take(source, seconds)
        meta = describe(source.acquisition, said.described(), rate_of(source, settings.device), source="calibrate")
    return Recording(meta, sample.counts, sample.sequence, sample.t_ns - sample.t_ns[0])


def _result(fitted: Fitted, model: Path | None, report: Path | None) -> dict[str, Any]:
    from touchd.calibration.place_correction import widths_of

    fit = fitted.fit
    return {
        "verdict": fit.verdict, "expected_mm": fit.expected_mm, "reasons": list(fit.reasons),
        "parameters": [parameter._asdict() for parameter in fit.parameters], "undecided": list(fit.undecided),
        "scale_error": fit.scale_error, "places": widths_of(fit)._asdict(), "unexplained": fit.unexplained,
        "model": model and str(model), "report": report and str(report),
    }  # fmt: skip


def _text(found: dict[str, Any], page: str) -> str:
    lines = [f"{found['verdict']}: expected median error of a touch {found['expected_mm']:.2f} mm"]
    lines += [f"  {reason}" for reason in found["reasons"]]
    lines.append(f"  {'':23} {'said, usual':>11} {'fitted':>10} {'+-':>9}")
    for p in found["parameters"]:
        if p["name"].startswith(JOINTS) and found["report"]:
            continue
        late = "  further off than expected" if p["at_prior"] else ""
        lines.append(
            f"  {p['name']:23} {p['said']:11.5g} {p['fitted']:10.5g} {p['standard_error']:9.2g} {p['unit']}{late}"
        )
    lines += [f"  undecided: {what}" for what in found["undecided"]]
    if taps := found.get("taps"):
        lines.append(
            f"{taps['used']} of {taps['taps']} taps fit, and scatter by {taps['scatter_mm']:.1f} mm; the drawing is "
            f"{taps['orientation']}; places are moved by {taps['moved_mm']:.2f} mm"
            + (f"; {1 - taps['lack_stays']:.0%} of what the fit lacks is mended" if taps["lack_stays"] < 1 else "")
        )
    if found["model"]:
        lines.append(f"{found['model']}: the model, with its atlas beside it")
    if found["report"]:
        lines.append(f"{Path(found['report']) / page}: response, residual, expected error and parameters")
    return "\n".join(lines)
