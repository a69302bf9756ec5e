"""A network alone places fingers with a standard error that grows with the noise of the untouched plate."""

from __future__ import annotations

import math
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from touchd.config.schema import Settings
from touchd.detection.detection import Detection
from touchd.frame import Acquisition, Plate
from touchd.localization.features import windowed_dft
from touchd.localization.model import Description, Estimate, Model
from touchd.localization.model_file import put_model
from touchd.localization.network_localizer import NetworkLocalizer
from touchd.outcome import Outcome
from touchd.training.network.export import make_graph
from touchd.training.network.network import PaperNetwork, PositionNetwork

RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
LEVELS = (1.0, 10.0, 100.0)
"""Deviations of the noise, counts."""
SETTINGS = Settings.model_validate({"model": {"min_confidence": 0.0, "keep_confidence": 0.0, "max_sigma_mm": 1e6}})


def model_of(network: PositionNetwork | PaperNetwork, folder: Path) -> Model:
    about = Description(
        name="test", head="regression", domain="frequency", input="residual", acquisition=RIG,
        plate=Plate(width_mm=200, height_mm=200),
    )  # fmt: skip
    return put_model(make_graph(network, about).SerializeToString(), folder / "a.onnx")


def placed(model: Model, residual: np.ndarray, deviation: float, settings: Settings = SETTINGS) -> list[float]:
    """The sigma of the finger in a residual, on a plate with white noise of this deviation."""
    energy = float(np.square(residual).sum())
    detection = Detection(
        Outcome.TOUCHED, 0, energy, (deviation**2 * residual.size) ** (1 / 3), 0.0, residual, residual, 0 * residual,
        np.ones(RIG.channels, bool),
    )  # fmt: skip
    found = NetworkLocalizer(model, settings, None).localize(detection, alive=True)
    return [touch.sigma_mm for touch in found.touches]


@pytest.fixture(scope="module")
def residual() -> np.ndarray:
    return np.random.default_rng(2).normal(scale=200.0, size=RIG.shape).astype(np.float32)


def test_sigma(residual: np.ndarray, tmp_path: Path) -> None:
    """The standard error grows with the noise as in float64."""
    torch.manual_seed(3)
    network = PositionNetwork(392, (200.0, 200.0)).eval()
    model = model_of(network, tmp_path)
    features = (residual.astype(np.float64) @ windowed_dft(RIG)).reshape(1, -1)
    with torch.inference_mode():
        _, sigma, _, noise = network.double()(torch.from_numpy(features))
    sigma_mm, noise_mm = sigma.item(), noise.item()
    gain = np.square(np.hanning(250)).sum() * 49 / 250
    for deviation in LEVELS:
        ratio = np.sqrt(gain * deviation**2 * 1000) / np.linalg.norm(features)
        assert placed(model, residual, deviation) == [pytest.approx(np.hypot(sigma_mm, noise_mm * ratio), rel=5e-3)]


def test_max_sigma(residual: np.ndarray, tmp_path: Path) -> None:
    """A finger whose standard error is above `max_sigma_mm` is not placed."""
    torch.manual_seed(3)
    model = model_of(PositionNetwork(392, (200.0, 200.0)), tmp_path)
    quiet, *_, loud = (placed(model, residual, deviation)[0] for deviation in LEVELS)
    between = SETTINGS.model_copy(
        update={"model": SETTINGS.model.model_copy(update={"max_sigma_mm": (quiet + loud) / 2})}
    )
    assert len(placed(model, residual, LEVELS[0], between)) == 1
    assert placed(model, residual, LEVELS[-1], between) == []


def test_network_without_noise(residual: np.ndarray, tmp_path: Path) -> None:
    """A network that does not know the noise has one standard error in any."""
    model = model_of(PaperNetwork(392, (200.0, 200.0)), tmp_path)
    assert {sigma for deviation in LEVELS for sigma in placed(model, residual, deviation)} == {1.0}


class Said:
    """A model that says what it is told to."""

    description = Description(
        name="test", head="regression", domain="time", input="residual", acquisition=RIG,
        plate=Plate(width_mm=200, height_mm=150),
    )  # fmt: skip
    dtype = np.dtype(np.float32)

    def __init__(self, estimate: Estimate) -> None:
        self.features = np.zeros((1, 1000), np.float32)
        self._estimate = estimate

    def estimate(self) -> Estimate:
        return self._estimate


ANY = st.floats(allow_nan=True, allow_infinity=True)


@given(
    st.builds(
        Estimate, ANY | st.floats(-20, 220), ANY | st.floats(-20, 170), ANY | st.floats(0, 9), ANY | st.floats(0, 1)
    )
)
@example(Estimate(1e9, 50.0, 1.0, 0.9))
@example(Estimate(math.nan, 50.0, 1.0, 0.9))
@example(Estimate(50.0, 50.0, 1.0, math.inf))
@example(Estimate(50.0, 50.0, 1.0, 1.5))
def test_any_answer(said: Estimate) -> None:
    """No answer of a network places a touch off the plate, or without a finite confidence and standard error."""
    residual = np.full(RIG.shape, 100, np.float32)
    detection = Detection(
        Outcome.TOUCHED, 0, 1e7, 1.0, 0.0, residual, residual, 0 * residual, np.ones(RIG.channels, bool)
    )
    found = NetworkLocalizer(cast(Model, Said(said)), Settings(), None).localize(detection, alive=True)
    for touch in found.touches:
        assert 0 <= touch.x_mm <= 200
        assert 0 <= touch.y_mm <= 150
        assert 0 <= touch.sigma_mm <= Settings().model.max_sigma_mm
        assert 0 <= touch.confidence <= 1
        assert 0 <= touch.force <= 1


@pytest.mark.parametrize(("x_mm", "placed_mm"), [(-2.5, 0.0), (202.5, 200.0), (200.0, 200.0), (-3.5, None)])
def test_edge(x_mm: float, placed_mm: float | None) -> None:
    """A finger within 3 standard errors of the edge is placed on it, one farther away nowhere."""
    residual = np.full(RIG.shape, 100, np.float32)
    detection = Detection(
        Outcome.TOUCHED, 0, 1e7, 1.0, 0.0, residual, residual, 0 * residual, np.ones(RIG.channels, bool)
    )
    model = cast(Model, Said(Estimate(x_mm, 50.0, 1.0, 0.9)))
    found = NetworkLocalizer(model, Settings(), None).localize(detection, alive=True)
    assert [(touch.x_mm, touch.y_mm) for touch in found.touches] == ([] if placed_mm is None else [(placed_mm, 50.0)])
