"""An ONNX network with its own description inside, run on one thread with buffers bound once."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from touchd.errors import ModelInvalid, ModelMismatch, ModelMissing
from touchd.files import is_missing, open_file, stamps_of
from touchd.frame import HANN, Acquisition, Plate
from touchd.keypad import Layout
from touchd.localization.atlas import Atlas, atlas_path, load_atlas
from touchd.localization.features import Domain, band_bins

METADATA_KEY = "touchd"
_FLOAT, _DOUBLE = "tensor(float)", "tensor(double)"
_NO_ONNX = "INVALID_PROTOBUF", "No graph was found"
"""What ONNX Runtime says of a file that is none."""
Head = Literal["regression", "grid", "keypad"]
Outputs = dict[str, NDArray[np.floating]]


class Description(BaseModel):
    """What a model says of itself: the JSON object under `touchd` in the ONNX file's metadata."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    version: Literal[1] = 1
    name: str
    head: Head
    domain: Domain
    """Frequency (windowed bins of the chirp's band) or time (samples)."""
    taper: float = Field(default=HANN, ge=0, le=1)
    """Of the bins' window: the share of the frame over which it rises and falls; 1 is Hann's."""
    input: Literal["residual", "signal"]
    """Whether the baseline is subtracted before the features are taken."""
    acquisition: Acquisition
    plate: Plate
    grid: int = Field(default=0, ge=0, le=1000)
    """Grid head: zones along each side."""
    layout: Layout | None = None
    """Keypad head: the keys, in the order of the classes; the last class is the zone around them."""
    precision: Literal["float32", "int8"] = "float32"
    """Of the weights."""
    data_sha256: str = ""
    """Digest of the training recording's frames and truth."""
    command: str = ""
    """The command that made the model."""
    seed: int = 0
    scores: dict[str, float] = {}
    """On held-out touches, for example `rmse_mm`."""

    @property
    def inputs(self) -> int:
        """Number of features that the network takes."""
        a = self.acquisition
        return a.channels * (2 * len(band_bins(a)) if self.domain == "frequency" else a.samples)


class Estimate(NamedTuple):
    """Where a finger is, by one frame alone."""

    x_mm: float
    y_mm: float
    sigma_mm: float
    """Predicted standard error, per axis; without that of noise where `noise_mm` tells it."""
    confidence: float
    """0..1: how much the frame looks like a finger."""
    key: str | None = None
    """Keypad head only: the key, None beside all keys."""
    noise_mm: float = 0.0
    """Predicted standard error, per axis, of noise as strong as the features; 0 where it is not told apart."""

    def error_mm(self, noise_to_signal: float) -> float:
        """Return the predicted standard error, per axis, in noise of this norm over that of the features."""
        return math.hypot(self.sigma_mm, self.noise_mm * noise_to_signal)


class Model:
    """A loaded network. `features` is its input buffer: fill it, then call `estimate`.

    Parameters
    ----------
    path : Path
    atlas : bool
        Whether to load the field atlas that may lie beside it.

    Raises
    ------
    ModelMissing, ModelInvalid
        If the file cannot be read, is no ONNX model, or carries no usable description.
    """

    def __init__(self, path: Path, *, atlas: bool = True) -> None:
        self.path = path
        self.stamps = stamps_of(path, atlas_path(path))
        """What told its files from others at the same path before they were read."""
        self._session = _load(path)
        self.description = _describe(self._session, path)
        self._check_input()
        network_input = self._session.get_inputs()[0]
        self.dtype: np.dtype[np.floating] = np.dtype(np.float64 if network_input.type == _DOUBLE else np.float32)
        """Of the network's input, and of all arrays from the frame to it."""
        self._check_outputs()
        self.features = np.zeros((1, self.description.inputs), self.dtype)
        self.outputs: Outputs = {
            output.name: np.zeros((1, output.shape[1]), self.dtype) for output in self._session.get_outputs()
        }
        self._binding = self._session.io_binding()
        self._binding.bind_input(
            network_input.name, "cpu", 0, self.dtype.type, self.features.shape, self.features.ctypes.data
        )
        for name, buffer in self.outputs.items():
            self._binding.bind_output(name, "cpu", 0, self.dtype.type, buffer.shape, buffer.ctypes.data)
        self._read = _READERS[self.description.head]
        self.atlas = self._load_atlas() if atlas else None
        """The field atlas beside it, if there is one."""
        try:
            self.estimate()  # the first run allocates: have it done before the first touch
        except Exception as error:  # ONNX Runtime's are of no common class
            raise _invalid(path, f"the network does not run ({_first_line(error)})") from error

    def check(self, acquisition: Acquisition) -> None:
        """Raise ModelMismatch unless frames of this acquisition are what the model was trained on."""
        mine = self.description.acquisition
        if mine.shape != acquisition.shape:
            raise ModelMismatch(
                f"the model takes frames of shape {mine.shape} (channels, samples), these are {acquisition.shape}",
                str(self.path),
                "use a model made for this acquisition: touchd calibrate, or touchd train",
            )
        for name in ("sample_rate_hz", "chirp"):
            if getattr(mine, name) != getattr(acquisition, name):
                raise ModelMismatch(
                    f"the model was trained with {name} = {getattr(mine, name)}, "
                    f"the frames have {getattr(acquisition, name)}",
                    str(self.path),
                    "use a model made for this acquisition: touchd calibrate, or touchd train",
                )

    def run(self, features: NDArray[np.float32]) -> Outputs:
        """Return the outputs for many feature vectors, shape (n, inputs), each with n rows; for offline jobs.

        One by one, as the daemon runs them: an int8 network scales its activations by the whole batch.
        """
        rows: dict[str, list[NDArray[np.float32]]] = {name: [] for name in self.outputs}
        for self.features[0] in features:
            self.infer()
            for name, buffer in self.outputs.items():
                rows[name].append(buffer[0].copy())
        return {name: np.array(found, np.float32).reshape(len(features), -1) for name, found in rows.items()}

    def infer(self) -> None:
        """Run the network on `features`, filling `outputs`."""
        self._session.run_with_iobinding(self._binding)

    def estimate(self) -> Estimate:
        """Run the network on `features` and return what it says."""
        self.infer()
        return self._read(self)

    def _load_atlas(self) -> Atlas | None:
        path = atlas_path(self.path)
        if not os.path.exists(path):
            return None
        atlas, d = load_atlas(path, self.dtype), self.description
        a = atlas.description
        if (a.data_sha256, a.acquisition, a.plate) != (d.data_sha256, d.acquisition, d.plate):
            raise ModelInvalid(
                f"the atlas was learned from another recording than {self.path.name}",
                str(path),
                "train both together: touchd train --recipe atlas; or remove the atlas",
            )
        return atlas

    def _check_input(self) -> None:
        inputs, wanted = self._session.get_inputs(), self.description.inputs
        if [(len(i.shape), i.shape[-1:], i.type in (_FLOAT, _DOUBLE)) for i in inputs] != [(2, [wanted], True)]:
            found = f"the network takes inputs of shape {[i.shape for i in inputs]}"
            raise _invalid(self.path, f"{found}, but its description means (n, {wanted})")

    def _check_outputs(self) -> None:
        d = self.description
        expected = {
            "regression": {"position_mm": 2, "sigma_mm": 1, "confidence": 1},
            "grid": {"probability": d.grid**2},
            "keypad": {"probability": len(d.layout.key) + 1 if d.layout else 0},
        }[d.head]
        found = {output.name: output.shape[1] for output in self._session.get_outputs() if len(output.shape) == 2}
        # A network that does not tell the error of noise apart has it in its sigma.
        optional = {"noise_mm": 1} if d.head == "regression" and "noise_mm" in found else {}
        if found != expected | optional or len(found) != len(self._session.get_outputs()):
            raise _invalid(self.path, f"the network's outputs are {found}, but its {d.head} head means {expected}")


