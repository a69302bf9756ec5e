"""Read the configuration in a process of its own: what that takes, 25 MB, ends with it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

from touchd.errors import ConfigError

if TYPE_CHECKING:
    from touchd.config.schema import Settings


def load_apart(path: Path | None = None, overrides: Mapping[str, Any] | None = None) -> Settings:
    """Return `load(path, overrides)` with its lists as lists and its paths as text; raise what it raises."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        answer: dict[str, Any] = {"internal": True}
        try:
            from touchd.config.load import load

            answer = load(path, overrides).model_dump(mode="json")
        except ConfigError as error:
            answer = {"refused": [error.what, error.where, error.fix]}
        finally:
            with open(writer, "w") as pipe:
                json.dump(answer, pipe)
            os._exit(0)
    os.close(writer)
    with open(reader) as pipe:
        text = pipe.read()
    os.waitpid(child, 0)
    answer = json.loads(text)
    if "refused" in answer:
        raise ConfigError(*answer["refused"])
    if "internal" in answer:
        raise RuntimeError("the configuration could not be read")
    return cast("Settings", json.loads(text, object_hook=lambda table: SimpleNamespace(**table)))
