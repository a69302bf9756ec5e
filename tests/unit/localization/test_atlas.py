"""An atlas comes back as it was written, and a damaged one says what is wrong with it."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.fields import Field, make_atlas, scattering, yielding
from touchd.errors import ModelInvalid, OutputError
from touchd.localization.atlas import Atlas, atlas_path, load_atlas, save_atlas


@pytest.fixture(scope="module")
def atlas() -> Atlas:
    return make_atlas(Field())


@pytest.fixture(scope="module")
def whole(atlas: Atlas, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("atlas") / "plate.atlas.npz"
    save_atlas(atlas, path)
    return path


def test_it_comes_back_within_half_precision(atlas: Atlas, whole: Path) -> None:
    found = load_atlas(whole)
    assert found.description == atlas.description
    assert found.size == atlas.size
    most = np.abs(atlas.coefficients).max()
    # Half precision keeps 11 bits; what is far below the largest is subnormal.
    np.testing.assert_allclose(found.coefficients, atlas.coefficients, rtol=2**-11, atol=1e-7 * most)
    np.testing.assert_array_equal(found.baseline, atlas.baseline)
    np.testing.assert_array_equal(found.error, atlas.error)
    assert os.listdir(whole.parent) == [whole.name], "nothing else is left in the folder"


def test_what_it_knows_of_loads_comes_back(whole: Path, tmp_path: Path) -> None:
    """An atlas of a plate that yields under a finger says so; one that does not know stays one that does not."""
    assert load_atlas(whole).yields is None
    save_atlas(yielding(), tmp_path / "plate.atlas.npz")
    found, yields = load_atlas(tmp_path / "plate.atlas.npz", np.float64).yields, yielding().yields
    assert found is not None
    assert yields is not None
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, yields, rtol=2**-10, atol=1e-6)


@pytest.mark.parametrize("lossy", [False, True])
def test_what_it_knows_of_modes_comes_back(lossy: bool, tmp_path: Path) -> None:
    """So does what tells how fingers scatter each other's waves."""
    atlas = scattering(lossy=lossy)
    save_atlas(atlas, tmp_path / "plate.atlas.npz")
    found = load_atlas(tmp_path / "plate.atlas.npz", np.float64).modes
    assert found
    assert atlas.modes
    for one, other in zip(found, atlas.modes, strict=True):
        np.testing.assert_allclose(np.asarray(one), np.asarray(other), rtol=2**-10, atol=1e-6)
    assert {part.dtype for part in found if isinstance(part, np.ndarray)} <= {np.dtype("f8"), np.dtype("c16")}


def test_it_lies_beside_its_network() -> None:
    assert atlas_path(Path("models/plate.onnx")) == Path("models/plate.atlas.npz")


Parts = dict[str, Any]


def described(**changes: Any) -> Callable[[Parts], None]:
    """Write other things into the description."""

    def change(parts: Parts) -> None:
        parts["description"] = np.array(json.dumps(json.loads(str(parts["description"])) | changes))

    return change


