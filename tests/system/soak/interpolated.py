"""An instrument that computes what a resting or gliding contact changes in some frames, and interpolates between."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.twin.instrument import Instrument
from touchd.twin.physics.contact import size_of
from touchd.twin.physics.finger import Contact

Floats = NDArray[np.float64]
Touch = Sequence[Contact]

NODES = 6
WAVE_RAD_MM, AREA_RAD = 0.6, 1.0
"""Phase of the way to and from a contact, a millimetre, and a bound for what its area, ratio and direction turn."""
SMOOTH_RAD, REACH_RAD = 0.05, 2.0
"""A path goes on while its step changes by no more than the first from frame to frame, and up to the second: what is
interpolated then errs by 70 dB less than the contact changes the signal."""


class Interpolated(Instrument):
    """Ten times as fast where fingers rest, three times where they tap; exact where they land, lift or move fast.

    Trigger jitter must be 0.
    """

    def change(self, touches: Sequence[Touch], temperature_c: ArrayLike, late_s: ArrayLike = 0.0) -> Floats:
        """Return the change (n, R, S) of the signals; see `Instrument.change`."""
        assert not np.any(late_s)
        temperature = np.broadcast_to(np.asarray(temperature_c, float), (len(touches),))
        chosen: list[int] = []
        runs: list[tuple[int, int, NDArray[np.int64], int]] = []
        for first, stop in _runs(touches):
            nodes = np.arange(first, stop)
            if stop - first > NODES:
                at = (1 - np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)) / 2 * (stop - 1 - first)
                nodes = first + np.unique(np.rint(at).astype(int))
            runs.append((first, stop, nodes, len(chosen)))
            chosen += nodes.tolist()
        known = super().change([touches[i] for i in chosen], temperature[chosen])
        result = np.zeros((len(touches), *known.shape[1:]))
        for first, stop, nodes, start in runs:
            own = known[start : start + len(nodes)]
            result[first:stop] = np.tensordot(_weights(np.arange(first, stop), nodes), own, 1)
        return result


def _runs(touches: Sequence[Touch]) -> list[tuple[int, int]]:
    """Return the first frame of each smooth path, and the one after its last; untouched frames belong to none."""
    runs: list[tuple[int, int]] = []
    first, way, before = 0, 0.0, None
    for i, touch in enumerate(touches):
        step = _step(touches[i - 1], touch) if i > first else None
        if i > first:
            smooth = step is not None and (before is None or np.abs(step - before).max() < SMOOTH_RAD)
            way += 0.0 if step is None else float(np.abs(step).max())
            if not smooth or way > REACH_RAD:
                runs.append((first, i))
                first, way, step = i, 0.0, None
        before = step
    runs.append((first, len(touches)))
    return [(first, stop) for first, stop in runs if touches[first]]


def _step(one: Touch, other: Touch) -> Floats | None:
    """Return what turns from one frame to the next, rad; None if contacts come, go or get other forces."""
    if not one or [(c.kind, size_of(c)) for c in one] != [(c.kind, size_of(c)) for c in other]:
        return None
    rows = []
    for a, b in zip(one, other, strict=True):
        oval = b.ratio * np.exp(2j * b.angle_rad) - a.ratio * np.exp(2j * a.angle_rad)
        rows.append([
            WAVE_RAD_MM * (b.x_mm - a.x_mm), WAVE_RAD_MM * (b.y_mm - a.y_mm),
            AREA_RAD * np.log(b.area_mm2 / a.area_mm2), AREA_RAD * oval.real, AREA_RAD * oval.imag,
        ])  # fmt: skip
    return np.array(rows)


def _weights(at: NDArray[np.int64], nodes: NDArray[np.int64]) -> Floats:
    """Return the weights of Lagrange's interpolation, shape (n, m)."""
    others = ~np.eye(len(nodes), dtype=bool)
    return np.stack(
        [np.prod((at[:, None] - nodes[o]) / (nodes[k] - nodes[o]), axis=1) for k, o in enumerate(others)], axis=1
    )
