"""Make the field atlas of a fitted plate from physics, without a touch.

The field of a touch is what a small contact at any place adds to each bin. It takes the wave that the emitter sends to
it, weakens it by its own impedance, and sends it to each receiver. All three receptances are sums over the fitted
plate's modes, so near fields of edges and discs are in them.

The field's error and the scales of the standard error come from touches drawn on the fitted plate, of other contact
areas, in noise.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.calibration.emission import emission
from touchd.calibration.plate_fit import PlateFit, Progress
from touchd.calibration.reduced_plate import Complex, Floats
from touchd.calibration.spline_grid import coefficients_of, grid_of, solved
from touchd.calibration.untouched_model import band
from touchd.evaluation.dataset import BASELINE_NOISE, complex_bins
from touchd.frame import Acquisition, Plate
from touchd.localization.atlas import MAX_BYTES, Atlas, AtlasDescription
from touchd.localization.features import band_bins, windowed_dft
from touchd.localization.plate_modes import PlateModes
from touchd.localization.position_error import UNUSUAL
from touchd.training.field.bins import TAPER, informative, weights
from touchd.training.field.error_scale import calibrate, field_error, noisy_levels
from touchd.training.field.place import FieldMap, place
from touchd.twin.physics.corners import inside
from touchd.twin.physics.finger import impedance
from touchd.twin.physics.material import mindlin_wavenumber
from touchd.twin.record import Record

AREA_MM2 = 20.0
"""Contact area of the reference touch: a silicone finger of 5 mm. The amplitude absorbs most of the difference to
others."""
STEPS_PER_WAVE = 3.9
"""Nodes per shortest wavelength of the field, which is half the plate's: 2.5 mm on 5 mm glass. There the splines miss
2e-6 of the field's energy, 3e-5 at the edges; another contact area changes 3e-4 of it (twin)."""
AREAS = (0.6, 1.4)
"""Contact areas of the touches that tell the field's error, over the reference's."""
STEADY_AREAS = (0.4, 2.0)
"""The same in steady state, where the atlas knows what weighs on the plate: what it still misses grows with that."""
MODES_ABOVE = 1.4
"""Modes up to this many times the highest frequency tell how contacts scatter each other's waves."""
MODES_SHARE = 0.9
"""Of the largest atlas, all that shapes may fill up: the rest of them is small."""
_LEAST_LINE = 1e-6
"""Lines with a smaller share of the largest line's energy in the bins are in none."""
STEADY_LACK = 4.0
"""In steady state a fit's few lines leave less of the discs' response than of a wave elsewhere. With it 60 and 76 % of
fingertips' errors are within the standard error, with 1 42 and 54 % (other simulator, 5 mm at 192 kHz and 2 mm at
96 kHz)."""
DRAWN = 300
_WEIGHINGS = 2
_SEED = 0xF1E1D


class Reference(NamedTuple):
    """A kind of touch, as an atlas is made for one."""

    tissue: str
    area_mm2: float
    """What weighs on the plate."""
    face_mm2: float
    """What the wave is averaged over: a fingertip follows it, and has its second derivatives beside it."""


TIP = Reference("silicone", AREA_MM2, AREA_MM2)
LIGHT_FINGER = Reference("human", 40.0, AREA_MM2)
"""In steady state, where resonances are sharp, what weighs on the plate moves them. Between a silicone finger and a
fingertip: with the former as reference fingertips are placed to 0.061 mm, with this to 0.046, and silicone to 0.016 and
0.031 (twin, 192 kHz)."""
_BLOCK = 512


def spectra_to_bins(record: Record, acquisition: Acquisition) -> Complex:
    """Return the matrix that takes real and then imaginary parts of a spectrum to an atlas' bins, (2 F, bins)."""
    unit = np.eye(len(record.hz))
    signals = record.to_time(np.concatenate([unit, 1j * unit]))
    return complex_bins(signals @ windowed_dft(acquisition, taper=TAPER), 1)[:, 0]


