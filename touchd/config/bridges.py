"""The settings of the bridges: `touchd input` and `touchd tuio`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from touchd.config.kinds import Section


class InputSettings(Section):
    """The screen below the plate. `touchd input` and `touchd tuio` read it when they start."""

    screen_mm: tuple[float, ...] = Field(
        (), description="Where it lies on the plate: [x, y, width, height], mm; `touchd map` measures it. Needed."
    )
    rotate: int = Field(
        0, ge=0, le=270, multiple_of=90, description="Degrees by which the picture is turned clockwise, by 90."
    )
    residual_mm: float = Field(
        0.0, ge=0, le=1000, description="RMS error of the mapping by `touchd map`, mm; 0: written by hand."
    )
    border: Literal["clamp", "lift"] = Field(
        "clamp", description="A finger that leaves the screen stays at its border, or lifts."
    )
    edge_mm: float = Field(
        0.0, ge=0, le=100, description="Fingers that come down nearer to the screen's border, mm, are dropped."
    )
    min_contact_s: float = Field(0.0, ge=0, le=5, description="Time before a finger counts, s, to within 0.1 s.")
    ignore: tuple[Literal["palm", "water", "object"], ...] = Field(
        ("palm", "water", "object"), description="Kinds of contacts to drop."
    )
    hold_off: bool = Field(
        False, description="No touches while all screens or backlights are off; a finger then wakes nothing."
    )
    keypad: bool = Field(False, description="Type the keys of `keypad.layout` instead of being a touch screen.")

    @field_validator("screen_mm")
    @classmethod
    def _is_a_rectangle(cls, screen_mm: tuple[float, ...]) -> tuple[float, ...]:
        if screen_mm and (len(screen_mm) != 4 or not all(10 <= size <= 10_000 for size in screen_mm[2:])
                          or not all(abs(at) <= 10_000 for at in screen_mm[:2])):  # fmt: skip
            raise ValueError("must be x, y, width and height, mm, the last two from 10 to 10000")
        return screen_mm


class TuioSettings(Section):
    """Where `touchd tuio` sends touches."""

    to: str = Field("127.0.0.1:3333", description="HOST:PORT, UDP.", min_length=1)
    insecure: bool = Field(False, description="Allow an address beyond loopback, unencrypted.")
