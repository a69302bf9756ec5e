"""Keypad mode: keys as rectangles on the plate."""

from __future__ import annotations

import tomllib
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from touchd.errors import ConfigError

PHONE = Path(__file__).resolve().parent / "keypads" / "phone.toml"
"""The layout that ships with touchd: 1-9 * 0 # in the middle of a plate of 200 x 200 mm."""


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


class Layout(BaseModel):
    """The keys of a keypad; everything beside them is the zone that the paper calls L."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: tuple[Key, ...] = Field(min_length=1)

    def at(self, x_mm: float, y_mm: float) -> str | None:
        """Return the name of the key under a point, or None beside all keys."""
        for key in self.key:
            if key.holds(x_mm, y_mm):
                return key.name
        return None


def load_layout(path: Path) -> Layout:
    """Return the layout of a TOML file with one `[[key]]` table a key.

    Raises
    ------
    ConfigError
        If the file cannot be read or is no such layout; keys must have different names.
    """
    try:
        layout = Layout.model_validate(tomllib.loads(path.read_text("utf-8")))
    except OSError as error:
        raise ConfigError(f"cannot be read ({error.strerror})", str(path), "check keypad.layout") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"not TOML ({error})", str(path), "correct the file at the place named") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{key}: {first['msg']}", str(path), f"compare with {PHONE.name}") from error
    names = [key.name for key in layout.key]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ConfigError(f"two keys are named {min(twice)!r}", str(path), "give each key its own name")
    return layout
