"""Simulate plates with discs as three-dimensional elastic solids: `python -m touchd.lab.plates.solid_plate FOLDER`.

Each disc in turn sends a pulse; what the discs sense and how the face moves is saved, for
`touchd.lab.plates.solid_instrument`. On an H200 a plate takes ten seconds to two minutes, on a processor an hour.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchd.lab.plates.spectral_elements import RATE_HZ, Floats, Mesh, Solid, polynomials

PULSE_HZ, PULSE_S, DELAY_S = 75e3, 6e-6, 36e-6
"""Carrier, standard deviation and middle of the Gaussian pulse: 0.4 of its spectrum's peak at 40 and 110 kHz."""
LENGTH_S = 1e-3 + 2 * DELAY_S
FACE_PEAK = 1e4
"""Largest coefficient of each source's face as saved, so that half precision loses no small ones."""


def default_solid(width_mm: float, height_mm: float, thick_mm: float, **constants: Any) -> Solid:
    """Return a plate as `touchd.lab.plates.cases.make` makes it: a ruler's error off, with the default places."""
    places = np.array([(30.0, 100.0), (15.0, 15.0), (185.0, 20.0), (180.0, 185.0), (20.0, 170.0)])
    true = width_mm + 0.13, height_mm - 0.11, thick_mm * 0.996
    return Solid(true, places / 200 * [width_mm, height_mm], **constants)


def pulse_at(time_s: NDArray[Any]) -> Floats:
    """Return the force of the pulse, N."""
    t = time_s - DELAY_S
    return np.asarray(np.exp(-0.5 * (t / PULSE_S) ** 2) * np.cos(2 * np.pi * PULSE_HZ * t))


class Run(NamedTuple):
    """What D discs sense and the face does after each disc's pulse, T samples at `RATE_HZ`."""

    signals: Floats
    """Mean outward displacement of the rims, m, shape (D, D, T): emitter, receiver, sample."""
    face: Floats
    """Vertical displacement of the upper face in Legendre products, m^2, shape (D, T, nx, ny)."""
    missed: float
    """Share of the face's displacement, beyond twice the discs' radius, that the polynomials miss at the end."""
    dt_s: float


def simulate(mesh: Mesh, *, length_s: float = LENGTH_S, told_every: int = 0) -> Run:
    """Advance all sources together; print every `told_every` steps."""
    import torch

    count = len(mesh.solid.discs_mm)
    dt_s = mesh.time_step_s()
    a, b = mesh.damping()
    every, samples = round(1 / (RATE_HZ * dt_s)), round(length_s * RATE_HZ) + 1
    force = pulse_at(np.arange(every * samples) * dt_s)
    force[np.arange(len(force)) * dt_s > 2 * DELAY_S] = 0.0
    left, right = mesh.to_polynomials()
    u, v = mesh.rest(count), mesh.rest(count)
    signals, face = u.new_zeros(samples, count, count), u.new_zeros(samples, count, len(left), len(right))
    started_s = time.monotonic()
    with torch.inference_mode():
        for n in range(every * (samples - 1) + 1):
            if n % every == 0:
                signals[n // every] = mesh.sense(u)
                face[n // every] = left @ u[2, :, -1] @ right.T
            # In displacements and velocities, single precision suffices; in two displacements it does not.
            change = mesh.acceleration(torch.add(u, v, alpha=b), float(force[n]))
            v.mul_(1 - a * dt_s).add_(change, alpha=dt_s)
            u.add_(v, alpha=dt_s)
            if told_every and n % told_every == 0:
                if u.is_cuda:
                    torch.cuda.synchronize()
                spent_s = time.monotonic() - started_s
                sys.stdout.write(f"step {n} of {every * (samples - 1)}, {1e3 * spent_s / (n + 1):.2f} ms each, "
                                 f"largest {float(u.abs().max()):.3g} m\n")  # fmt: skip
                sys.stdout.flush()
    return Run(
        signals.permute(1, 2, 0).double().cpu().numpy(), face.transpose(0, 1).double().cpu().numpy(),
        _missed(mesh, u[2, :, -1].double().cpu().numpy()), dt_s,
    )  # fmt: skip


def _missed(mesh: Mesh, w: Floats) -> float:
    """Return the share of the nodes' deflections, of shape (D, Nx, Ny), that the face's polynomials miss."""
    left, right = (each.double().cpu().numpy() for each in mesh.to_polynomials())
    x, y, counts = mesh.x.nodes_m, mesh.y.nodes_m, mesh.face_counts()
    kept = polynomials(x, x[-1], counts[0]) @ (left @ w @ right.T) @ polynomials(y, y[-1], counts[1]).T
    apart_mm = [1e3 * np.hypot(x[:, None] - cx * 1e-3, y - cy * 1e-3) for cx, cy in mesh.solid.discs_mm]
    far = (np.min(apart_mm, axis=0) > mesh.solid.diameter_mm) * np.sqrt(mesh.x.weights_m[:, None] * mesh.y.weights_m)
    return float(np.linalg.norm((kept - w) * far) / np.linalg.norm(w * far))


def save(path: Path, solid: Solid, run: Run) -> None:
    """Save a run. The face is in half precision, 5e-4 of each coefficient, after scaling each source."""
    peak = np.abs(run.face).max(axis=(1, 2, 3))
    np.savez_compressed(
        path, signals=run.signals.astype(np.float32), face_scale=peak / FACE_PEAK, missed=run.missed, dt_s=run.dt_s,
        face=(run.face / peak[:, None, None, None] * FACE_PEAK).astype(np.float16), rate_hz=RATE_HZ,
        pulse=pulse_at(np.arange(run.signals.shape[2]) / RATE_HZ),
        **{f"solid_{name}": value for name, value in solid._asdict().items()},
    )  # fmt: skip


SOLIDS = {
    "solid-glass-5": default_solid(220, 160, 5),
    "solid-glass-3": default_solid(180, 180, 3),
    "solid-acrylic-6": default_solid(190, 140, 6, E_pa=3.25e9, nu=0.346, rho_kg_m3=1185.0, loss=0.03),
    "solid-discs-10": default_solid(220, 160, 5, diameter_mm=10.0, mass_g=0.6),
    "solid-discs-15": default_solid(220, 160, 5, diameter_mm=15.0, mass_g=1.34),
}
"""Plates by name, and the same with wider discs."""


def main() -> None:
    """Simulate plates and save each."""
    import torch

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("plates", nargs="*", default=list(SOLIDS), help=", ".join(SOLIDS))
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--single", action="store_true", help="compute in single precision")
    asked = parser.parse_args()
    for name in asked.plates:
        mesh = Mesh(SOLIDS[name], device=asked.device, double=not asked.single)
        sys.stdout.write(f"{name}: {mesh.x.count} x {mesh.y.count} elements, nodes {mesh.shape}, "
                         f"step {1e9 * mesh.time_step_s():.2f} ns\n")  # fmt: skip
        run = simulate(mesh, told_every=5000 if asked.device != "cpu" else 100)
        path = asked.folder / f"{name}.npz"
        save(path, mesh.solid, run)
        sys.stdout.write(f"{path}: {path.stat().st_size / 2**20:.1f} MiB, polynomials miss {run.missed:.2g}\n")


if __name__ == "__main__":
    main()
