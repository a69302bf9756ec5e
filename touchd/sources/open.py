"""Open the source of frames that the command line names: a DAQ, a recording, or the digital twin."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from pathlib import Path

from touchd.config.schema import Settings
from touchd.errors import DeviceBusy, DeviceLost, SourceError
from touchd.frame import ACQUISITIONS
from touchd.localization.model import Model
from touchd.sources.source import Source

PAPER = ACQUISITIONS["usb"]
"""What the source paper's rig samples: the acquisition of an NI rig without a model."""


@dataclass(frozen=True, slots=True)
class SourceChoice:
    """The source that the command line names; by default the DAQ on USB."""

    replay: Path | None = None
    """A recording to play back."""
    simulate: str | None = None
    """A scene of the digital twin to simulate."""
    speed: float = 1.0
    """Of a replay or simulation, relative to real time; infinite is as fast as frames are taken."""
    loop: bool = False
    """Restart the replay or scene at its end."""
    seed: int = 0
    """Of the simulation."""
    ni: bool = False
    """Use the NI rig."""
    audio: str | None = None
    """ALSA name of an audio interface to use; empty takes the configured one."""

    @property
    def kind(self) -> str:
        """What a recording says of its source."""
        named = {"simulated": self.simulate, "replay": self.replay, "audio": self.audio}
        return next((kind for kind, value in named.items() if value is not None), "ni" if self.ni else "usb")

    @property
    def is_device(self) -> bool:
        """Whether a real plate is measured."""
        return self.replay is None and self.simulate is None


def open_source(
    choice: SourceChoice, settings: Settings, model: Model | None = None, *, late: bool = False
) -> Source:  # fmt: skip
    """Open the source that was chosen; import its backend only then.

    With the model that the frames are for, a DAQ may be plugged in later, and one that does not fit the model is
    refused. Without one a DAQ on USB decides what frames are; with `late` it too may be plugged in later, and must then
    be like the paper's.

    Raises SourceError if several sources are named, a scene is given a speed, or the DAQ cannot be used.
    """
    given = {"--replay": choice.replay is not None, "--simulate": choice.simulate is not None, "--ni": choice.ni,
             "--audio": choice.audio is not None}  # fmt: skip
    named = [option for option, is_given in given.items() if is_given]
    if len(named) > 1:
        raise SourceError("several sources were named", " and ".join(named), "name one of them")
    if choice.replay is not None:
        from touchd.sources.replay import ReplaySource

        return ReplaySource(choice.replay, speed=choice.speed, loop=choice.loop)
    if choice.simulate is not None:
        return _simulate(choice.simulate, choice, model)
    if choice.audio is not None:
        from touchd.audio.alsa import AlsaCard
        from touchd.sources.audio import open_audio

        return open_audio(settings, AlsaCard, choice.audio or settings.audio.device, model)
    return _open_ni(settings, model) if choice.ni else _open_usb(settings, model, late=late)


def _simulate(scene: str, choice: SourceChoice, model: Model | None) -> Source:
    from touchd.sources.simulated import SimulatedSource
    from touchd.twin.instrument import Instrument
    from touchd.twin.simulate import DEFAULT_PLATE

    if choice.speed not in (1.0, inf):
        raise SourceError("a live scene has no other speed", f"--speed {choice.speed:g}", "leave it out, or say max")
    asked = model.description.acquisition if model else PAPER
    instrument = Instrument(DEFAULT_PLATE, acquisition=asked) if asked.channels == PAPER.channels else None
    return SimulatedSource(scene, seed=choice.seed, paced=choice.speed != inf, loop=choice.loop, instrument=instrument)


def _open_ni(settings: Settings, model: Model | None) -> Source:
    from touchd.sources.live import DaqSource
    from touchd.sources.ni import NiDaq

    acquisition = model.description.acquisition if model else PAPER
    return DaqSource(lambda: iter([lambda: NiDaq(settings.ni, acquisition)]), settings.device, acquisition)


def _open_usb(settings: Settings, model: Model | None, *, late: bool) -> Source:
    from touchd.sources.usb import open_usb

    if model is not None:
        return open_usb(settings.device, model.description.acquisition, model.check)
    try:
        return open_usb(settings.device)
    except (DeviceLost, DeviceBusy):
        if not late:
            raise
    return open_usb(settings.device, PAPER)
