"""Models: one file that says what it is, and is refused where it does not fit."""

import json
from pathlib import Path
from typing import TypeVar

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from touchd.errors import ModelInvalid, ModelMismatch, ModelMissing, TrainingError
from touchd.frame import Acquisition, Chirp, Plate
from touchd.keypad import PHONE, load_layout
from touchd.localization.atlas import atlas_path
from touchd.localization.model import METADATA_KEY, Description, Model
from touchd.localization.model_file import put_model
from touchd.training.network.export import TOLERANCE, check_export, fold, make_graph
from touchd.training.network.network import PaperNetwork, PositionNetwork
from touchd.training.network.zones_and_keys import Classifier

RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
PLATE = Plate(width_mm=200, height_mm=150)


def description(**changes: object) -> Description:
    values: dict[str, object] = {
        "name": "test", "head": "regression", "domain": "frequency", "input": "residual",
        "acquisition": RIG, "plate": PLATE, "scores": {"rmse_mm": 1.0},
    }  # fmt: skip
    return Description.model_validate(values | changes)


def export(network: PositionNetwork | PaperNetwork | Classifier, about: Description, path: Path) -> Model:
    return put_model(make_graph(network, about).SerializeToString(), path)


GRID = description(head="grid", grid=5)
N = TypeVar("N", PositionNetwork, PaperNetwork, Classifier)


def seen(network: N) -> N:
    """A network whose batch normalisations have seen some data, and are therefore no identities."""
    torch.manual_seed(1)
    network.train()
    for _ in range(3):
        network(torch.randn(64, 392) * 50)
    network.eval()
    return network


@pytest.fixture(scope="module")
def regression(tmp_path_factory: pytest.TempPathFactory) -> Model:
    path = tmp_path_factory.mktemp("model") / "regression.onnx"
    return export(seen(PositionNetwork(392, (200.0, 150.0))), description(), path)


def test_a_model_says_what_it_is(regression: Model) -> None:
    assert Model(regression.path).description == description()


def test_what_is_exported_is_what_was_trained(tmp_path: Path) -> None:
    network = seen(PositionNetwork(392, (200.0, 150.0)))
    features = np.random.default_rng(1).standard_normal((200, 392)).astype(np.float32) * 50
    assert 0 < check_export(network, export(network, description(), tmp_path / "a.onnx"), features) <= TOLERANCE


def test_plain_spectra_lose_no_digits_to_what_they_have_in_common(tmp_path: Path) -> None:
    """The paper's input: a touch changes spectra of 10,000 counts by some ten."""

    def rounding(common: float) -> float:
        torch.manual_seed(1)
        network = PaperNetwork(392, (200.0, 150.0))
        far = common * torch.randn(1, 392)
        for _ in range(100):
            network.raw(far + 10 * torch.randn(64, 392))
        model = export(network, description(), tmp_path / "a.onnx")
        return check_export(network, model, (far + 10 * torch.randn(200, 392)).numpy())

    assert rounding(common=1e4) < 5 * rounding(common=0.0)


@pytest.mark.parametrize("weight", ["trunk.1.weight", "head.bias"])
def test_another_function_than_the_trained_one_is_refused(weight: str, tmp_path: Path) -> None:
    network = seen(PositionNetwork(392, (200.0, 150.0)))
    model = export(network, description(), tmp_path / "a.onnx")
    with torch.no_grad():
        dict(network.named_parameters())[weight][0].add_(0.1)
    features = np.random.default_rng(1).standard_normal((200, 392)).astype(np.float32) * 50
    with pytest.raises(TrainingError, match="differs from the trained network by"):
        check_export(network, model, features)


def test_folding_leaves_no_normalisation_and_the_same_function() -> None:
    network = seen(PositionNetwork(392, (200.0, 150.0))).double()
    features = torch.randn(100, 392, dtype=torch.float64) * 50
    folded = fold(network)
    assert not any(isinstance(m, torch.nn.BatchNorm1d) for m in folded.modules())
    for mine, theirs in zip(folded(features), network(features), strict=True):
        np.testing.assert_allclose(mine.detach().numpy(), theirs.detach().numpy(), rtol=1e-9, atol=1e-9)


