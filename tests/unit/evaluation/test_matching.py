"""Contacts are assigned to fingers at the least total distance, and every score is counted from that."""

from __future__ import annotations

import itertools
from math import hypot, inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from touchd.evaluation import matching
from touchd.evaluation.matching import REACH_MM, Seen, match, match_frames, scores_by_fingers
from touchd.evaluation.metrics import FEWEST
from touchd.touch import Touch
from touchd.tracking.assignment import assign

Places = list[tuple[float, float]]

PLACES = st.lists(st.tuples(st.integers(0, 60).map(float), st.integers(0, 60).map(float)), max_size=5)


@st.composite
def frames_of_fingers(draw: st.DrawFn) -> tuple[Places, Places]:
    """Fingers, and contacts near some of them or anywhere."""
    true_mm = draw(PLACES)
    offset = st.tuples(st.sampled_from([0.0, 0.5, 1.0, 1.5, 3.0]), st.sampled_from([0.0, 1.0]))
    found = [(x + dx, y + dy) for x, y in true_mm if draw(st.integers(0, 4)) for dx, dy in [draw(offset)]]
    return true_mm, found + (draw(PLACES) if not draw(st.integers(0, 3)) else [])


FRAMES = st.lists(frames_of_fingers(), min_size=1, max_size=12)


def touch(x_mm: float, y_mm: float, sigma_mm: float = 1.0, force: float = 0.5) -> Touch:
    return Touch(x_mm, y_mm, sigma_mm, 0.9, force)


def cost(pairs: list[tuple[int, int]], true_mm: Places, position_mm: Places, reach_mm: float) -> float:
    """Distances, and the reach for each finger without a contact."""
    together = sum(hypot(true_mm[i][0] - position_mm[j][0], true_mm[i][1] - position_mm[j][1]) for i, j in pairs)
    return together + (reach_mm * (len(true_mm) - len(pairs)) if len(pairs) < len(true_mm) else 0.0)


@given(PLACES, PLACES, st.floats(0.5, 60))
def test_no_other_assignment_within_the_reach_costs_less(true_mm: Places, position_mm: Places, reach_mm: float) -> None:
    pairs = match(true_mm, position_mm, reach_mm)
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)
    assert all(cost([pair], [true_mm[pair[0]]] * 5, position_mm, 0) <= reach_mm for pair in pairs)
    few, many = sorted([range(len(true_mm)), range(len(position_mm))], key=len)
    best = inf
    for size in range(len(few) + 1):
        for chosen, others in itertools.product(itertools.combinations(few, size), itertools.permutations(many, size)):
            tried = list(zip(chosen, others, strict=True))
            if len(true_mm) > len(position_mm):
                tried = [(i, j) for j, i in tried]
            if all(cost([(0, j)], [true_mm[i]], position_mm, 0) <= reach_mm for i, j in tried):
                best = min(best, cost(tried, true_mm, position_mm, reach_mm))
    assert cost(pairs, true_mm, position_mm, reach_mm) == pytest.approx(best, abs=1e-6)


