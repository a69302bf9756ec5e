"""Leaving one touch out by the formula is what regressing the others again would give, value and gradient."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.training.waves import Waves, touch
from touchd.training.field.leave_one_out import (
    Displaced,
    displacements,
    label_noise_mm,
    left_out,
    predicted_by_others,
)
from touchd.training.field.regression import Prior, Regression, Touches, each

K = np.array([0.2, 0.25, 0.3])


@pytest.fixture(scope="module")
def touches() -> Touches:
    return touch(Waves(K, 2, 0), 220, 60.0, 1)[0]


@pytest.fixture(scope="module")
def regression(touches: Touches) -> Regression:
    return Regression(touches, Prior(K, ridge=1e-3))


def without(touches: Touches, i: int, b: int, regression: Regression) -> tuple[Regression, np.ndarray]:
    """The regression of all others, with the same scale of the bin."""
    rest = Touches(np.delete(touches.position_mm, i, 0), np.delete(touches.values, i, 0), touches.noise)
    other = Regression(rest, regression.prior)
    other.scale, other.ridge = regression.scale, regression.ridge
    return other, other.weights(b, np.ones(len(rest.values), np.complex64))


@pytest.mark.parametrize("i", [0, 7, 100, 219])
def test_a_touch_is_foretold_by_the_others_alone(i: int, touches: Touches, regression: Regression) -> None:
    b, one = 1, np.ones(len(touches.values), np.complex64)
    inverse = regression.inverse(b, one)
    field, by_x, by_y = predicted_by_others(regression, b, one, inverse)[:, i] * regression.scale[b]
    other, weights = without(touches, i, b, regression)
    at, step = touches.position_mm[i], 0.05
    around = at + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    values = other.at(b, weights, around)
    size = np.abs(values).max()
    np.testing.assert_allclose(field, values[0], atol=3e-3 * size)
    np.testing.assert_allclose(by_x, (values[1] - values[2]) / (2 * step), atol=1e-2 * size)
    np.testing.assert_allclose(by_y, (values[3] - values[4]) / (2 * step), atol=1e-2 * size)
    np.testing.assert_allclose(left_out(regression, b, one)[i], touches.values[i, :, b] - values[0], atol=3e-3 * size)


def test_a_touch_with_a_wrong_label_is_seen_where_it_was() -> None:
    touches, _ = touch(Waves(K, 4, 5), 400, 60.0, 6, spread=0.0)
    moved_mm = np.random.default_rng(2).normal(scale=0.3, size=(8, 2))
    wrong = touches.position_mm.copy()
    chosen = np.flatnonzero(np.abs(wrong - 30).max(axis=1) < 22)[:80:10]
    wrong[chosen] += moved_mm
    regression = Regression(Touches(wrong, touches.values, touches.noise), Prior(K))
    amplitude, bins = np.ones((len(wrong), 3), np.complex64), np.arange(3)
    inverses = each(lambda b: regression.inverse(b, amplitude[:, b]), bins)
    found = displacements(regression, amplitude, bins, inverses).by_mm[chosen]
    left_mm = np.linalg.norm(found + moved_mm, axis=1)
    assert np.median(left_mm) < 0.25 * np.median(np.linalg.norm(moved_mm, axis=1))


def seen(per_channel_mm: float, labels_mm: float) -> float:
    """The label error that is found where each channel sees a touch elsewhere, and labels are off."""
    rng, k = np.random.default_rng(8), np.linspace(0.2, 0.3, 12)
    waves, at_mm = Waves(k, 4, 5), rng.uniform(0, 60, (400, 2))
    jitter_mm = per_channel_mm * rng.normal(size=(4, 400, 2))
    values = np.stack([waves.at(at_mm + jitter_mm[c])[:, c] for c in range(4)], axis=1)
    label_mm = at_mm + labels_mm * rng.normal(size=at_mm.shape)
    regression = Regression(Touches(label_mm, values.astype(np.complex64), 1e-4), Prior(k, ridge=1e-2))
    amplitude, bins = np.ones((400, 12), np.complex64), np.arange(12)
    inverses = each(lambda b: regression.inverse(b, amplitude[:, b]), bins)
    displaced = displacements(regression, amplitude, bins, inverses)
    inner = np.abs(label_mm - 30).max(axis=1) < 24
    return label_noise_mm(Displaced(displaced.by_mm[inner], displaced.covariance[inner]))


def test_what_the_channels_see_apart_is_no_error_of_the_label() -> None:
    """Where each channel sees a touch displaced for itself, the labels are not blamed; where they are off, they are."""
    assert seen(per_channel_mm=0.0, labels_mm=0.2) == pytest.approx(0.2, rel=0.25)
    assert seen(per_channel_mm=0.2, labels_mm=0.0) < 0.03
    assert seen(per_channel_mm=0.2, labels_mm=0.2) == pytest.approx(0.2, rel=0.35)
