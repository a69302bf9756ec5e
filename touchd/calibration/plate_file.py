"""PLATE.toml: what a person measures of plate and discs with a ruler and a caliper."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from touchd.errors import PlateFileInvalid
from touchd.files import read_toml
from touchd.frame import Plate, impossible_lengths
from touchd.twin.physics.corners import inside
from touchd.twin.physics.material import MATERIALS, ElasticPlate, Material
from touchd.twin.physics.transducer import Layout

LEAST_DISC_MM = 2.0
"""No wider than thick: what bends a plate is wider."""
ROUNDING_MM = 1e-9
"""Of a place's way to the edge."""
Edge = Literal["free", "pads", "tape", "clamped"]
Millimetres = Annotated[float, Field(gt=0, le=1e5, strict=True)]
Coordinate = Annotated[float, Field(ge=-1e5, le=1e5)]
Place = tuple[Coordinate, Coordinate]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Edges(_Table):
    """What holds each side of the plate."""

    left: Edge = "free"
    right: Edge = "free"
    top: Edge = "free"
    bottom: Edge = "free"


class PlateSaid(_Table):
    """The table `[plate]`."""

    width_mm: Millimetres
    """Along x, to the right."""
    height_mm: Millimetres
    """Along y, down."""
    thickness_mm: Millimetres
    material: str | None = None
    """A name of `MATERIALS`; else the three constants below."""
    young_gpa: float | None = Field(default=None, ge=0.1, le=2000)
    poisson: float | None = Field(default=None, ge=0, lt=0.5)
    density_kg_m3: float | None = Field(default=None, ge=100, le=30_000)
    rolled: bool = False
    """Whether it is rolled sheet, stiffer along one side than along the other."""
    corner_radius_mm: float = Field(default=0.0, ge=0, le=1e5)
    """Of all four corners; 0 where they are sharp."""
    width_uncertainty_mm: float = Field(default=0.3, gt=0, le=100)
    height_uncertainty_mm: float = Field(default=0.3, gt=0, le=100)
    thickness_uncertainty_mm: float = Field(default=0.03, gt=0, le=10)
    corner_radius_uncertainty_mm: float = Field(default=1.0, gt=0, le=100)
    edge: Edge | Edges = "free"
    """What holds the sides: the fit finds how stiff, heavy and lossy it is."""

    @property
    def edges(self) -> Edges:
        """What holds each side."""
        if isinstance(self.edge, Edges):
            return self.edge
        return Edges(left=self.edge, right=self.edge, top=self.edge, bottom=self.edge)

    @property
    def elastic(self) -> Material:
        """Elastic constants: the material's, or those given."""
        if self.young_gpa is not None and self.poisson is not None and self.density_kg_m3 is not None:
            return Material(self.young_gpa * 1e9, self.poisson, self.density_kg_m3)
        return MATERIALS[(self.material or "").lower()]


class DiscsSaid(_Table):
    """The table `[discs]`."""

    diameter_mm: Millimetres
    emitter_mm: Place
    receivers_mm: tuple[Place, ...] = Field(min_length=1)
    """In the order of the channels."""
    uncertainty_mm: float = Field(default=1.0, gt=0, le=50)


class ScattererSaid(_Table):
    """A table `[[scatterers]]`: a hole, a button, a bracket."""

    at_mm: Place
    diameter_mm: Millimetres
    uncertainty_mm: float = Field(default=1.0, gt=0, le=50)
    """Of the place."""


class PlateFile(_Table):
    """What PLATE.toml says."""

    plate: PlateSaid
    discs: DiscsSaid
    scatterers: tuple[ScattererSaid, ...] = ()

    def described(self) -> Plate:
        """Return the plate as recordings describe it."""
        p = self.plate
        return Plate(
            width_mm=p.width_mm, height_mm=p.height_mm, thickness_mm=p.thickness_mm, material=p.material or "custom"
        )

    def twin_plate(self) -> ElasticPlate:
        """Return the plate as the twin takes it."""
        p = self.plate
        return ElasticPlate(**self.described().model_dump(), elastic=p.elastic, corner_radius_mm=p.corner_radius_mm)

    def layout(self) -> Layout:
        """Return the discs as the twin takes them."""
        d = self.discs
        return Layout(emitter_mm=d.emitter_mm, receivers_mm=d.receivers_mm, diameter_mm=d.diameter_mm)


