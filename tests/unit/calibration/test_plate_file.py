from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

from touchd.calibration.plate_file import PlateFile, check_plate_file, read_plate_file
from touchd.errors import PlateFileInvalid
from touchd.twin.physics.material import Material

CONTENT: dict[str, Any] = {
    "plate": {"width_mm": 200, "height_mm": 150, "thickness_mm": 5, "material": "glass"},
    "discs": {"diameter_mm": 6, "emitter_mm": [30, 100], "receivers_mm": [[15, 15], [185, 20]]},
}


def changed(table: str, **keys: Any) -> dict[str, Any]:
    content = deepcopy(CONTENT)
    content[table].update(keys)
    return {name: {key: value for key, value in part.items() if value is not ...} for name, part in content.items()}


def read(table: str, **keys: Any) -> PlateFile:
    return check_plate_file(changed(table, **keys))


def test_uncertainties_have_the_defaults_of_a_ruler_and_a_caliper() -> None:
    """A file without uncertainties is read with those of a ruler and a caliper."""
    said = check_plate_file(CONTENT)
    p, d = said.plate, said.discs
    assert (p.width_uncertainty_mm, p.height_uncertainty_mm, p.thickness_uncertainty_mm) == (0.3, 0.3, 0.03)
    assert d.uncertainty_mm == 1


def test_the_twin_takes_it() -> None:
    """Plate and discs reach the twin with their material's constants."""
    said = read("plate", material=..., young_gpa=70, poisson=0.2, density_kg_m3=2400)
    assert said.twin_plate().elastic == Material(70e9, 0.2, 2400)
    assert said.layout().centres_mm.tolist() == [[30, 100], [15, 15], [185, 20]]


def test_an_edge_is_one_word_or_a_table() -> None:
    """`edge` names what holds all sides, or each."""
    assert read("plate", edge="tape").plate.edges.top == "tape"
    assert read("plate", edge={"left": "pads"}).plate.edges.model_dump() == {
        "left": "pads", "right": "free", "top": "free", "bottom": "free",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("table", "keys", "said"),
    [
        ("plate", {"width_mm": 0.2}, "plate.width_mm.*metres.*millimetres"),
        ("plate", {"thickness_mm": 0.005}, "plate.thickness_mm.*millimetres"),
        ("plate", {"thickness_mm": 60}, "plate.thickness_mm"),
        ("discs", {"emitter_mm": [0.03, 0.1]}, "discs.emitter_mm.*metres"),
        ("plate", {"width_mm": 8}, "plate.width_mm.*centimetres.*millimetres"),
        ("discs", {"diameter_mm": 0.006}, "discs.diameter_mm.*metres"),
        ("discs", {"diameter_mm": 0.6}, "discs.diameter_mm.*centimetres.*millimetres"),
        ("discs", {"receivers_mm": [[15, 15], [199, 20]]}, "discs.receivers_mm.1: receiver 2, .*edge"),
        ("discs", {"receivers_mm": [[15, 15], [18, 17]]}, "discs.receivers_mm.1: receiver 2 lies on receiver 1 "),
        ("discs", {"receivers_mm": [[28, 99], [185, 20]]}, "discs.receivers_mm.0: receiver 1 lies on emitter "),
        ("discs", {"receivers_mm": [[0.1, 0.2], [185, 20]]}, "discs.receivers_mm.0: receiver 1 .*metres"),
        ("discs", {"receivers_mm": [[15, 15], [185, None]]}, "discs.receivers_mm.1.1: receiver 2, y: .*-> correct it"),
        ("discs", {"receivers_mm": [[15, 15], [185]]}, "discs.receivers_mm.1.1: receiver 2, y: .*give x and y"),
        ("discs", {"receivers_mm": [[15, 15], 5]}, "discs.receivers_mm.1: receiver 2: "),
        ("discs", {"receivers_mm": []}, "discs.receivers_mm: tuple should"),
        ("discs", {"emitter_mm": [None, 100]}, "discs.emitter_mm.0: emitter, x: "),
        ("plate", {"material": "cheese"}, "cheese.*glass, aluminium"),
        ("plate", {"material": ...}, "material is missing"),
        ("plate", {"young_gpa": 70}, "name and constants"),
        ("plate", {"corner_radius_mm": 80}, "plate.corner_radius_mm: is more than half of the shorter side"),
        ("plate", {"corner_radius_mm": 50}, "discs.receivers_mm.0: receiver 1, of 6 mm at .*, reaches over the edge"),
        ("plate", {"edge": "glued"}, "edge.*use one of free, pads"),
        ("plate", {"colour": "red"}, "plate.colour.*known keys: width_mm"),
        ("plate", {"height_mm": ...}, "plate.height_mm.*measure it"),
        ("plate", {"width_mm": float("nan")}, "plate.width_mm"),
    ],
)
def test_mistakes(table: str, keys: dict[str, Any], said: str) -> None:
    """A mistake is refused with its key and what to do."""
    with pytest.raises(PlateFileInvalid, match=said):
        read(table, **keys)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"at_mm": [120, 170], "diameter_mm": 16}, "scatterers.0.at_mm: scatterer 1 .*beside the 200 x 150 mm plate"),
        ({"at_mm": [120, 70]}, "scatterers.0.diameter_mm: scatterer 1: .*measure it"),
        ({"at_mm": [120, 70], "diameter_mm": 16, "hole": True}, "scatterers.0.hole.*known keys: at_mm"),
    ],
)
def test_mistakes_in_a_scatterer(table: dict[str, Any], said: str) -> None:
    """What is wrong with a hole or a button is said, too."""
    with pytest.raises(PlateFileInvalid, match=said):
        check_plate_file({**CONTENT, "scatterers": [table]})


