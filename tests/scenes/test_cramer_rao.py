"""The bound is right: no estimator does better, and the best possible one does as well."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import spline_filter1d
from scipy.stats import chi2

from touchd.errors import SimulationError
from touchd.evaluation.cramer_rao import (
    TouchField,
    atlas_field,
    median_bound_mm,
    median_distance_mm,
    plain_covariance,
    position_covariance,
    recorded_field,
    residual_noise,
    rms_mm,
    twin_field,
    whitener,
)
from touchd.frame import HANN
from touchd.localization.atlas import Atlas, AtlasDescription
from touchd.localization.features import band_bins, windowed_dft
from touchd.training.field.bins import TAPER
from touchd.twin.electronics import Digitiser, Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.simulate import simulate_touches

Floats = NDArray[np.float64]

FINGER = Contact(71.3, 124.6, 18.0, "silicone")
FRAMES = 600
NOISE = 5.0
PHASE_MATTERS = 1e-4
SEVERAL = [FINGER, Contact(12.0, 9.0, 14.0, "silicone"), Contact(150.0, 60.0, 27.0, "silicone")]


@pytest.fixture(scope="module")
def field(instrument: Instrument) -> TouchField:
    return twin_field(instrument, SEVERAL)


def noisy_frames(instrument: Instrument) -> tuple[Floats, float]:
    """Residuals of one touch as the twin's own electronics give them, and the deviation of a sample's noise."""
    untouched = instrument.untouched([REFERENCE_C])[0]
    touched = untouched + instrument.change([[FINGER]], [REFERENCE_C])[0]
    electronics = Electronics()
    digitiser = Digitiser(electronics, instrument.acquisition, untouched, np.random.SeedSequence(5))
    counts = digitiser.counts(np.repeat(touched[None], FRAMES, axis=0), np.zeros(FRAMES))
    full = electronics.peak * 2 ** (instrument.acquisition.bits - 1)
    deviation = full * np.sqrt(np.mean(untouched**2)) * 10 ** (-electronics.noise_db / 20)
    return counts - full * untouched, float(np.sqrt(deviation**2 + 1 / 12))  # rounding adds its own


def estimates_mm(instrument: Instrument, residual: Floats, *, weighted: bool) -> Floats:
    """The places (n, 2) of least squares on the true field, by Gauss-Newton from 0.1 mm away."""
    a = instrument.acquisition
    bins = band_bins(a)
    T = whitener(a, bins) if weighted else np.eye(2 * len(bins))
    rows = (residual @ windowed_dft(a, bins) @ T).reshape(len(residual), -1)
    position_mm = np.tile([FINGER.x_mm + 0.07, FINGER.y_mm - 0.07], (len(residual), 1))
    for _ in range(2):
        # All start at one place: the field is computed once for each that differs.
        unique_mm, which = np.unique(position_mm, axis=0, return_inverse=True)
        there = twin_field(instrument, [FINGER._replace(x_mm=x, y_mm=y) for x, y in unique_mm.tolist()])
        u = TouchField(there.value[which], there.by_x[which], there.by_y[which], there.bins)

        def columns(*parts: NDArray[np.complex128]) -> Floats:
            stacked = np.stack(parts, axis=1)
            real = np.concatenate([stacked.real, stacked.imag], axis=-1) @ T
            return np.asarray(real.reshape(len(residual), len(parts), -1).transpose(0, 2, 1))

        basis = columns(u.value, 1j * u.value)
        parts = np.stack([np.linalg.lstsq(b, r, rcond=None)[0] for b, r in zip(basis, rows, strict=True)])
        z = (parts[:, 0] + 1j * parts[:, 1])[:, None, None]
        slopes = columns(z * u.by_x, z * u.by_y, u.value, 1j * u.value)
        left = rows - np.einsum("nij,nj->ni", basis, parts)
        position_mm += np.stack([np.linalg.lstsq(s, r, rcond=None)[0][:2] for s, r in zip(slopes, left, strict=True)])
    return position_mm


def test_maximum_likelihood_scatters_as_the_bound_says(instrument: Instrument) -> None:
    """What the bound promises is what the best possible estimator reaches, in both axes and in their correlation."""
    residual, noise = noisy_frames(instrument)
    covariance = position_covariance(twin_field(instrument, [FINGER]), instrument.acquisition, noise)[0]
    error = estimates_mm(instrument, residual, weighted=True) - [FINGER.x_mm, FINGER.y_mm]
    # Along the bound's own axes, in its own units: independent and of variance 1, if it is right.
    unit = np.linalg.solve(np.linalg.cholesky(covariance), error.T)
    assert chi2.ppf(0.0005, 2 * FRAMES) < np.square(unit).sum() < chi2.ppf(0.9995, 2 * FRAMES)
    for axis in unit:
        assert chi2.ppf(0.0005, FRAMES) < np.square(axis).sum() < chi2.ppf(0.9995, FRAMES)
    assert abs(unit[0] @ unit[1]) < 3.3 * np.sqrt(FRAMES)
    assert (np.abs(unit.mean(axis=1)) < 3.3 / np.sqrt(FRAMES)).all()


def test_least_squares_without_the_noise_s_covariance_scatters_more(instrument: Instrument) -> None:
    """The window correlates neighbouring bins: unweighted least squares loses as much precision as predicted."""
    residual, noise = noisy_frames(instrument)
    field = twin_field(instrument, [FINGER])
    bound, plain = (part(field, instrument.acquisition, noise)[0] for part in (position_covariance, plain_covariance))
    error = estimates_mm(instrument, residual, weighted=False) - [FINGER.x_mm, FINGER.y_mm]

    def squared(covariance: Floats) -> float:
        return float(np.einsum("ni,ij,nj->", error, np.linalg.inv(covariance), error))

    assert chi2.ppf(0.0005, 2 * FRAMES) < squared(plain) < chi2.ppf(0.9995, 2 * FRAMES)
    assert squared(bound) > 1.5 * chi2.ppf(0.9995, 2 * FRAMES)


def test_an_atlas_window_wastes_little(instrument: Instrument) -> None:
    """Least squares come within an eighth of the bound under it; under Hann's window half as much again is lost."""
    times = {}
    for taper in (TAPER, HANN):
        field = twin_field(instrument, [FINGER, FINGER._replace(x_mm=150.0, y_mm=40.0)], taper)
        both = (of(field, instrument.acquisition, 1.0) for of in (plain_covariance, position_covariance))
        plain, bound = map(median_distance_mm, both)
        times[taper] = plain / bound
    assert times[TAPER] < 1.125
    assert times[HANN] > 1.4


