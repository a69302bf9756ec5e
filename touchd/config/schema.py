"""Every setting with its unit, range, default and meaning.

Each default is written here alone. docs/configuration.md and deploy/touchd.toml are generated from these models.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from touchd.config.bridges import InputSettings, TuioSettings
from touchd.config.kinds import LEAST_RATE, Endpoint, Group, OptionalPath, Section, refuse_key
from touchd.config.rigs import AudioSettings, NiSettings


class DeviceSettings(Section):
    """The DAQ, and the name under which its events are published."""

    name: str = Field("touchd", description="`device` in every message; tells several plates apart.", min_length=1)
    vendor_id: int = Field(0x1209, ge=0, le=0xFFFF, description="USB vendor id.")
    product_id: int = Field(0x0001, ge=0, le=0xFFFF, description="USB product id.")
    serial: str = Field("", description="USB serial number; empty takes the first device found.")
    rate_hz: int = Field(125, ge=1, le=65535, description="Frame rate asked of the device, Hz.")
    idle_rate_hz: int = Field(
        50, ge=1, le=65535, description="The same once the plate has been untouched for 2 s, Hz, if the device can "
        "change it; not above `rate_hz`. With the screen off it is 10.",
    )  # fmt: skip
    stall_s: float = Field(
        1.0,
        ge=0.05,
        le=10,
        description="After this time without a frame, contacts are lifted and the stream restarts, s.",
    )
    queue_frames: int = Field(
        64, ge=2, le=10000, description="Most frames that wait while the computer is busy; then the oldest are dropped."
    )


class ModelSettings(Section):
    """The network that places touches."""

    path: OptionalPath = Field(
        None,
        description="ONNX file with touchd's description; unset uses the installed model, and for a recording or a "
        "scene, if there is none, the shipped one.",
    )
    atlas: bool = Field(True, description="Place fingers by the field atlas beside the model: several, and finer.")
    min_confidence: float = Field(
        0.5, ge=0, le=1, description="Least confidence of the network that a frame shows a finger."
    )
    keep_confidence: float = Field(
        0.2, ge=0, le=1, description="The same while a contact is down: the hysteresis keeps it from splitting."
    )
    min_snr_db: float = Field(
        3.0, ge=0, le=100, description="Least ratio of signal to noise of a touch that the network alone locates, dB."
    )
    max_sigma_mm: float = Field(
        5.0, ge=0.001, le=1e9, description="Largest predicted standard error of a reported position, mm."
    )


class BaselineSettings(Section):
    """The untouched plate, followed as it drifts."""

    learn_frames: int = Field(
        32, ge=2, le=1000, description="Frames averaged into the first baseline; until then touchd detects nothing."
    )
    time_constant_s: float = Field(
        0.5, ge=0.01, le=3600, description="Time constant with which the baseline follows the untouched plate, s."
    )
    absorb_s: float = Field(
        30.0, ge=0.1, le=86400, description="A change that lasts this long becomes part of the baseline, s."
    )


class GateSettings(Section):
    """Detection: whether the plate is touched."""

    false_alarm_rate: float = Field(
        1e-7, ge=LEAST_RATE, lt=0.1, description="Probability per frame that noise alone opens the gate, at 125 "
        "frames/s; at other rates it is as rare per time.",
    )  # fmt: skip
    noise_frames: int = Field(
        1000, ge=10, le=1_000_000, description="Untouched frames over which the noise is averaged, at 125 "
        "frames/s; at other rates it is the same time.",
    )  # fmt: skip


class SkipSettings(Section):
    """Work that the scene does not need, which each key skips; false measures what it saves."""

    gate: bool = Field(
        True,
        description="No features and no network while the gate is closed.",
    )
    still: bool = Field(
        True,
        description="Nor on a frame that differs from the last one examined by noise alone.",
    )
    still_false_alarm_rate: float = Field(
        0.01, ge=LEAST_RATE, lt=0.5, description="Probability per frame that noise alone examines a still finger again."
    )
    unheard: bool = Field(True, description="No messages of a topic without subscribers.")
    screen: bool = Field(True, description="No touches while the screen is off (`touchd screen off`).")


class TrackerSettings(Section):
    """From positions to contacts."""

    confirm_frames: int = Field(
        2,
        ge=1,
        le=100,
        description="Consecutive frames before a contact is reported down: its delay. Up to 2, "
        "one is enough for a lone finger with a confidence above 0.99 and a `sigma_mm` below 0.3.",
    )
    reach_mm: float = Field(
        25.0, ge=0.1, le=1000, description="Farthest a contact moves from one frame to the next, mm."
    )
    dead_band_mm: float = Field(
        0.1, ge=0, le=1000, description="Movement within this, or within 1.5 `sigma_mm` if that is more, is `hold`, mm."
    )
    min_cutoff_hz: float = Field(
        4.0, ge=0.001, le=1e6, description="One-Euro filter: cut-off for a still finger with a `sigma_mm` of 0.5, Hz; "
        "a smaller `sigma_mm` raises it in proportion. From the next contact on.",
    )  # fmt: skip
    beta: float = Field(
        0.6, ge=0, le=1000, description="One-Euro filter: how the cut-off rises with speed, Hz per mm/s."
    )
    force_full_scale: float = Field(
        0.1, ge=1e-6, le=10, description="Change of the signal, as a share of its size, that is reported as `force` 1."
    )


class KeypadSettings(Section):
    """Keypad mode."""

    layout: OptionalPath = Field(None, description="TOML file of keys, rectangles in mm; it turns keypad mode on.")


class BusSettings(Section):
    """Where events are published."""

    bind: tuple[Endpoint, ...] = Field(
        (),
        description="Addresses of the publisher. Unset is `bus` in the service's runtime folder, or "
        "tcp://127.0.0.1:5570 without a service.",
    )
    ipc_group: Group = Field(
        "", description="Group that may use ipc:// sockets (mode 0660); empty keeps them private, "
        "but for the service's own, which is for `touchd-bus`.",
    )  # fmt: skip
    curve_secret_key: Annotated[OptionalPath, AfterValidator(refuse_key)] = Field(
        None, description="Server key file made by `touchd keygen`; needed for any address beyond loopback."
    )
    curve_clients: OptionalPath = Field(
        None,
        description="Folder of the public keys that may subscribe; unset admits every client with the server's key.",
    )
    insecure: bool = Field(False, description="Allow an address beyond loopback without keys.")
    high_water_mark: int = Field(
        1000, ge=1, le=100_000, description="Most messages that wait for a slow subscriber; then it loses some."
    )
    max_subscribers: int = Field(64, ge=1, le=10000, description="Most connections at once.")


class ControlSettings(Section):
    """The socket of `touchd screen`."""

    socket: OptionalPath = Field(
        None,
        description="Socket file; unset is `control` in the service's runtime folder, or no socket without a service.",
    )
    group: Group = Field("", description="Group that may use it (mode 0660); empty keeps it private.")


class HealthSettings(Section):
    """The `health` topic."""

    period_s: float = Field(1.0, ge=0.01, le=3600, description="Longest time between health messages, s.")


class PreRollSettings(Section):
    """The last seconds of frames, saved on SIGUSR1 to replay a ghost touch. They can reveal a PIN."""

    seconds: float = Field(10.0, ge=0, le=600, description="Time kept in memory, s; 0 keeps nothing.")
    folder: OptionalPath = Field(
        None, description="Where they are saved; unset is the service's state directory, or ~/.local/state/touchd."
    )
    min_confidence: float = Field(
        0.0, ge=0, le=1, description="A touch that goes down with a lower confidence saves them too; 0 never does."
    )
    keep: int = Field(20, ge=1, le=10_000, description="Most files in the folder; older ones are deleted.")


class LogSettings(Section):
    """The log."""

    level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="Least severe level that is logged."
    )
    format: Literal["auto", "console", "json"] = Field("auto", description="auto: console on a terminal, else JSON.")


class RealtimeSettings(Section):
    """What makes latency steadier; for more see docs/integrator.md."""

    awake_from_hz: float = Field(
        500.0, ge=0, le=65535, description="Frame rate from which the processors are kept awake while a finger is on "
        "the plate, Hz, if the system permits it; 0 never does.",
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
