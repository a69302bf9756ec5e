"""The atlas and the scan of a plate, from physics."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import numpy_helper

from tests.unit.calibration.plates import PEAK_COUNTS, PLATE, exact_fit
from touchd.calibration.physical_atlas import PhysicalField, Reference, make_physical_atlas
from touchd.calibration.plate_fit import PlateFit
from touchd.calibration.spline_grid import Grid, grid_of
from touchd.calibration.start_scan import HALF_CONFIDENCE, start_scan
from touchd.evaluation.cramer_rao import twin_values
from touchd.evaluation.dataset import complex_bins
from touchd.frame import Plate, parse_acquisition
from touchd.localization.atlas import Atlas, load_atlas, save_atlas
from touchd.localization.features import band_bins, windowed_dft
from touchd.localization.model import Description, Model
from touchd.localization.scattering import Scattering
from touchd.training.field.bins import TAPER
from touchd.training.field.place import FieldMap, place, yields_of
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact


@pytest.fixture(scope="module")
def field(fit: PlateFit) -> PhysicalField:
    return PhysicalField(fit)


@pytest.fixture(scope="module")
def atlas(fit: PlateFit) -> Atlas:
    noise = 1e-3 * float(np.sqrt(np.square(fit.measured).mean()))
    return make_physical_atlas(fit, noise, data_sha256="some", command="touchd calibrate")


THIN = Plate(width_mm=110, height_mm=90, thickness_mm=2)
AUDIO = parse_acquisition("96000:384:15000-44000:0.004:0.004")


@pytest.fixture(scope="module")
def thin() -> tuple[PlateFit, Atlas]:
    """2 mm of glass on an audio interface, exactly as it is."""
    found = exact_fit(Instrument(THIN, acquisition=AUDIO))
    return found, make_physical_atlas(found, 1e-3 * float(np.sqrt(np.square(found.measured).mean())))


def places(low: float, high: float, count: int = 60) -> np.ndarray:
    """Positions whose distance from the nearest edge is between two lengths, mm."""
    size = np.array([PLATE.width_mm, PLATE.height_mm])
    drawn = np.random.default_rng(5).uniform(0, size, (100_000, 2))
    edge = np.minimum(drawn, size - drawn).min(axis=1)
    return np.asarray(drawn[(edge >= low) & (edge <= high)][:count])


def missed(atlas: Atlas, field: PhysicalField, position_mm: np.ndarray) -> np.ndarray:
    """Share of the exact field's energy that the atlas misses at each position."""
    d = atlas.description
    kept = np.array(d.bins) - d.bins[0]
    first = d.bins[0] - 51  # the band begins at bin 51
    exact = field.at(position_mm)[..., first + kept].reshape(len(position_mm), -1)
    found = FieldMap(atlas).look_up(position_mm)[0]
    return np.asarray(np.square(np.abs(found - exact)).sum(axis=1) / np.square(np.abs(exact)).sum(axis=1))


def test_field_is_the_twins(instrument: Instrument, field: PhysicalField) -> None:
    """With the twin's parameters the field is what the twin computes, near fields included."""
    at = places(2.6, 30.0, 20)
    exact = twin_values(instrument, [Contact(x, y, 20.0, "silicone") for x, y in at.tolist()], TAPER)
    assert np.linalg.norm(field.at(at) - exact) < 1e-6 * np.linalg.norm(exact)


@pytest.mark.parametrize(("low", "high", "most"), [(6.0, 50.0, 3e-5), (0.0, 6.0, 2e-4)])
def test_atlas_between_nodes(atlas: Atlas, field: PhysicalField, low: float, high: float, most: float) -> None:
    """Off its nodes, and up to the edge, the atlas misses less of the field than another contact area changes."""
    share = missed(atlas, field, places(low, high))
    assert np.median(share) < most
    assert share.max() < 20 * most


@pytest.mark.parametrize(
    ("area_mm2", "tissue", "alone"), [(5.0, "human", 0.04), (20.0, "silicone", 0.01), (70.0, "human", 0.03)]
)
def test_thin_plate(thin: tuple[PlateFit, Atlas], area_mm2: float, tissue: str, alone: float) -> None:
    """In steady state a light and a heavy touch differ from the reference by how the plate yields: the atlas knows."""
    fit, atlas = thin
    exact, at = PhysicalField(fit), np.random.default_rng(5).uniform(10, [100, 80], (40, 2))
    first = np.array(atlas.description.bins) - int(
        exact.bins_hz[0] * atlas.description.acquisition.samples / 96e3 + 0.5
    )
    values = exact.at(at, Reference(tissue, area_mm2, min(area_mm2, 20.0)))[..., first] * atlas.description.bin_weights
    plain = FieldMap(atlas).at(at)
    shares = FieldMap(atlas, yields_of(atlas)).at(at)

    def left(field: np.ndarray) -> tuple[np.ndarray, float]:
        power = np.square(np.abs(field)).sum(axis=(1, 2))
        z = (field.conj() * values).sum(axis=(1, 2)) / power
        missed = np.square(np.abs(values - z[:, None, None] * field)).sum(axis=(1, 2))
        return np.abs(z), float((missed / np.square(np.abs(values)).sum(axis=(1, 2))).mean())

    size, as_reference = left(plain)
    for _ in range(4):
        size, loaded = left(plain / (1 + (size[:, None, None] - 1) * shares))
    assert as_reference > alone
    assert loaded < 0.01