def test_whitened_features_of_white_noise_are_independent(instrument: Instrument) -> None:
    """Their covariance is that of the samples, to rounding."""
    a = instrument.acquisition
    W = windowed_dft(a) @ whitener(a, band_bins(a))
    assert np.abs(W.T @ W - np.eye(W.shape[1])).max() < 1e-9


@given(factor=st.floats(1e-3, 1e3))
def test_the_bound_falls_as_the_noise_does(instrument: Instrument, field: TouchField, factor: float) -> None:
    """Half the amplitude of the noise is half the error; twice the amplitude is the same."""
    one = position_covariance(field, instrument.acquisition, NOISE)
    other = position_covariance(field, instrument.acquisition, factor * NOISE)
    assert np.allclose(rms_mm(other), factor * rms_mm(one), rtol=1e-9)
    stronger = position_covariance(field.times(np.full(3, 1 / factor + 0j)), instrument.acquisition, NOISE)
    assert np.allclose(rms_mm(stronger), factor * rms_mm(one), rtol=1e-6)


@given(phase=st.floats(-np.pi, np.pi))
def test_the_phase_of_the_amplitude_does_not_matter(instrument: Instrument, field: TouchField, phase: float) -> None:
    """It is unknown anyway; real and imaginary parts hold nearly the same noise."""
    one = position_covariance(field, instrument.acquisition, NOISE)
    other = position_covariance(field.times(np.full(3, np.exp(1j * phase))), instrument.acquisition, NOISE)
    assert np.allclose(rms_mm(other), rms_mm(one), rtol=PHASE_MATTERS)


def test_fewer_bins_or_channels_never_tell_more(instrument: Instrument, field: TouchField) -> None:
    """The bound of a part of the data is above that of all."""
    a = instrument.acquisition
    whole = position_covariance(field, a, NOISE)
    few = TouchField(field.value[..., :37], field.by_x[..., :37], field.by_y[..., :37], field.bins[:37])
    deaf = TouchField(field.value[:, :3], field.by_x[:, :3], field.by_y[:, :3], field.bins)
    for part in (few, deaf):
        assert (np.linalg.eigvalsh(position_covariance(part, a, NOISE) - whole) > 0).all()


