"""Simulate the receivers' signals of one chirp at any temperature, before electronics and noise.

Temperature scales all modes' frequencies by one factor s. The response at omega = s nu equals that at nu, so the plate
is computed once, on a fixed grid of nu; emission and contacts are evaluated at s nu, and the time signal at s t, by a
Taylor series about t. This is exact and costs a few inverse transforms.

In steady state the frequencies are those of the chirps' period at any temperature. There the response is computed at a
few scales, and interpolated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.errors import SimulationError
from touchd.frame import Acquisition, Plate
from touchd.twin.few_frames import few_of
from touchd.twin.physics import chebyshev
from touchd.twin.physics.contact import size_of
from touchd.twin.physics.filters import anti_alias
from touchd.twin.physics.finger import Contact, patches
from touchd.twin.physics.mounting import FREE, Mounting, mounted_modes
from touchd.twin.physics.response import Response
from touchd.twin.physics.transducer import Layout, LoadedModes, default_layout, loaded_modes
from touchd.twin.record import Record

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

REFERENCE_C = 22.0
SPAN_K = 20.0
"""Largest difference from it."""
TEMPERATURE_PER_K = -4.5e-5
"""Relative change of the modes' frequencies; -2e-4 .. -2e-5 for other plates."""
ERROR = 1e-11
"""Error of the series in time and temperature relative to the signal: far below one count."""
_STEADY_NODES, _DIGITS = 16, 9
"""Scales at which the untouched plate is computed in steady state, and decimal digits of interpolated contacts."""
MOST_DRIVE_DB = 100.0
MOST_LATE_S = 1e-6
"""Largest trigger delay; the Taylor series that shifts the signal converges up to it."""