def read_plate_file(path: Path) -> PlateFile:
    """Read PLATE.toml.

    Raises PlateFileInvalid if the file is missing or no TOML, a key is unknown, missing or out of range, the material
    is unknown, lengths are not in millimetres, or a disc reaches over the edge.
    """
    return check_plate_file(read_toml(path, PlateFileInvalid), str(path))


def check_plate_file(content: dict[str, Any], where: str = "PLATE.toml") -> PlateFile:
    """Check the tables of a PLATE.toml; `where` names it in the error. Raises as `read_plate_file` does."""
    try:
        said = PlateFile.model_validate(content)
    except ValidationError as error:
        raise _refused([*_explained(error)], where) from error
    # Lengths in metres put every disc in the wrong place: places are checked once the lengths are right.
    if wrong := [*_check_material(said.plate), *_check_lengths(said)] or [*check_places(said)]:
        raise _refused(wrong, where)
    return said


def to_toml(tables: dict[str, Any]) -> str:
    """Return tables of numbers, texts, lists and one table within, and lists of such, as PLATE.toml has them."""
    lines: list[str] = []
    several = [(f"[[{name}]]", each) for name, value in tables.items() if isinstance(value, list) for each in value]
    for name, table in [(f"[{name}]", value) for name, value in tables.items() if isinstance(value, dict)] + several:
        lines.append(name)
        for key, value in table.items():
            if isinstance(value, dict):
                inner = ", ".join(f"{side} = {json.dumps(held)}" for side, held in value.items())
                lines.append(f"{key} = {{ {inner} }}")
            else:
                lines.append(f"{key} = {json.dumps(value)}")
        lines.append("")
    return "\n".join(lines)


Mistake = tuple[str, str, str]
"""What is wrong, the key, and what to do."""


def _refused(wrong: list[Mistake], where: str) -> PlateFileInvalid:
    errors = [PlateFileInvalid(what, f"{where}: {key}", fix) for what, key, fix in wrong]
    if len(errors) == 1:
        return errors[0]
    return PlateFileInvalid(f"{len(errors)} mistakes: {'; '.join(map(str, errors))}", where, "correct them all")


def _explained(error: ValidationError) -> Iterator[Mistake]:
    """Explain each key that pydantic refuses once."""
    named = set()
    for found in error.errors():
        # Of a choice of types pydantic names each; and a key may hold anything.
        parts = [str(part) for part in found["loc"] if not str(part).startswith(("literal[", "Edges"))]
        key = "".join(c if c.isprintable() else "?" for c in ".".join(parts))
        if key not in named:
            named.add(key)
            what = f"{found['msg'][:1].lower()}{found['msg'][1:]}"
            counted = _counted(found["loc"])
            yield f"{counted}: {what}" if counted else what, key, _fix(found["type"], found["loc"])


def _counted(place: tuple[int | str, ...]) -> str:
    """Return what a person calls a disc or a scatterer, who counts from 1, and its coordinate; empty of another key."""
    match place:
        case ("discs", "emitter_mm", *rest):
            name = "emitter"
        case ("discs", "receivers_mm", int(number), *rest):
            name = f"receiver {number + 1}"
        case ("scatterers", int(number), "at_mm", *rest):
            name = f"scatterer {number + 1}"
        case ("scatterers", int(number), *_):
            return f"scatterer {number + 1}"
        case _:
            return ""
    axis = {0: ", x", 1: ", y"}.get(rest[0], "") if rest and isinstance(rest[0], int) else ""
    return name + axis


