"""Kinds of values that the configuration has, and what no key of a kind takes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

LEAST_RATE = 1e-15
"""Least probability per frame: 1 less a smaller one is 1 in double precision, whose normal quantile is infinite."""


class Section(BaseModel):
    """One table of the file. An unknown key is an error; values never change after loading."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_bool_for_number(cls, value: Any, info: ValidationInfo) -> Any:
        # Pydantic would take `rate_hz = true` for 1.
        if isinstance(value, bool) and cls.model_fields[str(info.field_name)].annotation in (int, float):
            raise PydanticCustomError("number_type", "must be a number")
        return value


def _empty_is_unset(value: Any) -> Any:
    # TOML has no null: an empty text unsets a path, also one that a lower layer sets.
    return None if value == "" else value


def _is_nameable(name: Any) -> Any:
    text = str(name)
    if "\0" in text or any("\ud800" <= character <= "\udfff" for character in text):
        raise ValueError("holds characters that no name can have")
    return name


def refuse_key(path: Path | None) -> Path | None:
    """Raise ValueError if a path is the text of a key itself."""
    text = str(path)
    if re.fullmatch(r"[^/\s,;'\"\\|`~_][^\s,;'\"\\|`~_]{39}", text) and not text.endswith(".key"):
        raise ValueError("looks like a key itself, must be the path of the file that holds it")
    return path


def _from_hexadecimal(value: Any) -> Any:
    # A variable's text; in TOML 0x1209 is a number.
    return int(value, 16) if isinstance(value, str) and re.fullmatch("0[xX][0-9a-fA-F]{1,8}", value) else value


UsbId = Annotated[int, BeforeValidator(_from_hexadecimal), Field(ge=0, le=0xFFFF)]
"""A vendor or product, as USB counts them."""
OptionalPath = Annotated[Path | None, BeforeValidator(_empty_is_unset), AfterValidator(_is_nameable)]
"""A path, or None; an empty text means None."""
Group = Annotated[str, AfterValidator(_is_nameable)]
"""A group of this computer's users."""
Endpoint = Annotated[str, Field(pattern=r"^(tcp|ipc)://.+$"), AfterValidator(_is_nameable)]
"""An address of the bus."""
