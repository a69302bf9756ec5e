"""What a real rig has beside plate, discs and chirp: mounting, aged transducers, electronics. One TOML file.

All of it is off by default. Sizes and sources stand in `mounting`, `instrument` and `electronics`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from touchd.errors import SimulationError
from touchd.files import read_toml
from touchd.frame import Plate
from touchd.twin.electronics import Dead, Electronics, Impulses, Ripple, Tone
from touchd.twin.instrument import Instrument
from touchd.twin.physics.mounting import FREE, Attachment, Mounting, Support

MOST_STRETCH = 0.03


class Rig(BaseModel):
    """A rig's own properties; each key of the file is a field of the class of its table."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mounting: Mounting = FREE
    tilts: tuple[tuple[float, float], ...] = ()
    """Tilt of each receiver's phase, deg, and gain, dB, from the middle of the band to its upper end."""
    feedthrough: tuple[tuple[float, float], ...] = ()
    """What each receiver hears of the drive itself: level beside what the plate sends it, dB, and phase, deg. Leads
    side by side have some 50 pF/m, a disc and its cable 300 pF: 20 cm pass on -30 dB of the drive, as the plate does
    where a drive of 10 V makes 300 mV. 0 deg by common wires, 90 deg into an amplifier of low impedance."""
    stretch: float = Field(default=0.0, ge=-MOST_STRETCH, le=MOST_STRETCH)
    """How much higher all resonances are than they were in training. By Young's modulus, a kelvin lowers them by some
    4.5e-5 on glass, 1.4e-4 on steel, 2.7e-4 on aluminium and 1e-3 on acrylic: ten kelvin there are -0.01."""
    electronics: Electronics = Electronics()

    def instrument(self, plate: Plate, **settings: Any) -> Instrument:
        """Return the instrument on a plate; `settings` as of `Instrument`."""
        own = {name: getattr(self, name) for name in ("mounting", "tilts", "feedthrough", "stretch")}
        return Instrument(plate, **own, **settings)


IDEAL = Rig()
_KEYS: dict[str, Iterable[str]] = {
    "": Rig.model_fields, "mounting": Mounting.model_fields, "mounting.attachments": Attachment.model_fields,
    "mounting.attachments.support": Support._fields, "electronics": Electronics._fields,
    "electronics.impulses": Impulses._fields, "electronics.ripple": Ripple._fields,
    "electronics.tones": Tone._fields, "electronics.dead": Dead._fields,
}  # fmt: skip
"""Keys of each table, by its name."""


MOST_DB, MOST = 400.0, 1e18
"""Of a level or an angle, and of any other number: beyond, powers overflow."""
_LEVELS = ("_db", "tilts", "feedthrough")
_ENDLESS = ("electronics.noise_db", "electronics.tones.stop_s")
"""May be infinite."""


def _numbers(key: str, value: object) -> Iterator[tuple[str, float]]:
    """Yield all numbers of a table, with their keys."""
    if isinstance(value, dict):
        for name, each in value.items():
            yield from _numbers(f"{key}.{name}".removeprefix("."), each)
    elif isinstance(value, list):
        for each in value:
            yield from _numbers(key, each)
    elif isinstance(value, int | float):
        yield key, value


def load_rig(path: Path) -> Rig:
    """Return the rig of a TOML file.

    Raises SimulationError if the file cannot be read, is not TOML, or has a key or value that no rig has.
    """
    tables = read_toml(path, SimulationError)
    for key, value in _numbers("", tables):
        endless = value == math.inf and key in _ENDLESS
        if not (endless or abs(value) <= (MOST_DB if key.endswith(_LEVELS) else MOST)):
            raise SimulationError(f"{key}: is {str(value)[:24]}", str(path), "correct it: no rig has that")
    try:
        return Rig.model_validate(tables)
    except ValidationError as error:
        # A key misspelt is missing, too.
        first = min(error.errors(), key=lambda each: each["type"] != "extra_forbidden")
        *table, _ = first["loc"]
        what, fix = first["msg"].removeprefix("Value error, "), "correct it"
        if first["type"] == "extra_forbidden":
            keys = _KEYS[".".join(part for part in table if isinstance(part, str))]
            what, fix = "unknown key", f"use {', '.join(keys)}"
        key = ".".join(map(str, first["loc"]))
        raise SimulationError(f"{key}: {what}", str(path), fix) from error
