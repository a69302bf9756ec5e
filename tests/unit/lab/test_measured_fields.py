"""What is said of measured wave fields follows from the scans alone."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from touchd.errors import RecordingError
from touchd.lab import measured_fields
from touchd.lab.measured_fields import METHODS, WaveField, errors, read_field

K_PER_MM = 0.5


@pytest.fixture(scope="module")
def waves() -> WaveField:
    """Random waves of one wavenumber."""
    rng = np.random.default_rng(3)
    x, y, angles = 0.8 * np.arange(160), 0.8 * np.arange(150), rng.uniform(0, 2 * np.pi, 400)
    along_x, along_y = K_PER_MM * np.outer(x, np.cos(angles)), K_PER_MM * np.outer(np.sin(angles), y)
    strengths = rng.standard_normal((2, 400)).T @ [1, 1j]
    return WaveField((np.exp(1j * along_x) * strengths) @ np.exp(1j * along_y), 0.8, 1e5)


def scan(path: Path, field: WaveField) -> Path:
    """Write a field as the repository has it: the spectrum of the field in the corner of a larger raster."""
    padded = np.zeros((256, 256), complex)
    padded[: field.values.shape[0], : field.values.shape[1]] = field.values
    spectrum = np.fft.fftshift(np.fft.fft2(padded)).T
    parts = np.zeros(spectrum.shape, [("real", float), ("imag", float)])
    parts["real"], parts["imag"] = spectrum.real, spectrum.imag
    with h5py.File(path, "w") as file:
        file["experiment/spectrum/value"] = parts
        file["experiment/N_POINT/value"] = np.array(field.values.shape, float)[:, None]
        file["experiment/dx/value"] = np.full((2, 1), field.step_mm * 1e-3)
        file["experiment/frequency/value"] = np.array([[field.frequency_hz]])
    return path


def test_read(tmp_path: Path, waves: WaveField) -> None:
    """A scan is read as the wave that it holds."""
    found = read_field(scan(tmp_path / "Data_AlSide_x.mat", waves))
    np.testing.assert_allclose(found.values, waves.values, atol=1e-9)
    assert found.step_mm == pytest.approx(0.8)
    assert found.frequency_hz == 1e5


@pytest.mark.parametrize("content", [b"", b"MATLAB 5.0 MAT-file", b"\x89HDF\r\n\x1a\n" + bytes(99)])
def test_other_file(tmp_path: Path, content: bytes) -> None:
    """A file without a scan is refused with its name, whatever it holds."""
    path = tmp_path / "Data_AlSide_x.mat"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="Data_AlSide_x"):
        read_field(path)


def test_band(waves: WaveField) -> None:
    """The wavenumber is that of the waves; a wave has no power above it, a product none above twice."""
    assert waves.wavenumber_per_mm == pytest.approx(K_PER_MM, rel=0.02)
    assert waves.share_above(1.15 * K_PER_MM) < 0.01  # the taper widens each line of the spectrum
    assert waves.product().share_above(2.3 * K_PER_MM) < 0.01
    assert waves.product().share_above(K_PER_MM) > 0.2


def test_prediction(waves: WaveField, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel of the right wavenumber predicts a product of waves better than all others do."""
    monkeypatch.setattr(measured_fields, "FREEDOM", 100.0)
    monkeypatch.setattr(measured_fields, "TESTED", 100)
    found = dict(zip(METHODS, errors(waves.product(), K_PER_MM, 3.0, np.random.default_rng(5)), strict=True))
    assert found["kernel"] == min(found.values())
    assert found["kernel"] < 0.2 < found["nearest"]
