"""Set keys of a configuration file; its comments and all else stay."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path

from touchd.errors import OutputError
from touchd.files import read_text, replacing


def set_keys(path: Path, table: str, keys: Mapping[str, str]) -> None:
    """Set keys of `[table]` in a file, or in the target of a link; it is made if it is not there.

    Raises what `with_keys` and `read_text` raise.
    """
    path = Path(os.path.realpath(path))
    there = path.exists()
    text = with_keys(read_text(path) if there else "", table, keys, str(path))
    with replacing(path, mode=path.stat().st_mode & 0o777 if there else 0o644) as file:
        file.write(text.encode())


def with_keys(text: str, table: str, keys: Mapping[str, str], where: str = "") -> str:
    """Return a configuration file's text with keys of `[table]` set to values in TOML.

    Raises OutputError if it has a key in a form that this does not understand, such as a list over several lines.
    """
    parts = re.split(r"(?m)^(?=\[)", text)
    at = next((n for n, part in enumerate(parts) if re.match(rf"\[[ \t]*{table}[ \t]*\]", part)), None)
    if at is None:
        at = len(parts) + 1
        parts += ["\n" if text else "", f"[{table}]\n"]
    head, _, body = parts[at].partition("\n")
    for key, value in keys.items():
        body, done = re.subn(rf"(?m)^{key}\s*=.*$", f"{key} = {value}", body)
        if not done:
            body = f"{key} = {value}\n{body}"
    parts[at] = f"{head}\n{body}"
    changed = "".join(parts)
    wanted = tomllib.loads("\n".join(f"{key} = {value}" for key, value in keys.items()))
    try:
        understood = wanted.items() <= tomllib.loads(changed)[table].items()
    except tomllib.TOMLDecodeError:
        understood = False
    if not understood:
        raise OutputError(f"has the keys of [{table}] in an unusual form", where, "write them by hand")
    return changed