def test_the_slopes_are_those_of_the_field(instrument: Instrument, field: TouchField) -> None:
    """A step of half a millimetre, to its second order, arrives where the field is."""
    ahead = twin_field(instrument, [c._replace(x_mm=c.x_mm + 0.5, y_mm=c.y_mm - 0.25) for c in SEVERAL])
    back = twin_field(instrument, [c._replace(x_mm=c.x_mm - 0.5, y_mm=c.y_mm + 0.25) for c in SEVERAL])
    expected = 2 * (0.5 * field.by_x - 0.25 * field.by_y)
    assert np.abs(ahead.value - back.value - expected).max() < 0.02 * np.abs(expected).max()


def test_an_atlas_that_is_right_gives_the_twin_s_bound(instrument: Instrument) -> None:
    """The variant from an atlas reads value and slopes from splines through the same field."""
    x_mm, y_mm = np.arange(60.0, 90.0, 2.5), np.arange(110.0, 137.5, 2.5)
    nodes = [FINGER._replace(x_mm=x, y_mm=y) for y in y_mm.tolist() for x in x_mm.tolist()]
    value = twin_field(instrument, nodes).value
    grid = np.stack([value.real, value.imag], axis=2).reshape(len(y_mm), len(x_mm), -1)
    for axis in (0, 1):
        grid = spline_filter1d(grid, 3, axis=axis, mode="mirror")
    a = instrument.acquisition
    description = AtlasDescription(
        acquisition=a, plate=instrument.plate, bins=tuple(band_bins(a).tolist()), step_mm=2.5, origin_mm=(60.0, 110.0),
        low_mm=(65.0, 115.0), high_mm=(80.0, 130.0),
    )  # fmt: skip
    atlas = Atlas(description, grid.astype(np.float32), np.zeros(a.shape, np.float32), np.zeros((4, 49), np.float32))
    found = position_covariance(atlas_field(atlas, np.array([[FINGER.x_mm, FINGER.y_mm]])), a, NOISE)
    assert np.allclose(found, position_covariance(twin_field(instrument, [FINGER]), a, NOISE), rtol=0.03, atol=1e-6)


@given(long=st.floats(0.01, 3.0), angle=st.floats(0, np.pi))
def test_the_median_distance_is_that_of_drawn_errors(long: float, angle: float) -> None:
    """Of a narrow and a wide Gaussian at once, however they lie; and of a round one by the formula."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = np.stack([turn @ np.diag([long**2, 1.0]) @ turn.T, 0.25 * np.eye(2)])
    drawn = np.random.default_rng(1).standard_normal((2, 20_000, 2))
    distance = np.linalg.norm(drawn @ np.linalg.cholesky(covariance).transpose(0, 2, 1), axis=-1)
    assert median_distance_mm(covariance) == pytest.approx(np.median(distance), rel=0.03)
    assert median_distance_mm(covariance[1:]) == pytest.approx(0.5 * np.sqrt(2 * np.log(2)), rel=1e-9)


def test_the_reference_plate_s_bound_is_known(instrument: Instrument) -> None:
    """0.018 mm RMS and 0.013 mm median at 60 dB, silicone: what the field atlas is compared with."""
    recording = simulate_touches(150, seed=7, instrument=instrument)
    assert median_bound_mm(recording, instrument) == pytest.approx(0.0135, rel=0.1)
    field = recorded_field(recording, instrument)
    covariance = position_covariance(field, instrument.acquisition, residual_noise(recording))
    assert np.sqrt(np.square(rms_mm(covariance)).mean()) == pytest.approx(0.0185, rel=0.12)
    # The amplitudes are those of the frames: as from the contacts themselves.
    x_mm, y_mm = recording.contacts_mm[1, 0].tolist()  # type: ignore[index]  # simulated touches have a truth
    found = position_covariance(field, instrument.acquisition, NOISE)
    force_n = float(recording.force_n[1, 0])  # type: ignore[index]  # as above
    true = twin_field(instrument, [Contact(x_mm, y_mm, 14.0 * force_n**0.5, "silicone")])
    exact = position_covariance(true, instrument.acquisition, NOISE)
    assert rms_mm(found)[0] == pytest.approx(rms_mm(exact)[0], rel=0.03)


def test_a_contact_over_the_edge_has_no_bound(instrument: Instrument) -> None:
    with pytest.raises(SimulationError, match="reaches over the edge"):
        twin_field(instrument, [FINGER._replace(x_mm=1.0)])