def _fix(kind: str, place: tuple[int | str, ...]) -> str:
    if kind == "missing" and isinstance(place[-1], int):
        return "give x and y, in mm"
    if kind == "missing":
        return "measure it, in mm, and add the key"
    if kind == "extra_forbidden":
        tables: dict[str, type[_Table]] = {"plate": PlateSaid, "discs": DiscsSaid, "scatterers": ScattererSaid}
        table = tables.get(str(place[0]))
        return f"remove it; known keys: {', '.join(table.model_fields)}" if table and len(place) > 1 else "remove it"
    if "edge" in place:
        return f"use one of {', '.join(get_args(Edge))}"
    return "correct it"


def _check_material(plate: PlateSaid) -> Iterator[Mistake]:
    constants = (plate.young_gpa, plate.poisson, plate.density_kg_m3)
    known = f"one of {', '.join(MATERIALS)}, or give young_gpa, poisson and density_kg_m3"
    key = "plate.material"
    if plate.material is None and None in constants:
        yield "the material is missing", key, f"name {known}"
    if plate.material is not None and any(constant is not None for constant in constants):
        yield "has a name and constants", key, "keep either the name or the three constants"
    if plate.material is not None and plate.material.lower() not in MATERIALS:
        yield f"unknown material {plate.material!r}", key, f"use {known}"


def _check_lengths(said: PlateFile) -> Iterator[Mistake]:
    """Refuse lengths that can only be metres or centimetres."""
    plate, discs = said.plate, said.discs
    fix = "write every length in millimetres"
    for key, what in impossible_lengths(plate.width_mm, plate.height_mm, plate.thickness_mm):
        yield what, f"plate.{key}", fix
    if discs.diameter_mm < LEAST_DISC_MM:
        yield f"{discs.diameter_mm:g} mm is no disc: metres or centimetres?", "discs.diameter_mm", fix
    if plate.corner_radius_mm > min(plate.width_mm, plate.height_mm) / 2:
        yield "is more than half of the shorter side", "plate.corner_radius_mm", "measure it again"
    for name, key, place in _places(discs):
        if 0 < max(place) < 1 and min(place) >= 0:
            yield f"{name} at ({place[0]:g}, {place[1]:g}) looks like metres", key, fix


def check_places(said: PlateFile) -> Iterator[Mistake]:
    """Yield what is wrong of places: discs over the edge or on each other, and scatterers beside the plate."""
    plate, radius = said.plate, said.discs.diameter_mm / 2
    places, size_mm = _places(said.discs), np.array([plate.width_mm, plate.height_mm])
    _, edges_mm = inside(np.array([place for *_, place in places]), size_mm, plate.corner_radius_mm)
    for number, (name, key, (x, y)) in enumerate(places):
        if edges_mm[number] < radius - ROUNDING_MM:
            what = f"{name}, of {2 * radius:g} mm at ({x:g}, {y:g}), reaches over the edge of the "
            what += f"{plate.width_mm:g} x {plate.height_mm:g} mm plate"
            yield what, key, "measure from the top left corner, x to the right and y down"
        for other, _, (x2, y2) in places[:number]:
            if (x - x2) ** 2 + (y - y2) ** 2 < (2 * radius) ** 2:
                yield f"{name} lies on {other}", key, "measure both again"

    for number, one in enumerate(said.scatterers):
        x, y = one.at_mm
        if not (0 <= x <= plate.width_mm and 0 <= y <= plate.height_mm):
            what = f"scatterer {number + 1} at ({x:g}, {y:g}) lies beside the "
            what += f"{plate.width_mm:g} x {plate.height_mm:g} mm plate"
            yield what, f"scatterers.{number}.at_mm", "measure from the top left corner, x to the right and y down"


def _places(discs: DiscsSaid) -> list[tuple[str, str, Place]]:
    """Return each disc as a person calls it, its key, which counts from 0, and its place."""
    receivers = enumerate(discs.receivers_mm)
    return [
        ("emitter", "discs.emitter_mm", discs.emitter_mm),
        *((f"receiver {i + 1}", f"discs.receivers_mm.{i}", place) for i, place in receivers),
    ]
