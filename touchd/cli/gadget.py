"""`touchd gadget`: make this computer a DAQ at the end of a USB cable."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import click

from touchd import __version__
from touchd.cli.options import PATH
from touchd.config.load import load
from touchd.errors import GadgetError
from touchd.frame import Acquisition
from touchd.gadget.device import Gadget
from touchd.gadget.functionfs import ConfigFs, FunctionFs, first_udc
from touchd.service.log import configure
from touchd.service.runner import frames_of
from touchd.service.signals import stopping
from touchd.sources.open import SourceChoice, open_source
from touchd.sources.source import Source
from touchd.sources.usb_protocol import Capability, Info

_LOOK_S = 0.2


@click.command()
@click.option("--udc", metavar="NAME", help="USB device port, from /sys/class/udc.  [default: the first]")
@click.option("--functionfs", type=PATH, metavar="DIR", help="Use the FunctionFS mounted here; do not set up the port.")
@click.option("--replay", type=PATH, help="Stream a recording, in a loop.")
@click.option("--simulate", metavar="SCENE", help="Stream a scene of the digital twin.  [default: demo]")
@click.option("--seed", default=0, type=click.IntRange(min=0), help="Seed of the scene.", show_default=True)
@click.option("--serial", default="TWIN0001", show_default=True, help="Serial number of the device.")
@click.option("--commands", is_flag=True,
              help="Read commands from stdin: plug, unplug, corrupt, short, halt, silent, normal.")  # fmt: skip
@click.pass_context
def command(
    ctx: click.Context,
    udc: str | None,
    functionfs: Path | None,
    replay: Path | None,
    simulate: str | None,
    seed: int,
    serial: str,
    commands: bool,
) -> None:
    """Stream the digital twin or a recording over a USB cable, as a DAQ does.

    This needs a Linux board with a USB device port, and root. The host sets the frame rate.
    """
    settings = load((ctx.obj or {}).get("config"))
    configure(settings.log)
    choice = SourceChoice(replay, simulate or (None if replay else "demo"), float("inf"), loop=True, seed=seed)
    with ExitStack() as stack:
        source = open_source(choice, settings)
        stack.callback(source.close)
        gadget = Gadget(info_of(source.acquisition), samples_of(source))
        device: ConfigFs | None = None
        folder = functionfs
        if folder is None:
            device = ConfigFs(serial, settings.device.vendor_id, settings.device.product_id)
            stack.callback(device.remove)
            device.create()
            folder = device.folder
        endpoints = FunctionFs(folder, gadget)
        if device is not None:
            udc = udc or first_udc()
            device.plug(udc)
            click.echo(f"plugged in at {udc}: {serial}", err=True)
        _serve(gadget, endpoints, device, udc or "", commands)


def info_of(acquisition: Acquisition) -> Info:
    """Return the GET_INFO reply for this acquisition."""
    chirp = acquisition.chirp
    major, minor, patch = (int(part) for part in __version__.split(".")[:3])
    return Info(
        channels=acquisition.channels,
        samples=acquisition.samples,
        sample_rate_hz=round(acquisition.sample_rate_hz),
        bits=acquisition.bits,
        dac_rate_hz=round(chirp.dac_rate_hz),
        chirp_start_hz=round(chirp.start_hz),
        chirp_stop_hz=round(chirp.stop_hz),
        chirp_us=round(chirp.duration_s * 1e6),
        full_scale_mv=round(acquisition.full_scale_v * 1e3),
        max_frame_rate_hz=max(1, min(1000, int(acquisition.sample_rate_hz / acquisition.samples))),
        min_frame_rate_hz=1,
        firmware=(major, minor, patch),
        capabilities=Capability.SET_RATE,
    )


def samples_of(source: Source) -> Iterator[bytes]:
    """Yield each frame's samples in wire order: interleaved int16, little-endian."""
    for frame in frames_of(source):
        if frame is not None:
            yield frame.counts.T.astype("<i2").tobytes()


def _serve(gadget: Gadget, endpoints: FunctionFs, device: ConfigFs | None, udc: str, commands: bool) -> None:
    """Serve until a signal, the end of the commands, or a failure of the endpoints."""
    with stopping() as stop:

        def obey() -> None:
            for line in sys.stdin:
                name = line.strip().removeprefix("!")
                try:
                    if name == "plug" and device is not None:
                        device.plug(udc)
                    elif name == "unplug" and device is not None:
                        device.unplug()
                    elif name:
                        gadget.command(name)
                except (ValueError, GadgetError) as error:
                    click.echo(f"touchd: {error}", err=True)
            stop.set()

        if commands:
            threading.Thread(target=obey, daemon=True, name="gadget-commands").start()
        while not stop.wait(_LOOK_S):
            if endpoints.error is not None:
                raise endpoints.error
