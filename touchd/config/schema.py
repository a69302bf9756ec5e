"""The configuration: every setting with its unit, range, default and meaning.

The models here are the only place where a default is written; docs/configuration.md and
deploy/touchd.toml are generated from them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError


class _Section(BaseModel):
    """One table of the file. Unknown keys are errors; values are never changed after loading."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_bool_for_number(cls, value: Any, info: ValidationInfo) -> Any:
        # Pydantic would take `rate_hz = true` for 1.
        if isinstance(value, bool) and cls.model_fields[str(info.field_name)].annotation in (int, float):
            raise PydanticCustomError("number_type", "must be a number")
        return value


def _empty_is_unset(value: Any) -> Any:
    # TOML has no null: this is how a file says "none", and how it takes back what a lower layer set.
    return None if value == "" else value


def _is_nameable(path: Path | None) -> Path | None:
    text = str(path)
    if "\0" in text or any("\ud800" <= character <= "\udfff" for character in text):
        raise ValueError("holds characters that no file name can have")
    return path


def _is_no_key(path: Path | None) -> Path | None:
    text = str(path)
    if re.fullmatch(r"[^/\s,;'\"\\|`~_][^\s,;'\"\\|`~_]{39}", text) and not text.endswith(".key"):
        raise ValueError("looks like a key itself, must be the path of the file that holds it")
    return path


OptionalPath = Annotated[Path | None, BeforeValidator(_empty_is_unset), AfterValidator(_is_nameable)]
"""A path, or None; an empty text means None."""


class DeviceSettings(_Section):
    """The DAQ, and the name under which its events are published."""

    name: str = Field("touchd", description="`device` of every message; tell several plates apart by it.", min_length=1)
    vendor_id: int = Field(0x1209, ge=0, le=0xFFFF, description="USB vendor id.")
    product_id: int = Field(0x0001, ge=0, le=0xFFFF, description="USB product id.")
    serial: str = Field("", description="USB serial number; empty takes the first device found.")
    rate_hz: int = Field(125, ge=1, le=65535, description="Frames a second asked of the device.")
    stall_s: float = Field(
        1.0, ge=0.05, le=10, description="Without a frame for so long contacts are lifted and the stream begun anew, s."
    )
    queue_frames: int = Field(
        64, ge=2, le=10000, description="Frames that wait at most when the computer is busy; the oldest are dropped."
    )


class NiSettings(_Section):
    """A rig of NI hardware, taken instead of a DAQ on USB by the option --ni. Not tried on hardware."""

    inputs: str = Field("cDAQ1Mod1/ai0:3", description="Analog inputs, one for each receiver.", min_length=1)
    output: str = Field("cDAQ1Mod2/ao0", description="Analog output that plays the chirp.", min_length=1)
    trigger: str = Field(
        "", description="Terminal at which the inputs start; empty is the start trigger of the output's chassis."
    )
    amplitude_v: float = Field(5.0, gt=0, le=10, description="Of the chirp, V.")
    output_limit_v: float = Field(10.0, gt=0, le=100, description="What the output can give, V.")


class ModelSettings(_Section):
    """The network that places touches."""

    path: OptionalPath = Field(None, description="ONNX file with touchd's description; unset uses the shipped model.")
    atlas: bool = Field(
        True,
        description="Place fingers on the field atlas beside the model, if there is one: several, and ten times finer.",
    )
    min_confidence: float = Field(
        0.5, ge=0, le=1, description="Below this a frame is taken for something else than a finger, and not placed."
    )
    keep_confidence: float = Field(
        0.2, ge=0, le=1, description="The same while a contact is down: hysteresis, so that none is split."
    )
    min_snr_db: float = Field(
        3.0,
        ge=0,
        description="A change less than this above the noise tells that something is there, but not where, dB.",
    )
    max_sigma_mm: float = Field(
        5.0, gt=0, description="A finger placed less surely than this is not placed (yet); regression only, mm."
    )


class BaselineSettings(_Section):
    """The untouched plate, followed as it drifts."""

    learn_frames: int = Field(
        32, ge=2, description="Frames averaged into the first baseline, before anything is sensed."
    )
    time_constant_s: float = Field(0.5, gt=0, description="How fast the baseline follows the untouched plate, s.")
    absorb_s: float = Field(
        30.0, gt=0, description="What stays on the plate this long becomes part of the baseline, and is reported, s."
    )
    drift_below_db: float = Field(
        -50.0,
        lt=0,
        description="Without a finger, a change smaller than this share of the signal is drift and followed, dB.",
    )
    unsteady_s: float = Field(
        1.0,
        gt=0,
        description="A change without a finger that never repeats itself for this long is noise: learn it, s.",
    )


class GateSettings(_Section):
    """Whether anything is there at all."""

    false_alarm_rate: float = Field(
        1e-7, gt=0, lt=0.1, description="Probability that noise alone opens the gate, per frame."
    )
    close_ratio: float = Field(
        0.5, gt=0, lt=1, description="The gate closes at this fraction of the excess that opens it (hysteresis)."
    )
    noise_frames: int = Field(1000, ge=10, description="Untouched frames over which the noise is followed.")


class SkipSettings(_Section):
    """What the scene does not need is not done. Each skip can be switched off, to see what it saves."""

    gate: bool = Field(
        True, description="No features and no network while the gate is closed; if false they run all the same."
    )
    still: bool = Field(
        True, description="No features and no network while a frame is, but for the noise, the one looked at last."
    )
    still_false_alarm_rate: float = Field(
        0.01, gt=0, lt=0.5, description="Probability that noise alone has a still finger looked at again, per frame."
    )
    unheard: bool = Field(True, description="No messages of a topic that nobody is subscribed to.")
    screen: bool = Field(True, description="No touches while the screen is off, as told by `touchd screen off`.")


