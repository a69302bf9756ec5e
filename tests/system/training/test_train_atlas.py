"""A network and its atlas are trained together, or the atlas beside a network that is there; what does not fit is
refused before anything is written.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from touchd.cli.train import command
from touchd.errors import ModelMismatch
from touchd.evaluation.dataset import Split, make_dataset
from touchd.localization.atlas import atlas_path, load_atlas
from touchd.localization.features import band_bins
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.recording.format import write
from touchd.training.data.temperature import at_one_temperature
from touchd.training.field.make_atlas import try_atlas
from touchd.training.field.place import place
from touchd.training.field.regression import touches_of
from touchd.training.network.recipe import RECIPES
from touchd.training.report.report import write_atlas_report
from touchd.training.train_atlas import AtlasResult, train_atlas
from touchd.training.train_network import train
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_touches

QUICK = 3
"""Epochs: enough to tell the parts of the plate apart."""


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave a report's pictures empty, where a test reads its page alone."""
    monkeypatch.setattr("touchd.training.report.report.save", lambda _figure, path: path.touch())


@pytest.fixture(scope="module")
def result(touches: Recording, tmp_path_factory: pytest.TempPathFactory) -> AtlasResult:
    path = tmp_path_factory.mktemp("atlas") / "plate.onnx"
    return train_atlas(touches, path, epochs=QUICK, command="touchd train touches.npz")


def test_origin(result: AtlasResult) -> None:
    """Network and atlas lie beside each other and say what they were trained on."""
    model, atlas = Model(result.model.path), load_atlas(result.path)
    assert result.path == atlas_path(model.path)
    d = atlas.description
    assert d.data_sha256 == model.description.data_sha256 != ""
    assert (d.seed, d.command, d.touches, d.fitted) == (0, "touchd train touches.npz", 360, False)
    assert len(d.wavenumber_rad_m) == len(band_bins(d.acquisition))
    assert set(d.bins) <= set(band_bins(d.acquisition).tolist())
    assert d.scores["n"] == 40
    assert d.scores["median_mm"] == pytest.approx(float(np.median(result.judged.distance_mm)), abs=1e-4)
    assert result.network is not None
    assert model.description.scores["n"] == 40


def test_accuracy(result: AtlasResult, touches: Recording) -> None:
    """Touches that the atlas never saw are placed to a tenth of a millimetre.

    From a millimetre beside them; with 360 touches for 98 degrees of freedom. A network of these is 2 mm off.
    """
    atlas, parts = load_atlas(result.path), result.parts
    steady, _ = at_one_temperature(touches, make_dataset(touches, taper=atlas.description.taper))
    at = parts.test
    kept = np.flatnonzero(np.isin(band_bins(atlas.description.acquisition), atlas.description.bins))
    true_mm = steady.position_mm[at].astype(float)
    placed = place(atlas, touches_of(steady, at).values[:, :, kept], true_mm + 0.7)
    off_mm = np.linalg.norm(placed.position_mm - true_mm, axis=1)
    print(f"median {np.median(off_mm):.3f}, 95 % {np.percentile(off_mm, 95):.3f} mm")
    assert np.median(off_mm) < 0.12
    assert np.median(placed.misfit) < 0.05


def test_standard_errors(result: AtlasResult) -> None:
    """Its standard errors hold at every level of noise."""
    assert [round(db) for db, _, _ in result.calibration] == [60, 50, 40]
    for _, within, _ in result.calibration:
        assert within == pytest.approx(0.683, abs=0.08)
    medians = [median_mm for _, _, median_mm in result.calibration]
    assert medians == sorted(medians)
    assert (result.atlas.error >= 0).all()


def test_standard_errors_of_other_touches(result: AtlasResult, instrument: Instrument) -> None:
    """They hold for touches of another session, too: of a field that was learned from more than calibrated them."""
    other = simulate_touches(300, seed=4, instrument=instrument, margin_mm=72.0)
    atlas = result.atlas
    steady, _ = at_one_temperature(other, make_dataset(other, taper=atlas.description.taper))
    judged = try_atlas(atlas, steady, Split(*(np.arange(300),) * 3), steady.position_mm.astype(float))
    within = float((np.abs(judged.error_mm) < judged.sigma_mm[:, None]).mean())
    assert within == pytest.approx(0.683, abs=0.08)


def test_report(result: AtlasResult, touches: Recording) -> None:
    """The report has every picture it speaks of."""
    folder = write_atlas_report(result, touches.meta, ["touches.npz"])
    assert folder == result.path.with_suffix("").with_suffix(".atlas.report")
    text = (folder / "report.md").read_text()
    pictures = {path.name for path in folder.iterdir()} - {"report.md"}
    assert pictures == {"maps.png", "sigma.png"}
    assert all(f"]({name})" in text and (folder / name).stat().st_size > 10_000 for name in pictures)
    for words in (result.atlas.description.data_sha256, "noise_scale", "bins are kept", "| 40 dB |"):
        assert words in text


