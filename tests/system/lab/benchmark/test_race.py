"""Every estimator gets the same touches, and its errors are those of its own answers."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.lab.benchmark.estimators import Estimator, Place, race
from touchd.lab.benchmark.scenes import BLOCK, Array, Block
from touchd.twin.physics.finger import Contact

SHAPE = (1, 2)


def block(first: int) -> Block:
    """Touches whose residual is their place."""
    true_mm = np.stack([np.arange(first, first + BLOCK), np.zeros(BLOCK)], axis=1).astype(np.float32)
    residual = true_mm.reshape(BLOCK, *SHAPE)
    contacts = [Contact(x, y, 20.0, "silicone") for x, y in true_mm.tolist()]
    return Block(np.zeros(SHAPE, np.float32), np.zeros((2, *SHAPE), np.float32), residual + 1, residual, contacts)


BLOCKS = [block(0), block(BLOCK), block(2 * BLOCK)]


def off_by(x_mm: float, y_mm: float, **more: object) -> tuple[Estimator, list[Array]]:
    """An estimator that errs always alike, and what it was asked."""
    asked: list[Array] = []

    def locate(residual: Array) -> Place:
        asked.append(residual)
        return float(residual[0, 0]) + x_mm, float(residual[0, 1]) + y_mm

    made = Estimator("wrong", "network", locate, macs=1, bytes=4096)
    for name, value in more.items():
        setattr(made, name, value)
    return made, asked


def test_the_scores_are_those_of_the_distance_to_the_truth() -> None:
    estimator, _ = off_by(3.0, 4.0)
    _, (found,) = race([estimator], lambda: None, BLOCKS, passes=2, limit_s=60.0)
    assert (found.rmse_mm, found.median_mm, found.p95_mm) == pytest.approx((5.0, 5.0, 5.0))
    assert (found.touches, found.missed) == (3 * BLOCK, 0)
    assert found.p50_us <= found.p99_us <= found.p999_us <= found.max_us


def test_a_touch_that_is_not_found_is_counted_and_not_scored() -> None:
    estimator, _ = off_by(0.0, 1.0)
    inner = estimator.locate
    estimator.locate = lambda residual: None if residual[0, 0] < 10 else inner(residual)
    _, (found,) = race([estimator], lambda: None, BLOCKS, passes=1, limit_s=60.0)
    assert found.missed == 10
    assert found.rmse_mm == pytest.approx(1.0)


def test_an_estimator_is_asked_in_every_pass() -> None:
    estimator, asked = off_by(0.0, 1.0)
    race([estimator], lambda: None, BLOCKS, passes=3, limit_s=60.0)
    assert len(asked) == 9 * BLOCK


def test_no_pass_begins_when_the_time_is_over_but_the_first() -> None:
    estimator, asked = off_by(0.0, 1.0)
    race([estimator], lambda: None, BLOCKS, passes=3, limit_s=0.0)
    assert len(asked) == 3 * BLOCK


def test_the_frame_before_and_each_new_plate_are_shown_before_the_touch() -> None:
    estimator, _ = off_by(0.0, 1.0)
    order: list[str] = []
    inner = estimator.locate
    estimator.rebase = lambda _block: order.append("plate")
    estimator.prepare = lambda before: order.append(f"before {before[0, 0]:.0f}")

    def locate(residual: Array) -> Place:
        order.append(f"touch {residual[0, 0]:.0f}")
        return inner(residual)

    estimator.locate = locate
    race([estimator], lambda: None, BLOCKS[:1], passes=1, limit_s=60.0)
    assert order[:5] == ["plate", "before 1", "touch 0", "before 2", "touch 1"]