def test_bound_buffers_give_what_a_batch_gives(regression: Model) -> None:
    features = np.random.default_rng(2).standard_normal((20, 392)).astype(np.float32) * 50
    batch = regression.run(features)
    for i, row in enumerate(features):
        regression.features[0] = row
        estimate = regression.estimate()
        np.testing.assert_allclose((estimate.x_mm, estimate.y_mm), batch["position_mm"][i], atol=1e-3)
        assert estimate.sigma_mm == pytest.approx(float(batch["sigma_mm"][i, 0]), rel=1e-4)


@given(hnp.arrays(np.float32, (392,), elements=st.floats(-(2.0**30), 2.0**30, width=32)))
def test_whatever_it_is_fed_a_model_answers_with_a_place_on_the_plate(regression: Model, features: np.ndarray) -> None:
    regression.features[0] = features
    estimate = regression.estimate()
    assert 0 <= estimate.x_mm <= 200
    assert 0 <= estimate.y_mm <= 150
    assert 0 < estimate.sigma_mm < 200
    assert 0 <= estimate.confidence <= 1


def test_the_error_of_noise_is_told_apart_and_grows_with_the_noise(tmp_path: Path) -> None:
    network = seen(PositionNetwork(392, (200.0, 150.0)))
    model = export(network, description(), tmp_path / "a.onnx")
    features = np.random.default_rng(6).standard_normal((20, 392)).astype(np.float32) * 50
    with torch.inference_mode():
        _, sigma_mm, _, noise_mm = (part.numpy() for part in network.double()(torch.from_numpy(features).double()))
    for row, sigma, noise in zip(features, sigma_mm[:, 0], noise_mm[:, 0], strict=True):
        model.features[0] = row
        estimate = model.estimate()
        assert (estimate.sigma_mm, estimate.noise_mm) == pytest.approx((sigma, noise), rel=1e-4)
        for ratio in (0.0, 0.1, 1.0):
            assert estimate.error_mm(ratio) == pytest.approx(np.sqrt(sigma**2 + (ratio * noise) ** 2), rel=1e-4)


def test_a_model_that_does_not_tell_the_error_of_noise_apart_has_one_sigma_in_any_noise(tmp_path: Path) -> None:
    network = seen(PaperNetwork(392, (200.0, 150.0)))
    network.sigma_mm.fill_(3.0)
    model = export(network, description(), tmp_path / "plain.onnx")
    estimate = model.estimate()
    assert "noise_mm" not in model.outputs
    assert estimate.error_mm(0.0) == estimate.error_mm(10.0) == 3.0


