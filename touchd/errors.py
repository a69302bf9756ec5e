"""Errors that touchd raises on purpose: one tree, each class with its exit status.

::

    TouchdError                    exit  cause: remedy
    ├── ConfigError                  10  configuration file, variable or option is invalid: correct the named key
    ├── RecordingError               20  the recording is unusable
    │   ├── RecordingMissing         21  no such file or folder: check the path
    │   ├── RecordingTruncated       22  incomplete .npz: copy the file again, or remove the damaged chunk
    │   ├── RecordingVersion         23  unknown format, or written by a newer touchd: upgrade
    │   ├── RecordingShape           24  an array or key is missing, or has the wrong type or shape
    │   ├── RecordingUnsafe          25  the file contains pickled objects; touchd refuses to load them
    │   └── RecordingValues          26  NaN, infinity, or values out of order
    ├── ModelError                   30  the model is unusable
    │   ├── ModelMissing             31  no such file: check the path
    │   ├── ModelInvalid             32  not ONNX, or without touchd's metadata: export the model again
    │   └── ModelMismatch            33  the model expects another acquisition: train a model for this one
    ├── BusError                     40  publishing or receiving failed
    │   ├── AddressInUse             41  another process has bound the address: stop it, or bind another
    │   ├── InsecureBind             42  a bind beyond loopback without keys: configure CURVE keys
    │   └── BusTimeout               43  no message arrived in time: check that the other side runs
    ├── SourceError                  50  the source delivers no frames
    │   ├── DeviceLost               51  the DAQ was unplugged: check its cable
    │   └── ReaderFailed             52  the DAQ's reader thread died or hangs: restart touchd
    ├── MissingExtra                 60  an optional package is missing: install the named extra
    ├── TrainingError                70  the recording cannot train this model
    ├── SimulationError              80  the twin cannot simulate this scene, plate or count
    ├── OutputError                  90  the file cannot be written: check folder, space and permissions
    ├── BridgeError                  92  no touch screen, or a mapping that does not fit: follow the remedy
    ├── GadgetError                  95  this computer cannot act as a USB device: it needs a device port, and root
    ├── CheckFailed                  97  touchd doctor found a failure: follow the remedy in its report
    ├── JobError                    100  a job of a long computation failed: repeat the command, finished jobs are kept
    │   └── ClusterError            101  the Dask cluster is unusable: check address, workers and versions
    └── CalibrationError            110  the plate cannot be calibrated
        ├── PlateFileInvalid        111  PLATE.toml is unusable: correct the named key
        ├── PlateTouched            112  a finger lies on the plate in the recording: record it again untouched
        ├── PlateUnsteady           113  the plate drifts during the recording: let it settle, and record again
        ├── SignalClipped           114  the signal exceeds the ADC's range: lower the gain
        ├── PlateMismatch           115  the recording has another geometry than PLATE.toml
        └── PlatePoor               116  the fit is poor: follow its reasons, or accept it with --force
"""

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
    """A configuration file, environment variable or option is invalid."""

    exit_code = 10


class RecordingError(TouchdError):
    """The recording is unusable."""

    exit_code = 20


class RecordingMissing(RecordingError):
    """The recording does not exist or cannot be opened."""

    exit_code = 21


class RecordingTruncated(RecordingError):
    """The .npz archive is incomplete."""

    exit_code = 22


class RecordingVersion(RecordingError):
    """The file has an unknown format or version."""

    exit_code = 23


class RecordingShape(RecordingError):
    """An array or key is missing, or has the wrong type or shape."""

    exit_code = 24


class RecordingUnsafe(RecordingError):
    """The file contains pickled Python objects, which could run code."""

    exit_code = 25


class RecordingValues(RecordingError):
    """A value is NaN, infinite or out of order."""

    exit_code = 26


class ModelError(TouchdError):
    """The model is unusable."""

    exit_code = 30


class ModelMissing(ModelError):
    """The model file does not exist or cannot be opened."""

    exit_code = 31


class ModelInvalid(ModelError):
    """The file is not an ONNX model, or lacks touchd's metadata."""

    exit_code = 32


class ModelMismatch(ModelError):
    """The model expects frames of another acquisition."""

    exit_code = 33


class BusError(TouchdError):
    """Publishing or receiving events failed."""

    exit_code = 40


class AddressInUse(BusError):
    """Another process has bound the address."""

    exit_code = 41


class InsecureBind(BusError):
    """The configuration binds an address beyond loopback without keys."""

    exit_code = 42


class BusTimeout(BusError):
    """No message arrived in time."""

    exit_code = 43


class SourceError(TouchdError):
    """The source delivers no frames."""

    exit_code = 50


class DeviceLost(SourceError):
    """The DAQ was unplugged."""

    exit_code = 51


class ReaderFailed(SourceError):
    """The DAQ's reader thread died or hangs."""

    exit_code = 52


class MissingExtra(TouchdError):
    """The verb needs an optional package."""

    exit_code = 60


class TrainingError(TouchdError):
    """The recording cannot train this model."""

    exit_code = 70


class SimulationError(TouchdError):
    """The twin cannot simulate this scene, plate or count."""

    exit_code = 80


class OutputError(TouchdError):
    """The file cannot be written."""

    exit_code = 90


class BridgeError(TouchdError):
    """A bridge cannot make its touch screen, or the mapping of the screen does not fit."""

    exit_code = 92


class GadgetError(TouchdError):
    """The computer cannot act as a USB device."""

    exit_code = 95


class CheckFailed(TouchdError):
    """`touchd doctor` found a failure."""

    exit_code = 97


class JobError(TouchdError):
    """A job of a long computation failed."""

    exit_code = 100


class ClusterError(JobError):
    """The Dask cluster is unreachable or unusable."""

    exit_code = 101


class CalibrationError(TouchdError):
    """The plate cannot be calibrated."""

    exit_code = 110


class PlateFileInvalid(CalibrationError):
    """PLATE.toml is missing or invalid."""

    exit_code = 111


class PlateTouched(CalibrationError):
    """A finger lies on the plate in a recording that must be untouched."""

    exit_code = 112


class PlateUnsteady(CalibrationError):
    """The plate drifts during the recording."""

    exit_code = 113


class SignalClipped(CalibrationError):
    """The signal exceeds the range of the ADC."""

    exit_code = 114


class PlateMismatch(CalibrationError):
    """The recording has another geometry than PLATE.toml."""

    exit_code = 115


class PlatePoor(CalibrationError):
    """The fitted plate explains too little of the response."""

    exit_code = 116
