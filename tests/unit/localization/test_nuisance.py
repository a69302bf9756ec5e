"""A delay and hit samples are fitted with the fingers: neither hides a finger, moves it or makes one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from tests.fields import BINS, RIG, Field, bins_of, in_double, look_up, make_atlas, untouched
from tests.unit.localization.rig import Rig, at
from touchd.config.schema import Settings
from touchd.detection.impulses import WIDTH
from touchd.localization.features import windowed_dft
from touchd.localization.gauss_newton import GaussNewton
from touchd.localization.nuisance import Nuisance, hit_rows
from touchd.localization.plate_changes import delayed
from touchd.outcome import Outcome

FIELD = Field()
ATLAS = make_atlas(FIELD)
DOUBLE = in_double(ATLAS)
MATRIX = windowed_dft(RIG, np.array(BINS))
OMEGA_RAD_S = 2 * np.pi * np.array(BINS) * RIG.sample_rate_hz / RIG.samples
PLATE = untouched()
DELAY = delayed(PLATE @ MATRIX, OMEGA_RAD_S).ravel()
"""What a delay of a second adds to the bins."""
LEVEL = (PLATE @ MATRIX).ravel()
DRIVE = np.stack([DELAY, LEVEL, LEVEL * np.tile(np.linspace(-1, 1, len(BINS)), 2 * RIG.channels)])
"""What a delay, a rise and a slope of the drive add."""
SLOPE = (untouched(delay_s=1e-9) - untouched(delay_s=-1e-9)) / 2e-9
SIGMA = 5.0
"""Standard deviation of a bin's noise."""
PLACES = st.tuples(st.floats(10, 110), st.floats(10, 80))
DELAYS_S = st.floats(-60e-9, 60e-9)


def knowing(jitter_s: float, dtype: type = np.float32, level: float = 0.0) -> Nuisance:
    """Nuisance that has heard 64 untouched frames of this jitter, and of levels and slopes that differ."""
    rng = np.random.default_rng(1)
    nuisance = Nuisance(ATLAS.size, np.dtype(dtype))
    nuisance.set_drive(DRIVE, None)
    for _ in range(64):
        vector = jitter_s * rng.standard_normal() * DELAY + SIGMA * rng.standard_normal(ATLAS.size)
        vector += level * rng.standard_normal(2) @ DRIVE[1:]
        nuisance.hear(vector.astype(dtype))
    return nuisance


JITTERY, JITTERY_DOUBLE = knowing(30e-9), knowing(30e-9, np.float64)


def frame(x_mm: float, y_mm: float, delay_s: float, seed: int = 0) -> np.ndarray:
    return FIELD.frame([(x_mm, y_mm, 0.5 + 0.3j)], SIGMA, seed) + delay_s * DELAY


def settled(
    nuisance: Nuisance, vector: np.ndarray, near_mm: tuple[float, float], runs: tuple[int, ...] = ()
) -> tuple[float, float, float]:
    """Position, mm, and energy left, of a finger fitted with the nuisance."""
    atlas = DOUBLE if vector.dtype == np.float64 else ATLAS
    solver = GaussNewton(atlas)
    nuisance.remove(vector, hit_rows(MATRIX.astype(vector.dtype), runs, RIG.channels), None)
    bins = bins_of(vector, dtype=vector.dtype.type)
    fit = solver.fit_one(bins, *near_mm, 8)
    bins, fit = nuisance.settle(bins, fit, solver, SIGMA**2 * ATLAS.size)
    return *fit.positions_mm[0], fit.residual_energy


def joint(vector: np.ndarray, x_mm: float, y_mm: float, directions: np.ndarray) -> tuple[float, float]:
    """The least-squares position with all amounts as unknowns, in float64."""
    for _ in range(12):
        u, u_x, u_y = look_up(ATLAS, x_mm, y_mm)
        z_columns = [features(column) for column in (u, 1j * u)]
        table = np.stack([*z_columns, *directions], axis=1)
        found = np.linalg.lstsq(table, vector, rcond=1e-9)[0]
        z = found[0] + 1j * found[1]
        table = np.column_stack([features(z * u_x), features(z * u_y), table])
        move = np.linalg.lstsq(table, vector - table[:, 2:] @ found, rcond=1e-9)[0][:2]
        x_mm, y_mm = x_mm + move[0], y_mm + move[1]
        if np.abs(move).max() < 1e-6:
            break
    return x_mm, y_mm


def features(bins: np.ndarray) -> np.ndarray:
    parts = bins.reshape(RIG.channels, -1)
    return np.stack([parts.real, parts.imag], axis=1).ravel()


@given(PLACES, DELAYS_S, st.integers(0, 99))
@settings(deadline=None, max_examples=8)
def test_delay(place_mm: tuple[float, float], delay_s: float, seed: int) -> None:
    """The finger is where least squares over finger and delay put it, in float32 and in float64."""
    vector = frame(*place_mm, delay_s, seed)
    expected = joint(vector, *place_mm, DELAY[None] / np.linalg.norm(DELAY))
    for dtype, nuisance in ((np.float32, JITTERY), (np.float64, JITTERY_DOUBLE)):
        x_mm, y_mm, left = settled(nuisance, vector.astype(dtype), place_mm)
        assert math.dist((x_mm, y_mm), expected) < 0.02
        assert left < 1.5 * SIGMA**2 * ATLAS.size


