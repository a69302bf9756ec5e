"""Errors that touchd raises on purpose: one tree, each class with its cause, its remedy and its exit status."""

from __future__ import annotations


class TouchdError(Exception):
    """An error that states what failed, where, and what the user can do.

    Parameters
    ----------
    what : str
        The failure, in one clause.
    where : str
        File, key, address or array that caused it; may be empty.
    fix : str
        What the user can do; empty only if nothing helps.
    """

    exit_code = 1

    def __init_subclass__(cls, *, exit_code: int) -> None:
        cls.exit_code = exit_code

    def __init__(self, what: str, where: str = "", fix: str = "") -> None:
        self.what = what
        self.where = where
        self.fix = fix
        super().__init__(what, where, fix)

    def __str__(self) -> str:
        line = f"{self.where}: {self.what}" if self.where else self.what
        return f"{line} -> {self.fix}" if self.fix else line


class ConfigError(TouchdError, exit_code=10):
    """Configuration file, variable or option is invalid: correct the named key."""


class RecordingError(TouchdError, exit_code=20):
    """The recording is unusable."""


class RecordingMissing(RecordingError, exit_code=21):
    """The recording does not exist or cannot be opened: check the path."""


class RecordingTruncated(RecordingError, exit_code=22):
    """The .npz archive is incomplete: copy the file again, or remove the damaged chunk."""


class RecordingVersion(RecordingError, exit_code=23):
    """The file has an unknown format, or was written by a newer touchd: upgrade."""


class RecordingShape(RecordingError, exit_code=24):
    """An array or key is missing, or has the wrong type or shape."""


class RecordingUnsafe(RecordingError, exit_code=25):
    """The file contains pickled Python objects, which could run code; touchd refuses to load them."""


class RecordingValues(RecordingError, exit_code=26):
    """A value is NaN, infinite or out of order."""


class ModelError(TouchdError, exit_code=30):
    """The model is unusable."""


class ModelMissing(ModelError, exit_code=31):
    """The model file does not exist or cannot be opened: check the path."""


class ModelInvalid(ModelError, exit_code=32):
    """The file is not an ONNX model, or lacks touchd's metadata: export the model again."""


class ModelMismatch(ModelError, exit_code=33):
    """The model expects another acquisition: train a model for this one."""


class BusError(TouchdError, exit_code=40):
    """Publishing or receiving failed."""


class AddressInUse(BusError, exit_code=41):
    """Another process has bound the address: stop it, or bind another."""


class InsecureBind(BusError, exit_code=42):
    """The configuration binds an address beyond loopback without keys: configure CURVE keys."""


class BusTimeout(BusError, exit_code=43):
    """No message arrived in time: check that the other side runs."""


class SourceError(TouchdError, exit_code=50):
    """The source delivers no frames."""


class DeviceLost(SourceError, exit_code=51):
    """The DAQ was unplugged: check its cable."""


class ReaderFailed(SourceError, exit_code=52):
    """The DAQ's reader thread died or hangs: restart touchd."""


class DeviceBusy(SourceError, exit_code=53):
    """Another program uses the DAQ: stop that."""


class MissingExtra(TouchdError, exit_code=60):
    """An optional package is missing: install the named extra."""


class TrainingError(TouchdError, exit_code=70):
    """The recording cannot train this model."""


class SimulationError(TouchdError, exit_code=80):
    """The twin cannot simulate this scene, plate or count."""


class OutputError(TouchdError, exit_code=90):
    """The file cannot be written: check folder, space and permissions."""


class BridgeError(TouchdError, exit_code=92):
    """No touch screen, or a mapping that does not fit: follow the remedy."""


class GadgetError(TouchdError, exit_code=95):
    """The computer cannot act as a USB device: it needs a device port, and root."""


class CheckFailed(TouchdError, exit_code=97):
    """Touchd doctor found a failure: follow the remedy in its report."""


class JobError(TouchdError, exit_code=100):
    """A job of a long computation failed: repeat the command, finished jobs are kept."""


class ClusterError(JobError, exit_code=101):
    """The Dask cluster is unreachable or unusable: check address, workers and versions."""


class CalibrationError(TouchdError, exit_code=110):
    """The plate cannot be calibrated."""


class PlateFileInvalid(CalibrationError, exit_code=111):
    """PLATE.toml is missing or invalid: correct the named key."""


class PlateTouched(CalibrationError, exit_code=112):
    """A finger lies on the plate in the recording: record it again untouched."""


class PlateUnsteady(CalibrationError, exit_code=113):
    """The plate drifts during the recording: let it settle, and record again."""


class SignalClipped(CalibrationError, exit_code=114):
    """The signal exceeds the ADC's range: lower the gain."""


class PlateMismatch(CalibrationError, exit_code=115):
    """The recording has another geometry than PLATE.toml."""


class PlatePoor(CalibrationError, exit_code=116):
    """The fitted plate explains too little of the response: follow its reasons, or accept it with --force."""
