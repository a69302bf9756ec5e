"""Hold the field atlas' claims against wave fields that were measured on a real plate.

The claims: a plate's wave has no spatial frequencies above its wavenumber k; the field of a bin, a product of two
waves, none above 2 k; and `training.field.regression` predicts the field between labelled touches better than a kernel
that does not know k. The data are scans of a reverberant plate of aluminium and carbon fibre, 225 x 247 mm in steps of
0.8 mm: https://github.com/BAMresearch/WavenumberAnalysis (GPL-3), of Lugovtsova et al., Damage Quantification in
Aluminium-CFRP Composite Structures using Guided Wave Wavenumber Mapping, 2019. No finger touches that plate: the
product of the wave and its own copy, turned and shifted, stands for a bin's field.

    git clone https://github.com/BAMresearch/WavenumberAnalysis
    python -m touchd.lab.measured_fields WavenumberAnalysis/Data --csv docs/accuracy/measured_fields.csv

It needs the extras `train` and `dev` (for h5py).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator, NearestNDInterpolator
from scipy.linalg import eigh

from touchd.errors import RecordingError
from touchd.training.field.regression import BAND_MARGIN, covariance, distances
from touchd.training.report.template import Table, write_csv

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

FREEDOM = 600.0
"""Degrees of freedom A k^2 / pi of the part of the plate that is predicted."""
TOUCHES_PER_FREEDOM = (0.5, 1.0, 2.0, 3.0)
TESTED = 400
"""Positions that are predicted."""
REPEATS, SEED = 4, 1
"""Parts of the plate over which errors are averaged."""
RIDGES = np.geomspace(1e-5, 0.3, 14)
LENGTHS = np.linspace(0.6, 1.8, 5)
"""Lengths of the generic kernel that are tried, in 1/k."""
METHODS = ("nearest", "cubic", "generic", "kernel")
HEADINGS = ("frequency_hz", "touches_per_freedom", *METHODS)


@dataclass(frozen=True, slots=True)
class WaveField:
    """A wave at one frequency, scanned on a raster."""

    values: Complex
    """Shape (columns, rows)."""
    step_mm: float
    frequency_hz: float

    @property
    def wavenumber_per_mm(self) -> float:
        """Where the spectrum's power per ring is largest, as a centroid over the ring, rad/mm."""
        k, power = self.spectrum()
        rings = np.arange(0.0, k.max(), 0.02)
        of_ring, _ = np.histogram(k, rings, weights=power)
        peak = rings[of_ring.argmax()] + 0.01
        near = np.abs(k - peak) < 0.15 * peak
        return float((k[near] * power[near]).sum() / power[near].sum())

    def spectrum(self) -> tuple[Floats, Floats]:
        """Return wavenumber (rad/mm) and power of the tapered field, both flat."""
        tapered = self.values * np.outer(*(np.hanning(n) for n in self.values.shape))
        power = np.square(np.abs(np.fft.fft2(tapered)))
        k = np.hypot(*np.meshgrid(*(2 * np.pi * np.fft.fftfreq(n, self.step_mm) for n in power.shape), indexing="ij"))
        return k.ravel(), power.ravel()

    def share_above(self, wavenumber_per_mm: float) -> float:
        """Return the share of the power above a wavenumber."""
        k, power = self.spectrum()
        return float(power[k > wavenumber_per_mm].sum() / power.sum())

    def product(self) -> WaveField:
        """Return the wave times its copy, turned by 180 degrees and shifted by a third of the plate."""
        columns, rows = self.values.shape
        turned = np.roll(self.values[::-1, ::-1], (columns // 3, rows // 3), (0, 1))
        both = (self.values * turned)[columns // 3 :, rows // 3 :]  # what no seam of the shift crosses
        return WaveField(both, self.step_mm, self.frequency_hz)


def read_field(path: Path) -> WaveField:
    """Read the wave field of one file of the repository; raise RecordingError if the file holds no such field."""
    import h5py  # only these files are HDF5

    try:
        with h5py.File(path) as file:
            experiment = file["experiment"]
            spectrum = experiment["spectrum/value"][()]
            counts = experiment["N_POINT/value"][()].ravel().astype(int)
            step_mm = 1e3 * float(experiment["dx/value"][0, 0])
            frequency_hz = float(experiment["frequency/value"][0, 0])
    except (OSError, KeyError) as error:
        raise RecordingError(f"{path}: no scanned wave field ({error}); take the files Data_*_100kHz.mat") from error
    shifted = (spectrum["real"] + 1j * spectrum["imag"]).T
    values = np.asarray(np.fft.ifft2(np.fft.ifftshift(shifted)))
    return WaveField(values[: counts[0], : counts[1]], step_mm, frequency_hz)


def errors(field: WaveField, wavenumber_per_mm: float, per_freedom: float, rng: np.random.Generator) -> list[float]:
    """Return the relative RMS error of each of `METHODS` between positions drawn from a part of the plate.

    The part is a square of `FREEDOM` degrees of freedom. An error of 1 is that of knowing nothing.
    """
    points = int(np.sqrt(FREEDOM * np.pi) / wavenumber_per_mm / field.step_mm)
    left, low = (int(rng.integers(0, max(n - points, 0) + 1)) for n in field.values.shape)
    part = field.values[left : left + points, low : low + points]
    count = round(per_freedom * FREEDOM)
    chosen = rng.permutation(part.size)[: count + TESTED]
    at_mm = np.column_stack(np.unravel_index(chosen, part.shape)).astype(float) * field.step_mm
    known_mm, asked_mm = at_mm[:count], at_mm[count:]
    known, truth = part.ravel()[chosen[:count]], part.ravel()[chosen[count:]]

    def error(predicted: Complex) -> float:
        return float(np.sqrt(np.mean(np.abs(predicted - truth) ** 2) / np.mean(np.abs(truth) ** 2)))

    def kernel_error(kernel: Callable[[Floats], Floats]) -> float:
        """Return the error of kernel ridge regression, the ridge by leave-one-out errors (as `leave_one_out`)."""
        values, vectors = eigh(kernel(distances(known_mm, known_mm).astype(np.float64)))
        turned, best = vectors.T @ known, (np.inf, known)
        for ridge in RIDGES:
            shrunk = 1 / (np.maximum(values, 0.0) + ridge)
            weights = vectors @ (shrunk * turned)
            left_out = float(np.mean(np.abs(weights / (np.square(vectors) @ shrunk)) ** 2))
            if left_out < best[0]:
                best = left_out, weights
        return error(kernel(distances(known_mm, asked_mm).astype(np.float64)).T @ best[1])

    nearest = NearestNDInterpolator(known_mm, known)(asked_mm)
    cubic = CloughTocher2DInterpolator(known_mm, known)(asked_mm)
    generic = (partial(_gaussian, length_mm=length / wavenumber_per_mm) for length in LENGTHS)
    return [
        error(nearest),
        error(np.where(np.isnan(cubic), nearest, cubic)),
        min(map(kernel_error, generic)),  # the best length on the test: more than it could know
        kernel_error(partial(covariance, wavenumber_per_mm=wavenumber_per_mm)),
    ]


def _gaussian(r_mm: Floats, length_mm: float) -> Floats:
    return np.exp(-np.square(r_mm / length_mm) / 2)


@click.command(help=(__doc__ or "").split("\n")[0])
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--csv", "table", type=click.Path(path_type=Path), help="Write the table of errors to this file.")
def main(folder: Path, table: Path | None) -> None:
    """Print the band limit and the errors of prediction for the scans in a folder."""
    rows = []
    for path in sorted(folder.glob("Data_AlSide_*.mat")):
        field = read_field(path)
        k, product = field.wavenumber_per_mm, field.product()
        above, above_twice = field.share_above(BAND_MARGIN * k), product.share_above(2 * BAND_MARGIN * k)
        print(
            f"{path.name}: k = {k:.3f} rad/mm; above 1.15 k {above:.2%}; of the product above 2.3 k {above_twice:.2%}"
        )
        for per_freedom in TOUCHES_PER_FREEDOM:
            found = [errors(product, k, per_freedom, np.random.default_rng([SEED, turn])) for turn in range(REPEATS)]
            row = [f"{value:.4g}" for value in (field.frequency_hz, per_freedom, *np.mean(found, axis=0))]
            rows.append(row)
            print("  " + "  ".join(f"{name} {value}" for name, value in zip(HEADINGS, row, strict=True)), flush=True)
    if not rows:
        sys.exit(f"{folder}: no file Data_AlSide_*.mat; it should be the folder Data of the repository")
    if table:
        write_csv(table, Table(HEADINGS, rows))


if __name__ == "__main__":
    main()
