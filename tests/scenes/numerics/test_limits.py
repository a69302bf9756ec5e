"""Inputs at the limits: never NaN, never a position outside the plate, never a wrong touch.

A published contact farther than 5 mm from all fingers, or without any finger, is wrong at any confidence: it has passed
the threshold.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenes.numerics.degenerate import in_nodes, on_discs, on_the_edge, taps_at
from tests.scenes.numerics.limits import Case, Verdict, cases, changed, image, judge, moments, tones, tried
from tests.scenes.numerics.watch import run
from tests.scenes.stages import frames_of
from touchd.localization.fit import Bins
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.model import Model
from touchd.recording.data import Recording
from touchd.twin.instrument import Instrument
from touchd.twin.simulate import simulate_scene

SEED = 31
LEFT_OUT = {"channel 1", "channel 2", "1 and", "and 2", "x 0.001", "x 0.1", "x 1000", "2 %", "20 %", "30 dB", "70 dB"}
CASES = [case for case in cases() if not any(name in case.name for name in LEFT_OUT)]
"""The page has all of them, and more touches."""


@pytest.fixture(scope="module")
def taps(instrument: Instrument) -> Recording:
    return simulate_scene("tap", seed=SEED, frames=330, instrument=instrument)


def check(verdict: Verdict) -> None:
    assert (verdict.not_finite, verdict.outside, verdict.wrong) == (0, 0, 0), verdict


@pytest.mark.parametrize("case", CASES, ids=[f"{case.group}, {case.name}" for case in CASES])
def test_whatever_is_done_to_the_frames_no_touch_is_wrong(case: Case, taps: Recording, atlas_model: Model) -> None:
    for since in moments(taps).values():
        check(tried(taps, case, since=since, seed=SEED, model=atlas_model))


@pytest.mark.parametrize("channel", [None, 0, 1, 2, 3])
@pytest.mark.parametrize("frames", [2, 7, 40, 150])
def test_what_freezes_and_lives_again_leaves_no_wrong_touch(
    channel: int | None, frames: int, taps: Recording, atlas_model: Model
) -> None:
    """Of a channel that repeats itself nothing is seen in the places: the others find every touch."""
    for since in moments(taps).values():
        counts = taps.frames.copy()
        part = counts[since : since + frames, slice(None) if channel is None else channel]
        part[:] = part[0]
        made = replace(taps, frames=counts)
        verdict = judge(made, run(frames_of(made), model=atlas_model))
        check(verdict)
        if channel is not None:
            assert verdict.found == verdict.fingers


@pytest.mark.parametrize("group", ["one channel frozen", "one channel stuck"])
def test_a_channel_that_says_nothing_costs_no_touch(group: str, taps: Recording, atlas_model: Model) -> None:
    for case in cases():
        if case.group == group:
            for since in moments(taps).values():
                verdict = tried(taps, case, since=since, seed=SEED, model=atlas_model)
                check(verdict)
                assert verdict.found == verdict.fingers, case.name


def test_a_channel_inverted_since_the_training_costs_no_touch(taps: Recording, atlas_model: Model) -> None:
    for case in cases():
        if case.group == "one channel inverted":
            verdict = tried(taps, case, since=0, seed=SEED, model=atlas_model)
            check(verdict)
            assert verdict.found == verdict.fingers, case.name


@pytest.mark.parametrize("case", [*tones(-40, 15013.0), *tones(-20, 31013.0)], ids=lambda case: f"{case.name}")
def test_tones_at_any_frequency_are_no_touches(case: Case, taps: Recording, atlas_model: Model) -> None:
    for since in moments(taps).values():
        check(tried(taps, case, since=since, seed=SEED, model=atlas_model))


@pytest.mark.parametrize("level_db", [-30.0, -10.0])
def test_the_chirps_image_is_part_of_the_plate(level_db: float, instrument: Instrument) -> None:
    verdict = image(level_db, SEED, instrument)
    check(verdict)
    assert verdict.found == verdict.fingers


def test_without_anything_done_all_is_found(taps: Recording, atlas_model: Model) -> None:
    verdict = judge(taps, run(frames_of(taps), model=atlas_model))
    check(verdict)
    assert verdict.found == verdict.fingers >= 2
    assert verdict.unsure == 0


def test_a_wrong_touch_would_be_seen(taps: Recording, atlas_model: Model) -> None:
    """The same events beside a truth that has moved by 6 mm, or that holds no finger, are all wrong."""
    result = run(frames_of(taps), model=atlas_model)
    truth = taps.contacts_mm
    assert truth is not None
    moved = replace(taps, contacts_mm=np.clip(truth + np.float32(6.0), 0, 200))
    verdict = judge(moved, result)
    assert verdict.wrong == verdict.published > 0
    empty = replace(taps, contacts_mm=np.full_like(truth, np.nan))
    assert judge(empty, result).wrong == verdict.published


@given(
    plan=st.lists(
        st.tuples(st.sampled_from(CASES), st.integers(0, 329)),
        min_size=1, max_size=3,
    ),
    seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
@settings(max_examples=8)
def test_several_faults_one_after_the_other_break_nothing(
    plan: list[tuple[Case, int]], seed: int, taps: Recording, atlas_model: Model
) -> None:
    made = taps
    for case, since in plan:
        made = changed(made, case, since=since, seed=seed)
    verdict = judge(made, run(frames_of(made), model=atlas_model))
    assert (verdict.not_finite, verdict.outside) == (0, 0)


@pytest.mark.parametrize("where", ["discs", "edge", "nodes"])
def test_where_the_field_says_little_nothing_wrong_is_said(
    where: str, instrument: Instrument, atlas_model: Model
) -> None:
    assert atlas_model.atlas is not None
    if where == "nodes":
        places = in_nodes(atlas_model.atlas)  # a second of search
    else:
        places = {"discs": on_discs, "edge": on_the_edge}[where](instrument)
    recording = taps_at(places, instrument)
    verdict = judge(recording, run(frames_of(recording), model=atlas_model))
    check(verdict)
    if where != "edge":
        assert verdict.found == len(places)


ANYWHERE = st.floats(allow_nan=True, allow_infinity=True)
SCALES = st.sampled_from([0.0, 1e-42, 1e-38, 1e-30, 1e-10, 1.0, 1e3, 8e6])


@given(start=st.tuples(ANYWHERE, ANYWHERE), scale=SCALES, seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_any_frame_from_any_start_is_fitted_on_the_plate(
    start: tuple[float, float], scale: float, seed: int, atlas_model: Model
) -> None:
    """8e6 is what bins can hold at most: 250 samples of 16 bits under the window."""
    assert atlas_model.atlas is not None
    solver, size = GaussNewton(atlas_model.atlas), atlas_model.atlas.size
    vector = (scale * np.random.default_rng(seed).uniform(-1, 1, size)).astype(np.float32)
    bins = Bins(vector, None, (vector @ vector).item())
    for fit in (solver.fit_one(bins, *start, 5), solver.fit_several(bins, [start, (100.0, 100.0)], 4)):
        # On the plate to the raster's rounding, of 0.3 um.
        assert all(-3e-4 <= along <= 200 + 3e-4 for position in fit.positions_mm for along in position)
        assert np.isfinite(fit.amplitudes).all()
        assert np.isfinite(fit.energies).all()
        assert np.isfinite(fit.fisher_information).all()
        assert np.isfinite(fit.residual_energy)