@given(PLACES, DELAYS_S, st.floats(-0.02, 0.02), st.floats(-0.01, 0.01), st.integers(0, 99))
@settings(deadline=None, max_examples=8)
def test_level(place_mm: tuple[float, float], delay_s: float, level: float, slope: float, seed: int) -> None:
    """Of a drive that is late, louder and slopes, too, a fit leaves no more of a finger than least squares."""
    drive = np.array([delay_s, level, slope]) @ DRIVE
    vector = frame(*place_mm, 0.0, seed) + drive
    expected = joint(vector, *place_mm, np.linalg.qr(DRIVE.T)[0].T)
    for dtype in (np.float32, np.float64):
        x_mm, y_mm, left = settled(knowing(30e-9, dtype, 0.01), vector.astype(dtype), place_mm)
        assert math.dist((x_mm, y_mm), expected) < 0.02
        assert left < 1.5 * SIGMA**2 * ATLAS.size


@given(PLACES, st.integers(45, 190), st.integers(0, 99))
@settings(deadline=None, max_examples=8)
def test_hit_samples(place_mm: tuple[float, float], start: int, seed: int) -> None:
    """Whatever an impulse left in its samples, the finger is where least squares with these samples unknown puts it."""
    impulse = np.zeros(RIG.shape)
    impulse[:, start : start + 4] = 3000 * np.random.default_rng(seed).standard_normal((RIG.channels, 4))
    vector = frame(*place_mm, 0.0, seed) + (impulse @ MATRIX).ravel()
    rows = np.concatenate(hit_rows(MATRIX, (start - 1,), RIG.channels))
    expected = joint(vector, *place_mm, rows)
    x_mm, y_mm, left = settled(knowing(0.0), vector.astype(np.float32), place_mm, (start - 1,))
    assert math.dist((x_mm, y_mm), expected) < 0.03
    assert left < 1.5 * SIGMA**2 * ATLAS.size


def test_no_jitter() -> None:
    """Without jitter the bins stay as they are, bit for bit, and nothing is fitted."""
    nuisance = knowing(0.0)
    vector = frame(60.0, 45.0, 0.0).astype(np.float32)
    before = vector.copy()
    assert not nuisance.engaged
    nuisance.remove(vector, [], None)
    np.testing.assert_array_equal(vector, before)


def test_warming_is_no_jitter() -> None:
    """A plate that slowly moves along the delay, as a warming one does, does not jitter."""
    rng = np.random.default_rng(1)
    nuisance = knowing(0.0)
    for step in range(64):
        vector = 0.3e-9 * step * DELAY + SIGMA * rng.standard_normal(ATLAS.size)
        nuisance.hear(vector.astype(np.float32))
    assert not nuisance.active.any()


def test_hits_end_with_their_frame() -> None:
    """The frame after a hit one is whole again."""
    nuisance = knowing(0.0)
    nuisance.remove(frame(60.0, 45.0, 0.0).astype(np.float32), hit_rows(MATRIX, (100,), RIG.channels), None)
    assert nuisance.engaged
    after = frame(60.0, 45.0, 0.0).astype(np.float32)
    before = after.copy()
    nuisance.remove(after, [], None)
    np.testing.assert_array_equal(after, before)
    assert not nuisance.engaged


class Late(Rig):
    """A rig whose trigger jitters by 20 ns."""

    def residual(self, *fingers: tuple[float, float, complex]) -> np.ndarray:
        delay_s = 20e-9 * np.random.default_rng(self._seed + 1000).standard_normal()
        return np.asarray(super().residual(*fingers) + delay_s * SLOPE, np.float32)


@pytest.mark.parametrize("place_mm", [(30.0, 30.0), (60.0, 45.0), (95.0, 70.0)])
def test_followed(place_mm: tuple[float, float]) -> None:
    """A finger fainter than the jitter is placed as it lands and while it moves; no frame has another."""
    rig, (x_mm, y_mm) = Late(), place_mm
    change = np.square(FIELD.residual([(x_mm, y_mm, 0.05 + 0j)])).sum() / np.square(20e-9 * SLOPE).sum()
    assert change < 1
    for step in range(12):
        assert at(rig.touch((x_mm + 0.3 * step, y_mm, 0.05 + 0j)), (x_mm + 0.3 * step, y_mm), within_mm=0.5)


def test_rests() -> None:
    """A finger that rests is recognised although every frame comes at another time."""
    rig = Late(settings=Settings())
    found = [rig.see(rig.residual((60.0, 45.0, 0.3 + 0j))).outcome for _ in range(30)]
    assert found.count(Outcome.STILL) > 20


def test_lifted() -> None:
    """Jitter without a finger makes none."""
    rig = Late()
    assert at(rig.touch((60.0, 45.0, 0.3 + 0j)), (60.0, 45.0))
    assert not any(rig.touch() for _ in range(200))


def test_impulse() -> None:
    """A hit frame has its finger, with the samples unknown, at landing and while it is followed."""
    rig = Rig()
    for step in range(6):
        residual = rig.residual((60.0 + 0.3 * step, 45.0, 0.2 + 0j))
        residual[:, 100 : 100 + WIDTH] = 0
        detection = replace(rig.detection(residual), hits=(100,))
        rig.network.near_mm = (60.5, 45.5)
        found = rig.localizer.localize(detection, alive=False).touches
        assert at(found, (60.0 + 0.3 * step, 45.0))
