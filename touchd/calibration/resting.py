"""Tell whether what a fit leaves of the untouched response is what a finger that rests on the plate changes.

A finger is a small mass and a small dashpot at a place (Born). Beside what the unknowns of the fit could take of it,
the two explain most of what is left; what holes, buttons and glue leave a mass alone explains.
"""

from __future__ import annotations

import numpy as np

from touchd.calibration.candidates import grid
from touchd.calibration.parameters import wavelength_mm
from touchd.calibration.reduced_plate import Floats
from touchd.calibration.stages import WHOLE, State, variance_of, window_of
from touchd.calibration.untouched_model import UntouchedModel

PER_WAVE = 10.0
"""Places looked at per wavelength, along each axis."""
FINER = np.stack(np.meshgrid(*2 * (np.linspace(-0.8, 0.8, 5),)), axis=-1).reshape(-1, 2)
"""Beside the best of them, in steps of that grid."""
EXPLAINED, DAMPED = 0.45, 0.12
"""Shares of what is left that a finger explains, and that its dashpot explains beside its mass. On glass 11 of 12
fingertips and thumbs of 44 mm^2 and more exceed both, on acrylic, where fits leave more, 1 of 8; of 33 plates with
nothing on them none does, and of holes, buttons and beads of glue the dashpot explains up to 0.04 (other simulator)."""
WHAT = (
    "something at ({:.0f}, {:.0f}) mm damps waves, as a finger does: lift it and record again, unless it is a glued "
    "foot"
)
"""For a person."""


def resting(model: UntouchedModel, state: State) -> tuple[float, float] | None:
    """Return the place, mm, of a finger that explains what a fit of the whole frame leaves; None if there is none."""
    reader, at = model.reader, model.reader.index(state.names)
    residual, prior = state.fitted.residual, reader.prior[at]
    root = 1 / np.sqrt(variance_of(residual, window_of(model, WHOLE), model.noise))[:, None]
    slopes = (state.fitted.slopes * root).reshape(len(at), -1)
    Q = np.linalg.qr(np.concatenate([slopes, np.diag(1 / prior)], axis=1).T)[0]
    left = np.concatenate([(residual * root).ravel(), (state.p - reader.start)[at] / prior])
    left -= Q @ (Q.T @ left)
    Q, found, energy = Q[: residual.size], left[: residual.size], float(left @ left)
    ratio = model.nu_rad_s / np.mean(model.nu_rad_s.real)
    loads = np.stack([ratio**2, -1j * ratio])  # of a mass, and of a dashpot

    def explained(places_mm: Floats) -> Floats:
        """Return the shares that both explain, and the mass alone, and the dashpot's strength, shape (n, 3)."""
        rows = []
        for changes in model.changes(state.p, state.fitted, 1e-3 * places_mm, loads):
            changed = (changes * root).reshape(*changes.shape[:2], -1)
            taken, met = changed @ Q, changed @ found
            normal = changed @ changed.transpose(0, 2, 1) - taken @ taken.transpose(0, 2, 1)
            strength = np.linalg.solve(normal, met[..., None])[..., 0]
            both, mass = (met * strength).sum(axis=1), met[:, 0] ** 2 / normal[:, 0, 0]
            rows.append(np.stack([both / energy, mass / energy, strength[:, 1]], axis=1))
        return np.concatenate(rows)

    plate = reader.plate(state.p)
    step_mm = wavelength_mm(plate, model.untouched.acquisition.chirp) / PER_WAVE
    places_mm = grid(*plate.size_mm, step_mm, step_mm)
    best_mm = places_mm[explained(places_mm)[:, 0].argmax()]
    places_mm = np.clip(best_mm + step_mm * FINER, 0.0, plate.size_mm)
    shares = explained(places_mm)
    best = int(shares[:, 0].argmax())
    both, mass, damping = shares[best]
    if both < EXPLAINED or both - mass < DAMPED or damping < 0:
        return None
    x_mm, y_mm = places_mm[best].tolist()
    return x_mm, y_mm
