"""Size and shape of a contact come from its amplitudes, with standard errors that hold, or are not told."""

from __future__ import annotations

import gc
import math
import weakref
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fields import COUNTS, Field, in_double, make_atlas
from tests.unit.localization.test_contact_model import as_bins, contact, contact_model
from touchd.localization import position_error
from touchd.localization.atlas import Atlas
from touchd.localization.contact_size import MOMENTS_MM2, SIZES_MM2, ContactSize
from touchd.localization.fit import Fit, finish
from touchd.localization.noise import NoiseModel
from touchd.localization.position_error import PHASE_RAD
from touchd.localization.spline import Position
from touchd.touch import Face

ATLAS = in_double(make_atlas(Field()))
VARIANCE = 1e-5 * COUNTS**2
TURN = complex(math.cos(PHASE_RAD), math.sin(PHASE_RAD))
MOMENT = MOMENTS_MM2[5]
AT = (60.0, 45.0)
PHASE = st.floats(-math.pi, math.pi)


@cache
def size_of_noise(variance: float) -> ContactSize:
    """Sizes at a noise floor; their table takes milliseconds."""
    noise = NoiseModel(ATLAS)
    noise.variance, noise.ceiling, noise.active_bins = variance, variance * ATLAS.size, ATLAS.size
    return ContactSize(ATLAS, noise)


def fit_of(z: complex, xx: complex, yy: complex, xy: complex, at: Position = AT) -> Fit:
    return Fit([at], [z], [1.0], (), 0.0, [[0j, z * xx, z * yy, z * xy]])


def face_of(fit: Fit, variance: float = VARIANCE) -> Face | None:
    return size_of_noise(variance).faces(fit)[0]


@given(PHASE, st.floats(0.5, 5), st.floats(-1, 1), st.floats(-1, 1))
def test_moments(phase: float, size: float, long: float, turned: float) -> None:
    """What is longer along x, or along x = y, says so, whatever the phase and size of the amplitude."""
    mean = MOMENT * TURN
    face = face_of(fit_of(size * complex(math.cos(phase), math.sin(phase)), mean + long, mean - long, 2 * turned))
    assert face is not None
    assert face.mean_mm2 == pytest.approx(SIZES_MM2[5])
    assert math.copysign(1, face.along_mm2) == math.copysign(1, long) or abs(long) < 1e-9
    assert face.along_mm2 * turned == pytest.approx(face.diagonal_mm2 * long, abs=1e-9)


@given(st.floats(0.6, 6))
def test_larger(moment: float) -> None:
    """A larger moment is a larger face, also beyond the largest known."""
    one, other = (face_of(fit_of(1.0, m * TURN, m * TURN, 0)) for m in (moment, 1.05 * moment))
    assert one is not None
    assert other is not None
    assert one.mean_mm2 < other.mean_mm2


def test_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its table, a quarter of a second of work, is made once for each atlas, and goes with it."""
    made: list[Atlas] = []
    tables = position_error._tables

    def counted(atlas: Atlas) -> np.ndarray:
        made.append(atlas)
        return tables(atlas)

    monkeypatch.setattr(position_error, "_tables", counted)
    atlas = in_double(make_atlas(Field()))
    first, second = (ContactSize(atlas, NoiseModel(atlas)) for _ in range(2))
    assert made == [atlas]
    gone = weakref.ref(made.pop())
    del atlas, first, second
    gc.collect()
    assert gone() is None


def test_rigid() -> None:
    """The size of a face without a moment, of a faint one, or of no number is not told."""
    assert face_of(fit_of(1.0, 0.01, 0.01, 0)) is None
    assert face_of(fit_of(1e-3, MOMENT, MOMENT, 0)) is None
    assert face_of(fit_of(0.0, 0, 0, 0)) is None
    assert face_of(fit_of(1.0, math.nan, math.nan, 0)) is None


def test_standard_errors() -> None:
    """The standard errors are the scatter of noisy contacts' moments, at any place, beside the share without noise."""
    rng, model = np.random.default_rng(3), contact_model(ATLAS)
    variance = 4e-3 * COUNTS**2  # so much that noise is the larger part
    share = face_of(fit_of(1.0, MOMENT * TURN, MOMENT * TURN, 0), 1e-9)
    assert share is not None
    for at in ((60.0, 45.0), (31.0, 62.5), (97.5, 20.0)):
        clean = contact(*at, 1.0, (MOMENT, MOMENT, 0.0))
        size = size_of_noise(variance)
        faces: list[Face] = []
        for _ in range(150):
            noise = rng.standard_normal(clean.shape) + 1j * rng.standard_normal(clean.shape)
            fit = finish(model.pieces(as_bins(clean + math.sqrt(variance) * noise), [at], 1e-12, 4))
            found = size.faces(Fit(fit.positions_mm, fit.amplitudes, fit.energies, (), 0.0, fit.shapes))
            faces += [face for face in found if face]
        table = np.array([(one.mean_mm2, one.along_mm2, one.mean_sigma_mm2, one.oval_sigma_mm2) for one in faces])
        scatter, said = table[:, :2].std(axis=0), np.median(table[:, 2:], axis=0)
        print(at, scatter, said)
        expected = np.hypot(scatter, [share.mean_sigma_mm2, share.oval_sigma_mm2])
        assert said == pytest.approx(expected, rel=0.3)
        assert (scatter > 0.5 * said).all()


def test_dead_channels() -> None:
    """Without two of four channels the standard errors are larger."""
    noise = NoiseModel(ATLAS)
    noise.variance, noise.ceiling, noise.active_bins = 1e-2 * COUNTS**2, 0.0, ATLAS.size
    size, fit = ContactSize(ATLAS, noise), fit_of(1.0, MOMENT * TURN, MOMENT * TURN, 0)
    (whole,) = size.faces(fit)
    mask = np.ones(ATLAS.size)
    mask[: ATLAS.size // 2] = 0
    noise.mask, noise.active_bins = mask, ATLAS.size // 2
    (half,) = size.faces(fit)
    assert whole is not None
    assert half is not None
    assert half.mean_sigma_mm2 > 1.2 * whole.mean_sigma_mm2
