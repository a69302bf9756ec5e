"""Pictures of the atlas show what was measured."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes

from docs.accuracy import MODEL, PAGE, freedom_of
from docs.accuracy_plots import (
    FieldImage,
    NoiseLevel,
    draw_field,
    draw_learning,
    draw_noise,
)
from tests.unit.evaluation.test_replay_scores import META
from touchd.evaluation.model_scores import Judgement
from touchd.localization.model import Model


def line(axes: Axes, label: str) -> np.ndarray:
    (found,) = (one for one in axes.lines if one.get_label() == label)
    return np.asarray(found.get_ydata(), float)


def test_error_and_bound_are_drawn_by_noise() -> None:
    rng = np.random.default_rng(2)
    levels = []
    for noise_db, sigma_mm in ((60.0, 0.03), (40.0, 0.3)):
        true_mm = rng.uniform(0, 200, (400, 2)).astype(np.float32)
        position_mm = true_mm + sigma_mm * rng.standard_normal((400, 2))
        judged = Judgement(true_mm, position_mm, np.full(400, sigma_mm), np.ones(400))
        levels.append(NoiseLevel(noise_db, judged, sigma_mm / 2, sigma_mm / 1.5))
    figure = draw_noise(levels)
    left, right = figure.axes
    np.testing.assert_allclose(line(left, "Cramer-Rao bound, median"), [0.015, 0.15])
    # The median distance of a round Gaussian is sqrt(2 ln 2) of its deviations.
    np.testing.assert_allclose(line(left, "median error"), [0.0353, 0.353], rtol=0.12)
    np.testing.assert_allclose(np.median(line(right, "40 dB")), 0.3, rtol=0.15)
    figure.draw_without_rendering()


def test_a_wave_s_spectrum_lies_on_its_wavenumber() -> None:
    """A plane wave of 2 k is brightest on the outer circle."""
    x_mm = np.arange(0.0, 200.0, 2.0)
    k = 0.25
    wave = np.exp(2j * k * x_mm)[None, :] * np.ones((100, 1))
    figure = draw_field(FieldImage(x_mm, x_mm, wave, 1.1 * wave, 75e3, k, 0), META)
    left, middle, right = (axes for axes in figure.axes if axes.get_title())
    image = middle.images[0]
    level = np.asarray(image.get_array())
    row, column = np.unravel_index(level.argmax(), level.shape)
    west, east, south, north = image.get_extent()
    kx = west + (column + 0.5) / level.shape[1] * (east - west)
    ky = north + (row + 0.5) / level.shape[0] * (south - north)
    assert kx == pytest.approx(2 * k, abs=0.02)
    assert ky == pytest.approx(0, abs=0.02)
    assert right.get_title() == "learned less true field: median 10.0 %"
    assert "75 kHz" in left.get_title()
    figure.draw_without_rendering()


def test_the_error_is_drawn_by_the_number_of_touches() -> None:
    scores = [{"median_mm": 1 / n, "rmse_mm": 2 / n, "p95_mm": 3 / n} for n in (1000, 2000)]
    figure = draw_learning([1000, 2000], scores, 1350.0)
    np.testing.assert_allclose(line(figure.axes[0], "median"), [1e-3, 5e-4])
    figure.draw_without_rendering()


def test_the_page_has_the_degrees_of_freedom_of_the_picture() -> None:
    """The page's degrees of freedom are those that `python -m docs.accuracy learning` draws."""
    atlas = Model(MODEL).atlas
    assert atlas is not None
    assert f"{freedom_of(atlas.description):.0f} where the reference plate was touched" in PAGE.read_text()