class TrackerSettings(_Section):
    """From positions to contacts."""

    confirm_frames: int = Field(2, ge=1, description="Frames in a row before a contact is reported down.")
    release_frames: int = Field(2, ge=1, description="Frames without it before a contact is reported up.")
    max_contacts: int = Field(10, ge=1, description="Contacts alive at once; further ones are ignored.")
    reach_mm: float = Field(25.0, gt=0, description="A contact moves at most this far from one frame to the next, mm.")
    dead_band_mm: float = Field(
        0.1, ge=0, description="Movement within this, or within 1.5 `sigma_mm` if that is more, is `hold`, mm."
    )
    min_cutoff_hz: float = Field(
        4.0, gt=0, description="One-Euro filter: cut-off for a still finger, Hz, where `sigma_mm` is 0.5; a surer "
        "one's is higher in proportion.",
    )  # fmt: skip
    beta: float = Field(
        0.6, ge=0, description="One-Euro filter: how much the cut-off opens with speed, Hz per mm/s, at the same sigma."
    )
    force_full_scale: float = Field(
        0.1, gt=0, description="Change of the signal, as a share of its size, that counts as `force` 1."
    )
    refresh_s: float = Field(0.1, gt=0, description="A message at least this often while a contact is down, s.")


class KeypadSettings(_Section):
    """Keypad mode."""

    layout: OptionalPath = Field(
        None, description="TOML file of keys with rectangles in mm; set, it turns keypad mode on."
    )


Endpoint = Annotated[str, Field(pattern=r"^(tcp|ipc)://.+$")]


class BusSettings(_Section):
    """Where events are published."""

    bind: tuple[Endpoint, ...] = Field(
        ("tcp://127.0.0.1:5570",), min_length=1, description="Addresses of the publisher: tcp:// or ipc://."
    )
    ipc_group: str = Field("", description="Group that may use ipc:// sockets (mode 0660); empty keeps them private.")
    curve_secret_key: Annotated[OptionalPath, AfterValidator(_is_no_key)] = Field(
        None, description="Server key file made by `touchd keygen`; needed for any address beyond loopback."
    )
    curve_clients: OptionalPath = Field(
        None,
        description="Folder of the public keys that may subscribe; unset admits every client that has the server's.",
    )
    insecure: bool = Field(False, description="Allow an address beyond loopback without keys.")
    high_water_mark: int = Field(1000, ge=1, description="Messages kept for a slow subscriber before it loses some.")


class ControlSettings(_Section):
    """Where the daemon is told that the screen went off or on: see `touchd screen`."""

    socket: OptionalPath = Field(
        None,
        description="Socket file; unset is `control` in the service's runtime folder, and none without a service.",
    )
    group: str = Field("", description="Group that may use it (mode 0660); empty keeps it private.")


class HealthSettings(_Section):
    """The `health` topic."""

    period_s: float = Field(1.0, gt=0, description="A health message at least this often, s.")


class PreRollSettings(_Section):
    """The last seconds of frames, saved on SIGUSR1 so that a ghost touch can be replayed. They can reveal a PIN."""

    seconds: float = Field(10.0, ge=0, le=600, description="Kept in memory, s; 0 keeps none.")
    folder: OptionalPath = Field(
        None, description="Where they are saved; unset is the service's state directory, or ~/.local/state/touchd."
    )
    min_confidence: float = Field(
        0.0, ge=0, le=1, description="A touch that goes down less surely than this saves them too; 0 never does."
    )
    interval_s: float = Field(10.0, ge=0, description="They are not saved more often than this, s.")
    keep: int = Field(20, ge=1, description="Files kept in the folder; older ones are deleted.")


class LogSettings(_Section):
    """What is logged, and how."""

    level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="Least severe level that is logged."
    )
    format: Literal["auto", "console", "json"] = Field("auto", description="auto: console on a terminal, else JSON.")


class RealtimeSettings(_Section):
    """Optional: what makes latency steadier; docs/integrator.md has the measured benefit."""

    cpus: tuple[Annotated[int, Field(ge=0)], ...] = Field(
        (), description="Processors that the daemon may run on; empty leaves it to the kernel."
    )
    fifo_priority: int = Field(
        0, ge=0, le=99, description="Priority under SCHED_FIFO, ahead of all ordinary programs; 0 is ordinary."
    )
    nice: int = Field(0, ge=-20, le=19, description="Among ordinary programs, lower is ahead.")
    lock_memory: bool = Field(False, description="Keep all of the daemon's memory from being swapped out.")
    freeze_gc: bool = Field(True, description="Leave what was loaded at the start out of Python's garbage collection.")
    awake_from_hz: float = Field(
        500.0,
        ge=0,
        description="With so many frames a second or more, keep the processors from sleeping between them while a "
        "finger is on the plate, if the system permits it; 0 never does.",
    )


class Settings(_Section):
    """The whole configuration."""

    device: DeviceSettings = DeviceSettings()
    ni: NiSettings = NiSettings()
    model: ModelSettings = ModelSettings()
    baseline: BaselineSettings = BaselineSettings()
    gate: GateSettings = GateSettings()
    skip: SkipSettings = SkipSettings()
    tracker: TrackerSettings = TrackerSettings()
    keypad: KeypadSettings = KeypadSettings()
    bus: BusSettings = BusSettings()
    control: ControlSettings = ControlSettings()
    health: HealthSettings = HealthSettings()
    preroll: PreRollSettings = PreRollSettings()
    log: LogSettings = LogSettings()
    realtime: RealtimeSettings = RealtimeSettings()
