"""A plate that was knocked on rings as its receptance says, as loud as asked for, and falls silent."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.filters import anti_alias
from touchd.twin.physics.knock import COUPLED_HZ, FACE_MM2, Knock, Ringing
from touchd.twin.physics.response import Response

SECONDS = 0.05
BANDS_HZ = [(1e3, 5e3), (5e3, 2e4), (2e4, 5e4), (5e4, 1e5)]


def ringing(instrument: Instrument, knock: Knock) -> np.ndarray:
    n = round(SECONDS * instrument.acquisition.sample_rate_hz)
    return Ringing(instrument, knock).signal(knock.at_s + np.arange(n) / instrument.acquisition.sample_rate_hz)


def by_receptance(instrument: Instrument, knock: Knock) -> np.ndarray:
    """The same by another way: the force's spectrum times the receptance, and back to time, (receivers, samples)."""
    rate_hz = instrument.acquisition.sample_rate_hz
    n = round(SECONDS * rate_hz)
    decay = 8 / SECONDS
    nu = (2 * np.pi * np.fft.rfftfreq(n, 1 / rate_hz) - 1j * decay).astype(np.complex128)
    r = instrument.response
    shape = r.shape_at(np.array([knock.x_mm]), np.array([knock.y_mm]), np.array([FACE_MM2]))
    heard = Response(instrument.plate, r.modes, nu, r.loss).receptance(shape, r.modes.discs[:, 1:])
    w = np.pi / knock.contact_s
    force = w * 2 * np.cos(nu * knock.contact_s / 2) / (w**2 - nu**2)
    coupled = 1j * nu / (1j * nu + 2 * np.pi * COUPLED_HZ)
    spectrum = heard.T * force * coupled * anti_alias(nu, rate_hz)
    return np.asarray(np.fft.irfft(spectrum, n) * np.exp(decay * np.arange(n) / rate_hz))


@pytest.mark.parametrize("contact_s", [6e-5, 3e-4])
def test_as_the_receptance_says(contact_s: float, instrument: Instrument) -> None:
    """In each band, early and late, to half a decibel: modes that ring freely are the whole response."""
    knock = Knock(0.0, 70.0, 110.0, 0.0, contact_s)
    rate_hz = instrument.acquisition.sample_rate_hz
    found, known = ringing(instrument, knock), by_receptance(instrument, knock)
    ratios_db = []
    for start_s in (1e-3, 10e-3):
        part = slice(round(start_s * rate_hz), round((start_s + 8e-3) * rate_hz))
        f_hz = np.fft.rfftfreq(part.stop - part.start, 1 / rate_hz)
        power = [np.abs(np.fft.rfft(each[:, part] * np.hanning(len(each[0, part])))) ** 2 for each in (found, known)]
        for low_hz, high_hz in BANDS_HZ[: 4 if start_s < 5e-3 else 2]:
            band = (f_hz >= low_hz) & (f_hz < high_hz)
            ratios_db.append(10 * np.log10(power[0][:, band].sum() / power[1][:, band].sum()))
    print(np.round(ratios_db, 2))
    assert np.ptp(ratios_db) < 0.5


@pytest.mark.parametrize("level_db", [-30.0, 10.0])
def test_as_loud_as_asked_for(level_db: float, instrument: Instrument) -> None:
    """In the chirp's band, in the millisecond after it; below, there is more."""
    a = instrument.acquisition
    signal = ringing(instrument, Knock(0.02, 150.0, 60.0, level_db))[:, : a.samples]
    rms = np.sqrt(np.square(instrument.untouched([REFERENCE_C])).mean())
    spectrum = np.abs(np.fft.rfft(signal * np.hanning(a.samples))) ** 2
    f_hz = np.fft.rfftfreq(a.samples, 1 / a.sample_rate_hz)
    low, high = (spectrum[:, (f_hz > one) & (f_hz < other)].sum() for one, other in ((2e3, 4e4), (5e4, 1e5)))
    assert low > 10 * high
    in_band = np.sqrt(2 * high / a.samples / np.square(np.hanning(a.samples)).sum() / a.channels)
    assert 20 * np.log10(in_band / rms) == pytest.approx(level_db, abs=3.0)


def test_before_and_long_after(instrument: Instrument) -> None:
    knock = Knock(0.5, 70.0, 110.0)
    ring, frame_s = Ringing(instrument, knock), np.arange(250) / 250e3
    assert not ring.signal(0.499 + frame_s[:-1]).any()
    early, late = (np.abs(ring.signal(0.5 + after_s + frame_s)).max() for after_s in (0.0, 1.0))
    assert late < 1e-4 * early
