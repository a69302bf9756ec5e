"""The reference of all settings, docs/configuration.md."""

from __future__ import annotations

from touchd.config.render import expected, section, summary, toml_value
from touchd.config.schema import Settings

_HEAD = """\
# Configuration

<!-- Generated from touchd/config/schema.py: do not edit. -->

Settings, with their defaults in brackets. `touchd config` prints those in effect, with ranges;
`touchd config --default` the defaults. touchd reads `--config` or `/etc/touchd/touchd.toml`; variables such as
`TOUCHD_DEVICE__RATE_HZ=500` win over the file, options over both. In a variable, commas part a list. An empty text
unsets a path. An unknown key is an error; one of an earlier version is ignored, with a warning.
"""


def page() -> str:
    """Return the page: a list for each section."""
    text = _HEAD
    for table in Settings.model_fields:
        text += f"\n## `[{table}]`\n\n{summary(table)}\n\n"
        for key, field in section(table).model_fields.items():
            choices = f", {words}" if (words := expected(field)).startswith("one of") else ""
            text += f"- `{key}` (`{toml_value(field.default, key)}`{choices}): {field.description}\n"
    return text
