"""Simulate the receivers' signals of one chirp at any temperature, before electronics and noise.

Signals are computed on a record a few times longer than a frame, at complex frequencies, so that ringing beyond the
record does not wrap around into the frame: damping the record by exp(-13) and undoing it afterwards leaves -110 dB.
Only the frame at the start of the record is kept.

Temperature scales all modes' frequencies by one factor s. The response at omega = s nu equals that at nu, so the plate
is computed once, on a fixed grid of nu; emission and contacts are evaluated at s nu, and the time signal at s t, by a
Taylor series about t. This is exact and costs a few inverse transforms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd import chirp
from touchd.errors import SimulationError
from touchd.frame import Acquisition, Plate
from touchd.twin.physics import chebyshev
from touchd.twin.physics.contact import size_of
from touchd.twin.physics.finger import Contact, patches
from touchd.twin.physics.mounting import FREE, Mounting, mounted_modes
from touchd.twin.physics.response import Response
from touchd.twin.physics.transducer import Layout, LoadedModes, default_layout, loaded_modes

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

REFERENCE_C = 22.0
SPAN_K = 20.0
"""Largest difference from it."""
TEMPERATURE_PER_K = -4.5e-5
"""Relative change of the modes' frequencies; -2e-4 .. -2e-5 for other plates."""
ERROR = 1e-11
"""Error of the series in time and temperature relative to the signal: far below one count."""
MOST_LATE_S = 1e-6
"""Largest trigger delay; the Taylor series that shifts the signal converges up to it."""


