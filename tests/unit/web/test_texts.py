"""What a person reads on the page comes from one file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from touchd.localization.model_fit import WORN

SCRIPTS = Path(__file__).parents[3] / "touchd/web/static"
COMMENT = re.compile(r"(?<![:'\"`])//.*")
VALUE = re.compile(r"\$\{[^{}`'\"]*\}")
STRING = re.compile(r"'((?:[^'\\\n]|\\.)*)'|\"([^\"\n]*)\"|`((?:(?!\$\{)[^`])*)`")
"""Without a value in it: each is replaced by `#` before."""
SHOWN = re.compile(
    r"(?:\bsay\([^,()]+(?:\([^()]*\))?,|\.textContent =|(?:aria-label|title|alt|placeholder):"
    r"|\belement\(\w+, \{[^{}]*\},)\s*$"
)
"""What stands before a string that is shown, once other strings are words."""
WORD = r"[^\W\d_]{2,}"
SENTENCE = re.compile(rf"{WORD} {WORD} {WORD}|# +(?:%|[^\W\d_])")
"""Three words in a row, or a value with its unit."""
PLAIN = re.compile("px system-ui, sans-serif")


def texts_of(script: str) -> list[str]:
    """Strings that a person would read."""
    code, found = VALUE.sub("#", COMMENT.sub("", script)), []
    while match := STRING.search(code):
        said = next(part for part in match.groups() if part is not None)
        shown = re.search(WORD, said) and SHOWN.search(code, 0, match.start())
        if (shown or SENTENCE.search(said)) and not PLAIN.search(said):
            found.append(said)
        name = said if re.fullmatch("[a-z-]+", said) else "string"
        code = VALUE.sub("#", f"{code[: match.start()]}{name}{code[match.end() :]}")
    return found


@pytest.mark.parametrize("name", sorted(path.name for path in SCRIPTS.glob("*.js") if path.name != "texts.js"))
def test_texts_stand_in_one_file(name: str) -> None:
    """To translate the page one translates `texts.js`."""
    assert texts_of((SCRIPTS / name).read_text()) == []


@pytest.mark.parametrize(
    "line",
    [
        "say(word, 'Working');",
        "say(this.item(1), `${n} done`);",
        "element('p', { class: 'x' }, 'Press more')",
        "{ 'aria-label': 'Views' }",
        "one.textContent = 'Stop'",
        "const help = 'look whether it runs';",
        "found.push(shape('text', {}, `${width} mm`));",
    ],
)
def test_texts_are_noticed(line: str) -> None:
    """A text anywhere else is found."""
    assert len(texts_of(line)) == 1


def test_least_fit() -> None:
    """The page calls for a calibration at the limit of `touchd doctor`."""
    assert f"LEAST_FIT = {1 - WORN:.2f};" in (SCRIPTS / "panels.js").read_text()
    assert f"below {100 * (1 - WORN):.0f} % calibrate again" in (SCRIPTS / "texts.js").read_text()
