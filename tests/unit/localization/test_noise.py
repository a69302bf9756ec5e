"""What of a frame is listened to: neither dead channels nor bins that drown, and how much noise the rest holds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fields import Field, make_atlas
from touchd.localization.noise import Hearing

ATLAS = make_atlas(Field())
NOWHERE = np.zeros((0, ATLAS.size), np.float32)


def hearing(noise: np.ndarray | float, directions: np.ndarray = NOWHERE, *dead: int) -> Hearing:
    """One that has heard 200 frames of noise of some deviation, for each feature or for all."""
    made, rng = Hearing(ATLAS), np.random.default_rng(1)
    for _ in range(200):
        made.hear((noise * rng.standard_normal(ATLAS.size)).astype(np.float32))
    made.listen_to(~np.isin(np.arange(4), dead), directions)
    return made


@given(st.floats(0.1, 100), st.sets(st.integers(0, 3), max_size=3))
@settings(deadline=None, max_examples=20)
def test_the_noise_expected_is_that_of_what_is_listened_to(deviation: float, dead: set[int]) -> None:
    heard = hearing(deviation, NOWHERE, *dead)
    assert heard.alive == ATLAS.size * (4 - len(dead)) // 4
    assert heard.expected == pytest.approx(heard.alive * deviation**2, rel=0.05)
    assert heard.variance == pytest.approx(ATLAS.description.noise_scale * deviation**2, rel=0.05)
    assert (heard.mask is None) is (not dead)


def test_a_bin_that_drowns_is_left_out() -> None:
    noise = np.ones(ATLAS.size)
    noise[[3, 3 + ATLAS.size // 8]] = 10.0  # both parts of a bin of the first channel
    heard = hearing(noise)
    assert heard.mask is not None
    assert np.flatnonzero(heard.mask == 0).tolist() == [3, 3 + ATLAS.size // 8]
    assert heard.expected == pytest.approx(ATLAS.size - 2, rel=0.05)


def test_noise_of_few_shapes_is_told_from_white_noise_whatever_its_size() -> None:
    """Trigger jitter has one."""
    rng = np.random.default_rng(4)
    shape = rng.standard_normal(ATLAS.size)
    for size in (1e-3, 1.0, 1e5):
        heard = hearing(size)
        said = [heard.is_alike]
        for _ in range(64):
            jitter = rng.choice([-1, 1]) * rng.uniform(0.5, 2) * shape
            heard.hear((size * (jitter + 0.2 * rng.standard_normal(ATLAS.size))).astype(np.float32))
        said.append(heard.is_alike)
        for _ in range(200):
            heard.hear((size * rng.standard_normal(ATLAS.size)).astype(np.float32))
        said.append(heard.is_alike)
        assert said == [False, True, False]


def test_with_every_channel_dead_all_are_listened_to() -> None:
    assert hearing(1.0, NOWHERE, 0, 1, 2, 3).mask is None


@pytest.mark.parametrize("dead", [(), (2,)])
def test_what_lies_along_the_plates_own_movement_is_told_from_what_does_not(dead: tuple[int, ...]) -> None:
    """With a channel left out, the directions are those of the others, orthonormal again."""
    rng = np.random.default_rng(2)
    own = np.linalg.qr(rng.standard_normal((ATLAS.size, 3)))[0].T.astype(np.float32)
    heard = hearing(1.0, own, *dead)
    np.testing.assert_allclose(heard.own @ heard.own.T, np.eye(3), atol=1e-5)
    alive = np.ones(ATLAS.size, np.float32) if heard.mask is None else heard.mask
    moved = (np.array([3.0, -1.0, 2.0]) @ own * alive).astype(np.float32)
    assert heard.by_itself(moved) == pytest.approx(float(moved @ moved), rel=1e-4)
    other = (rng.standard_normal(ATLAS.size) * alive).astype(np.float32)
    other -= (heard.own @ other) @ heard.own
    assert heard.by_itself(other) < 1e-6 * float(other @ other)
