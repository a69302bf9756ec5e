"""Every setting with its unit, range, default and meaning.

Each default is written here alone. docs/configuration.md and deploy/touchd.toml are generated from these models.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, field_validator

from touchd.config.kinds import LEAST_RATE, Endpoint, Group, OptionalPath, Section, UsbId, refuse_key
from touchd.config.rigs import AudioSettings, NiSettings

Place = tuple[Annotated[float, Field(ge=-1e5, le=1e5)], Annotated[float, Field(ge=-1e5, le=1e5)]]
"""x and y, mm."""


class DeviceSettings(Section):
    """The DAQ."""

    name: str = Field("touchd", description="`device` in every message: tells plates apart.", min_length=1)
    vendor_id: UsbId = Field(0x1209, description="USB vendor id.")
    product_id: UsbId = Field(0x0001, description="USB product id.")
    serial: str = Field("", description="USB serial number; empty: any.")
    rate_hz: int = Field(
        125, ge=1, le=65535, description="Frames a second; unset, an audio interface takes the nearest that whole "
        "chirps fill.",
    )  # fmt: skip
    idle_rate_hz: int = Field(
        50,
        ge=1,
        le=65535,
        description="The same of an untouched plate, if the device can change it; more than `rate_hz` is `rate_hz`.",
    )
    stall_s: float = Field(
        1.0, ge=0.05, le=10, description="After this time without a frame, s, contacts lift and the stream restarts."
    )
    queue_frames: int = Field(
        64, ge=2, le=10000, description="Most frames that wait for a busy computer; then the oldest are dropped."
    )


class ModelSettings(Section):
    """The network that places touches."""

    path: OptionalPath = Field(
        None, description="ONNX file; unset: the installed model, else, of a recording or a scene, the shipped one."
    )
    atlas: bool = Field(True, description="Use the field atlas beside the model.")
    min_confidence: float = Field(0.5, ge=0, le=1, description="Least confidence of the network in a finger.")
    keep_confidence: float = Field(0.2, ge=0, le=1, description="The same while a contact is down.")
    min_snr_db: float = Field(
        3.0, ge=0, le=100, description="Least signal-to-noise ratio of a touch that the network alone places, dB."
    )
    max_sigma_mm: float = Field(5.0, ge=0.001, le=1e9, description="Largest standard error of a reported position, mm.")
    feet_mm: tuple[Place, ...] = Field(
        (), max_length=64, description="Where the plate lies on feet or pads that nothing glues, mm: fingers press it "
        "on them, and they answer as light fingers would."
    )  # fmt: skip


class BaselineSettings(Section):
    """The untouched plate, followed as it drifts."""

    learn_frames: int = Field(32, ge=2, le=1000, description="Frames averaged into the first baseline.")
    time_constant_s: float = Field(0.5, ge=0.01, le=3600, description="Time constant with which it follows, s.")
    absorb_s: float = Field(30.0, ge=0.1, le=86400, description="A change that lasts this long, s, becomes part of it.")


class GateSettings(Section):
    """Detection: whether the plate is touched."""

    false_alarm_rate: float = Field(
        1e-7, ge=LEAST_RATE, lt=0.1, description="Probability per frame that noise opens the gate, at 125 frames/s; as "
        "rare per time at any rate.",
    )  # fmt: skip
    noise_frames: int = Field(
        1000, ge=10, le=1_000_000, description="Untouched frames over which noise is averaged, at 125 "
        "frames/s; the same time at any rate.",
    )  # fmt: skip


class SkipSettings(Section):
    """Work to skip; false measures what that saves."""

    gate: bool = Field(True, description="Skip features and network while the gate is closed.")
    still: bool = Field(True, description="Skip them if a frame differs from the last one examined by noise alone.")
    still_false_alarm_rate: float = Field(
        0.01, ge=LEAST_RATE, lt=0.5, description="Probability per frame that noise alone undoes that."
    )
    unheard: bool = Field(True, description="Skip messages without a subscriber.")
    screen: bool = Field(True, description="Skip touches while the screen is off (`touchd screen off`).")


class TrackerSettings(Section):
    """From positions to contacts."""

    confirm_frames: int = Field(
        2,
        ge=1,
        le=100,
        description="Frames in a row before a contact is `down`; with 1 or 2, a sure lone finger needs one.",
    )
    reach_mm: float = Field(
        25.0, ge=0.1, le=1000, description="Farthest that a contact moves between frames, mm; one at rest, less."
    )
    dead_band_mm: float = Field(
        0.1, ge=0, le=1000, description="Movement within this, or within 1.5 `sigma_mm` if that is more, is `hold`, mm."
    )
    min_cutoff_hz: float = Field(
        4.0,
        ge=0.001,
        le=1e6,
        description="One-Euro filter: cut-off of a still finger, Hz, in proportion to 0.5 / `sigma_mm`.",
    )
    beta: float = Field(0.6, ge=0, le=1000, description="One-Euro filter: rise of the cut-off with speed, Hz per mm/s.")
    force_full_scale: float = Field(
        0.1, ge=1e-6, le=10, description="Change of the signal, as a share of it, that is `force` 1."
    )


class KeypadSettings(Section):
    """Keys."""

    layout: OptionalPath = Field(None, description="TOML file of keys; it turns keypad mode on.")


class BusSettings(Section):
    """Where events are published."""

    bind: tuple[Endpoint, ...] = Field(
        (),
        description="Addresses of the publisher; unset: `bus` in the service's runtime folder, or tcp://127.0.0.1:5570.",
    )
    ipc_group: Group = Field(
        "", description="Group that may use ipc:// sockets; empty: none, but `touchd-bus` the service's own.",
    )  # fmt: skip
    curve_secret_key: Annotated[OptionalPath, AfterValidator(refuse_key)] = Field(
        None, description="Server key file made by `touchd keygen`; needed beyond loopback."
    )
    curve_clients: OptionalPath = Field(
        None, description="Folder of the public keys that may subscribe; unset: every client with the server's key."
    )
    insecure: bool = Field(False, description="Allow an address beyond loopback without keys.")
    high_water_mark: int = Field(1000, ge=1, le=100_000, description="Most messages that wait for a slow subscriber.")
    max_subscribers: int = Field(64, ge=1, le=10000, description="Most connections at once.")


class InputSettings(Section):
    """The screen below the plate. `touchd input` and `touchd tuio` read it when they start."""

    screen_mm: tuple[float, ...] = Field(
        (), description="Where it lies on the plate: [x, y, width, height], mm; `touchd map` measures it. Needed."
    )
    rotate: int = Field(
        0, ge=0, le=270, multiple_of=90, description="Degrees by which the picture is turned clockwise, by 90."
    )
    residual_mm: float = Field(
        0.0, ge=0, le=1000, description="RMS error of the mapping by `touchd map`, mm; 0: written by hand."
    )
    border: Literal["clamp", "lift"] = Field(
        "clamp", description="A finger that leaves the screen stays at its border, or lifts."
    )
    edge_mm: float = Field(
        0.0, ge=0, le=100, description="Fingers that come down nearer to the screen's border, mm, are dropped."
    )
    min_contact_s: float = Field(0.0, ge=0, le=5, description="Time before a finger counts, s, to within 0.1 s.")
    ignore: tuple[Literal["palm", "water", "object"], ...] = Field(
        ("palm", "water", "object"), description="Kinds of contacts to drop."
    )
    hold_off: bool = Field(
        False, description="No touches while all screens or backlights are off; a finger then wakes nothing."
    )
    keypad: bool = Field(False, description="Type the keys of `keypad.layout` instead of being a touch screen.")

    @field_validator("screen_mm")
    @classmethod
    def _is_a_rectangle(cls, screen_mm: tuple[float, ...]) -> tuple[float, ...]:
        if screen_mm and (len(screen_mm) != 4 or not all(10 <= size <= 10_000 for size in screen_mm[2:])
                          or not all(abs(at) <= 10_000 for at in screen_mm[:2])):  # fmt: skip
            raise ValueError("must be x, y, width and height, mm, the last two from 10 to 10000")
        return screen_mm


class TuioSettings(Section):
    """Where `touchd tuio` sends touches."""

    to: str = Field("127.0.0.1:3333", description="HOST:PORT, UDP.", min_length=1)
    insecure: bool = Field(False, description="Allow an address beyond loopback, unencrypted.")

    @field_validator("to")
    @classmethod
    def _has_a_port(cls, to: str) -> str:
        host, _, port = to.rpartition(":")
        if not host.strip("[]") or not port.isdecimal() or not 0 < int(port) < 65536:
            raise ValueError("must be HOST:PORT, for example 127.0.0.1:3333")
        return to


class ControlSettings(Section):
    """The socket of `touchd screen`."""

    socket: OptionalPath = Field(
        None, description="Socket file; unset: `control` in the service's runtime folder, or none."
    )
    group: Group = Field("", description="Group that may use it.")


class HealthSettings(Section):
    """The `health` topic."""

    period_s: float = Field(
        1.0, ge=0.01, le=3600, description="Longest time between health messages, s; without subscribers 10."
    )


class PreRollSettings(Section):
    """The last seconds of frames, saved on SIGUSR1. They can reveal a PIN."""

    seconds: float = Field(10.0, ge=0, le=600, description="Time kept in memory, s.")
    folder: OptionalPath = Field(
        None, description="Where they are saved; unset: in the service's state folder, or ~/.local/state."
    )
    min_confidence: float = Field(
        0.0, ge=0, le=1, description="A touch that goes down with a lower confidence saves them, too."
    )
    keep: int = Field(20, ge=1, le=10_000, description="Most files kept.")


class LogSettings(Section):
    """The log."""

    level: Literal["debug", "info", "warning", "error"] = Field("info", description="Lowest level that is logged.")
    format: Literal["auto", "console", "json"] = Field("auto", description="auto: console on a terminal, else json.")


class RealtimeSettings(Section):
    """Latency: see docs/integrator.md."""

    awake_from_hz: float = Field(
        500.0, ge=0, le=65535, description="Frame rate from which a finger keeps the processors awake, Hz; 0: never.",
    )  # fmt: skip


RETIRED = {
    "realtime.cpus": "CPUAffinity= in a drop-in of the systemd unit",
    "realtime.fifo_priority": "CPUSchedulingPolicy=fifo and CPUSchedulingPriority= in a drop-in of the systemd unit",
    "realtime.nice": "Nice= in a drop-in of the systemd unit",
    "realtime.lock_memory": "MemorySwapMax=0 in a drop-in of the systemd unit",
    "realtime.freeze_gc": "nothing: the daemon always exempts what it loads at the start",
    "model.contact_shapes": "nothing: fingers always have a size and a shape",
    "baseline.drift_below_db": "nothing: -50 dB always",
    "baseline.unsteady_s": "nothing: 1 s always",
    "gate.close_ratio": "nothing: the gate closes at half of the excess that opens it, always",
    "tracker.release_frames": "nothing: 2 frames always",
    "tracker.max_contacts": "nothing: 10 contacts always",
    "tracker.refresh_s": "nothing: 0.1 s always",
    "preroll.interval_s": "nothing: 10 s always",
}
"""Keys that earlier versions had, and what took their place. They are accepted and ignored, with a warning."""


class Settings(Section):
    """The whole configuration."""

    device: DeviceSettings = DeviceSettings()
    ni: NiSettings = NiSettings()
    audio: AudioSettings = AudioSettings()
    model: ModelSettings = ModelSettings()
    baseline: BaselineSettings = BaselineSettings()
    gate: GateSettings = GateSettings()
    skip: SkipSettings = SkipSettings()
    tracker: TrackerSettings = TrackerSettings()
    keypad: KeypadSettings = KeypadSettings()
    bus: BusSettings = BusSettings()
    input: InputSettings = InputSettings()
    tuio: TuioSettings = TuioSettings()
    control: ControlSettings = ControlSettings()
    health: HealthSettings = HealthSettings()
    preroll: PreRollSettings = PreRollSettings()
    log: LogSettings = LogSettings()
    realtime: RealtimeSettings = RealtimeSettings()
