"""`touchd audio-check`: measure an audio interface before it becomes a DAQ."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import click

from touchd.cli.options import PATH, NumberRange, check_picture, config_option, json_option
from touchd.errors import ConfigError, DeviceLost

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from touchd.audio.check import Checked
    from touchd.calibration.plan import Plan
    from touchd.calibration.plate_file import PlateFile
    from touchd.config.rigs import AudioSettings

_WIDTH = 107  # of a row's text: 120 with its name


@click.command()
@click.argument("device", required=False, default="")
@click.option("--inputs", type=click.IntRange(1, 256), help="Inputs to measure.  [default: those configured]")
@click.option("--level", type=NumberRange(-80, 0), default=-12.0, show_default=True, metavar="DBFS",
              help="Level of the sweep.")  # fmt: skip
@click.option("--restarts", type=click.IntRange(1, 1000), default=10, show_default=True, metavar="N",
              help="Starts that tell how stable the delay is.")  # fmt: skip
@click.option("--seconds", type=NumberRange(0.1, 86400), default=10.0, show_default=True, metavar="S",
              help="For how long xruns are counted.")  # fmt: skip
@click.option("--plate", "plate_file", type=PATH, metavar="PLATE.toml",
              help="Also compute the expected error on this plate.")  # fmt: skip
@click.option("-o", "--output", type=PATH, metavar="FILE.png",
              help="Draw response, noise and crosstalk, and the expected error.")  # fmt: skip
@json_option
@config_option
def command(
    device: str,
    inputs: int | None,
    level: float,
    restarts: int,
    seconds: float,
    plate_file: Path | None,
    output: Path | None,
    as_json: bool,
    config: Path | None,
) -> None:
    """Measure the audio interface DEVICE, or else the configured one.

    DEVICE is an ALSA name such as hw:CARD=U192k. Join an output to an input with a cable first, and take the discs off:
    tones are played. Says which band and level to use, and what to do about what is wrong.
    """
    from touchd.audio.alsa import AlsaCard
    from touchd.audio.capture import periods_of
    from touchd.audio.card import CardAbsent, CardGone
    from touchd.audio.check import check
    from touchd.audio.delay import Doubtful
    from touchd.calibration.plate_file import read_plate_file
    from touchd.config.load import load
    from touchd.sources.audio import acquisition_of, rate_of
    from touchd.twin.physics.plate import polynomials_for

    if output is not None:
        check_picture(output)
    settings = load(config)
    audio = settings.audio
    said = read_plate_file(plate_file) if plate_file else None
    if said is not None:  # refused before a minute of measuring
        acquisition = acquisition_of(audio)
        periods_of(acquisition, rate_of(acquisition, settings.device))
        polynomials_for(said.twin_plate(), audio.band_hz[1])
    name = device or audio.device
    if not name:
        raise ConfigError("is not set", "audio.device", "name a card: hw:CARD=NAME; arecord -L lists them")
    if not name.isprintable():  # it is said in messages
        raise ConfigError(f"is {name!r}", "audio.device", "name a card as arecord -L lists it")
    try:
        card = AlsaCard(name, audio.sample_rate_hz, inputs or max(*audio.channels, audio.loopback))
        with closing(card):
            found = check(
                card, restarts=restarts, seconds=seconds, level_dbfs=level,
                progress=lambda what: click.echo(f"{what} ...", err=True),
            )  # fmt: skip
    except (CardAbsent, CardGone, Doubtful) as why:
        what, _, fix = str(why).partition(": ")
        raise DeviceLost(what, "audio", fix or "plug it in again, and repeat the command") from why
    plan = expect(found, said, audio) if said else None
    if output is not None:
        from touchd.evaluation.plots.session import save

        save(draw(found, said, plan), output)
    click.echo(json.dumps(result(found, plan), indent=1) if as_json else "\n".join(text(found, plan)))


def expect(found: Checked, said: PlateFile, audio: AudioSettings) -> Plan:
    """Return the expected error of fingertips on a plate, by the noise in the band."""
    from touchd.audio.check import UNTOUCHED_DBFS
    from touchd.calibration.plan import PlateMap
    from touchd.sources.audio import acquisition_of

    usual = audio.model_copy(update={"band_hz": found.band_hz, "sample_rate_hz": found.sample_rate_hz})
    acquisition = acquisition_of(usual).model_copy(update={"channels": len(said.discs.receivers_mm)})
    here = PlateMap(said, acquisition, UNTOUCHED_DBFS - found.floor_dbfs)
    return here.plan(said.layout().centres_mm)


def result(found: Checked, plan: Plan | None = None) -> dict[str, Any]:
    """Return what `--json` prints."""
    lists = {name: getattr(found, name) for name in ("frequency_hz", "response_db", "noise_db")}
    expected = dict(zip(("median_mm", "p95_mm", "worst_mm"), plan.quantiles_mm, strict=True)) if plan else None
    return (
        {name: value for name, value in vars(found).items() if name not in lists}
        | {"delay_spread_samples": found.delay_spread, "snr_db": found.snr_db, "expected": expected}
        | {name: [round(float(one), 2) for one in values] for name, values in lists.items()}
    )


def text(found: Checked, plan: Plan | None = None) -> list[str]:
    """Return the lines of the table: what was measured, and below it what to do if that will not do."""
    off_ppm = 1e6 * (found.true_rate_hz / found.sample_rate_hz - 1)
    mixed = [f"input {i}: {db:.0f}" for i, db in enumerate(found.crosstalk_db, 1) if i != found.cable]
    harmonics = [f"{'clips' if db is None else f'{db:.0f} dB'} at {at}" for at, db in found.distortion_db.items()]
    delays_ms = [1e3 * delay / found.sample_rate_hz for delay in found.delays]
    rows = {
        "cable": f"to input {found.cable}, {found.gain_db:+.1f} dB from output to input",
        "sample rate": f"{found.true_rate_hz:.1f} Hz, {off_ppm:+.0f} ppm by this computer's clock",
        "noise": f"{found.snr_db:.0f} dB below the chirp; "
        + ", ".join(f"input {i}: {db:.0f}" for i, db in enumerate(found.noise_dbfs, 1)) + " dBFS",
        "crosstalk": f"{', '.join(mixed)} dB, relative to input {found.cable}" if mixed else "no other input",
        "distortion": f"{', '.join(harmonics)} dBFS",
        "delay": f"{min(delays_ms):.1f} to {max(delays_ms):.1f} ms in {len(delays_ms)} starts, fractions of a sample "
        f"within {found.delay_spread:.4f}",
        "xruns": f"{found.xruns} in {found.seconds:g} s",
    }  # fmt: skip
    if plan is not None:
        median, p95, worst = plan.quantiles_mm
        rows["plate"] = (
            f"noise moves a fingertip by {median:.2g} mm, at most {p95:.2g} at 95 % of the places and {worst:.2g} at "
            f"the worst; what a calibration does not know of the plate, by some {plan.exact_mm:.2f} mm"
        )
    low_hz, high_hz = found.band_hz
    rows["use"] = (
        f"[audio]\nsample_rate_hz = {found.sample_rate_hz}\nband_hz = [{low_hz:.1f}, {high_hz:.1f}]\n"
        f"level_dbfs = {found.level_dbfs:.1f}"
    )
    remedies = _remedies(found)
    lines = []
    for name, row in rows.items():
        whole = [line for part in row.split("\n") for line in wrap(part, _WIDTH) or [part]]
        for at, line in enumerate(whole):
            lines.append(f"{'' if at else name:12} {line}")
        if name in remedies:
            lines += [f"{'':12} {line}" for line in wrap(f"-> {remedies[name]}", _WIDTH)]
    return lines


def _remedies(found: Checked) -> dict[str, str]:
    """Return by row what to do about what will not do."""
    from touchd.audio.check import GOOD_DB, LEVELS_DBFS, LOW_DISTORTION_DB, MOST_ECHO_DB, MOST_OFF, MOST_SPREAD_DB

    off = abs(found.true_rate_hz / found.sample_rate_hz - 1) > MOST_OFF
    wrong = {
        "cable": (
            found.gain_spread_db > MOST_SPREAD_DB,
            f"the gain changes by {found.gain_spread_db:.1f} dB with the level: switch automatic gain off, and let the "
            "knobs be",
        ),
        "sample rate": (
            bool(found.resamples) or off,
            found.resamples or "the card takes other samples than it says: set another audio.sample_rate_hz",
        ),
        "noise": (
            found.snr_db < GOOD_DB,
            f"{GOOD_DB:.0f} dB are wanted: turn the output up, or the input's gain; switch its pad off",
        ),
        "crosstalk": (
            bool(found.mixed),
            f"the output is mixed to input {', '.join(map(str, found.mixed))}, too: switch that off in the interface's "
            "mixer, and take other cables off",
        ),
        "distortion": (
            found.level_dbfs < LEVELS_DBFS[-2],
            f"below {LOW_DISTORTION_DB:.0f} dB is wanted at {LEVELS_DBFS[-2]:g} dBFS: turn the input's gain down, and "
            "switch a limiter off",
        ),
        "delay": (
            found.echo_db > MOST_ECHO_DB,
            f"heard again {1e3 * found.echo_s:.1f} ms later, at {found.echo_db:.0f} dB: switch direct monitoring off",
        ),
        "xruns": (found.xruns > 0, "end other programs; see Real time in docs/integrator.md"),
    }
    return {name: remedy for name, (is_wrong, remedy) in wrong.items() if is_wrong}


def draw(found: Checked, said: PlateFile | None = None, plan: Plan | None = None) -> Figure:
    """Plot response, noise and crosstalk over frequency, and the expected error over the plate."""
    from matplotlib.figure import Figure

    from touchd.calibration.calibrate import draw_maps

    figure = Figure(figsize=(8.0 if plan is None else 14.0, 5.0), layout="constrained")
    left, *right = figure.subfigures(1, 1 if plan is None else 2, squeeze=False)[0]
    axes = left.subplots()
    axes.semilogx(found.frequency_hz, found.response_db, label=f"output to input {found.cable}")
    axes.semilogx(found.frequency_hz, found.noise_db, color="grey", label="noise in a tenth of an octave")
    for number, db in enumerate(found.crosstalk_db, 1):
        if number != found.cable:
            level_db, label = found.gain_db + db, f"crosstalk to input {number}"
            axes.hlines(level_db, *found.band_hz, colors=f"C{number}", linestyles="--", label=label)
    axes.axvspan(*found.band_hz, color="C2", alpha=0.15, label="band to use")
    axes.set(xlabel="frequency (Hz)", ylabel="level (dBFS)", ylim=(-140, 10))
    axes.grid(visible=True, alpha=0.3)
    axes.legend(
        title=f"{found.device} at {found.sample_rate_hz} Hz, full scale played", loc="lower center",
        bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False,
    )  # fmt: skip
    if said is not None and plan is not None:
        draw_maps(right[0], said.twin_plate(), {"fingertip, by noise": (plan.error_mm, plan.discs_mm)})
    return figure