class PhysicalField:
    """Evaluates the bins of touches on a fitted plate, ADC counts: R receivers, F frequencies."""

    def __init__(self, fit: PlateFit) -> None:
        a = fit.acquisition
        self.steady = a.chirp.period_s is not None
        self.reference, self.areas = (LIGHT_FINGER, STEADY_AREAS) if self.steady else (TIP, AREAS)
        self.size_mm, self.corner_radius_mm = np.array(fit.plate.size_mm), fit.plate.corner_radius_mm
        record = Record(a)
        nu = record.nu_rad_s
        self._response = fit.response(nu)
        self._discs = self._response.modes.discs
        x = band(a, record.hz)
        gain = fit.gains @ np.stack([x**k for k in range(fit.gains.shape[1])])
        self._heard = emission(a, nu, fit.late_us) * gain  # (R, F)
        self._to_bins = spectra_to_bins(record, a)
        self._hz, self.bins_hz = record.hz, band_bins(a) * a.sample_rate_hz / a.samples

    def at(self, position_mm: Floats, touch: Reference | None = None) -> Complex:
        """Return the bins of touches, by default the reference's, at positions (n, 2) on the plate, shape (n, R, bins).

        Near an edge a contact is as wide as the plate admits; on the edge it is a point.
        """
        starts, touch = range(0, len(position_mm), _BLOCK), touch or self.reference
        return np.concatenate([self._block(np.asarray(position_mm[i : i + _BLOCK], float), touch) for i in starts])

    def yields(self, position_mm: Floats) -> Complex:
        """Return the share of the wave that the reference takes from itself at positions (n, 2), shape (n, bins).

        It holds for the lines of a steady state: of a short frame the bins mix frequencies.
        """
        shape, load = self._contact(position_mm, self.reference)
        taken = load * self._response.receptance(shape, shape)
        share = taken / (1 + taken)
        lines = [np.interp(self.bins_hz, self._hz, part) for each in share.T for part in (each.real, each.imag)]
        real, imaginary = np.array(lines).reshape(len(position_mm), 2, -1).swapaxes(0, 1)
        return np.asarray(real + 1j * imaginary)

    def modes(
        self, size_mm: tuple[float, float], step_mm: float, kept: NDArray[np.integer], weight: Floats, most_bytes: int
    ) -> PlateModes | None:
        """Return what tells how contacts scatter each other's waves into the bins `kept`, which have weights.

        `step_mm` is the field's: a mode is half as fine as the field, a product of two waves. None where a file would
        hold more than `most_bytes` of shapes, as of large panes: the larger, the less contacts hear of each other.
        """
        to_bins = self._to_bins[:, kept] * weight
        size = np.square(np.abs(to_bins)).sum(axis=1).reshape(2, -1).sum(axis=0)
        lines = np.flatnonzero(size > _LEAST_LINE * size.max())
        response = self._response
        nu, omega = response.nu_rad_s[lines], response.modes.omega_rad_s
        near = omega < MODES_ABOVE * nu.real.max()
        loss = np.broadcast_to(response.loss, response.nu_rad_s.shape)[lines]
        x, y = (grid_of(side_mm, 2 * step_mm) for side_mm in size_mm)
        values = int(near.sum()) * len(x.nodes_mm) * len(y.nodes_mm) * (2 if np.iscomplexobj(self._discs) else 1)
        if np.dtype(np.float16).itemsize * values > most_bytes:
            return None
        samples = []
        for y_mm in y.samples_mm:
            places = np.stack([x.samples_mm, np.full_like(x.samples_mm, y_mm)], axis=1)
            shape, load = self._contact(places, self.reference)
            samples.append(shape[near].T)
        both = np.concatenate([lines, lines + len(response.nu_rad_s)])
        return PlateModes(
            solved(np.concatenate(samples), x, y),
            (2 * step_mm, float(x.nodes_mm[0]), float(y.nodes_mm[0])),
            self._discs[near],
            1 / (omega[near, None] ** 2 * (1 + 1j * loss) - nu**2),
            load[lines, 0],
            self._heard[:, lines],
            np.concatenate([to_bins.real, to_bins.imag], axis=1)[both],
        )

    def _contact(self, position_mm: Floats, touch: Reference) -> tuple[Floats | Complex, Complex]:
        """Return the plate's modes under n contacts, and by what they weigh on it at each frequency, shape (F, 1)."""
        # The atlas' sides are rounded to a micrometre, and its corners are sharp.
        position_mm, edge_mm = inside(position_mm, self.size_mm, self.corner_radius_mm)
        # Of a disc as wide as the plate admits rounding must not reach over the edge.
        area = np.minimum(touch.face_mm2, (1 - 1e-9) * np.pi * edge_mm**2)
        nu = self._response.nu_rad_s
        shape = self._response.shape_at(position_mm[:, 0], position_mm[:, 1], area)
        return shape, (1j * nu * impedance(touch.tissue, nu, touch.area_mm2))[:, None]

    def _block(self, position_mm: Floats, touch: Reference) -> Complex:
        shape, load = self._contact(position_mm, touch)
        response = self._response
        taken = -load / (1 + load * response.receptance(shape, shape))  # (F, n)
        taken *= response.receptance(self._discs[:, :1], shape)
        bins = []
        for receiver, heard in enumerate(self._heard, start=1):
            spectrum = heard[:, None] * taken * response.receptance(self._discs[:, receiver, None], shape)
            bins.append(np.concatenate([spectrum.real, spectrum.imag]).T @ self._to_bins)
        return np.stack(bins, axis=1)


