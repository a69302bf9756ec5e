"""The settings of the bridges: `touchd input` and `touchd tuio`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from touchd.config.kinds import Section


class InputSettings(Section):
    """The screen below the plate, for `touchd input` and `touchd tuio`. Both read it when they start."""

    screen_mm: tuple[float, ...] = Field(
        (), description="Where the visible screen lies on the plate: [x, y, width, height], mm; `touchd map` measures "
        "it. Without it neither starts.",
    )  # fmt: skip
    rotate: int = Field(
        0, ge=0, le=270, multiple_of=90, description="How far the picture is turned clockwise on the plate, degrees: "
        "0, 90, 180 or 270.",
    )  # fmt: skip
    residual_mm: float = Field(
        0.0, ge=0, le=1000, description="RMS distance of the touches from the mapping that `touchd map` fitted to "
        "them, mm, for `touchd doctor`; 0 for a mapping written by hand.",
    )  # fmt: skip
    border: Literal["clamp", "lift"] = Field(
        "clamp", description="What a finger that leaves the screen does: stay at its border, or lift. One that comes "
        "down outside is always dropped.",
    )  # fmt: skip
    edge_mm: float = Field(
        0.0, ge=0, le=100, description="Fingers that come down nearer to the border of the screen than this are "
        "dropped, mm.",
    )  # fmt: skip
    min_contact_s: float = Field(
        0.0, ge=0, le=5, description="Time that a finger has to stay before it counts, to within 0.1 s, s; delays all "
        "touches.",
    )  # fmt: skip
    ignore: tuple[Literal["palm", "water", "object"], ...] = Field(
        ("palm", "water", "object"), description="Kinds of contacts that are no touches."
    )
    hold_off: bool = Field(
        False, description="Show no touches while all screens are switched off or their backlights are; a finger that "
        "comes down then never counts, so it wakes nothing.",
    )  # fmt: skip
    keypad: bool = Field(
        False, description="Make a keypad that types the keys of `keypad.layout`, instead of a touch screen."
    )

    @field_validator("screen_mm")
    @classmethod
    def _is_a_rectangle(cls, screen_mm: tuple[float, ...]) -> tuple[float, ...]:
        if screen_mm and (len(screen_mm) != 4 or not all(10 <= size <= 10_000 for size in screen_mm[2:])
                          or not all(abs(at) <= 10_000 for at in screen_mm[:2])):  # fmt: skip
            raise ValueError("must be x, y, width and height, mm, the last two from 10 to 10000")
        return screen_mm


class TuioSettings(Section):
    """Where `touchd tuio` sends touches."""

    to: str = Field("127.0.0.1:3333", description="HOST:PORT of the program that takes TUIO over UDP.", min_length=1)
    insecure: bool = Field(
        False, description="Allow an address beyond loopback: anybody on the way can read what is touched."
    )