class Instrument:
    """Plate, discs and chirp: maps touches to signals. R receivers, S samples.

    Signals are in units of the peak of the untouched plate at the reference temperature.

    Parameters
    ----------
    plate : Plate
    layout : Layout, optional
        Positions of the discs; by default one emitter and four receivers.
    acquisition : Acquisition, optional
        As many channels as receivers; by default 250 samples at 250 kHz.
    loss : float
        Loss factor: 2e-3 .. 1e-2 for a mounted plate with bonded discs.
    tail_period_s : float, optional
        Include the ringing of all previous chirps, one per `tail_period_s`; the record is then as long.
    mounting : Mounting
        What holds the plate.
    tilts : sequence of (deg, dB), optional
        Tilt of each receiver's phase and gain along the chirp's band, from its middle to its upper end.
    modes : LoadedModes, optional
        Modes of plate and discs, by other physics than the twin's; real ones take `loss`, complex ones have theirs.

    Raises
    ------
    SimulationError
        The twin cannot simulate this instrument.
    """

    def __init__(
        self,
        plate: Plate,
        *,
        layout: Layout | None = None,
        acquisition: Acquisition | None = None,
        loss: float = 5e-3,
        tail_period_s: float | None = None,
        mounting: Mounting = FREE,
        tilts: Sequence[tuple[float, float]] = (),
        modes: LoadedModes | None = None,
    ) -> None:
        self.plate = plate
        self.layout = layout or default_layout(plate)
        receivers = len(self.layout.receivers_mm)
        self.acquisition = acquisition or Acquisition(channels=receivers, samples=250, sample_rate_hz=250e3)
        a = self.acquisition
        frame_s = a.samples / a.sample_rate_hz
        if a.channels != receivers:
            raise SimulationError(f"{a.channels} channels but {receivers} receivers", "acquisition", "make them agree")
        if a.chirp.duration_s > frame_s * (1 + 1e-9):
            raise SimulationError("the chirp is longer than the frame", "acquisition", "record more samples")
        if tail_period_s is not None and tail_period_s < frame_s:
            raise SimulationError("chirps follow each other faster than frames last", "tail", "lower the frame rate")
        if tail_period_s is not None and loss < 1e-4:
            raise SimulationError("without loss, all chirps ring for ever", "tail", "use a loss factor")
        if not 0 <= loss < 0.2:
            raise SimulationError(f"a loss factor of {loss:g}", "loss", "use 0 .. 0.2; glass with discs has 0.005")
        # With a tail, a record of one period wraps around exactly as the ringing does.
        record_s, damping = (2 * frame_s, 13.0) if tail_period_s is None else (tail_period_s, 0.0)
        self._record = round(record_s * a.sample_rate_hz / 2) * 2
        self._decay_per_s = damping / record_s
        grid_hz = np.arange(self._record // 2 + 1) * a.sample_rate_hz / self._record
        nu = 2 * np.pi * grid_hz - 1j * max(self._decay_per_s, 1e-3)
        highest_hz = a.sample_rate_hz / 2
        if modes is not None:
            self.response = Response(plate, modes, nu, 0.0 if np.iscomplexobj(modes.w) else loss)
        elif mounting == FREE:
            self.response = Response(plate, loaded_modes(plate, self.layout, highest_hz), nu, loss)
        else:
            self.response = Response(plate, mounted_modes(plate, self.layout, mounting, loss, highest_hz), nu, 0.0)
        self._t = np.arange(a.samples) / a.sample_rate_hz
        if len(tilts) not in (0, receivers):
            raise SimulationError(f"{len(tilts)} tilts for {receivers} receivers", "tilts", "give one per receiver")
        self._tilt = _tilt(tilts, a, self.response.nu_rad_s)
        self._tables()

    def scale(self, temperature_c: ArrayLike) -> Floats:
        """Return the factor of all modes' frequencies at a temperature.

        Raises
        ------
        SimulationError
            The temperature is outside `SPAN_K`.
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

        It is to be added to the untouched plate's signals; temperatures and delays as in `untouched`.

        Raises
        ------
        SimulationError
            A contact reaches over the edge.
        """
        scale = self.scale(temperature_c)
        late = _late(late_s, len(scale))
        split = [tuple(patch for contact in touch for patch in patches(contact)) for touch in touches]
        alike: dict[tuple[int, ...], dict[tuple[Contact, ...], list[int]]] = {}
        for i, touch in enumerate(split):
            if touch:
                alike.setdefault(tuple(map(size_of, touch)), {}).setdefault(touch, []).append(i)
        result = np.zeros((len(split), self.acquisition.channels, self.acquisition.samples))
        for sizes, equal in alike.items():
            rows = list(equal.values())
            # Limit the group, so that the products of modes stay in cache and memory.
            groups = min(len(rows), math.ceil(len(rows) * (sum(sizes) + 5) ** 2 / 2000))
            for some in np.array_split(np.arange(len(rows)), groups):
                part = [i for k in some for i in rows[k]]
                spectrum = self.response.change([split[i] for i in part], scale[part])
                spectrum *= (chebyshev.weights(scale[part], self._node_scale) @ self._emission)[:, None, :]
                if self._tilt is not None:
                    spectrum *= self._tilt
                result[part] = self._to_time(spectrum, scale[part], late[part])
        return result / self.peak

    def _tables(self) -> None:
        """Compute the emission, and the untouched signals with their time derivatives, at the temperature nodes."""
        nu = self.response.nu_rad_s
        a = self.acquisition
        span = abs(TEMPERATURE_PER_K) * SPAN_K
        # A Chebyshev series of n terms has the error of a Taylor series over half the span; add one for safety.
        n = self._orders(span * float(self._t[-1]) / 2) + 1
        self._node_scale = chebyshev.points(1.0, span, n)
        self._emission = np.array(
            [chirp.spectrum(a.chirp, s * nu) * anti_alias(s * nu, a.sample_rate_hz) for s in self._node_scale]
        )
        s = self._node_scale
        received = self.response.untouched() * self._emission[:, None, :] / s[:, None, None] ** 2
        if self._tilt is not None:
            received *= self._tilt
        # The derivative with respect to the trigger's time is s times that with respect to the record's time.
        orders = [
            self._to_time(received * (1j * nu) ** k, s, np.zeros(n)) * s[:, None, None] ** k / math.factorial(k)
            for k in range(self._orders(MOST_LATE_S))
        ]
        self._untouched = np.stack(orders)
        self.peak = 1.0
        """Peak of the untouched plate at the reference temperature, from which signals are counted."""
        self.peak = float(np.abs(self.untouched([REFERENCE_C])).max())
        self._untouched /= self.peak

    def _orders(self, shift_s: float) -> int:
        """Return the number of Taylor terms that shift a time signal by `shift_s` to within `ERROR`."""
        x = np.pi * self.acquisition.sample_rate_hz * shift_s
        k, term = 1, x
        while term > ERROR:
            k += 1
            term *= x / k
        return k

    def _to_time(self, spectrum: Complex, scale: Floats, late_s: Floats) -> Floats:
        """Return the time signals at s (t + late) of spectra over nu of shape (n, R, F); result (n, R, S)."""
        a = self.acquisition
        at = scale[:, None] * (self._t + late_s[:, None])
        shift = at - self._t
        nu = self.response.nu_rad_s
        result = np.zeros((*spectrum.shape[:2], a.samples))
        power = np.ones_like(shift)
        for k in range(self._orders(float(np.abs(shift).max()))):
            if k:
                spectrum = spectrum * (1j * nu)
                power = power * shift / k
            wave = np.fft.irfft(spectrum, self._record, axis=-1)[..., : a.samples]
            result += wave * power[:, None, :]
        undamp = scale[:, None] * np.exp(self._decay_per_s * self._t)
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
    chirp_hz = acquisition.chirp.start_hz, acquisition.chirp.stop_hz
    middle, half = (max(chirp_hz) + min(chirp_hz)) / 2, abs(chirp_hz[1] - chirp_hz[0]) / 2
    deg, db = np.array(tilts).T
    rate = np.log(10) / 20 * db + 1j * np.deg2rad(deg)
    return np.asarray(np.exp(rate[:, None] * (nu_rad_s / (2 * np.pi) - middle) / half))


def anti_alias(omega_rad_s: Complex, sample_rate_hz: float) -> Complex:
    """Return the gain of the anti-alias filter: 1 up to 80 % of half the sample rate, -87 dB at half the rate.

    It is an analytic function, so it is the same filter at complex frequencies.
    """
    f = omega_rad_s / (np.pi * sample_rate_hz)
    return np.asarray(1 / (1 + np.exp((f - 0.92) / 0.008)))