def spoiled(key: str, value: float) -> Callable[[Parts], None]:
    def change(parts: Parts) -> None:
        parts[key] = parts[key].copy()
        parts[key].flat[7] = value

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: p.pop("scale"), "scale missing"),
        (lambda p: p.update(format=np.array("touchd-recording")), "another format or version"),
        (lambda p: p.update(version=np.array(2)), "another format or version"),
        (lambda p: p.update(description=np.array("{")), "description: "),
        (described(bins=[]), "description: bins: "),
        (described(step_mm=-1.0), "description: step_mm: "),
        (described(plate={"width_mm": 100}), "description: plate.height_mm: "),
        (described(low_mm=[-50.0, 2.5]), "the touched part"),
        (described(high_mm=[117.5, 500.0]), "the touched part"),
        (described(bins=[54, 57]), r"coefficients of shape .* not \(rows, columns, 16\)"),
        (lambda p: p.update(coefficients=p["coefficients"][:3]), r"coefficients of shape \(3,"),
        (lambda p: p.update(coefficients=p["coefficients"][0]), "coefficients of shape"),
        (lambda p: p.update(baseline=p["baseline"][:2]), r"baseline of shape \(2, 250\)"),
        (lambda p: p.update(error=p["error"].T), r"error of shape \(15, 4\)"),
        (spoiled("coefficients", np.nan), "numbers that are none"),
        (spoiled("baseline", np.inf), "numbers that are none"),
        (spoiled("error", np.nan), "numbers that are none"),
        (described(plate={"width_mm": 1, "height_mm": 90}), "is not on the plate"),
        (described(plate={"width_mm": 1e300, "height_mm": 90}), "description: plate.width_mm: "),
        (described(step_mm=1e-300), "description: step_mm: "),
        (described(step_mm=1e300), "description: step_mm: "),
        (described(noise_scale=1e300), "description: noise_scale: "),
        (described(origin_mm=[1e300, -1e300]), "the touched part"),
        (described(bins=list(range(53, 98, 3))[::-1]), "bins from"),
        (described(bins=[-1, *range(57, 99, 3)]), "bins from -1"),
        (described(bins=[*range(54, 96, 3), 10**9]), "bins from 54 to 1000000000"),
        (lambda p: p.update(scale=np.array(np.float32(3e38))), "too large"),
        (lambda p: p.update(scale=np.array(np.float32(0))), "a field of zeros"),
        (lambda p: p.update(scale=np.array(np.float32(np.nan))), "numbers that are none"),
        (spoiled("baseline", 1e30), "too large"),
        (spoiled("error", -1.0), "a negative error"),
        (lambda p: p.update(scale=np.array("text")), "not a usable atlas"),
        (lambda p: p.update(scale=np.ones(3, np.float32)), "not a usable atlas"),
        (lambda p: p.update(yields=p["coefficients"]), "yields of shape"),
        (lambda p: p.update(yields=p["coefficients"][..., :30].astype(int)), "yields int64"),
        (lambda p: p.update(yields=np.full_like(p["coefficients"][..., :30], np.nan)), "numbers that are none"),
    ],
)
def test_a_damaged_one_says_what_is_wrong(
    change: Callable[[Parts], object], says: str, whole: Path, tmp_path: Path
) -> None:
    with np.load(whole) as archive:
        parts = dict(archive)
    change(parts)
    path = tmp_path / "damaged.atlas.npz"
    np.savez(path, **parts)
    with pytest.raises(ModelInvalid, match=says) as caught:
        load_atlas(path)
    assert caught.value.where == str(path)
    assert "touchd train --recipe atlas" in caught.value.fix


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: p.pop("modes_discs"), "modes_discs missing"),
        (lambda p: p.update(modes_loads=p["modes_loads"][:-1]), "modes_receptance of shape"),
        (lambda p: p.update(modes_heard=p["modes_heard"][1:]), "modes_heard of shape"),
        (lambda p: p.update(modes_shapes=p["modes_shapes"][:2]), "modes_shapes of shape"),
        (lambda p: p.update(modes_shapes=p["modes_shapes"][..., [0, 0, 0]]), "modes_shapes of shape"),
        (lambda p: p.update(modes_discs=p["modes_discs"][1:]), "modes_discs of shape"),
        (lambda p: p.update(modes_loads=np.float32(1)), "modes_loads of shape"),
        (lambda p: p.update(modes_grid=np.zeros(3)), "modes_grid of shape"),
        (lambda p: p.update(modes_to_bins=p["modes_to_bins"][:, :-2]), "modes of 4 channels and 28 values"),
        (lambda p: p.update(modes_shapes=p["modes_shapes"].astype(int)), "modes_shapes holds what is no number"),
        (lambda p: p.update(modes_receptance=np.full_like(p["modes_receptance"], np.inf)), "modes_receptance holds"),
        (lambda p: p.update(modes_loads=np.full(p["modes_loads"].shape, 1e300)), "modes_loads holds"),
        (lambda p: p.update(modes_heard=p["modes_heard"][..., :1]), "modes_heard of shape"),
        (lambda p: p.update(modes_discs=np.repeat(p["modes_discs"], 2, axis=-1)), "modes_discs of shape"),
        (lambda p: p.pop("yields"), "modes, but no yields"),
    ],
)
def test_damaged_modes(change: Callable[[Parts], object], says: str, tmp_path: Path) -> None:
    """Of an atlas with modes each part is checked, too."""
    path = tmp_path / "plate.atlas.npz"
    save_atlas(scattering(), path)
    with np.load(path) as archive:
        parts = dict(archive)
    change(parts)
    np.savez(path, **parts)
    with pytest.raises(ModelInvalid, match=says):
        load_atlas(path)


def test_a_bomb_is_refused(whole: Path, tmp_path: Path) -> None:
    """A file whose arrays are far larger than any atlas is refused before they are read."""
    with np.load(whole) as archive:
        parts = dict(archive)
    parts["coefficients"] = np.zeros((700, 700, 120), np.float16)
    np.savez_compressed(tmp_path / "bomb.atlas.npz", **parts)
    with pytest.raises(ModelInvalid, match=r"claims .* bytes of arrays"):
        load_atlas(tmp_path / "bomb.atlas.npz")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_one_is_refused(share: float, whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "short.atlas.npz"
    data = whole.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ModelInvalid, match="not a whole"):
        load_atlas(path)


def test_none_at_all_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelInvalid, match="no such file"):
        load_atlas(tmp_path / "none.atlas.npz")


def test_one_that_is_too_large_is_refused_and_leaves_nothing_behind(
    atlas: Atlas, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise cannot be compressed: two million halves of it are four megabytes."""
    monkeypatch.setattr("touchd.localization.atlas.MAX_BYTES", 3_000_000)
    noise = np.random.default_rng(1).random((130, 130, atlas.size), np.float32)
    assert 2 * noise.size > 3_000_000
    path = tmp_path / "large.atlas.npz"
    path.write_bytes(b"the older one")
    with pytest.raises(OutputError, match="more than 3"):
        save_atlas(replace(atlas, coefficients=noise), path)
    assert os.listdir(tmp_path) == [path.name]
    assert path.read_bytes() == b"the older one"


def test_a_folder_that_is_none_is_an_output_error(atlas: Atlas, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        save_atlas(atlas, tmp_path / "none" / "plate.atlas.npz")


def test_a_name_that_is_taken_by_a_folder_leaves_nothing_behind(atlas: Atlas, tmp_path: Path) -> None:
    (tmp_path / "plate.atlas.npz").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        save_atlas(atlas, tmp_path / "plate.atlas.npz")
    assert os.listdir(tmp_path) == ["plate.atlas.npz"]