def make_physical_atlas(
    fit: PlateFit,
    noise_counts: float,
    *,
    data_sha256: str = "",
    command: str = "",
    progress: Progress = lambda _stage, _share: None,
) -> Atlas:
    """Return the atlas of a fitted plate.

    `noise_counts` is the standard deviation of a sample's noise, ADC counts. `progress` receives "field" and the share
    that is done.
    """
    a, p, field = fit.acquisition, fit.plate, PhysicalField(fit)
    # As models describe it, to a micrometre.
    plate = Plate(
        width_mm=round(p.width_mm, 3), height_mm=round(p.height_mm, 3), thickness_mm=round(p.thickness_mm, 3),
        material=p.material,
    )  # fmt: skip
    f_hz = band_bins(a) * a.sample_rate_hz / a.samples
    wavenumber_rad_m = mindlin_wavenumber(fit.plate, f_hz)
    step_mm = round(1e3 * np.pi / float(wavenumber_rad_m[-1]) / STEPS_PER_WAVE, 2)
    x, y = (grid_of(side_mm, step_mm) for side_mm in plate.size_mm)
    position_mm, values = draw(field)
    variance = BASELINE_NOISE * noise_counts**2 * float(np.square(a.window(TAPER)).sum())
    snr = np.square(np.abs(values)).mean(axis=(0, 1)) / max(variance, 1e-12)
    kept = informative(snr, wavenumber_rad_m, a)
    weight = weights(snr, a)[kept]
    rows, shares = [], []
    for done, y_mm in enumerate(y.samples_mm):
        places = np.stack([x.samples_mm, np.full_like(x.samples_mm, y_mm)], axis=1)
        rows.append(field.at(places)[..., kept] * weight)
        if field.steady:
            shares.append(field.yields(places)[:, None, kept])
        progress("field", (done + 1) / len(y.samples_mm))
    description = AtlasDescription(
        acquisition=a, plate=plate, taper=TAPER, bins=tuple(map(int, band_bins(a)[kept])), step_mm=step_mm,
        origin_mm=(float(x.nodes_mm[0]), float(y.nodes_mm[0])), low_mm=(0.0, 0.0),
        high_mm=plate.size_mm, data_sha256=data_sha256, command=command,
        wavenumber_rad_m=tuple(wavenumber_rad_m.round(3).tolist()),
        weights=tuple(weight.round(6).tolist()) if weight.min() < 1 else (),
    )  # fmt: skip
    plain = Atlas(
        description, coefficients_of(np.concatenate(rows), x, y), fit.measured.astype(np.float32),
        np.zeros((a.channels, len(kept)), np.float32),
    )  # fmt: skip
    values = values[..., kept] * weight
    if field.steady:
        yields = coefficients_of(np.concatenate(shares), x, y)
        values = as_reference(plain, values, position_mm, field.yields(position_mm)[:, kept])
        left = int(MODES_SHARE * MAX_BYTES) - np.dtype(np.float16).itemsize * (plain.coefficients.size + yields.size)
        plain = replace(plain, yields=yields, modes=field.modes(plate.size_mm, step_mm, kept, weight, left))
    return calibrated(plain, fit.lacking, position_mm, values, noise_counts)