@pytest.mark.parametrize("fingers", [2, 3])
def test_fingers_on_a_thin_plate(thin: tuple[PlateFit, Atlas], fingers: int) -> None:
    """What fingers send to each other has a tenth of their energy or more: the atlas tells nearly all of it."""
    _, atlas = thin
    d, instrument = atlas.description, Instrument(THIN, acquisition=AUDIO)
    kept = np.searchsorted(band_bins(AUDIO), d.bins)

    def bins_of(touches: list[list[Contact]]) -> np.ndarray:
        change = PEAK_COUNTS * instrument.change(touches, [REFERENCE_C] * len(touches))
        bins = complex_bins(change @ windowed_dft(AUDIO, taper=TAPER), AUDIO.channels)
        return np.asarray(bins[..., kept] * d.bin_weights)

    drawn, shares, missed = np.random.default_rng(7).uniform(12, [98, 78], (40, fingers, 2)), [], []
    for places in drawn:
        if min(math.dist(*pair) for pair in combinations(places.tolist(), 2)) < 16:
            continue
        touches = [Contact(x, y, 60.0, "human") for x, y in places.tolist()]
        alone, together = bins_of([[one] for one in touches]), bins_of([touches])[0]
        fields = FieldMap(atlas).at(places)
        amplitudes = [complex(np.vdot(u, own) / np.vdot(u, u)) for u, own in zip(fields, alone, strict=True)]
        told = Scattering(atlas).of(places.tolist(), amplitudes).reshape(AUDIO.channels, 2, -1)
        sent = together - sum(alone)
        power = float(np.square(np.abs(sent)).sum())
        shares.append(power / np.square(np.abs(together)).sum())
        missed.append(np.square(np.abs(sent - told[:, 0] - 1j * told[:, 1])).sum() / power)
    assert np.median(shares) > 0.08
    assert np.median(missed) < 0.07


def test_large_pane(thin: tuple[PlateFit, Atlas]) -> None:
    """Where a file would not hold the modes' shapes, the atlas is made without them."""
    fit, atlas = thin
    field, d = PhysicalField(fit), atlas.description
    kept = np.searchsorted(band_bins(AUDIO), d.bins)
    assert atlas.modes
    shapes_bytes = 2 * atlas.modes.shapes.size
    asked = THIN.size_mm, d.step_mm, kept, d.bin_weights
    assert field.modes(*asked, shapes_bytes - 1) is None
    found = field.modes(*asked, shapes_bytes)
    assert found
    np.testing.assert_allclose(found.shapes, atlas.modes.shapes)


@pytest.mark.parametrize("length_mm", [100.0, 99.99, 250.3, 7.6])
def test_grid(length_mm: float) -> None:
    """Every place on the plate has its four nodes, and every node enough samples: a smooth function comes back."""
    grid: Grid = grid_of(length_mm, 2.5)
    assert grid.nodes_mm[1] <= 0
    assert grid.nodes_mm[-3] >= length_mm
    assert grid.samples_mm.min() == 0
    assert grid.samples_mm.max() == length_mm
    coefficients = grid.solve @ np.cos(0.2 * grid.samples_mm)
    assert np.abs(coefficients).max() < 2


def test_atlas_is_a_file_as_others(atlas: Atlas, tmp_path: Path) -> None:
    """It is saved and loaded as a learned one, and covers the plate from edge to edge."""
    path = tmp_path / "plate.atlas.npz"
    save_atlas(atlas, path)
    d = load_atlas(path).description
    assert (d.low_mm, d.high_mm) == ((0.0, 0.0), (PLATE.width_mm, PLATE.height_mm))
    assert d.data_sha256 == "some"