def test_other_network(result: AtlasResult, touches: Recording, tmp_path: Path) -> None:
    """A network of another recording or another head is refused."""
    other = replace(touches, frames=np.roll(touches.frames, 1, axis=2))
    with pytest.raises(ModelMismatch, match="another recording"):
        train_atlas(other, tmp_path / "a.onnx", result.model.path)
    paper = train(touches, tmp_path / "p.onnx", RECIPES["paper-regression"], epochs=1)
    with pytest.raises(ModelMismatch, match="paper-regression"):
        train_atlas(touches, tmp_path / "a.onnx", paper.model.path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["p.onnx"]


@pytest.mark.usefixtures("undrawn")
def test_unknown_material(result: AtlasResult, touches: Recording, tmp_path: Path) -> None:
    """An unknown material is no obstacle; the given network is copied beside the atlas as it is."""
    plate = touches.meta.plate.model_copy(update={"material": "unobtainium"})
    strange = replace(touches, meta=touches.meta.model_copy(update={"plate": plate}))
    found = train_atlas(strange, tmp_path / "a.onnx", result.model.path)  # frames and truth are the same
    assert found.network is None
    assert (tmp_path / "a.onnx").read_bytes() == result.model.path.read_bytes()
    assert found.atlas.description.fitted
    assert sum("unobtainium" in note for note in found.notes) == 1
    known, fitted = (np.array(one.atlas.description.wavenumber_rad_m)[:36] for one in (result, found))
    np.testing.assert_allclose(fitted, known, rtol=0.1)
    assert "predicts the touches best" in (write_atlas_report(found, strange.meta, ["a"]) / "report.md").read_text()


@pytest.mark.usefixtures("undrawn")
def test_label_noise(touches: Recording, tmp_path: Path) -> None:
    """Label noise is reported, and the standard errors are those of the atlas.

    Labels off by 0.3 mm: not taken for errors of the atlas, which places exact touches better than that.
    """
    assert touches.contacts_mm is not None
    off_mm = 0.3 * np.random.default_rng(0).normal(size=touches.contacts_mm.shape)
    sloppy = replace(touches, contacts_mm=(touches.contacts_mm + off_mm).astype(np.float32))
    result = train_atlas(sloppy, tmp_path / "a.onnx", epochs=1)
    assert result.learned.label_noise_mm == pytest.approx(0.3, abs=0.05)
    for _, within, _ in result.calibration:
        assert within == pytest.approx(0.683, abs=0.1)
    steady, _ = at_one_temperature(touches, make_dataset(touches, taper=result.atlas.description.taper))
    at = result.parts.test
    kept = np.flatnonzero(np.isin(band_bins(steady.acquisition), result.atlas.description.bins))
    true_mm = steady.position_mm[at].astype(float)
    placed = place(result.atlas, touches_of(steady, at).values[:, :, kept], true_mm)
    median_mm = float(np.median(np.linalg.norm(placed.position_mm - true_mm, axis=1)))
    print(f"median {median_mm:.3f} mm from labels that are off by 0.3 mm per axis")
    assert median_mm < 0.25
    page = (write_atlas_report(result, sloppy.meta, ["a"]) / "report.md").read_text()
    assert "off by about 0.3" in page


def test_command(result: AtlasResult, touches: Recording, tmp_path: Path) -> None:
    """The command writes what it says and replaces nothing unasked: beside an existing network the same atlas.

    The network is left as it is where it lies; the split is the network's, not the command's.
    """
    write(tmp_path / "touches.npz", touches, compress=False)
    network = tmp_path / "net.onnx"
    network.write_bytes(result.model.path.read_bytes())
    arguments = [str(tmp_path / "touches.npz"), "-o", str(network), "--recipe", "atlas", "--network", str(network)]
    ran = CliRunner().invoke(command, [*arguments, "--no-report", "--seed", "5"], catch_exceptions=False)
    assert ran.exit_code == 0
    assert "net.atlas.npz: on 40 touches never seen in training" in ran.output
    made = load_atlas(tmp_path / "net.atlas.npz")
    assert made.description.command == "touchd train touches.npz -o net.onnx --recipe atlas --network net.onnx"
    assert network.read_bytes() == result.model.path.read_bytes()
    np.testing.assert_array_equal(made.coefficients, load_atlas(result.path).coefficients)
    assert made.description.seed == 0
    assert made.description.scores == result.scores
    again = CliRunner().invoke(command, arguments)
    assert again.exit_code != 0
    assert "already there" in str(again.exception)
    beside = CliRunner().invoke(command, [arguments[0], "-o", str(tmp_path / "net.onnx"), "--recipe", "best"])
    assert "already there" in str(beside.exception)
    wrong = CliRunner().invoke(command, [*arguments[:3], "--network", str(network)])
    assert "--network is for the recipe atlas" in wrong.output
