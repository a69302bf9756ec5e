"""A TOML file describes a real rig: what holds the plate, what has aged, what the electronics add."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from touchd.cli.main import main
from touchd.errors import SimulationError
from touchd.frame import Acquisition, Plate
from touchd.recording.format import read
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.rig import IDEAL, load_rig

EVERYTHING = """
tilts = [[10, 1.5], [-10, 1.5], [10, -1.5], [-10, -1.5]]
[mounting]
left = "tape"
pane = true
[[mounting.attachments]]
x_mm = [40, 48]
y_mm = [0, 8]
round = true
support = { dashpot_n_s_m3 = 1.8e5 }
[electronics]
jitter_s = 20e-9
crosstalk_db = -50
inl_lsb = 8
impulses = { share = 0.05 }
ripple = { share = 0.01, hz = 120 }
tones = [{ frequency_hz = 62000, level_db = -50, finger = true }]
"""


def rig_of(folder: Path, text: str) -> Path:
    path = folder / "rig.toml"
    path.write_text(text)
    return path


def test_file(tmp_path: Path) -> None:
    """Every effect has a key, and an empty file is the ideal rig."""
    rig = load_rig(rig_of(tmp_path, EVERYTHING))
    assert rig.mounting.left == "tape"
    assert rig.mounting.attachments[0].support.dashpot_n_s_m3 == 1.8e5
    assert rig.electronics.jitter_s == 20e-9
    assert rig.electronics.tones[0].finger
    assert rig.electronics.impulses is not None
    assert rig.electronics.ripple == (0.01, 120.0)
    assert load_rig(rig_of(tmp_path, "")) == IDEAL
    assert load_rig(rig_of(tmp_path, "[electronics]\nnoise_db = inf")).electronics.noise_db == float("inf")


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("[electronics]\njiter_s = 1e-9", "electronics.jiter_s: unknown key -> use noise_db, .*jitter_s"),
        ("[electronics]\nripple = { hx = 1 }", "electronics.ripple.hx: unknown key -> use share, hz"),
        ("[electronics]\ntones = [{ hz = 1 }]", "electronics.tones.0.hz: unknown key -> use frequency_hz"),
        ("[[mounting.attachments]]\nsupport = { loos = 1 }", "loos: unknown key -> use stiffness_n_m3"),
        ("[mounting]\nleft = 'glue'", "mounting.left"),
        ("[electronics]\nnoise_db = nan", "electronics.noise_db: is nan"),
        ("[electronics]\npeak = inf", "electronics.peak: is inf"),
        ("[electronics]\nimage_db = 1e308", "electronics.image_db: is 1e.308"),
        ("[[electronics.tones]]\nfrequency_hz = 6e4\nlevel_db = 1e300", "electronics.tones.level_db: is 1e.300"),
        (f"[electronics]\ninl_lsb = {10**30}", "electronics.inl_lsb: is 1000000"),
        ("tilts = [[1e9, 0]]", "tilts: is 1000000000.0"),
        ("[mounting]\nleft = 'pads'\npreload_n = inf", "mounting.preload_n: is inf"),
        (
            "[[mounting.attachments]]\nx_mm = [0, 5]\ny_mm = [0, 9]\npreload_n = 1",
            "attachments.0: preload_n: only round attachments can be pressed -> correct it",
        ),
        ("[plate]\nloss = 1", "plate: unknown key -> use mounting, tilts, feedthrough, stretch, electronics"),
        ("tilts = ", "not valid TOML"),
    ],
)
def test_mistakes(tmp_path: Path, text: str, what: str) -> None:
    """A key or value that no rig has is named."""
    with pytest.raises(SimulationError, match=what):
        load_rig(rig_of(tmp_path, text))
    with pytest.raises(SimulationError, match="cannot be read"):
        load_rig(tmp_path / "none.toml")


def test_simulate(tmp_path: Path) -> None:
    """`touchd simulate --rig` plays scenes and touches on the rig; an option of the command line wins."""
    small = ["--plate", "90x80x5", "--force", "--rig"]
    tilted = "feedthrough = [[-20, 0], [0, 90], [10, 200], [-3, 45]]\n[mounting]\nleft = 'tape'\n"
    recordings = {}
    for name, text in (("ideal", ""), ("real", tilted)):
        rig = str(rig_of(tmp_path, text))
        for scene, option, count in (("tap", "--frames", "170"), ("touches", "--count", "4")):
            output = tmp_path / f"{name}-{scene}.npz"
            assert main(["simulate", scene, option, count, "-o", str(output), *small, rig, "--noise-db", "80"]) == 0
            recordings[name, scene] = read(output).frames.astype(float)
    for scene in ("tap", "touches"):
        ideal, real = recordings["ideal", scene], recordings["real", scene]
        assert np.square(real - ideal).mean() > 1e-3 * np.square(ideal).mean()


LONG, LOSS = Acquisition(channels=4, samples=750, sample_rate_hz=250e3), 0.015
"""Until the plate is silent: spectra are exact."""


def touched(small: Instrument, **rig: Any) -> NDArray[np.complex128]:
    """The spectra of a touch, in and about the band."""
    instrument = Instrument(small.plate, acquisition=LONG, loss=LOSS, **rig)
    change = instrument.change([[Contact(40.0, 30.0, 60.0, "human")]], [REFERENCE_C])[0]
    spectra: NDArray[np.complex128] = np.fft.rfft(change * instrument.peak)[:, 165:286:6]
    return spectra


@pytest.fixture(scope="module")
def plain(small: Instrument) -> NDArray[np.complex128]:
    return touched(small)


@pytest.mark.parametrize(("deg", "db", "level_db"), [(10.0, 1.5, -17), (30.0, 3.0, -9)])
def test_tilt(small: Instrument, plain: NDArray[np.complex128], deg: float, db: float, level_db: float) -> None:
    """Tilts turn and scale signal and touches alike, by as much as stated: nothing in the middle of the band."""
    tilted = Instrument(small.plate, tilts=[(deg, db)] * 4)
    before, after = (one.untouched([REFERENCE_C])[0] * one.peak for one in (small, tilted))
    change_db = 10 * np.log10(np.square(after - before).mean() / np.square(before).mean())
    assert change_db == pytest.approx(level_db, abs=2.5)
    turned = touched(small, tilts=[(deg, db)] * 4)
    at = (np.arange(330, 571, 12) - 450) / 150
    expected = np.exp((np.log(10) / 20 * db + 1j * np.deg2rad(deg)) * at) * plain
    assert np.abs(turned - expected).max() < 0.02 * np.abs(expected).max()


DRIVEN = (-20.0, 0.0), (0.0, 90.0), (10.0, 200.0), (-3.0, 45.0)


def test_feedthrough(small: Instrument, plain: NDArray[np.complex128]) -> None:
    """Each receiver hears as much of the drive as stated, the same at any temperature, and touches as before."""
    driven = Instrument(small.plate, feedthrough=DRIVEN)
    heard = [[one.untouched([at_c])[0] * one.peak for one in (small, driven)] for at_c in (15.0, REFERENCE_C)]
    cold, warm = (after - before for before, after in heard)
    level_db = 20 * np.log10(np.linalg.norm(warm, axis=1) / np.linalg.norm(heard[1][0], axis=1))
    np.testing.assert_allclose(level_db, [db for db, _ in DRIVEN], atol=1e-6)
    np.testing.assert_allclose(cold, warm, atol=1e-9 * np.abs(warm).max())
    assert np.abs(touched(small, feedthrough=DRIVEN) - plain).max() < 1e-9 * np.abs(plain).max()


def test_feedthrough_is_late_with_the_trigger(small: Instrument) -> None:
    """A trigger that is early or late delays the drive."""
    late_s, bins = 2e-8, np.arange(180, 270)
    driven, plain = (Instrument(small.plate, acquisition=LONG, loss=LOSS, feedthrough=given) for given in (DRIVEN, ()))
    early, at_once, late = (
        np.fft.rfft(driven.untouched([REFERENCE_C], at_s)[0] * driven.peak
                    - plain.untouched([REFERENCE_C], at_s)[0] * plain.peak)[:, bins]
        for at_s in (-late_s, 0.0, late_s)
    )  # fmt: skip
    turn = 2j * np.pi * bins * 250e3 / 750 * late_s
    for each, sign in ((late, 1), (early, -1)):
        np.testing.assert_allclose(each, np.exp(sign * turn) * at_once, atol=1e-3 * np.abs(at_once).max())


@pytest.mark.parametrize("driven", [(float("inf"), 0.0), (float("nan"), 0.0), (1e9, 0.0), (0.0, float("inf"))])
def test_impossible_feedthrough(tmp_path: Path, driven: tuple[float, float]) -> None:
    """Drive that no rig has is refused, and nothing is written."""
    (tmp_path / "rig.toml").write_text(f"feedthrough = {[list(driven)] * 4}")
    asked = ["simulate", "tap", "-o", str(tmp_path / "tap.npz"), "--rig", str(tmp_path / "rig.toml")]
    assert main(asked) == SimulationError.exit_code
    assert not (tmp_path / "tap.npz").exists()


@pytest.mark.parametrize("what", ["tilts", "feedthrough"])
def test_one_a_receiver(what: str) -> None:
    """Two tilts, or levels of the drive, for four receivers are refused."""
    given: dict[str, Any] = {what: [(1.0, 1.0)] * 2}
    with pytest.raises(SimulationError, match=f"2 {what}.* for 4 receivers"):
        Instrument(Plate(width_mm=90, height_mm=80, thickness_mm=5, material="glass"), **given)


@pytest.mark.parametrize("noise_db", ["nan", "5000", "-5000"])
def test_impossible_noise(tmp_path: Path, noise_db: str) -> None:
    """Noise that no rig has is refused, and nothing is written."""
    assert main(["simulate", "tap", "-o", str(tmp_path / "tap.npz"), "--noise-db", noise_db]) == 2
    assert not list(tmp_path.iterdir())
