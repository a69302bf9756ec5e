"""Maps show where and which way a model errs, and no more bias than there is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.quiver import Quiver, QuiverKey

from tests.unit.evaluation.test_replay_scores import META, contact, truth
from touchd.evaluation.model_scores import Judgement
from touchd.evaluation.plots.maps import cell_bias, cells_of, draw_error_map, draw_maps
from touchd.evaluation.plots.session import COLOURS, TRUTH, draw_session
from touchd.frame import Plate

PLATE = Plate(width_mm=200, height_mm=100)


def touches(n: int, error_mm: np.ndarray, seed: int = 1, size_mm: tuple[float, float] = (200.0, 200.0)) -> Judgement:
    true_mm = np.random.default_rng(seed).uniform(0, size_mm, (n, 2)).astype(np.float32)
    return Judgement(true_mm, true_mm + error_mm, np.ones(n), np.ones(n))


@given(st.integers(1, 3000), st.integers(1, 40), st.floats(30, 900), st.floats(30, 900), st.integers(0, 99))
def test_cells_cover_the_plate_and_each_place_lies_in_its_own(
    n: int, wanted: int, width_mm: float, height_mm: float, seed: int
) -> None:
    plate = Plate(width_mm=width_mm, height_mm=height_mm)
    position_mm = np.random.default_rng(seed).uniform(0, [width_mm, height_mm], (n, 2)).astype(np.float32)
    cell, (rows, columns) = cells_of(position_mm, plate, wanted)
    assert 3 <= rows <= 25
    assert 3 <= columns <= 25
    assert (cell >= 0).all()
    assert (cell < rows * columns).all()
    low_mm = np.stack([cell % columns, cell // columns], axis=1) * [width_mm / columns, height_mm / rows]
    inside = (position_mm >= low_mm - 1e-3) & (position_mm <= low_mm + [width_mm / columns, height_mm / rows] + 1e-3)
    assert inside.all()


@given(st.floats(-3, 3), st.floats(-3, 3), st.integers(0, 99))
def test_a_common_offset_is_the_bias_of_every_cell(dx_mm: float, dy_mm: float, seed: int) -> None:
    judged = touches(1000, np.array([dx_mm, dy_mm]), seed, (200.0, 100.0))
    centre_mm, bias_mm, _, side_mm = cell_bias(judged.true_mm, judged.error_mm, PLATE)
    np.testing.assert_allclose(bias_mm, np.broadcast_to([dx_mm, dy_mm], bias_mm.shape), atol=1e-4)
    assert ((centre_mm > 0) & (centre_mm < [200, 100])).all()
    assert side_mm <= 200 / 3


def test_a_bias_is_told_from_chance() -> None:
    """Without one, about one cell in twenty stands out; with one of a deviation nearly all do."""
    rng = np.random.default_rng(4)
    shares = []
    for offset_mm in (0.0, 1.0):
        judged = touches(20_000, rng.normal([offset_mm, 0.0], 1.0, (20_000, 2)))
        _, _, beyond, _ = cell_bias(judged.true_mm, judged.error_mm, Plate(width_mm=200, height_mm=200))
        shares.append(beyond.mean())
    assert shares[0] == pytest.approx(0.05, abs=0.05)
    assert shares[1] > 0.95


def test_a_few_gross_errors_do_not_turn_an_arrow() -> None:
    rng = np.random.default_rng(4)
    error_mm = rng.normal(0, 0.05, (2000, 2))
    error_mm[rng.choice(2000, 40, replace=False)] += 60
    judged = touches(2000, error_mm)
    _, bias_mm, _, _ = cell_bias(judged.true_mm, judged.error_mm, Plate(width_mm=200, height_mm=200))
    assert np.abs(bias_mm).max() < 0.1


def arrows(figure: Figure) -> tuple[np.ndarray, float]:
    """Every arrow drawn, and the length that the key states."""
    (key,) = (child for axes in figure.axes for child in axes.get_children() if isinstance(child, QuiverKey))
    fields = [child for axes in figure.axes for child in axes.get_children() if isinstance(child, Quiver)]
    return np.concatenate([np.stack([field.U, field.V], axis=1) for field in fields]), float(key.U)


@pytest.mark.parametrize("size_mm", [0.003, 0.4, 30.0])
def test_the_key_is_a_round_length_that_the_arrows_have(size_mm: float) -> None:
    judged = touches(600, np.random.default_rng(3).normal(0, size_mm, (600, 2)))
    drawn, key_mm = arrows(draw_maps(judged, META))
    length_mm = np.linalg.norm(drawn, axis=1)
    assert 0.4 * np.percentile(length_mm, 90) <= key_mm <= 1.1 * length_mm.max()
    assert f"{key_mm:e}"[0] in "125"
    expected = cell_bias(judged.true_mm, judged.error_mm, META.plate)[1]
    np.testing.assert_allclose(sorted(drawn.tolist()), sorted(expected.tolist()))


@pytest.mark.parametrize("n", [1, 2, 7])
def test_few_touches_are_drawn_too(n: int, tmp_path: Path) -> None:
    for error_mm in (np.zeros((n, 2)), np.ones((n, 2))):
        for draw in (draw_error_map, draw_maps):
            draw(touches(n, error_mm), META).savefig(tmp_path / "a.png", dpi=20)


@pytest.mark.parametrize("count", [2, len(COLOURS), len(COLOURS) + 3])
def test_contacts_are_named_while_their_colours_differ(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spans = [(8 * i, 8 * i + 6, 50.0, 60.0) for i in range(count)]
    events = [event for i, (start, stop, x, y) in enumerate(spans) for event in contact(i + 1, start, stop, x, y)]
    drawn: list[Figure] = []
    monkeypatch.setattr("touchd.evaluation.plots.session.save", lambda figure, _path: drawn.append(figure))
    draw_session(truth(spans, frames=8 * count), events, tmp_path / "session.png")
    legend = drawn[0].axes[0].get_legend()
    assert legend is not None
    names = {text.get_text() for text in legend.get_texts()} - {"truth"}
    assert names == ({f"contact {i + 1}" for i in range(count)} if count <= len(COLOURS) else {f"{count} contacts"})


def test_a_finger_that_rests(tmp_path: Path) -> None:
    """A true touch that stays at one place is seen on the plate, as one that moves is."""
    draw_session(truth([(5, 90, 100.0, 100.0)]), [], tmp_path / "rests.png")
    picture = imread(tmp_path / "rests.png")[..., :3]
    plate = picture[: picture.shape[0] * 4 // 5, : picture.shape[1] // 2]  # the legend lies below
    assert (np.abs(plate - to_rgb(TRUTH)).max(axis=2) < 0.01).sum() > 30


def test_a_recording_of_one_frame_is_drawn_without_a_warning(tmp_path: Path) -> None:
    draw_session(truth([], frames=1), [], tmp_path / "session.png")
