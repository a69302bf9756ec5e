"""`touchd simulate` writes what it was asked for, and overwrites nothing unasked."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from touchd.cli.simulate import command
from touchd.errors import OutputError, SimulationError
from touchd.recording.format import read

SMALL = ["--plate", "90x80x5"]


def call(*arguments: str | Path) -> Result:
    result = CliRunner().invoke(command, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def test_scene(tmp_path: Path) -> None:
    """A scene is written, with one closing line."""
    path = tmp_path / "tap.npz"
    result = call("tap", "-o", path, "--frames", "200", "--rate-hz", "100", "--seed", "3", *SMALL)
    assert result.exit_code == 0
    assert result.stdout.startswith(f"{path}: 200 frames, ")
    assert result.stdout.count("\n") == 1
    recording = read(path)
    assert recording.frames.shape == (200, 4, 250)
    assert recording.meta.frame_rate_hz == 100
    assert recording.meta.plate.width_mm == 90


def test_training_set(tmp_path: Path) -> None:
    """A training set has two frames a touch."""
    path = tmp_path / "touches.npz"
    assert call("touches", "-o", path, "--count", "12", *SMALL).exit_code == 0
    assert len(read(path).frames) == 24


def test_several_fingers(tmp_path: Path) -> None:
    """Fingers, temperature and label noise of a training set are those of its options."""
    path, other = tmp_path / "two.npz", tmp_path / "reference.npz"
    options = ["touches", "--count", "12", "--fingers", "2", *SMALL]
    assert call(*options, "-o", path, "--temperature-k", "-5", "--label-noise-mm", "0.3").exit_code == 0
    assert call(*options, "-o", other).exit_code == 0
    made, plain = read(path), read(other)
    assert made.contacts_mm is not None
    assert plain.contacts_mm is not None
    assert made.temperature_c is not None
    assert plain.temperature_c is not None
    assert made.contacts_mm.shape == (24, 2, 2)
    assert abs(made.temperature_c - plain.temperature_c + 5).max() < 1e-5
    off_mm = abs(made.contacts_mm - plain.contacts_mm)[1::2]
    assert 0.05 < off_mm.mean() < 0.6


def test_no_room(tmp_path: Path) -> None:
    """Fingers that do not fit are explained."""
    with pytest.raises(SimulationError, match="do not fit"):
        call("touches", "-o", tmp_path / "x.npz", "--count", "20", "--fingers", "5", "--apart-mm", "80", *SMALL)


def test_force(tmp_path: Path) -> None:
    """An existing recording is replaced only by `--force`."""
    path = tmp_path / "idle.npz"
    path.write_text("precious")
    with pytest.raises(OutputError, match="already there"):
        call("idle", "-o", path, "--frames", "10", *SMALL)
    assert path.read_text() == "precious"
    assert call("idle", "-o", path, "--frames", "10", "--force", *SMALL).exit_code == 0
    assert len(read(path).frames) == 10


def test_wrong_options(tmp_path: Path) -> None:
    """Options of touches are refused for a scene, and the other way round."""
    path = tmp_path / "x.npz"
    assert call("touches", "-o", path, "--frames", "10").exit_code == 2
    for option, value in (("count", 10), ("fingers", 2), ("apart-mm", 20), ("temperature-k", 5),
                          ("label-noise-mm", 0.3), ("stale-k", 1)):  # fmt: skip
        result = call("tap", "-o", path, f"--{option}", str(value))
        assert result.exit_code == 2
        assert f"--{option}" in result.output
    for plate in ("20x30", "20x30x0", "0.5x30x5", "nanx30x5", "1e300x30x5", "20x30x5x5"):
        assert call("tap", "-o", path, "--plate", plate).exit_code == 2
    for scene, option in (("idle", "--frames"), ("touches", "--count")):
        assert call(scene, "-o", path, option, str(10**26)).exit_code == 2
    assert not path.exists()


def test_a_frame_that_hears_nothing(tmp_path: Path) -> None:
    """Two samples, both at the frame's edge, are refused instead of noise without a signal."""
    with pytest.raises(SimulationError, match="hear nothing"):
        call("idle", "-o", tmp_path / "x.npz", *SMALL, "--acquisition", "250e3:2:5e4-1e5:1e-6")


@pytest.mark.parametrize("plate", ["200x200x0.001", "200x200x10000", "200x200x51", "9x200x1", "0.2x0.2x0.005"])
def test_no_plate(tmp_path: Path, plate: str) -> None:
    """Lengths that no plate has in millimetres are refused with what is wrong."""
    result = call("tap", "-o", tmp_path / "x.npz", "--plate", plate)
    assert result.exit_code == 2
    assert "mm" in result.output


def test_keypad(tmp_path: Path) -> None:
    """A keypad file places the keys."""
    layout = tmp_path / "keys.toml"
    layout.write_text('[[key]]\nname = "Z"\nx_mm = 20\ny_mm = 30\nwidth_mm = 20\nheight_mm = 20\n')
    path = tmp_path / "typed.npz"
    assert call("keypad", "-o", path, "--keypad", layout, "--code", "Z", *SMALL).exit_code == 0
    contacts_mm = read(path).contacts_mm
    assert contacts_mm is not None
    assert abs(contacts_mm[125, 0] - [30, 40]).max() <= 4


def test_too_large(tmp_path: Path) -> None:
    """A plate that is too large is explained."""
    with pytest.raises(SimulationError, match="wavelengths"):
        call("idle", "-o", tmp_path / "x.npz", "--plate", "2000x900x2")
