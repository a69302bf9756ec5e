"""Keypad mode: keys as rectangles on the plate."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from touchd.errors import ConfigError
from touchd.files import read_toml
from touchd.frame import Plate

PHONE = Path(__file__).resolve().parent / "keypads" / "phone.toml"
"""The layout that ships with touchd: 1-9 * 0 # in the middle of a plate of 200 x 200 mm."""
MOST_KEYS = 1000
"""Each is compared with each: of ten thousand a daemon starts after half a minute."""
_ROUNDING_MM = 1e-6
"""Edges that are the same to a person may differ by this much in floating point."""


class Key(BaseModel):
    """One key: a rectangle in millimetres from the plate's top-left corner."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    name: str = Field(min_length=1)
    x_mm: float
    """Left edge."""
    y_mm: float
    """Upper edge."""
    width_mm: float = Field(gt=0)
    height_mm: float = Field(gt=0)

    @property
    def centre_mm(self) -> tuple[float, float]:
        """The middle of the rectangle."""
        return self.x_mm + self.width_mm / 2, self.y_mm + self.height_mm / 2

    def holds(self, x_mm: float, y_mm: float) -> bool:
        """Return whether the point lies on the key."""
        return 0 <= x_mm - self.x_mm < self.width_mm and 0 <= y_mm - self.y_mm < self.height_mm

    def overlaps(self, other: Key) -> bool:
        """Return whether the two rectangles share more than an edge."""
        return (
            min(self.x_mm + self.width_mm, other.x_mm + other.width_mm) - max(self.x_mm, other.x_mm) > _ROUNDING_MM
            and min(self.y_mm + self.height_mm, other.y_mm + other.height_mm) - max(self.y_mm, other.y_mm)
            > _ROUNDING_MM
        )

    def lies_on(self, plate: Plate) -> bool:
        """Return whether the whole key lies on the plate."""
        return (
            min(self.x_mm, self.y_mm) >= -_ROUNDING_MM
            and self.x_mm + self.width_mm <= plate.width_mm + _ROUNDING_MM
            and self.y_mm + self.height_mm <= plate.height_mm + _ROUNDING_MM
        )


class Layout(BaseModel):
    """The keys of a keypad; everything beside them is the zone that the paper calls L."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: tuple[Key, ...] = Field(min_length=1, max_length=MOST_KEYS)

    def at(self, x_mm: float, y_mm: float) -> str | None:
        """Return the name of the key under a point, or None beside all keys."""
        for key in self.key:
            if key.holds(x_mm, y_mm):
                return key.name
        return None


def load_layout(path: Path, plate: Plate | None = None, named_by: str = "the path and its permissions") -> Layout:
    """Return the layout of a TOML file with one `[[key]]` table a key; `named_by` is what to check if there is none.

    Raises ConfigError if the file cannot be read or is no such layout: keys have different names, do not overlap, and
    lie on the plate if one is given.
    """
    try:
        layout = Layout.model_validate(read_toml(path, ConfigError, f"check {named_by}"))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{key}: {first['msg']}", str(path), f"compare with {PHONE.name}") from error
    for first_key, second in combinations(layout.key, 2):
        if first_key.name == second.name:
            raise ConfigError(f"two keys are named {second.name!r}", str(path), "give each key its own name")
        if first_key.overlaps(second):
            raise ConfigError(
                f"the keys {first_key.name!r} and {second.name!r} overlap", str(path), "move or shrink one of them"
            )
    beyond = [key.name for key in layout.key if plate and not key.lies_on(plate)]
    if plate and beyond:
        raise ConfigError(
            f"beyond the plate of {plate.width_mm:g} x {plate.height_mm:g} mm: {', '.join(map(repr, beyond))}",
            str(path),
            "keep each key on the plate that the model was trained on; x_mm and y_mm are its top-left corner",
        )
    return layout
