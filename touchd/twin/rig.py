"""What a real rig has beside plate, discs and chirp: mounting, aged transducers, electronics. One TOML file.

All of it is off by default. Sizes and sources stand in `mounting`, `instrument` and `electronics`.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from touchd.errors import SimulationError
from touchd.frame import Plate
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import Instrument
from touchd.twin.physics.mounting import FREE, Mounting


class Rig(BaseModel):
    """A rig's own properties; each key of the file is a field of the class of its table."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mounting: Mounting = FREE
    tilts: tuple[tuple[float, float], ...] = ()
    """Tilt of each receiver's phase, deg, and gain, dB, from the middle of the band to its upper end."""
    electronics: Electronics = Electronics()

    def instrument(self, plate: Plate, **settings: Any) -> Instrument:
        """Return the instrument on a plate; `settings` as of `Instrument`."""
        return Instrument(plate, mounting=self.mounting, tilts=self.tilts, **settings)


IDEAL = Rig()


def load_rig(path: Path) -> Rig:
    """Return the rig of a TOML file.

    Raises SimulationError if the file cannot be read, is not TOML, or has a key or value that no rig has.
    """
    try:
        return Rig.model_validate(tomllib.loads(path.read_text("utf-8")))
    except OSError as error:
        raise SimulationError(f"cannot be read ({error.strerror})", str(path), "check the name") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise SimulationError(
            f"{key}: {first['msg']}", str(path), f"use the tables {', '.join(Rig.model_fields)}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise SimulationError(f"not TOML ({error})", str(path), "correct the file at the place named") from error
