"""Open the source of frames that the command line names: a DAQ, a recording, or the digital twin."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from touchd.config.schema import Settings
from touchd.errors import SourceError
from touchd.frame import Acquisition
from touchd.localization.model import Model
from touchd.sources.source import Source

PAPER = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
"""What the source paper's rig samples: the geometry of a rig that no model is there for."""


@dataclass(frozen=True, slots=True)
class SourceChoice:
    """Which source the command line asked for: the DAQ on USB unless it names another."""

    replay: Path | None = None
    simulate: str | None = None
    speed: float = 1.0
    """Relative to the recording; infinite is as fast as frames are taken."""
    loop: bool = False
    seed: int = 0
    ni: bool = False


def open_source(choice: SourceChoice, settings: Settings, model: Model | None = None) -> Source:
    """Return the source that was asked for; each backend is imported on use.

    Parameters
    ----------
    choice : SourceChoice
    settings : Settings
        Those of `device` and `ni`, the DAQ to use if no other source was named.
    model : Model, optional
        What the DAQ's frames are for: it may then be plugged in later, and one that the model does not fit is refused.
        Without a model the DAQ has to be there.

    Raises
    ------
    SourceError
        If several were named, or a scene shall run at a speed of its own; or the DAQ cannot be used.
    """
    asked = {"--replay": choice.replay is not None, "--simulate": choice.simulate is not None, "--ni": choice.ni}
    named = [option for option, given in asked.items() if given]
    if len(named) > 1:
        raise SourceError("several sources were named", " and ".join(named), "name one of them")
    if choice.replay is not None:
        from touchd.sources.replay import ReplaySource

        return ReplaySource(choice.replay, speed=choice.speed, loop=choice.loop)
    if choice.simulate is not None:
        from touchd.sources.simulated import SimulatedSource

        if choice.speed not in (1.0, float("inf")):
            raise SourceError(
                "a live scene has no other speed", f"--speed {choice.speed:g}", "leave it out, or say max"
            )
        return SimulatedSource(
            choice.simulate, seed=choice.seed, paced=choice.speed != float("inf"), loop=choice.loop
        )  # fmt: skip
    if choice.ni:
        from touchd.sources.live import DaqSource
        from touchd.sources.ni import NiDaq

        acquisition = model.description.acquisition if model else PAPER
        check = model.check if model else (lambda _acquisition: None)
        return DaqSource(lambda: NiDaq(settings.ni, acquisition), settings.device, acquisition, check)
    from touchd.sources.usb import open_usb

    if model is None:
        return open_usb(settings.device)
    return open_usb(settings.device, model.description.acquisition, model.check)