def test_a_louder_touch_is_at_the_same_place() -> None:
    """Normalisation lives inside the graph: what is given are plain residuals."""
    features = np.random.default_rng(3).standard_normal(392).astype(np.float32)
    network = PositionNetwork(392, (200.0, 150.0)).eval()
    with torch.inference_mode():
        quiet, loud = (network.normalise(torch.from_numpy(features * gain)[None]) for gain in (1, 1000))
    np.testing.assert_allclose(quiet[0], loud[0], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(loud[1] - quiet[1], np.log(1000), rtol=1e-5)


def test_a_grid_head_answers_with_the_centre_of_its_zone(tmp_path: Path) -> None:
    model = export(seen(Classifier(GRID)), GRID, tmp_path / "grid.onnx")
    model.features[0] = np.random.default_rng(4).standard_normal(392).astype(np.float32)
    estimate = model.estimate()
    zone = int(model.outputs["probability"].argmax())
    assert (estimate.x_mm, estimate.y_mm) == ((zone % 5 + 0.5) * 40, (zone // 5 + 0.5) * 30)


def test_a_keypad_head_answers_with_a_key_or_none(tmp_path: Path) -> None:
    layout = load_layout(PHONE)
    keypad = description(head="keypad", layout=layout)
    network = Classifier(keypad, (100, 50))
    torch.nn.init.normal_(network.head.weight)  # untrained, it would prefer one class whatever comes
    model = export(seen(network), keypad, tmp_path / "keypad.onnx")
    keys = set()
    for seed in range(200):
        model.features[0] = np.random.default_rng(seed).standard_normal(392).astype(np.float32)
        estimate = model.estimate()
        best = int(model.outputs["probability"].argmax())
        assert estimate.key == (layout.key[best].name if best < 12 else None)
        keys.add(estimate.key)
    assert len(keys) > 3


def test_a_model_for_other_frames_is_refused_with_both_shapes(regression: Model) -> None:
    with pytest.raises(ModelMismatch) as caught:
        regression.check(Acquisition(channels=3, samples=200, sample_rate_hz=250e3))
    assert "(4, 250)" in str(caught.value)
    assert "(3, 200)" in str(caught.value)


@pytest.mark.parametrize("other", [{"sample_rate_hz": 200e3}, {"chirp": Chirp(start_hz=40e3)}])
def test_a_model_for_another_rate_or_chirp_is_refused(regression: Model, other: dict[str, object]) -> None:
    with pytest.raises(ModelMismatch, match=next(iter(other))):
        regression.check(RIG.model_copy(update=other))


def test_a_missing_file_is_told_from_a_wrong_one(tmp_path: Path) -> None:
    with pytest.raises(ModelMissing):
        Model(tmp_path / "none.onnx")
    wrong = tmp_path / "wrong.onnx"
    wrong.write_bytes(b"no model at all")
    with pytest.raises(ModelInvalid, match="is no ONNX model -> name a model"):
        Model(wrong)


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        (None, "carries no touchd description"),
        ("{}", "name: Field required"),
        ("not json", "unusable"),
        (description(head="grid", grid=3).model_dump_json(), "its grid head means"),
        (description(domain="time").model_dump_json(), r"\(n, 1000\)"),
        (description().model_copy(update={"version": 2}).model_dump_json(), "version"),
    ],
)
def test_a_model_whose_description_is_wrong_is_refused(
    regression: Model, tmp_path: Path, entry: str | None, says: str
) -> None:
    proto = onnx.load(regression.path)
    del proto.metadata_props[:]
    if entry is not None:
        proto.metadata_props.add(key=METADATA_KEY, value=entry)
    path = tmp_path / "changed.onnx"
    path.write_bytes(proto.SerializeToString())
    with pytest.raises(ModelInvalid, match=says):
        Model(path)


@pytest.mark.parametrize("value", [0, -1, 1e-300, 1e18, 1e300, 10**400])
@pytest.mark.parametrize(
    "key", ["acquisition.samples", "acquisition.channels", "acquisition.sample_rate_hz", "acquisition.chirp.stop_hz",
            "acquisition.chirp.duration_s", "plate.width_mm", "plate.height_mm"],
)  # fmt: skip
def test_an_impossible_number_is_refused(regression: Model, tmp_path: Path, key: str, value: float) -> None:
    """Of the description, before it takes memory."""
    about = json.loads(description().model_dump_json())
    *parents, last = key.split(".")
    part = about
    for parent in parents:
        part = part[parent]
    part[last] = value
    proto = onnx.load(regression.path)
    del proto.metadata_props[:]
    proto.metadata_props.add(key=METADATA_KEY, value=json.dumps(about))
    path = tmp_path / "changed.onnx"
    path.write_bytes(proto.SerializeToString())
    with pytest.raises(ModelInvalid, match=key.replace(".", r"\.")):
        Model(path)


def test_another_atlas_is_refused(atlas_model: Model, tmp_path: Path) -> None:
    """An atlas of another plate is refused, though its other parts fit."""
    path = tmp_path / "a.onnx"
    path.write_bytes(atlas_model.path.read_bytes())
    with np.load(atlas_path(atlas_model.path)) as archive:
        parts = dict(archive)
    about = json.loads(str(parts["description"]))
    about["plate"]["width_mm"] += 100
    np.savez(atlas_path(path), **parts | {"description": np.array(json.dumps(about))})
    with pytest.raises(ModelInvalid, match="another recording"):
        Model(path)


@given(at=st.integers(0, 10_000), keep=st.booleans())
@settings(max_examples=30)
def test_a_damaged_model_is_refused_or_whole(
    regression: Model, tmp_path_factory: pytest.TempPathFactory, at: int, keep: bool
) -> None:
    """Truncated anywhere in its first or last 10,000 bytes: never anything but ModelInvalid."""
    content = regression.path.read_bytes()
    path = tmp_path_factory.mktemp("damaged") / "model.onnx"
    path.write_bytes(content[:at] if keep else content[: len(content) - 1 - at])
    with pytest.raises(ModelInvalid):
        Model(path)
