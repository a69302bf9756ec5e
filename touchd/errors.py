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

    def __init__(self, what: str, where: str = "", fix: str = "") -> None:
        self.what = what
        self.where = where
        self.fix = fix
        super().__init__(what, where, fix)

    def __str__(self) -> str:
        line = f"{self.where}: {self.what}" if self.where else self.what
        return f"{line} -> {self.fix}" if self.fix else line


class ConfigError(TouchdError):
    """Configuration file, variable or option is invalid: correct the named key."""

    exit_code = 10


class RecordingError(TouchdError):
    """The recording is unusable."""

    exit_code = 20


class RecordingMissing(RecordingError):
    """The recording does not exist or cannot be opened: check the path."""

    exit_code = 21


class RecordingTruncated(RecordingError):
    """The .npz archive is incomplete: copy the file again, or remove the damaged chunk."""

    exit_code = 22


class RecordingVersion(RecordingError):
    """The file has an unknown format, or was written by a newer touchd: upgrade."""

    exit_code = 23


class RecordingShape(RecordingError):
    """An array or key is missing, or has the wrong type or shape."""

    exit_code = 24


class RecordingUnsafe(RecordingError):
    """The file contains pickled Python objects, which could run code; touchd refuses to load them."""

    exit_code = 25


class RecordingValues(RecordingError):
    """A value is NaN, infinite or out of order."""

    exit_code = 26


class ModelError(TouchdError):
    """The model is unusable."""

    exit_code = 30


class ModelMissing(ModelError):
    """The model file does not exist or cannot be opened: check the path."""

    exit_code = 31


class ModelInvalid(ModelError):
    """The file is not an ONNX model, or lacks touchd's metadata: export the model again."""

    exit_code = 32


class ModelMismatch(ModelError):
    """The model expects another acquisition: train a model for this one."""

    exit_code = 33


class BusError(TouchdError):
    """Publishing or receiving failed."""

    exit_code = 40


class AddressInUse(BusError):
    """Another process has bound the address: stop it, or bind another."""

    exit_code = 41


class InsecureBind(BusError):
    """The configuration binds an address beyond loopback without keys: configure CURVE keys."""

    exit_code = 42


class BusTimeout(BusError):
    """No message arrived in time: check that the other side runs."""

    exit_code = 43


class SourceError(TouchdError):
    """The source delivers no frames."""

    exit_code = 50


class DeviceLost(SourceError):
    """The DAQ was unplugged: check its cable."""

    exit_code = 51


class ReaderFailed(SourceError):
    """The DAQ's reader thread died or hangs: restart touchd."""

    exit_code = 52


class MissingExtra(TouchdError):
    """An optional package is missing: install the named extra."""

    exit_code = 60


class TrainingError(TouchdError):
    """The recording cannot train this model."""

    exit_code = 70


class SimulationError(TouchdError):
    """The twin cannot simulate this scene, plate or count."""

    exit_code = 80


class OutputError(TouchdError):
    """The file cannot be written: check folder, space and permissions."""

    exit_code = 90


class BridgeError(TouchdError):
    """No touch screen, or a mapping that does not fit: follow the remedy."""

    exit_code = 92


class GadgetError(TouchdError):
    """This computer cannot act as a USB device: it needs a device port, and root."""

    exit_code = 95


class CheckFailed(TouchdError):
    """Touchd doctor found a failure: follow the remedy in its report."""

    exit_code = 97


class JobError(TouchdError):
    """A job of a long computation failed: repeat the command, finished jobs are kept."""

    exit_code = 100


class ClusterError(JobError):
    """The Dask cluster is unreachable or unusable: check address, workers and versions."""

    exit_code = 101


class CalibrationError(TouchdError):
    """The plate cannot be calibrated."""

    exit_code = 110


class PlateFileInvalid(CalibrationError):
    """PLATE.toml is missing or invalid: correct the named key."""

    exit_code = 111


class PlateTouched(CalibrationError):
    """A finger lies on the plate in the recording: record it again untouched."""

    exit_code = 112


class PlateUnsteady(CalibrationError):
    """The plate drifts during the recording: let it settle, and record again."""

    exit_code = 113


class SignalClipped(CalibrationError):
    """The signal exceeds the ADC's range: lower the gain."""

    exit_code = 114


class PlateMismatch(CalibrationError):
    """The recording has another geometry than PLATE.toml."""

    exit_code = 115


class PlatePoor(CalibrationError):
    """The fitted plate explains too little of the response: follow its reasons, or accept it with --force."""

    exit_code = 116
