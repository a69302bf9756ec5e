"""`touchd audio-check`: measure an audio interface before it becomes a DAQ."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from touchd.errors import DeviceLost

if TYPE_CHECKING:
    from touchd.audio.check import Checked


@click.command(short_help="Measure an audio interface.")
@click.argument("device", required=False, default="")
@click.option("--inputs", type=click.IntRange(1, 256), help="Inputs to measure.  [default: those configured]")
@click.option("--level", type=click.FloatRange(-80, 0), default=-12.0, show_default=True, metavar="DBFS",
              help="Level of the sweep.")  # fmt: skip
@click.option("--restarts", type=click.IntRange(1, 1000), default=10, show_default=True, metavar="N",
              help="Starts that tell how stable the delay is.")  # fmt: skip
@click.option("--seconds", type=click.FloatRange(1, 86400), default=10.0, show_default=True, metavar="S",
              help="For how long xruns are counted.")  # fmt: skip
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Write a picture of response, noise and crosstalk."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
@click.option("--config", "config", type=click.Path(path_type=Path), help="Configuration file (TOML).")
@click.pass_context
def command(
    ctx: click.Context,
    device: str,
    inputs: int | None,
    level: float,
    restarts: int,
    seconds: float,
    output: Path | None,
    as_json: bool,
    config: Path | None,
) -> None:
    """Measure the audio interface DEVICE, or else the configured one.

    DEVICE is an ALSA name such as hw:CARD=U192k. Join an output to an input with a cable first, and take the discs off:
    tones are played. Says which band and level to use.
    """
    from touchd.audio.alsa import AlsaCard
    from touchd.audio.card import CardAbsent, CardGone
    from touchd.audio.check import check
    from touchd.audio.delay import Doubtful
    from touchd.config.load import load

    audio = load(config or (ctx.obj or {}).get("config")).audio
    try:
        card = AlsaCard(device or audio.device, audio.sample_rate_hz, inputs or max(*audio.channels, audio.loopback))
        with closing(card):
            found = check(
                card, restarts=restarts, seconds=seconds, level_dbfs=level,
                progress=lambda what: click.echo(f"{what} ...", err=True),
            )  # fmt: skip
    except (CardAbsent, CardGone, Doubtful) as why:
        raise DeviceLost(str(why), "audio", "follow this, and repeat the command") from why
    if output is not None:
        _draw(found, output)
    click.echo(json.dumps(result(found), indent=1) if as_json else "\n".join(text(found)))


def result(found: Checked) -> dict[str, Any]:
    """Return what `--json` prints."""
    lists = {"frequency_hz": found.frequency_hz, "response_db": found.response_db}
    return (
        {name: value for name, value in vars(found).items() if name not in lists}
        | {"delay_spread_samples": found.delay_spread}
        | {name: [round(float(one), 2) for one in values] for name, values in lists.items()}
    )


def text(found: Checked) -> list[str]:
    """Return the lines of the table."""
    off_ppm = 1e6 * (found.true_rate_hz / found.sample_rate_hz - 1)
    heard = "  ".join(f"{i}: {db:.0f}" for i, db in enumerate(found.noise_dbfs, 1))
    mixed = "  ".join(f"{i}: {db:.0f}" for i, db in enumerate(found.crosstalk_db, 1) if i != found.cable)
    harmonics = "  ".join(f"{at}: {'clips' if db is None else f'{db:.0f}'}" for at, db in found.distortion_db.items())
    whole = sorted(round(delay) for delay in found.delays)
    low_hz, high_hz = found.band_hz
    rows = {
        "cable": f"to input {found.cable}, {found.gain_db:+.1f} dB from output to input",
        "sample rate": found.resamples or f"{found.true_rate_hz:.1f} Hz, {off_ppm:+.0f} ppm by this computer's clock",
        "noise": f"{heard}  dBFS by input",
        "crosstalk": f"{mixed or 'no other input'}  dB by input",
        "distortion": f"{harmonics}  dB by level played, dBFS",
        "delay": f"{whole[0]} to {whole[-1]} samples in {len(whole)} starts, fractions within {found.delay_spread:.4f}",
        "xruns": f"{found.xruns} in {found.seconds:g} s",
        "use": f"band_hz = [{low_hz:.0f}, {high_hz:.0f}]  level_dbfs = {found.level_dbfs:g}",
    }
    return [f"{name:12} {row}" for name, row in rows.items()]


def _draw(found: Checked, path: Path) -> None:
    from matplotlib.figure import Figure

    from touchd.files import writing

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.add_subplot()
    axes.semilogx(found.frequency_hz, found.response_db, label=f"output to input {found.cable}")
    axes.axhline(found.noise_dbfs[found.cable - 1], color="grey", linestyle=":", label="noise, dBFS")
    for number, db in enumerate(found.crosstalk_db, 1):
        if number != found.cable:
            axes.axhline(found.gain_db + db, linewidth=0.8, linestyle="--", label=f"crosstalk to input {number}")
    axes.axvspan(*found.band_hz, alpha=0.15, label="band to use")
    axes.set(xlabel="frequency, Hz", ylabel="dB", title=f"{found.device} at {found.sample_rate_hz} Hz")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend()
    with writing(path):
        figure.savefig(path, dpi=120)