def as_reference(plain: Atlas, values: Complex, position_mm: Floats, yields: Complex) -> Complex:
    """Return touches (n, R, bins) as the plate would answer if each weighed as much as the reference.

    `yields` (n, bins) are the reference's shares at their places. What each weighs is told by its amplitude.
    """
    found = values
    for _ in range(_WEIGHINGS):
        size = np.abs(place(plain, found, position_mm).amplitude)
        found = values * (1 + (size[:, None, None] - 1) * yields[:, None])
    return np.asarray(found)


def draw(field: PhysicalField) -> tuple[Floats, Complex]:
    """Draw touches of other areas than the atlas' all over the plate: places (n, 2) and exact bins (n, R, b)."""
    rng = np.random.default_rng(_SEED)
    ratios, touch = np.linspace(*field.areas, 5), field.reference
    margin_mm = np.sqrt(field.areas[1] * touch.face_mm2 / np.pi)
    anywhere_mm = rng.uniform(margin_mm, field.size_mm - margin_mm, (DRAWN, 2))
    position_mm, _ = inside(anywhere_mm, field.size_mm, field.corner_radius_mm, margin_mm)
    parts = np.array_split(position_mm, len(ratios))
    values = [
        field.at(part, Reference(touch.tissue, ratio * touch.area_mm2, ratio * touch.face_mm2))
        for part, ratio in zip(parts, ratios.tolist(), strict=True)
    ]
    return position_mm, np.concatenate(values)


def calibrated(plain: Atlas, lacking: float, position_mm: Floats, values: Complex, noise_counts: float) -> Atlas:
    """Return the atlas with the field's error, and with scales so that 68 % of the errors are within sigma.

    `lacking` is that of the fit. What physics lack is alike in many bins, as is the error of an unusual touch.
    """
    placed = place(plain, values, position_mm)
    predicted = FieldMap(plain).at(placed.position_mm)
    lack = lack_of_physics(predicted, lacking, plain.description.acquisition)
    error = field_error(values, predicted, placed.amplitude, 0.0)
    levels = noisy_levels(plain, values, position_mm, noise_counts, seed=_SEED)
    noise_scale, drawn_scale = calibrate([level for _, level in levels], float(error.mean()))
    # The touches drawn lack nothing of the fit's physics: they scale their own error alone.
    field_scale = float(np.average((drawn_scale, UNUSUAL), weights=(error.mean(), lack.mean())))
    description = plain.description.model_copy(update={"noise_scale": noise_scale, "field_scale": field_scale})
    return replace(plain, description=description, error=(error + lack).astype(np.float32))


def lack_of_physics(field: Complex, lacking: float, acquisition: Acquisition) -> Floats:
    """Return the mean square of what a field (n, R, bins) misses, shape (R, bins), of a fit with this `lacking`.

    What the fit leaves of the untouched response it leaves of a wave; the field is a product of two.
    """
    waves = 2 if acquisition.chirp.period_s is None else 2 * STEADY_LACK
    return np.asarray(waves * lacking * np.square(np.abs(field)).mean(axis=0))