def test_many_fingers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thousands of true fingers cost a few contacts a time that is linear in their number."""
    shapes = []

    def watched(cost: list[list[float]]) -> list[int]:
        shapes.append((len(cost), len(cost[0])))
        return assign(cost)

    monkeypatch.setattr(matching, "assign", watched)
    true_mm = [(float(i), float(j)) for i in range(50) for j in range(40)]
    assert match(true_mm, [(20.2, 7.0), (3.0, 3.3)]) == [(3 * 40 + 3, 1), (20 * 40 + 7, 0)]
    assert shapes == [(2, 2002)]


@given(PLACES, PLACES)
def test_without_a_reach_it_is_the_plain_assignment(true_mm: Places, position_mm: Places) -> None:
    pairs = match(true_mm, position_mm, inf)
    assert len(pairs) == min(len(true_mm), len(position_mm))
    apart_mm = np.array([[hypot(x - u, y - v) for u, v in position_mm] for x, y in true_mm]).reshape(
        len(true_mm), len(position_mm)
    )
    rows, columns = linear_sum_assignment(apart_mm)
    total_mm = sum(apart_mm[i, j] for i, j in pairs)
    assert total_mm == pytest.approx(apart_mm[rows, columns].sum(), abs=1e-5)


def test_the_nearest_to_each_is_not_always_the_best_for_all() -> None:
    """The contact between two fingers is nearer to the first, which has one of its own."""
    fingers, contacts = [(10.0, 0.0), (30.0, 0.0)], [(19.0, 0.0), (5.0, 0.0)]
    assert match(fingers, contacts) == [(0, 1), (1, 0)]


@given(FRAMES)
def test_missed_ghosts_and_matches_account_for_every_finger_and_contact(frames: list[tuple[Places, Places]]) -> None:
    seen = [Seen(true_mm, [touch(*place) for place in position_mm]) for true_mm, position_mm in frames]
    by_fingers = scores_by_fingers(match_frames(seen))
    assert sum(scores["n"] for scores in by_fingers.values()) == len(frames)
    for key, scores in by_fingers.items():
        mine = [(true_mm, position_mm) for true_mm, position_mm in frames if len(true_mm) == int(key)]
        pairs = [match(true_mm, position_mm) for true_mm, position_mm in mine]
        assert scores["n"] == len(mine)
        assert scores["ghosts"] == sum(len(position_mm) for _, position_mm in mine) - sum(map(len, pairs))
        assert scores["count_right"] == np.mean([len(true_mm) == len(position_mm) for true_mm, position_mm in mine])
        if key == "0":
            assert set(scores) == {"n", "count_right", "ghosts"}
            continue
        assert scores["missed"] == sum(len(true_mm) for true_mm, _ in mine) - sum(map(len, pairs))
        errors = [
            np.subtract(position_mm[j], np.array(true_mm[i], np.float32))
            for (true_mm, position_mm), found in zip(mine, pairs, strict=True)
            for i, j in found
        ]
        near = [
            len(found) == len(true_mm) and all(hypot(*np.subtract(true_mm[i], position_mm[j])) <= 2 for i, j in found)
            for (true_mm, position_mm), found in zip(mine, pairs, strict=True)
        ]
        assert scores["all_within_2_mm"] == np.mean(near)
        if not errors:
            assert scores["rmse_mm"] is scores["within_1_sigma"] is None
            continue
        distance_mm = np.linalg.norm(errors, axis=1)
        assert scores["rmse_mm"] == pytest.approx(np.sqrt(np.mean(distance_mm**2)), abs=1e-5)
        assert scores["median_mm"] == pytest.approx(np.median(distance_mm), abs=1e-5)
        assert scores["p95_mm"] == pytest.approx(np.percentile(distance_mm, 95), abs=1e-5)
        assert scores["within_2_sigma"] == np.mean(np.abs(errors) <= 2)


def test_a_frame_counts_as_within_a_distance_only_if_each_of_its_fingers_does() -> None:
    fingers = [(50.0, 50.0), (100.0, 50.0)]
    found = [
        [touch(50.5, 50), touch(100, 50.5)],  # both within 1 mm
        [touch(50.5, 50), touch(101.5, 50)],  # both within 2
        [touch(50.5, 50), touch(103, 50)],  # one is off
        [touch(50.5, 50)],  # one is missed
        [touch(50.5, 50), touch(100, 50.5), touch(150, 150)],  # and a ghost, which is counted as such
    ]
    scores = scores_by_fingers(match_frames(Seen(fingers, contacts) for contacts in found))["2"]
    assert scores["all_within_1_mm"] == 2 / 5
    assert scores["all_within_2_mm"] == 3 / 5
    assert scores["count_right"] == 3 / 5
    assert (scores["missed"], scores["ghosts"]) == (1, 1)
    assert scores["told_apart"] == 3 / 5


@pytest.mark.parametrize(
    ("contacts", "apart"),
    [
        ([touch(49, 50), touch(66, 50)], True),
        ([touch(57, 50), touch(59, 50)], True),  # far off, but each on its own finger's side
        ([touch(57, 50), touch(57.5, 50)], False),  # two contacts of one finger
        ([touch(58, 50)], False),  # one in the middle
        ([touch(50, 50), touch(66, 50), touch(58, 50)], False),  # and one too many
        ([touch(66, 50), touch(50, 50)], True),  # in any order
    ],
)
def test_two_fingers_are_told_apart_if_each_has_a_contact_nearer_to_it_than_to_the_other(
    contacts: list[Touch], apart: bool
) -> None:
    scores = scores_by_fingers(match_frames([Seen([(50.0, 50.0), (66.0, 50.0)], contacts)]))["2"]
    assert scores["told_apart"] == float(apart)


def test_a_contact_beyond_the_reach_is_a_ghost_and_its_finger_missed() -> None:
    near, far = touch(50 + REACH_MM, 50), touch(50.1 + REACH_MM, 50)
    scores = scores_by_fingers(match_frames([Seen([(50.0, 50.0)], [near])]))["1"]
    assert (scores["missed"], scores["ghosts"], scores["rmse_mm"]) == (0, 0, REACH_MM)
    scores = scores_by_fingers(match_frames([Seen([(50.0, 50.0)], [far])]))["1"]
    assert (scores["missed"], scores["ghosts"], scores["rmse_mm"]) == (1, 1, None)


def test_right_standard_errors_are_seen_to_be_right() -> None:
    """Gaussian errors of the stated size: 68.3 and 95.4 % lie within one and two of it."""
    rng = np.random.default_rng(1)
    sigma_mm = rng.uniform(0.02, 2.0, 5000)
    offsets = sigma_mm[:, None] * rng.standard_normal((5000, 2))
    found = [[touch(100 + dx, 100 + dy, s)] for (dx, dy), s in zip(offsets, sigma_mm, strict=True)]
    scores = scores_by_fingers(match_frames(Seen([(100.0, 100.0)], contacts) for contacts in found))["1"]
    assert scores["within_1_sigma"] == pytest.approx(0.683, abs=0.015)
    assert scores["within_2_sigma"] == pytest.approx(0.954, abs=0.01)


def test_each_count_of_fingers_has_its_own_forces() -> None:
    """One finger's force follows the true one; of two, it is the same whatever the true one."""
    force_n = np.linspace(0.2, 2, 2 * FEWEST)
    one = [Seen([(50.0, 50.0)], [touch(50, 50, force=f**0.5 / 2)], [f]) for f in force_n]
    two = [
        Seen([(50.0, 50.0), (90.0, 90.0)], [touch(90, 90, force=0.5), touch(50, 50, force=0.5)], [f, f])
        for f in force_n
    ]
    scores = scores_by_fingers(match_frames([*one, *two]))
    assert scores["1"]["force_rank"] == pytest.approx(1)
    assert scores["1"]["force_spread"] == pytest.approx(0)
    assert scores["2"]["force_rank"] is None
    assert scores_by_fingers(match_frames([Seen([(5.0, 5.0)], [touch(5, 5)])] * 50))["1"]["force_rank"] is None
