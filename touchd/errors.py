"""Every failure a user can cause, as one tree.

::

    TouchdError                    exit  when, and what helps
    ├── ConfigError                  10  a configuration file, variable or option is wrong: correct the named key
    ├── RecordingError               20  a recording cannot be used
    │   ├── RecordingMissing         21  no such file or folder: check the path
    │   ├── RecordingTruncated       22  not a whole .npz: copy it again, or drop the damaged chunk
    │   ├── RecordingVersion         23  another format or a newer version: upgrade touchd
    │   ├── RecordingShape           24  an array or key is missing, or has the wrong type or shape
    │   ├── RecordingUnsafe          25  holds pickled objects, which are never loaded
    │   └── RecordingValues          26  NaN, infinity or disorder where numbers are needed
    ├── ModelError                   30  a model cannot be used
    │   ├── ModelMissing             31  no such file: check the path
    │   ├── ModelInvalid             32  not ONNX, or without touchd's description: export it again
    │   └── ModelMismatch            33  the model does not fit the frames: train one for this acquisition
    ├── BusError                     40  events cannot be published or received
    │   ├── AddressInUse             41  another process holds the address: stop it, or bind elsewhere
    │   ├── InsecureBind             42  beyond loopback without keys: configure CURVE keys
    │   └── BusTimeout               43  nobody answered in time: check that the other side runs
    ├── SourceError                  50  frames cannot be read
    │   ├── DeviceLost               51  the DAQ is gone: look at the cable
    │   └── ReaderFailed             52  the thread that reads the DAQ died or hangs: restart touchd
    ├── MissingExtra                 60  an optional package is needed: install the named extra
    ├── TrainingError                70  a model cannot be trained from this recording
    ├── SimulationError              80  a scene, plate or count that the twin cannot make
    ├── OutputError                  90  a file cannot be written: check folder, space and permissions
    ├── GadgetError                  95  this computer cannot be a USB device: it needs a port for that, and root
    ├── CheckFailed                  97  touchd doctor found a failure: do what its lines say
    └── JobError                    100  a part of a long computation failed: the line names it; what is done is kept
        └── ClusterError            101  a Dask cluster cannot be used: check the address, its workers and versions
"""

from __future__ import annotations


class TouchdError(Exception):
    """A failure with an explanation: what happened, where, and what to do about it.

    Parameters
    ----------
    what : str
        What went wrong, in one clause.
    where : str
        The file, key, address or array concerned; empty if there is none.
    fix : str
        What the reader can do; empty only if nothing can be done.
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
    """A configuration file, environment variable or option is wrong."""

    exit_code = 10


class RecordingError(TouchdError):
    """A recording cannot be used."""

    exit_code = 20


class RecordingMissing(RecordingError):
    """The recording does not exist or cannot be opened."""

    exit_code = 21


class RecordingTruncated(RecordingError):
    """The file is not a whole .npz archive."""

    exit_code = 22


class RecordingVersion(RecordingError):
    """The file is another format, or a version this program does not know."""

    exit_code = 23


class RecordingShape(RecordingError):
    """An array or key is missing, or has the wrong type or shape."""

    exit_code = 24


class RecordingUnsafe(RecordingError):
    """The file holds pickled Python objects, which could run code; they are never loaded."""

    exit_code = 25


class RecordingValues(RecordingError):
    """A value is NaN, infinite or out of order where a number is needed."""

    exit_code = 26


class ModelError(TouchdError):
    """A model cannot be used."""

    exit_code = 30


class ModelMissing(ModelError):
    """The model file does not exist or cannot be opened."""

    exit_code = 31


class ModelInvalid(ModelError):
    """The file is not an ONNX model, or carries no usable description."""

    exit_code = 32


class ModelMismatch(ModelError):
    """The model was made for another acquisition than the frames at hand."""

    exit_code = 33


class BusError(TouchdError):
    """Events cannot be published or received."""

    exit_code = 40


class AddressInUse(BusError):
    """Another process already holds the address."""

    exit_code = 41


class InsecureBind(BusError):
    """An address beyond loopback was asked for without keys."""

    exit_code = 42


class BusTimeout(BusError):
    """Nobody answered in time."""

    exit_code = 43


class SourceError(TouchdError):
    """Frames cannot be read."""

    exit_code = 50


class DeviceLost(SourceError):
    """The DAQ has gone."""

    exit_code = 51


class ReaderFailed(SourceError):
    """The thread that reads the DAQ has died, or hangs."""

    exit_code = 52


class MissingExtra(TouchdError):
    """An optional package is needed for this verb."""

    exit_code = 60


class TrainingError(TouchdError):
    """No model can be trained from this recording."""

    exit_code = 70


class SimulationError(TouchdError):
    """A scene, plate or count that the twin cannot make."""

    exit_code = 80


class OutputError(TouchdError):
    """A file cannot be written."""

    exit_code = 90


class GadgetError(TouchdError):
    """A computer that cannot be a USB device."""

    exit_code = 95


class CheckFailed(TouchdError):
    """An examination of the set-up found a failure."""

    exit_code = 97


class JobError(TouchdError):
    """A part of a long computation failed."""

    exit_code = 100


class ClusterError(JobError):
    """A Dask cluster cannot be reached or used."""

    exit_code = 101
