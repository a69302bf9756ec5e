"""Expected error of a fingertip over a plate for a layout of its discs, and a search for a better layout.

The error by noise is the Cramer-Rao bound of a touch whose amplitude is unknown, on the free plate that PLATE.toml
describes. Discs weigh on the bare plate's modes by Woodbury's identity, so that a layout costs a few products. Model
error comes on top, alike for all layouts; one with a smaller bound leaves more room for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from touchd.calibration.emission import emission
from touchd.calibration.parameters import usual_loss, wavelength_mm
from touchd.calibration.physical_atlas import spectra_to_bins
from touchd.calibration.plate_file import PlateFile
from touchd.calibration.reduced_plate import Complex, Floats
from touchd.calibration.verdict import EXACT
from touchd.evaluation.dataset import BASELINE_NOISE
from touchd.frame import Acquisition
from touchd.training.field.bins import TAPER
from touchd.training.field.place import linearise
from touchd.twin.physics import legendre
from touchd.twin.physics.corners import inside
from touchd.twin.physics.finger import impedance
from touchd.twin.physics.plate import polynomials_for, size_m, solve
from touchd.twin.record import Record

NOISE_DB = 60.0
PLACES = 16
"""Places along the longer side of the map."""
SPARED_MM = 4.0
"""Margin of the map at the edges."""
FINGER, AREA_MM2 = "human", 40.0
"""A light fingertip."""
STEP_MM = 0.1
LONGEST_S, LEAST_BINS = 0.01, 64
"""A longer period is computed as some chirps of at most this length, whose mean is the frame: the bound is the same
within 3 % (twin), at a hundredth of the cost of 0.1 s. The band keeps that many bins."""
MOVES = 20
"""Moves of each disc that a search tries."""
EDGE_DIAMETERS, APART_DIAMETERS = 1.5, 2.5
"""Least distance of a disc's centre from the edge, and of two discs' centres, in their diameters."""
MIRRORED_MM = 6.0
"""Least distance of a disc from the mirror image of another, or of itself: a symmetric layout cannot tell mirrored
touches."""
SQUARE = 0.1
"""Relative difference of the sides up to which a plate's diagonals count as axes of symmetry."""
WORST = 95
"""Percentile of the plate's places by which layouts are compared: a layout is as good as its poor places."""
Progress = Callable[[float], object]
"""Receives the share of a search that is done."""


class Plan(NamedTuple):
    """Expected errors of a layout."""

    discs_mm: Floats
    """Centres of the discs, the emitter first, shape (1 + receivers, 2)."""
    error_mm: Floats
    """RMS distance from the truth by noise, shape (rows, columns)."""
    exact_mm: float
    """Median error without noise: physics that no fit has."""

    @property
    def quantiles_mm(self) -> tuple[float, float, float]:
        """Median, 95 %, and the worst place."""
        return tuple(np.percentile(self.error_mm, (50, WORST, 100)).tolist())


class Way(NamedTuple):
    """A disc on the bare plate: n modes, F frequencies."""

    vectors: Floats
    """Its rim's rotation and its mean deflection in the modes, shape (2, n)."""
    fields: Complex
    """Receptances of both to all places, and their slopes by x and y, shape (2, 3, F, places)."""


def shortened(acquisition: Acquisition, longest_s: float) -> tuple[Acquisition, int]:
    """Return an acquisition of a shorter period, and how many of its chirps take as long as one of the given."""
    a, chirp = acquisition, acquisition.chirp
    period_s = a.samples / a.sample_rate_hz
    low_hz, high_hz = chirp.band_hz
    chirps = min(math.ceil(period_s / longest_s - 1e-9), int((high_hz - low_hz) * period_s / LEAST_BINS))
    if chirps <= 1 or not a.is_whole_period:
        return a, 1
    samples = round(a.samples / chirps)
    period_s = samples / a.sample_rate_hz
    chirp = chirp.model_copy(update={"duration_s": chirp.duration_s * samples / a.samples, "period_s": period_s})
    return a.model_copy(update={"samples": samples, "chirp": chirp}), chirps


