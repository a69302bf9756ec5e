"""`touchd simulate`: write a recording made by the digital twin."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from touchd.cli.options import PATH, Number, NumberRange, plate_of
from touchd.config.schema import LogSettings
from touchd.files import check_output
from touchd.frame import ACQUISITIONS, Acquisition, Plate, parse_acquisition
from touchd.keypad import load_layout
from touchd.recording import format as recording
from touchd.service.log import configure
from touchd.twin.cache import parts_kept
from touchd.twin.physics.finger import TISSUES
from touchd.twin.physics.material import MATERIALS
from touchd.twin.rig import IDEAL, load_rig
from touchd.twin.scenes.catalogue import SCENES, stage_scene
from touchd.twin.scenes.robot import COUNT, MOST_FINGERS, TouchSet
from touchd.twin.simulate import Session, simulate_session, simulate_stage

TOUCHES = "touches"
MOST_FRAMES = 2_000_000
"""4 GB in memory, of four channels. A touch has two."""
_SCENE_LINES = "\n".join(f"  {name:13} {scene.what}" for name, scene in SCENES.items())


def _plate(_ctx: click.Context, _param: click.Parameter, value: str) -> Plate:
    """Parse WIDTHxHEIGHTxTHICKNESS."""
    return plate_of(value, "three lengths in mm such as 200x200x5", lengths=3)


def _acquisition(_ctx: click.Context, _param: click.Parameter, value: str) -> Acquisition:
    """Parse the name or the numbers of an acquisition."""
    try:
        return parse_acquisition(value)
    except ValueError:
        raise click.BadParameter("a name, or numbers such as 192000:768:20000-85000:0.004:0.004") from None


acquisition_option = click.option(
    "--acquisition", default="usb", show_default=True, callback=_acquisition, metavar="NAME",
    help=f"{', '.join(ACQUISITIONS)}, or RATE_HZ:SAMPLES:START_HZ-STOP_HZ:CHIRP_S[:PERIOD_S]; with a period the plate "
    "rings from one chirp to the next.",
)  # fmt: skip


@click.command(
    epilog=f"\b\nScenes:\n  {TOUCHES:13} a robot's training set: an untouched frame before each touch\n{_SCENE_LINES}"
)
@click.argument("scene", type=click.Choice([TOUCHES, *SCENES]), metavar="SCENE")
@click.option("-o", "--output", type=PATH, required=True, help="The recording to write (.npz).")
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0), help="Equal seeds give equal counts.")
@click.option("--frames", type=click.IntRange(1, MOST_FRAMES), help="Frames of a scene.  [default: the scene's]")
@click.option("--rate-hz", type=Number(), help="Frames per second of a scene.  [default: 125; demo 100]")
@click.option(
    "--count", type=click.IntRange(1, MOST_FRAMES // 2), help=f"Touches of a training set.  [default: {COUNT}]"
)
@click.option("--finger", type=click.Choice(list(TISSUES)), help="Tissue of the finger.  [default: the scene's]")
@click.option("--keypad", type=PATH, help="Layout of the keys (TOML).  [default: 3 x 4 keys]")
@click.option("--code", help="Code to type on the keypad.")
@click.option("--plate", default="200x200x5", show_default=True, callback=_plate, metavar="WxHxT", help="In mm.")
@click.option("--material", default="glass", show_default=True, type=click.Choice(list(MATERIALS)))
@click.option("--loss", default=5e-3, show_default=True, type=Number(), help="Loss factor of the plate.")
@click.option("--rig", type=PATH, metavar="FILE.toml", help="Mounting, tilts and electronics of a real rig (TOML).")
@click.option(
    "--noise-db", type=NumberRange(-20, 200), metavar="DB",
    help="Signal-to-noise ratio of the untouched plate, dB.  [default: 60]",
)  # fmt: skip
@click.option("--jitter-ns", type=Number(), help="Standard deviation of the trigger's jitter, ns.  [default: 0]")
@click.option(
    "--stale-k", default=0.0, show_default=True, type=Number(),
    help="Touches: warming since the untouched frame, K.",
)  # fmt: skip
@click.option("--even", is_flag=True, help="Touches: without gaps and up to the edges, not at random.")
@click.option(
    "--temperature-k",
    "warmer_k",
    default=0.0,
    show_default=True,
    type=Number(),
    help="Touches: temperature above the reference, K.",
)
@click.option(
    "--fingers", default=1, show_default=True, type=click.IntRange(1, MOST_FINGERS), help="Fingers of each touch."
)
@click.option(
    "--apart-mm", default=0.0, show_default=True, type=Number(), help="Least distance between the fingers' centres."
)
@click.option(
    "--label-noise-mm",
    default=0.0,
    show_default=True,
    type=Number(),
    help="Touches: standard deviation of the labels, per axis.",
)
@acquisition_option
@click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="Processes for touches.  [default: all cores]")
@click.option("--dask", metavar="ADDRESS", help="Compute touches on the Dask cluster of this scheduler.")
@click.option("--force", is_flag=True, help="Replace the recording if it exists.")
def command(
    scene: str,
    output: Path,
    seed: int,
    frames: int | None,
    rate_hz: float | None,
    count: int | None,
    finger: str | None,
    keypad: Path | None,
    code: str | None,
    plate: Plate,
    material: str,
    loss: float,
    rig: Path | None,
    noise_db: float | None,
    jitter_ns: float | None,
    acquisition: Acquisition,
    jobs: int | None,
    dask: str | None,
    force: bool,
    **of_touches: Any,
) -> None:
    """Simulate SCENE on a plate and write a recording, labelled with true contacts."""
    if scene == TOUCHES and not (frames is None and rate_hz is None):
        raise click.UsageError("--frames and --rate-hz apply to scenes; use --count")
    if scene != "keypad" and not (keypad is None and code is None):
        raise click.UsageError("--keypad and --code apply to the scene keypad")
    touches = TouchSet(count or COUNT, finger or "silicone", **of_touches)  # its fields have the names of options
    if scene != TOUCHES and (count is not None or replace(touches, finger="silicone") != TouchSet()):
        raise click.UsageError(
            "--count, --even, --stale-k, --temperature-k, --fingers, --apart-mm and --label-noise-mm apply to touches; "
            "use --frames"
        )
    if scene != TOUCHES and not (jobs is None and dask is None):
        raise click.UsageError("--jobs and --dask apply to touches; a scene is simulated in one process")
    if jobs is not None and dask is not None:
        raise click.UsageError("--jobs counts processes of this computer; --dask uses the cluster's workers")
    check_output(output, replace=force)
    keys = [(key.name, *key.centre_mm) for key in load_layout(keypad).key] if keypad else None
    described = plate.model_copy(update={"material": material})
    held = load_rig(rig) if rig else IDEAL
    electronics = held.electronics
    if noise_db is not None:
        electronics = electronics._replace(noise_db=noise_db)
    if jitter_ns is not None:
        electronics = electronics._replace(jitter_s=jitter_ns * 1e-9)
    if scene == TOUCHES:
        total = 2 * touches.count
    else:
        stage = stage_scene(
            scene, described, seed=seed, frames=frames, rate_hz=rate_hz, electronics=electronics, finger=finger,
            keys=keys, code=code,
        )  # fmt: skip
        total = len(stage.sequence)
    configure(LogSettings())  # to standard error, beside the progress bar
    with ExitStack() as stack:
        if scene == TOUCHES:
            described_rig = held.model_copy(update={"electronics": electronics})
            session = Session(touches, seed, described, loss, described_rig, acquisition)
            kept = stack.enter_context(parts_kept("touches", session))
            simulate = partial(simulate_session, session, workers=jobs, dask=dask, kept=kept)
        else:
            instrument = held.instrument(described, loss=loss, acquisition=acquisition)
            simulate = partial(simulate_stage, stage, instrument, seed)
        with click.progressbar(length=total, label=scene, file=sys.stderr) as bar:
            made = simulate(progress=bar.update)
        recording.write(output, made)
    click.echo(f"{output}: {len(made.frames)} frames, {output.stat().st_size / 1e6:.1f} MB")
