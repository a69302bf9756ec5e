"""`touchd wizard`: calibrate step by step, as the page of `touchd web` asks."""

from __future__ import annotations

import asyncio
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

import click

from touchd.cli.options import PATH, NumberRange, bus_option, config_option
from touchd.cli.output import say


@click.command()
@click.option("--socket", "socket_path", type=PATH, metavar="FILE",
              help="Where to listen.  [default: the service's, or yours]")  # fmt: skip
@click.option("--folder", type=PATH, metavar="DIR",
              help="Where the state is kept.  [default: the service's state, or yours]")  # fmt: skip
@click.option("--seconds", type=NumberRange(0.5), default=10.0, show_default=True, metavar="S",
              help="How long the plate stays untouched.")  # fmt: skip
@bus_option
@config_option
def command(
    socket_path: Path | None, folder: Path | None, seconds: float, address: str | None, config: Path | None
) -> None:
    """Run the calibrations and trainings that the page of `touchd web` asks for, one at a time, until SIGTERM.

    Frames and changes of the model go through the daemon's control socket, the mapping goes to the configuration. What
    runs goes on after a restart.
    """
    from touchd.calibration.wizard import HANDED, default_socket
    from touchd.calibration.wizard.frames import shown
    from touchd.calibration.wizard.kept import held_folder
    from touchd.calibration.wizard.state import State
    from touchd.calibration.wizard.worker import Worker, serve
    from touchd.cli.main import missing_extra
    from touchd.config.load import DEFAULT_PATH, load
    from touchd.files import state_folder
    from touchd.service.control import SERVICE_PATH
    from touchd.service.log import configure
    from touchd.service.models import installed_path
    from touchd.service.systemd import Notifier

    settings = load(config)
    configure(settings.log)
    path = socket_path or default_socket()
    kept = folder or state_folder("wizard")
    trains = find_spec("torch") is not None
    untrainable = "" if trains else str(missing_extra(ModuleNotFoundError(name="torch")))
    with held_folder(kept), closing(Notifier.from_environment()) as manager:
        state = State(kept)
        state.set(mapping=shown(settings.input), untrainable=untrainable)
        worker = Worker(
            state, settings.control.socket or SERVICE_PATH, settings.model.path or installed_path(), seconds,
            config or DEFAULT_PATH, path.with_name(HANDED), address,
        )  # fmt: skip
        asyncio.run(serve(worker, state, path, manager, lambda: say(f"touchd: {path}: ready")))