@pytest.mark.parametrize("key", ["emitter_mm", "receivers_mm"])
def test_a_place_beyond_all_plates(key: str) -> None:
    """Its square would overflow."""
    far = [1e300, -1e300]
    with pytest.raises(PlateFileInvalid, match=f"discs.{key}.*100000"):
        read("discs", **{key: far if key == "emitter_mm" else [far, far]})


def test_all_mistakes() -> None:
    """All mistakes are reported at once, each with its remedy, and a choice of types once."""
    content = changed("plate", height_mm=..., edge="glued", colour="red")
    with pytest.raises(PlateFileInvalid, match=r"^PLATE\.toml: 3 mistakes: .*height_mm.*edge.*colour") as caught:
        check_plate_file(content)
    assert str(caught.value).count("->") == 4
    with pytest.raises(PlateFileInvalid, match=r"2 mistakes: .*cheese.*plate\.thickness_mm"):
        read("plate", material="cheese", thickness_mm=60)
    with pytest.raises(PlateFileInvalid, match=r"2 mistakes: .*receivers_mm\.0.*receivers_mm\.1"):
        read("discs", receivers_mm=[[1, 15], [199, 20]])


def test_byte_order_mark(tmp_path: Path) -> None:
    """A file that begins as Windows' editors begin one is read."""
    path = tmp_path / "PLATE.toml"
    lines = [f"{name}.{key} = {json.dumps(value)}" for name, keys in CONTENT.items() for key, value in keys.items()]
    path.write_text("\ufeff" + "\n".join(lines), "utf-8")
    assert read_plate_file(path) == check_plate_file(CONTENT)


def test_files(tmp_path: Path) -> None:
    """A missing file and broken TOML are explained."""
    path = tmp_path / "PLATE.toml"
    with pytest.raises(PlateFileInvalid, match="check the path"):
        read_plate_file(path)
    path.write_text("[plate\n")
    with pytest.raises(PlateFileInvalid, match="not valid TOML"):
        read_plate_file(path)
