"""A model is replaced whole, and the one before it is kept."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from touchd.config.schema import Settings
from touchd.errors import ModelInvalid, ModelMissing, OutputError
from touchd.localization.atlas import atlas_path
from touchd.localization.model import Model, default_model_path
from touchd.localization.model_file import digest, install, previous_path, put_model, rollback
from touchd.service.daemon import find_model

SHIPPED = default_model_path()
SMALL = SHIPPED.with_name("small.onnx")


@pytest.fixture
def target(tmp_path: Path) -> Path:
    return tmp_path / "state" / "model.onnx"


def test_install(target: Path) -> None:
    """A model comes with its atlas, into a folder that may be missing; the first one has no previous one."""
    assert install(SHIPPED, target).atlas is not None
    assert not previous_path(target).exists()
    assert sorted(path.name for path in target.parent.iterdir()) == [
        "model.atlas.npz", "model.onnx", "model.untouched.npz"
    ]  # fmt: skip


def test_rollback(target: Path) -> None:
    """The previous model comes back with its own atlas, and a second rollback undoes the first."""
    install(SHIPPED, target)
    install(SMALL, target)
    assert Model(target).description.name == "small"
    assert not atlas_path(target).exists(), "the atlas of the other model"
    assert rollback(target).atlas is not None
    assert rollback(target).description.name == "small"


def test_installed_again(target: Path) -> None:
    """The model in use, installed again, leaves the previous one what it was."""
    for model in (SMALL, SHIPPED, SHIPPED):
        install(model, target)
    assert rollback(target).description.name == "small"


@pytest.mark.parametrize(("source", "to"), [("model.v2", "model.onnx"), ("new.onnx", "plate")])
def test_names(tmp_path: Path, source: str, to: str) -> None:
    """What lies beside a model is found by its suffix: under another name nothing is installed, nor taken away."""
    install(SHIPPED, target := tmp_path / "model.onnx")
    shutil.copy(SMALL, tmp_path / source)
    before = sorted(tmp_path.iterdir())
    with pytest.raises((ModelInvalid, OutputError), match="not the name of a model"):
        install(tmp_path / source, tmp_path / to)
    assert sorted(tmp_path.iterdir()) == before
    assert Model(target).description.name == "best"


def test_nothing_to_go_back_to(target: Path) -> None:
    """Without a previous model the one in use stays."""
    with pytest.raises(ModelMissing, match="no model is installed"):
        rollback(target)
    install(SMALL, target)
    with pytest.raises(ModelMissing, match="no other model was installed before"):
        rollback(target)
    assert Model(target).description.name == "small"


def test_unreadable(tmp_path: Path) -> None:
    """A model that is there and cannot be looked at is not said to be missing, and ends in no internal error."""
    unseen = tmp_path / f"{'long' * 70}.onnx"
    with pytest.raises(ModelMissing, match=r"cannot be read \(File name too long\)"):
        Model(unseen)
    with pytest.raises(ModelMissing, match="cannot be read"):
        find_model(Settings.model_validate({"model": {"path": unseen}}))
    for work in (rollback, digest):
        with pytest.raises((ModelMissing, OutputError), match="too long"):
            work(unseen)
    with pytest.raises(ModelMissing, match="cannot be read"):
        Model(tmp_path)
    with pytest.raises(ModelMissing, match="no such model"):
        Model(tmp_path / "none.onnx")


def test_unusable(target: Path, tmp_path: Path) -> None:
    """What is no model, or has an atlas or a reference that cannot be used, replaces nothing."""
    install(SMALL, target)
    (wrong := tmp_path / "wrong.onnx").write_bytes(b"not a model")
    with pytest.raises(ModelInvalid):
        install(wrong, target)
    shutil.copy(SHIPPED.with_name("keypad.onnx"), other := tmp_path / "other.onnx")
    atlas_path(other).write_bytes(b"PK half an atlas")
    with pytest.raises(ModelInvalid):
        install(other, target)
    shutil.copy(SMALL, fine := tmp_path / "fine.onnx")
    fine.with_suffix(".untouched.npz").write_bytes(b"PK half a reference")
    with pytest.raises(ModelInvalid, match="not a usable reference"):
        install(fine, target)
    assert [path.name for path in target.parent.iterdir()] == ["model.onnx"]


def test_a_network_is_written_over_one_with_an_atlas(tmp_path: Path) -> None:
    """What lies there was learned with the one that goes: it once ended a training, after all its work."""
    path = tmp_path / "plate.onnx"
    atlas_path(path).write_bytes(b"of another network")
    assert put_model(SMALL.read_bytes(), path).atlas is None
