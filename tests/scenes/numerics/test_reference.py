"""The fast path in float32 says what float64 says: features, networks, and places in every scene."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fields import Field, gauss_newton, look_up, make_atlas
from tests.scenes.numerics import reference
from tests.scenes.numerics.agreement import FEATURES_RELATIVE, ROUNDING_MM, compared, networks, truncations
from tests.scenes.numerics.double import double_model, narrow_arrays
from tests.scenes.numerics.watch import run
from tests.scenes.stages import frames_of
from touchd.evaluation.dataset import make_dataset
from touchd.frame import Acquisition
from touchd.localization.features import Features
from touchd.localization.model import Model, default_model_path
from touchd.twin.instrument import Instrument
from touchd.twin.scenes.catalogue import SCENES
from touchd.twin.simulate import simulate_scene, simulate_touches

RIG = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
FRAMES = 200
"""Of each scene: the untouched start and what happens in the second after it."""
LONGER = {"drop": 300, "warming": 440, "drift": 440, "deadchannel": 200, "interference": 260}
UNTOUCHED = {"idle", "palm"}
"""Scenes without a finger."""
EARLY_SIGMAS = 0.25
"""Gauss-Newton may stop so far from the minimum: a fraction of what is not known of the place anyway. It stops 0.14
away at most, of a swipe, with shapes as without."""


@given(st.integers(0, 2**32 - 1), st.sampled_from([1.0, 30.0, 3000.0, 32767.0]))
@settings(max_examples=30)
def test_the_networks_features_are_those_of_rfft_in_float64(seed: int, size: float) -> None:
    residual = (size * np.random.default_rng(seed).uniform(-1, 1, RIG.shape)).astype(np.float32)
    features = Features("frequency", RIG)
    found = np.zeros(features.size, np.float32)
    features.extract(residual, found)
    exact = reference.network_features(residual, RIG)
    assert np.linalg.norm(found - exact) <= FEATURES_RELATIVE * np.linalg.norm(exact)


@given(st.floats(8, 112), st.floats(8, 82), st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_the_reference_goes_where_another_solver_goes(x_mm: float, y_mm: float, seed: int) -> None:
    """One that moves places and strengths together, and eliminates nothing; and both have the same field."""
    for mine, its in zip(reference.field(ATLAS, x_mm, y_mm), look_up(ATLAS, x_mm, y_mm), strict=True):
        np.testing.assert_allclose(mine, its, atol=1e-9 * np.abs(its).max())
    features = FIELD.frame([(x_mm, y_mm, 0.8 + 0.3j)], noise=8.0, seed=seed)
    start = np.array([(x_mm + 0.5, y_mm - 0.5)])
    fit = reference.refine(ATLAS, features, start)
    places, strengths = gauss_newton(ATLAS, features, start, steps=40)
    assert math.dist(fit.places_mm[0], places[0]) < 1e-7
    assert abs(fit.strengths[0] - strengths[0]) < 1e-7


FIELD = Field()
ATLAS = make_atlas(FIELD)


def test_the_run_in_double_precision_holds_no_single_one() -> None:
    wide = run([], wide=True)
    assert narrow_arrays(wide.pipeline) == []
    assert narrow_arrays(double_model(default_model_path())) == []
    assert len(narrow_arrays(run([]).pipeline)) > 10, "which the ordinary one does"


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_is_placed_as_float64_places_it(name: str, instrument: Instrument, atlas_model: Model) -> None:
    """The same steps to 1e-3 mm; and a converged solution to a fraction of sigma, since the steps stop early."""
    assert atlas_model.atlas is not None
    recording = simulate_scene(name, seed=21, frames=LONGER.get(name, FRAMES), instrument=instrument)
    found = compared(recording, atlas_model.atlas)
    print(
        f"{name}: {found.contacts} places, features {found.features:.1e}, "
        f"rounding {max(found.rounding_mm, default=0.0):.1e} mm, truncation {found.truncation_sigmas:.2f} sigma"
    )
    assert (found.contacts > 0) == (name not in UNTOUCHED)
    assert found.features <= FEATURES_RELATIVE
    assert max(found.rounding_mm, default=0.0) <= ROUNDING_MM
    assert len(found.begun_elsewhere_mm) <= 1 + 0.01 * found.contacts
    assert found.other == 0
    assert found.same_events
    assert found.truncation_sigmas <= EARLY_SIGMAS


def test_networks_say_the_same_in_float64_and_nearly_the_same_in_8_bits(instrument: Instrument) -> None:
    data = make_dataset(simulate_touches(60, seed=7201, instrument=instrument), least=1)
    wide_mm, int8_mm = networks(data.residual)
    assert wide_mm.max() <= ROUNDING_MM
    assert np.median(int8_mm) < 0.2
    assert int8_mm.max() < 1.0, "far within the 5 mm from which Gauss-Newton finds the place"


def test_points_would_be_seen_to_be_another_model(instrument: Instrument, atlas_model: Model) -> None:
    """Where contacts have shapes, the minimum of points lies farther away than steps that stop early."""
    atlas = atlas_model.atlas
    assert atlas is not None
    recording = simulate_scene("circle", seed=21, frames=180, instrument=instrument)
    looks = [look for look in run(frames_of(recording)).looks if look.shapes is not None]
    assert {look.known for look in looks} == {True, False}
    most = 0.0
    for look in looks:
        features = reference.atlas_features(look.residual, reference.plate_of(look.baseline, atlas), atlas)
        for distance_mm, sigma_mm in truncations(replace(look, shapes=None), features, atlas):
            most = max(most, distance_mm / sigma_mm)
    assert most > 4 * EARLY_SIGMAS


def test_a_difference_would_be_seen(instrument: Instrument, atlas_model: Model) -> None:
    """The same comparisons fail for features of a slightly other window, and for a field that lies 2 um off."""
    atlas = atlas_model.atlas
    assert atlas is not None
    recording = simulate_scene("circle", seed=21, frames=180, instrument=instrument)
    look = next(look for look in run(frames_of(recording)).looks if look.touches)
    plate = reference.plate_of(look.baseline, atlas)
    features = reference.atlas_features(look.residual, plate, atlas)
    assert np.linalg.norm(look.features - features) <= FEATURES_RELATIVE * np.linalg.norm(features)
    other = reference.atlas_features(look.residual * (1 + 1e-5 * np.hanning(250)), plate, atlas)
    assert np.linalg.norm(look.features - other) > FEATURES_RELATIVE * np.linalg.norm(other)

    x_mm, y_mm = atlas.description.origin_mm
    moved = replace(atlas, description=atlas.description.model_copy(update={"origin_mm": (x_mm + 0.002, y_mm)}))
    places = [reference.refine(one, features, np.array(look.places_mm)).places_mm[0] for one in (atlas, moved)]
    assert math.dist(*places) == pytest.approx(0.002, rel=1e-3)
    assert math.dist(*places) > ROUNDING_MM