def bound_mm(u: Complex, by_x: Complex, by_y: Complex, variance: float) -> Floats:
    """Return the RMS distance, mm, of touches with the field `u` (n, m) and its slopes in noise of this variance.

    It is infinite where the field does not change along a line, as with all discs on a diagonal.
    """
    told = linearise(u, u, by_x, by_y).fisher_information[:, 0]
    trace, determinant = np.trace(told, axis1=1, axis2=2), np.linalg.det(told)
    known = determinant > np.finfo(float).eps * trace**2
    return np.asarray(np.sqrt(variance * np.where(known, trace / np.where(known, determinant, 1.0), np.inf)))


class PlateMap:
    """Computes the map of the expected error for any layout on one plate.

    `acquisition` has a channel for each receiver; `noise_db` is the signal-to-noise ratio of the untouched plate. A
    period longer than `longest_s` is shortened.
    """

    def __init__(
        self, said: PlateFile, acquisition: Acquisition, noise_db: float = NOISE_DB, longest_s: float = LONGEST_S
    ) -> None:
        acquisition, chirps = shortened(acquisition, longest_s)
        self._a, self._noise = acquisition, 10 ** (-noise_db / 20) / math.sqrt(chirps)
        self._plate, self._said = said.twin_plate(), said
        record = Record(acquisition)
        top_hz = acquisition.chirp.band_hz[1]
        modes = solve(self._plate, polynomials_for(self._plate, top_hz), 1.3 * top_hz)
        self._counts = modes.w.shape[1:]
        n = len(modes.omega_rad_s)
        self._w, *self._psi = (field.reshape(n, -1) for field in modes[1:])
        self._load = -(record.nu_rad_s**2) * said.layout().mass_g * 1e-3
        nu = record.nu_rad_s
        loss = usual_loss(said)
        self._kernel = 1 / (modes.omega_rad_s[:, None] ** 2 * (1 + 1j * loss) - nu**2)  # (n, F)
        self._emission = emission(acquisition, nu)
        self._to_bins = spectra_to_bins(record, acquisition)
        self._to_time = record.to_time
        self._exact_mm = EXACT * wavelength_mm(self._plate, acquisition.chirp)
        self._size_mm = size = np.array(self._plate.size_mm)
        columns, rows = (max(round(PLACES * side / size.max()), 3) for side in size)
        self._shape = rows, columns
        x, y = (
            SPARED_MM + (side - 2 * SPARED_MM) * (np.arange(count) + 0.5) / count
            for side, count in zip(size, (columns, rows), strict=True)
        )
        self._places_mm = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        shapes = self._shapes(self._places_mm)
        self._finger = (1j * nu * impedance(FINGER, nu, AREA_MM2))[:, None]
        self._alone = self._kernel.T @ shapes**2  # (F, places)
        self._moved = [shapes] + [
            (self._shapes(self._places_mm + step) - self._shapes(self._places_mm - step)) / (2 * STEP_MM)
            for step in STEP_MM * np.eye(2)
        ]

    def _shapes(self, places_mm: Floats) -> Floats:
        """Return the modes' deflections at places (m, 2), shape (n, m)."""
        radius = np.full(len(places_mm), 1e-3 * np.sqrt(20.0 / np.pi))
        under = legendre.disc_average(1e-3 * places_mm, radius, size_m(self._plate), self._counts, (3, 8))
        return np.asarray(self._w @ under.reshape(len(places_mm), -1).T)

    def way(self, centre_mm: Floats) -> Way:
        """Return what a disc at a place has to do with all others."""
        size, radius = size_m(self._plate), 5e-4 * self._said.discs.diameter_mm
        x, y = (rim.ravel() for rim in legendre.rim_average(1e-3 * centre_mm, radius, size, self._counts))
        under = legendre.disc_average(1e-3 * centre_mm[None], np.array([radius]), size, self._counts).ravel()
        vectors = np.stack([self._psi[0] @ x + self._psi[1] @ y, self._w @ under])
        return Way(vectors, np.stack([[self._kernel.T @ (v[:, None] * m) for m in self._moved] for v in vectors]))

    def plan(self, discs_mm: Floats, ways: list[Way] | None = None) -> Plan:
        """Return the map of a layout; `ways` are those of its discs."""
        ways = ways or [self.way(place) for place in discs_mm]
        rims, under = (np.stack([way.vectors[i] for way in ways]) for i in (0, 1))  # (D, n)
        # Forces of the discs' masses: what each rim, and each place, finds in its way.
        between, to_rims = (
            np.einsum("nf,in,jn->fij", self._kernel, under, other, optimize=True) for other in (under, rims)
        )
        masses = np.linalg.inv(np.eye(len(ways)) / self._load[:, None, None] + between)
        to_places = np.stack([way.fields[1] for way in ways], axis=2).transpose(1, 2, 0, 3)  # (F, D, 3, places)
        held = np.einsum("fij,fjkp->fikp", masses, to_places, optimize=True)
        alone = self._alone - (to_places[:, :, 0] * held[:, :, 0]).sum(axis=1)
        taken = self._emission[:, None] * -self._finger / (1 + self._finger * alone)
        fields = [
            way.fields[0] - np.einsum("fi,fikp->kfp", to_rims[:, :, d], held) for d, way in enumerate(ways)
        ]  # each (3, F, places)
        e, e_x, e_y = fields[0]
        parts, heard = [], []
        straight = np.einsum("nf,n,dn->fd", self._kernel, rims[0], rims[1:], optimize=True)
        straight = straight - np.einsum("fi,fij,fjd->fd", to_rims[:, :, 0], masses, to_rims[:, :, 1:], optimize=True)
        for (r, r_x, r_y), way in zip(fields[1:], straight.T, strict=True):
            products = np.stack([e * r, e_x * r + e * r_x, e_y * r + e * r_y]) * taken
            parts.append(np.concatenate([products.real, products.imag], axis=1).swapaxes(1, 2) @ self._to_bins)
            heard.append(self._to_time(self._emission * way))
        u, by_x, by_y = np.concatenate(parts, axis=2)
        white = float(np.square(self._a.window(TAPER)).sum()) / 2
        variance = BASELINE_NOISE * self._noise**2 * float(np.square(heard).mean()) * white
        # No touch is farther off than the plate is wide.
        error_mm = np.minimum(bound_mm(u, by_x, by_y, variance), np.hypot(*self._size_mm)).reshape(self._shape)
        return Plan(np.asarray(discs_mm, float), error_mm, self._exact_mm)

    def suggest(self, plan: Plan, moves: int = MOVES, progress: Progress = lambda _share: None) -> Plan:
        """Return a layout at least as good: discs move one at a time, by ever shorter random steps."""
        rng = np.random.default_rng(0)
        discs, best = plan.discs_mm.copy(), plan
        known = [self.way(place) for place in discs]
        size = self._size_mm
        margin, apart = (each * self._said.discs.diameter_mm for each in (EDGE_DIAMETERS, APART_DIAMETERS))
        for move in range(moves):
            for k in range(len(discs)):
                reach = 0.25 * size * (1 - move / moves) + 2.0
                beside = discs[k, None] + reach * rng.standard_normal(2)
                tried = inside(beside, size, self._plate.corner_radius_mm, margin)[0][0].round()
                others = np.delete(discs, k, axis=0)
                progress((move * len(discs) + k + 1) / (moves * len(discs)))
                if np.linalg.norm(others - tried, axis=1).min() < apart or is_mirrored(tried, others, size):
                    continue
                places, ways = discs.copy(), list(known)
                places[k], ways[k] = tried, self.way(tried)
                other = self.plan(places, ways)
                if other.quantiles_mm[1] < best.quantiles_mm[1]:
                    discs, known, best = places, ways, other
        return best


def is_mirrored(place_mm: Floats, others_mm: Floats, size_mm: Floats) -> bool:
    """Return whether a disc lies near the mirror image of another, or on an axis of the plate."""
    x, y = place_mm
    images = [(size_mm[0] - x, y), (x, size_mm[1] - y)]
    if abs(size_mm[0] / size_mm[1] - 1) < SQUARE:
        images += [(y, x), (size_mm[1] - y, size_mm[0] - x)]
    every = np.concatenate([others_mm, place_mm[None]])
    near = [np.linalg.norm(every - image, axis=1).min() for image in np.array(images)]
    near.append(np.linalg.norm(others_mm - (size_mm - place_mm), axis=1).min())
    return bool(min(near) < MIRRORED_MM)