def _read_regression(model: Model) -> Estimate:
    said = model.outputs
    position_mm = said["position_mm"].item
    sigma_mm, confidence = said["sigma_mm"].item(), said["confidence"].item()
    noise_mm = said["noise_mm"].item() if "noise_mm" in said else 0.0
    return Estimate(position_mm(0), position_mm(1), sigma_mm, confidence, None, noise_mm)


def _read_grid(model: Model) -> Estimate:
    d = model.description
    probability = model.outputs["probability"][0]
    zone = int(probability.argmax())
    row, column = divmod(zone, d.grid)
    width_mm, height_mm = d.plate.width_mm / d.grid, d.plate.height_mm / d.grid
    return Estimate(
        (column + 0.5) * width_mm,
        (row + 0.5) * height_mm,
        _spread_mm(width_mm, height_mm),
        float(probability[zone]),
    )


def _read_keypad(model: Model) -> Estimate:
    d = model.description
    probability = model.outputs["probability"][0]
    best = int(probability.argmax())
    assert d.layout is not None  # _check_outputs has seen it
    if best < len(d.layout.key):
        key = d.layout.key[best]
        sigma_mm = _spread_mm(key.width_mm, key.height_mm)
        return Estimate(*key.centre_mm, sigma_mm, float(probability[best]), key.name)
    # Beside the keys: somewhere on the plate is all this head can say.
    width_mm, height_mm = d.plate.width_mm, d.plate.height_mm
    return Estimate(width_mm / 2, height_mm / 2, _spread_mm(width_mm, height_mm), float(probability[best]))


def _spread_mm(width_mm: float, height_mm: float) -> float:
    """Return the deviation per axis of a point anywhere in a rectangle."""
    return math.hypot(width_mm, height_mm) / math.sqrt(24)


_READERS = {"regression": _read_regression, "grid": _read_grid, "keypad": _read_keypad}


def _load(path: Path) -> Any:
    """Return an inference session on one thread that does not spin."""
    try:
        open_file(path).close()
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or str(error)
        what = "no such model" if is_missing(path) else f"cannot be read ({why})"
        raise ModelMissing(what, str(path), "check the path; touchd calibrate makes a model") from error
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 4
    try:
        return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        if any(said in str(error) for said in _NO_ONNX):
            fix = "name a model, a .onnx file: touchd calibrate, or touchd train, makes one"
            raise ModelInvalid("is no ONNX model", str(path), fix) from error
        raise _invalid(path, f"not a usable ONNX model ({_first_line(error)})") from error


def _invalid(path: Path, what: str) -> ModelInvalid:
    return ModelInvalid(what, str(path), "export the model again")


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0][:120]


def _describe(session: Any, path: Path) -> Description:
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if text is None:
        raise ModelInvalid("the model carries no touchd description", str(path), "export it with touchd train")
    try:
        return Description.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise _invalid(path, f"the model's description is unusable: {key}: {first['msg']}") from error


def default_model_path() -> Path:
    """Return the model that ships with touchd: inside the package when installed, beside it in a source tree."""
    here = Path(__file__).resolve().parent.parent
    for folder in (here / "models", here.parent / "models"):
        if (folder / "regression.onnx").is_file():
            return folder / "regression.onnx"
    raise ModelMissing(
        "the shipped model is not there", str(here / "models"), "install touchd again, or set model.path"
    )
