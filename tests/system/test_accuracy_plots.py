"""Pictures of the atlas show what was measured."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes

from docs.accuracy_plots import (
    FieldImage,
    NoiseLevel,
    draw_field,
    draw_fingers,
    draw_learning,
    draw_noise,
    followed,
)
from tests.unit.evaluation.test_replay_scores import META, message, truth
from touchd.evaluation.model_scores import Judgement

TWO = truth([(0, 20, 50.0, 60.0)], [(0, 20, 150.0, 100.0)], frames=20)
MESSAGES = [message(i, (1, "hold", 50.1, 60.0), (2, "hold", 150.0, 99.8)) for i in range(0, 20, 4)]


def line(axes: Axes, label: str) -> np.ndarray:
    (found,) = (one for one in axes.lines if one.get_label() == label)
    return np.asarray(found.get_ydata(), float)


def test_each_contact_is_followed_beside_its_own_finger() -> None:
    one, other = followed(TWO, MESSAGES)
    np.testing.assert_allclose(one[:, 1:3] - one[:, 4:6], [[0.1, 0.0]] * 5, atol=1e-5)
    np.testing.assert_allclose(other[:, 1:3] - other[:, 4:6], [[0.0, -0.2]] * 5, atol=1e-5)
    np.testing.assert_allclose(one[:, 0], 0.032 * np.arange(5))


def test_a_contact_far_from_all_fingers_has_no_error() -> None:
    (_, _, ghost) = followed(
        TWO, [message(3, (1, "down", 50.1, 60.0), (2, "down", 150.0, 99.8), (3, "down", 10.0, 190.0))]
    )
    assert np.isnan(ghost[:, 4:]).all()
    assert np.isfinite(ghost[:, :4]).all()


def test_a_session_is_drawn_with_its_errors() -> None:
    figure = draw_fingers(TWO, MESSAGES)
    _, _, _, x_axes, y_axes = figure.axes
    np.testing.assert_allclose(np.asarray(x_axes.lines[0].get_ydata(), float), 0.1, atol=1e-5)
    np.testing.assert_allclose(np.asarray(y_axes.lines[1].get_ydata(), float), -0.2, atol=1e-5)
    figure.draw_without_rendering()


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
