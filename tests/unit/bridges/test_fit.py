"""The mapping of the screen: found from a few touches, and refused if they do not fit."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.bridges.events import contact, touch
from touchd.bridges.area import CROSSES, Area, Crosses, Touched, fit
from touchd.cli.main import main
from touchd.cli.map import page_of
from touchd.config.schema import InputSettings
from touchd.errors import BridgeError, ConfigError

SCREENS = st.builds(
    lambda x, y, w, h, rotate: InputSettings(screen_mm=(x, y, w, h), rotate=rotate),
    st.floats(-50, 200), st.floats(-50, 200), st.floats(40, 600), st.floats(40, 600),
    st.sampled_from([0, 90, 180, 270]),
)  # fmt: skip


def on_plate(screen: InputSettings, across: float, along: float) -> tuple[float, float]:
    """Where a place of the picture lies on the plate, from `Area` alone: it is linear."""
    area = Area(screen)
    x0, y0, wide, high = screen.screen_mm
    corners = {}
    for n, (x, y) in enumerate([(0.25, 0.25), (0.75, 0.25), (0.25, 0.75)]):
        place = area.places({n + 1: contact(1, "down", x0 + x * wide, y0 + y * high)}, 0)[n + 1]
        corners[n] = (place.x_mm / area.size_mm[0], place.y_mm / area.size_mm[1])
    (u0, v0), (ux, vx), (uy, vy) = corners[0], corners[1], corners[2]
    a, b, c, d = ux - u0, uy - u0, vx - v0, vy - v0
    det = 2 * (a * d - b * c)
    p = 0.25 + ((across - u0) * d - (along - v0) * b) / det
    q = 0.25 + ((along - v0) * a - (across - u0) * c) / det
    return x0 + p * wide, y0 + q * high


@given(SCREENS, st.integers(4, 9), st.integers(0, 2**32))
def test_fit(screen: InputSettings, count: int, seed: int) -> None:
    """Four to nine touches that miss by 1 mm give the screen's rectangle and rotation, and say how far off they are."""
    touches = []
    for n, (across, along) in enumerate(CROSSES[:count]):
        x, y = on_plate(screen, across, along)
        angle = seed * 2.399 + n * 1.7
        touches.append(Touched(across, along, x + math.cos(angle), y + math.sin(angle)))
    found = fit(touches)
    assert found.rotate == screen.rotate
    assert found.screen_mm == pytest.approx(screen.screen_mm, abs=4.0)
    assert 0.0 <= found.residual_mm <= 1.01


def test_exact() -> None:
    """Touches without error give the rectangle exactly."""
    screen = InputSettings(screen_mm=(12.0, 30.0, 160.0, 90.0), rotate=270)
    found = fit([Touched(u, v, *on_plate(screen, u, v)) for u, v in CROSSES[:4]])
    assert found.screen_mm == (12.0, 30.0, 160.0, 90.0)
    assert (found.rotate, found.residual_mm) == (270, 0.0)


def square() -> list[Touched]:
    return [Touched(u, v, 200 * u, 100 * v) for u, v in CROSSES[:4]]


@pytest.mark.parametrize("bad", ["mirrored", "swapped", "missed", "one place", "few"])
def test_a_bad_mapping_is_refused(bad: str) -> None:
    """Touches that no screen explains are refused, with what to do."""
    touches = square()
    if bad == "mirrored":
        touches = [one._replace(x_mm=200 - one.x_mm) for one in touches]
    elif bad == "swapped":
        touches[0], touches[1] = (touches[0]._replace(x_mm=touches[1].x_mm, y_mm=touches[1].y_mm),
                                  touches[1]._replace(x_mm=touches[0].x_mm, y_mm=touches[0].y_mm))  # fmt: skip
    elif bad == "missed":
        touches[2] = touches[2]._replace(x_mm=touches[2].x_mm + 20)
    elif bad == "one place":
        touches = [one._replace(x_mm=50.0, y_mm=50.0) for one in touches]
    else:
        touches = touches[:3]
    with pytest.raises(BridgeError) as refused:
        fit(touches)
    assert refused.value.fix


@pytest.mark.parametrize(
    ("signs", "good_mm", "bad_mm"), [([1, -1, 1, -1], 2.95, 3.05), ([0, 0, 0, 0, 1, 0, 0, 0, 0], 6.7, 6.8)]
)
def test_bounds(signs: list[int], good_mm: float, bad_mm: float) -> None:
    """Touches 3 mm RMS off the best rectangle are refused, and one 6 mm off it; nearer ones are taken."""

    def missed(off_mm: float) -> list[Touched]:
        return [Touched(u, v, 200 * u + sign * off_mm, 100 * v) for sign, (u, v) in zip(signs, CROSSES, strict=False)]

    fit(missed(good_mm))
    with pytest.raises(BridgeError):
        fit(missed(bad_mm))


def test_touches_at_crosses() -> None:
    """A touch counts once, where it was on the average; one that ended while nobody listened does not count."""
    crosses = Crosses()
    assert not crosses.feed(touch(contact(1, "down", 10, 20)))
    assert not crosses.feed(touch(contact(1, "move", 20, 20)))
    assert crosses.feed(touch(contact(1, "up", 90, 90)))
    assert crosses.taken == [Touched(*CROSSES[0], 15, 20)]
    crosses.feed(touch(contact(2, "down")))
    crosses.feed(touch())
    assert not crosses.feed(touch(contact(2, "up")))
    assert crosses.due == CROSSES[1]


def test_what_is_not_written(tmp_path: Path) -> None:
    """A dry run writes nothing; nor does a mapping into a configuration that cannot be read."""
    config, given = tmp_path / "touchd.toml", tmp_path / "touched.json"
    given.write_text(json.dumps(square()))
    for text, options, code in (("", ["--dry-run"], 0), ("[input]\nborder = 1\n", [], ConfigError.exit_code)):
        config.write_text(text)
        assert main(["--config", str(config), "map", "--from", str(given), *options]) == code
        assert config.read_text() == text


@pytest.mark.parametrize(
    "text",
    [
        json.dumps([[u, v, 1e6 * u - 5e6, 200 * v] for u, v in CROSSES[:4]]),
        json.dumps([[u, v, 1e200 * u, 200 * v] for u, v in CROSSES[:4]]),
        json.dumps([[u, v, 1e308 * u, 1e308 * v] for u, v in CROSSES[:4]]),
        json.dumps([[u, v, 200 * u - 10_100, 100 * v] for u, v in CROSSES[:4]]),
        f"[[0.1, 0.1, {'9' * 400}, 20]]",
    ],
)
def test_no_mapping_is_written_that_a_daemon_refuses(
    tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whoever wrote the touches: a screen beyond the limits of `[input]` is refused, and nothing is written."""
    config, given = tmp_path / "touchd.toml", tmp_path / "touched.json"
    given.write_text(text)
    config.write_text("# mine\n")
    assert main(["--config", str(config), "map", "--from", str(given)]) == BridgeError.exit_code
    assert config.read_text() == "# mine\n"
    assert "touch" in capsys.readouterr().err


def test_the_page_has_the_crosses() -> None:
    """The page shows each cross where the fit takes it to be."""
    page = page_of(CROSSES[:4])
    for n, (x, y) in enumerate(CROSSES[:4], 1):
        assert f'left: {x:.0%}; top: {y:.0%}"><b>{n}</b>' in page