class Instrument:
    """Plate, discs and chirp: maps touches to signals. R receivers, S samples.

    Signals are in units of the peak of the untouched plate at the reference temperature. By default there are an
    emitter and four receivers, and frames of 250 samples at 250 kHz.

    `loss` is the loss factor, 2e-3 .. 1e-2 for a mounted plate with bonded discs. `tilts` are those of each receiver's
    phase and gain, (deg, dB), along the chirp's band, from its middle to its upper end. `feedthrough` is what each
    receiver hears of the drive itself, (dB, deg): its level beside what the plate sends it, and its phase in the middle
    of the band. `stretch` raises all modes' frequencies by a share, as another day's temperature does. `modes` are
    those of plate and discs by other physics than the twin's; real ones take `loss`, complex ones have theirs. Raises
    SimulationError if the twin cannot simulate this instrument.
    """

    def __init__(
        self,
        plate: Plate,
        *,
        layout: Layout | None = None,
        acquisition: Acquisition | None = None,
        loss: float = 5e-3,
        mounting: Mounting = FREE,
        tilts: Sequence[tuple[float, float]] = (),
        feedthrough: Sequence[tuple[float, float]] = (),
        stretch: float = 0.0,
        modes: LoadedModes | None = None,
    ) -> None:
        self.plate = plate
        self.layout = layout or default_layout(plate)
        receivers = len(self.layout.receivers_mm)
        self.acquisition = acquisition or Acquisition(channels=receivers, samples=250, sample_rate_hz=250e3)
        a = self.acquisition
        if a.channels != receivers:
            raise SimulationError(f"{a.channels} channels but {receivers} receivers", "acquisition", "make them agree")
        self._record = Record(a)
        if self._record.steady and loss < 1e-4:
            raise SimulationError("without loss, all chirps ring for ever", "acquisition", "use a loss factor")
        if not 0 <= loss < 0.2:
            raise SimulationError(f"a loss factor of {loss:g}", "loss", "use 0 .. 0.2; glass with discs has 0.005")
        nu, highest_hz = self._record.nu_rad_s, a.highest_hz
        if modes is None and mounting == FREE:
            modes = loaded_modes(plate, self.layout, highest_hz)
        elif modes is None:
            modes = mounted_modes(plate, self.layout, mounting, loss, highest_hz)
        modes = modes._replace(omega_rad_s=modes.omega_rad_s * (1 + stretch))
        self._loss = loss
        supports = [support for support in mounting.on(plate) if support.preload_n is not None]
        self.response = Response(plate, modes, nu, 0.0 if np.iscomplexobj(modes.w) else loss, supports)
        self._t = self._record.time_s
        if len(tilts) not in (0, receivers):
            raise SimulationError(f"{len(tilts)} tilts for {receivers} receivers", "tilts", "give one per receiver")
        if len(feedthrough) not in (0, receivers):
            raise SimulationError(
                f"{len(feedthrough)} feedthroughs for {receivers} receivers", "feedthrough", "give one per receiver"
            )
        if not all(abs(db) <= MOST_DRIVE_DB and math.isfinite(deg) for db, deg in feedthrough):
            raise SimulationError(
                f"the drive more than {MOST_DRIVE_DB:g} dB off", "feedthrough", "a rig has -60 to 20 dB of it"
            )
        self._tilt = _tilt(tilts, a, self.response.nu_rad_s)
        self._tables(feedthrough)

    def scale(self, temperature_c: ArrayLike) -> Floats:
        """Return the factor of all modes' frequencies at a temperature.

        Raises SimulationError if the temperature is outside `SPAN_K`.
        """
        off = np.asarray(temperature_c, dtype=float) - REFERENCE_C
        if not np.all(np.abs(off) <= SPAN_K):
            raise SimulationError(
                f"temperatures beyond {REFERENCE_C:g} +- {SPAN_K:g} C", "temperature", "stay within this range"
            )
        return np.asarray(1 + TEMPERATURE_PER_K * off)

    def untouched(self, temperature_c: ArrayLike, late_s: ArrayLike = 0.0) -> Floats:
        """Return the signals (n, R, S) of the untouched plate at temperatures (n,) and trigger delays (n,) or ()."""
        weights = chebyshev.weights(self.scale(temperature_c), self._node_scale)
        late = _late(late_s, len(weights))
        orders = np.arange(self._orders(float(np.abs(late).max(initial=0.0))))
        powers = late[:, None] ** orders
        _, K, R, S = self._untouched.shape
        combined = (powers[:, :, None] * weights[:, None, :]).reshape(-1, len(orders) * K)
        return np.asarray(combined @ self._untouched[: len(orders)].reshape(-1, R * S)).reshape(-1, R, S)

    def change(self, touches: Sequence[Sequence[Contact]], temperature_c: ArrayLike, late_s: ArrayLike = 0.0) -> Floats:
        """Return the change (n, R, S) of the signals due to n sequences of contacts, each possibly empty.

        It is to be added to the untouched plate's signals; temperatures and delays as in `untouched`. Raises
        SimulationError if a contact reaches over the edge.
        """
        scale = self.scale(temperature_c)
        late = _late(late_s, len(scale))
        split = [tuple(patch for contact in touch for patch in patches(contact)) for touch in touches]
        alike: dict[tuple[tuple[str, int], ...], list[int]] = {}
        for i, touch in enumerate(split):
            if touch:
                alike.setdefault(tuple((contact.kind, size_of(contact)) for contact in touch), []).append(i)
        result = np.zeros((len(split), self.acquisition.channels, self.acquisition.samples))
        for kinds, at in alike.items():
            some, factor = [split[i] for i in at], scale[at]
            few = few_of(some, factor)
            # Limit the group, so that the products of modes stay in cache and memory.
            groups = math.ceil(len(few.rows) * (sum(size for _, size in kinds) + 5) ** 2 / 2000)
            computed = [
                self._changed([some[k] for k in rows], factor[rows])
                for rows in np.array_split(few.rows, min(groups, len(few.rows)))
            ]
            spectrum = few.spread(np.concatenate(computed))
            if self._tilt is not None:
                spectrum *= self._tilt
            result[at] = self._to_time(spectrum, factor, late[at])
        return result / self.peak

    def _changed(self, touches: Sequence[Sequence[Contact]], scale: Floats) -> Complex:
        """Return the spectra (n, R, F) of contacts, with the same numbers of forces, as `_to_time` takes them."""
        if not self._record.steady:
            spectrum = self.response.change(touches, scale)
            spectrum *= (chebyshev.weights(scale, self._node_scale) @ self._emission)[:, None, :]
            return spectrum
        low, high = float(scale.min()), float(scale.max())
        # The nearest pole lies half a loss factor off: an interpolation through n points errs by rho^-n.
        z = self._loss / 2 / max((high - low) / 2, 1e-12)
        count = math.ceil(_DIGITS / math.log10(z + math.hypot(z, 1)))
        nodes = chebyshev.points((low + high) / 2, (high - low) / 2, count)
        mean: Complex = np.zeros((), np.complex128)
        for node, weight in zip(nodes.tolist(), chebyshev.weights(scale, nodes).T, strict=True):
            mean = mean + weight[:, None, None] * self._at(node).change(touches, np.full(len(touches), node))
        return np.asarray(mean * self._emission[0])

    def _at(self, scale: float) -> Response:
        """Return the response of the plate with all modes' frequencies scaled, at the record's own frequencies."""
        r = self.response
        return Response(self.plate, r.modes, r.nu_rad_s / scale, r.loss, r.supports)

    def _tables(self, feedthrough: Sequence[tuple[float, float]] = ()) -> None:
        """Compute the emission, and the untouched signals with their time derivatives, at the temperature nodes."""
        nu = self.response.nu_rad_s
        a = self.acquisition
        span = abs(TEMPERATURE_PER_K) * SPAN_K
        # A Chebyshev series of n terms has the error of a Taylor series over half the span; add one for safety.
        n = _STEADY_NODES if self._record.steady else self._orders(span * float(self._t[-1]) / 2) + 1
        s = self._node_scale = chebyshev.points(1.0, span, n)
        played = np.ones(1) if self._record.steady else s
        self._emission = np.array(
            [a.chirp.spectrum(each * nu) * anti_alias(each * nu, a.sample_rate_hz) for each in played]
        )
        played_to = [self._at(each) for each in s] if self._record.steady else [self.response]
        heard = np.stack([each.untouched() for each in played_to])
        received = heard * self._emission[:, None, :] / s[:, None, None] ** 2
        if self._tilt is not None:
            received *= self._tilt
        # The derivative with respect to the trigger's time is s times that with respect to the record's time.
        orders = [
            self._to_time(received * (1j * nu) ** k, s, np.zeros(n))
            * (1.0 if self._record.steady else s[:, None, None] ** k)
            / math.factorial(k)
            for k in range(self._orders(MOST_LATE_S))
        ]
        self._untouched = np.stack(orders)
        if len(feedthrough):
            self._untouched += self.driven(feedthrough, len(orders))[:, None]
        self.peak = float(np.abs(self.untouched([REFERENCE_C])).max())
        """Peak of the untouched plate at the reference temperature, from which signals are counted."""
        if not self.peak > 0:
            raise SimulationError(f"{a.samples} samples hear nothing of the chirp", "acquisition", "take longer frames")
        self._untouched /= self.peak

    def driven(
        self, feedthrough: Sequence[tuple[float, float]], count: int = 1, poles_hz: ArrayLike = np.inf
    ) -> Floats:
        """Return what receivers hear of the drive, and its first time derivatives over factorials, (count, R, S).

        Common wires pass it on as it is, a capacitance its derivative; neither knows the plate's temperature.
        `poles_hz`, of shape (R,), bends it along the band.
        """
        a, nu = self.acquisition, self.response.nu_rad_s
        db, deg = np.array(feedthrough).T
        as_is, rising = np.cos(np.radians(deg)), np.sin(np.radians(deg))
        played = a.chirp.spectrum(nu) * anti_alias(nu, a.sample_rate_hz)
        waves = (as_is[:, None] + 1j * rising[:, None] * nu / (np.pi * sum(a.chirp.band_hz))) * played
        waves /= 1 + 1j * nu / (2 * np.pi * np.reshape(poles_hz, (-1, 1)))
        moments = np.stack([waves * (1j * nu) ** k / math.factorial(k) for k in range(count)])
        signals = self._to_time(moments, np.ones(count), np.zeros(count))
        heard = np.linalg.norm(self.untouched([REFERENCE_C])[0], axis=1) / np.linalg.norm(signals[0], axis=1)
        return np.asarray(signals * (heard * 10 ** (db / 20))[:, None])

    def _orders(self, shift_s: float) -> int:
        """Return the number of Taylor terms that shift a time signal by `shift_s` to within `ERROR`."""
        x = np.pi * self.acquisition.sample_rate_hz * shift_s
        k, term = 1, x
        while term > ERROR:
            k += 1
            term *= x / k
        return k

    def _to_time(self, spectrum: Complex, scale: Floats, late_s: Floats) -> Floats:
        """Return the time signals at s (t + late) of spectra over nu of shape (n, R, F); result (n, R, S).

        In steady state at t + late: the scale is in the spectra.
        """
        a = self.acquisition
        scale = np.ones_like(scale) if self._record.steady else scale
        at = scale[:, None] * (self._t + late_s[:, None])
        shift = at - self._t
        nu = self.response.nu_rad_s
        result = np.zeros((*spectrum.shape[:2], a.samples))
        power = np.ones_like(shift)
        for k in range(self._orders(float(np.abs(shift).max()))):
            if k:
                spectrum = spectrum * (1j * nu)
                power = power * shift / k
            result += self._record.waves(spectrum) * power[:, None, :]
        undamp = scale[:, None] * np.exp(self._record.decay_per_s * self._t)
        return result * undamp[:, None, :] * a.sample_rate_hz


def _late(late_s: ArrayLike, n: int) -> Floats:
    """Broadcast the trigger delays to n frames, and check them."""
    late = np.broadcast_to(np.asarray(late_s, dtype=float), (n,))
    if not np.all(np.abs(late) <= MOST_LATE_S):
        raise SimulationError("a trigger off by more than 1 us", "jitter", "use 200 ns or less")
    return late


def _tilt(tilts: Sequence[tuple[float, float]], acquisition: Acquisition, nu_rad_s: Complex) -> Complex | None:
    """Return the receivers' gains along the band, shape (R, F); None without tilts.

    A ceramic disc and its bond age and warm: some degrees and a decibel across the band. 10 deg and 1.5 dB are a rig
    after months, 30 deg and 3 dB one whose bond fails.
    """
    if not len(tilts):
        return None
    low_hz, high_hz = acquisition.chirp.band_hz
    middle, half = (high_hz + low_hz) / 2, (high_hz - low_hz) / 2
    deg, db = np.array(tilts).T
    rate = np.log(10) / 20 * db + 1j * np.deg2rad(deg)
    return np.asarray(np.exp(rate[:, None] * (nu_rad_s / (2 * np.pi) - middle) / half))