def test_sigma(atlas: Atlas, field: PhysicalField, fit: PlateFit) -> None:
    """Two thirds of the errors of touches with another area, in noise, are within the standard error of the atlas."""
    at, d = places(3.0, 45.0, 200), atlas.description
    kept = np.array(d.bins)
    noise = 0.01 * np.sqrt(np.square(fit.measured).mean())
    W = windowed_dft(fit.acquisition, kept, d.taper)
    drawn = np.random.default_rng(1).normal(size=(len(at), *fit.acquisition.shape)) * noise @ W
    values = field.at(at, Reference("silicone", 16.0, 16.0))[..., kept - 51]
    values = values + drawn[..., : len(kept)] + 1j * drawn[..., len(kept) :]
    placed = place(atlas, values, at)
    variance = d.noise_scale * noise**2 * np.square(fit.acquisition.window(d.taper)).sum() / 2
    variance += d.field_scale * atlas.error.mean() * np.square(np.abs(placed.amplitude)) / 2
    sigma = np.sqrt(variance[:, None] * np.diagonal(np.linalg.inv(placed.fisher_information), axis1=1, axis2=2))
    assert 0.5 < (np.abs(placed.position_mm - at) < sigma).mean() < 0.85


@pytest.fixture(scope="module")
def model(atlas: Atlas, tmp_path_factory: pytest.TempPathFactory) -> Model:
    d = atlas.description
    description = Description(
        name="calibrated", head="regression", domain="frequency", input="residual", acquisition=d.acquisition,
        plate=d.plate, taper=d.taper, data_sha256="some",
    )  # fmt: skip
    graph = start_scan(atlas, description)
    onnx.checker.check_model(graph, full_check=True)
    path = tmp_path_factory.mktemp("scan") / "plate.onnx"
    path.write_bytes(graph.SerializeToString())
    return Model(path)


def scan(path: Path, features: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (n, 2), sigma (n, 1) and confidence (n, 1) for features (n, inputs), with the graph's constants."""
    c = {each.name: numpy_helper.to_array(each) for each in onnx.load(path).graph.initializer}
    real, imaginary = (features[:, c[part]] * c["weight"] for part in ("real", "imaginary"))
    along = np.concatenate([real, imaginary], axis=1) @ c["unit"].astype(np.float64)
    across = np.concatenate([imaginary, -real], axis=1) @ c["unit"].astype(np.float64)
    score = along**2 + across**2
    energy = np.square(real).sum(axis=1) + np.square(imaginary).sum(axis=1)
    share = 1 - score.max(axis=1) / np.maximum(energy, 1e-20)
    doubt = 1 + (np.clip(share, 0.0, 1.0)[:, None] / HALF_CONFIDENCE) ** 4
    return c["position"][score.argmax(axis=1)], float(c["spread"]) * doubt, 1 / doubt


def test_graph_is_the_reference(atlas: Atlas, model: Model) -> None:
    """The ONNX graph says what the same scan in NumPy says, for fingers, noise and nothing."""
    rng = np.random.default_rng(2)
    field = FieldMap(atlas).look_up(places(0.0, 50.0, 40))[0].reshape(40, 3, 1, -1)
    features = np.zeros((40, 3, 2, 49))
    features[..., np.array(atlas.description.bins) - 51] = np.concatenate([field.real, field.imag], axis=2)
    frames = np.concatenate([features.reshape(40, -1), rng.normal(size=(40, 3 * 98)), np.zeros((1, 3 * 98))])
    said = model.run(frames.astype(np.float32))
    position_mm, sigma_mm, confidence = scan(model.path, frames)
    assert np.abs(said["position_mm"][:-1] - position_mm[:-1]).max() < 1e-3
    assert np.abs(said["sigma_mm"] - sigma_mm).max() < 1e-3
    assert np.abs(said["confidence"] - confidence).max() < 1e-3


def test_scan_starts_fingers(field: PhysicalField, model: Model) -> None:
    """The scan comes as near to another contact than the atlas' as Gauss-Newton needs, in all but a few wrong valleys;
    noise is no finger."""
    at = places(2.6, 50.0, 80)
    bins = field.at(at, Reference("human", 60.0, 60.0))
    said = model.run(np.concatenate([bins.real, bins.imag], axis=2).reshape(80, -1).astype(np.float32))
    off_mm = np.linalg.norm(said["position_mm"] - at, axis=1)
    assert np.quantile(off_mm, 0.9) < 2.3, "half a diagonal of the grid"
    assert (off_mm > 4.0).mean() < 0.03
    assert said["confidence"].min() > 0.5
    noise = np.random.default_rng(3).normal(size=(80, 3 * 98)).astype(np.float32)
    assert model.run(noise)["confidence"].max() < 0.5


def test_scan_beside_an_edge(field: PhysicalField, model: Model) -> None:
    """Of rigid tips 2 to 4 mm from an edge the scan starts all but 2 in 100 within reach."""
    at = places(2.0, 4.0, 200)
    bins = field.at(at, Reference("silicone", 12.0, 12.0))
    said = model.run(np.concatenate([bins.real, bins.imag], axis=2).reshape(len(at), -1).astype(np.float32))
    assert (np.linalg.norm(said["position_mm"] - at, axis=1) > 4.0).mean() <= 0.02
