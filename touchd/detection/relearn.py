"""What stays on the plate: when a change that is no moving finger becomes part of the baseline."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from touchd.config.schema import BaselineSettings
from touchd.detection.baseline import Signal


class Verdict(StrEnum):
    """Why the plate as it now is shall be the new baseline."""

    ABSORBED = "absorbed"
    """It has stayed the same for `absorb_s`: a thing left on the plate, or a finger that rests there."""
    LIFTED = "lifted"
    """The negative of the change is a finger: one that was part of the baseline has gone."""
    NOISE = "noise"
    """It never repeats itself: the noise has grown."""


# The change counts as the same while what differs is under this share of its energy, and as noise while
# one frame differs from the one before by more than this share (2 on average for independent frames).
_SAME_BELOW = 0.25
_NOISE_ABOVE = 1.5
# A finger that is being followed is compared with where it was so often: what stays does so for seconds.
_LOOK_NS = 50_000_000
# One odd frame during a press must not cost the baseline.
_LIFTED_FRAMES = 3


class Standing:
    """Follows the residual while the gate is open, and says when it has become the normal state."""

    def __init__(self, shape: tuple[int, int], settings: BaselineSettings) -> None:
        self.retune(settings)
        size = shape[0] * shape[1]
        self._reference = np.zeros(size, np.float32)
        self._reference_energy = 0.0
        self._previous = np.zeros(size, np.float32)
        self._previous_energy = 0.0
        self._product = np.zeros((), np.float32)
        self.clear()

    def retune(self, settings: BaselineSettings) -> None:
        """Take other times; a change that lies on the plate already keeps its age."""
        self._absorb_ns = round(settings.absorb_s * 1e9)
        self._unsteady_ns = round(settings.unsteady_s * 1e9)

    def clear(self) -> None:
        """Forget everything: the gate has closed."""
        self._same_since_ns: int | None = None
        self._noise_since_ns = self._looked_ns = 0
        self._follows = False  # whether `_previous` is the frame before
        self._unlike = 0.0
        self._lifted = 0

    def watch(self, t_ns: int, residual: Signal, energy: float, *, finger: bool, leaving: bool) -> Verdict | None:
        """Take in one frame seen with the gate open.

        Parameters
        ----------
        t_ns : int
            Time of the frame.
        residual, energy : array of shape (channels, samples), float
            The frame less the baseline, and its energy.
        finger : bool
            Whether a finger was found in it, or is still being tracked.
        leaving : bool
            Whether the negative of the residual looks like a finger.
        """
        if self._same_since_ns is None:
            self._begin(t_ns, residual.reshape(-1), energy)
            self._noise_since_ns = self._looked_ns = t_ns
            return None
        if finger:  # no noise, whatever it does, and nothing that has gone: what it differs by need seldom be known
            self._noise_since_ns, self._follows, self._lifted = t_ns, False, 0
            if 0 <= t_ns - self._looked_ns < _LOOK_NS and t_ns - self._same_since_ns < self._absorb_ns:
                return None
        self._looked_ns = t_ns
        flat = residual.reshape(-1)
        if self._distance(flat, energy, self._reference, self._reference_energy) > _SAME_BELOW * energy:
            self._begin(t_ns, flat, energy)
        if not finger:
            self._compare(t_ns, flat, energy)
            self._lifted = self._lifted + 1 if leaving else 0

        if self._lifted >= _LIFTED_FRAMES:
            return Verdict.LIFTED
        if t_ns - self._same_since_ns >= self._absorb_ns:
            return Verdict.ABSORBED
        if t_ns - self._noise_since_ns >= self._unsteady_ns:
            return Verdict.NOISE
        return None

    def _begin(self, t_ns: int, flat: Signal, energy: float) -> None:
        self._same_since_ns = t_ns
        self._reference[...] = flat
        self._reference_energy = energy

    def _compare(self, t_ns: int, flat: Signal, energy: float) -> None:
        """Follow how much each frame differs from the one before."""
        if self._follows:
            # A running mean over some ten frames: one frame alone can resemble the one before by chance.
            unlike = self._distance(flat, energy, self._previous, self._previous_energy) / energy
            self._unlike += 0.1 * (unlike - self._unlike)
        if self._unlike < _NOISE_ABOVE:
            self._noise_since_ns = t_ns
        self._previous[...] = flat
        self._previous_energy = energy
        self._follows = True

    def _distance(self, a: Signal, a_energy: float, b: Signal, b_energy: float) -> float:
        """Return the energy of the difference, by one product: a millionth of the energies is lost to rounding."""
        a.dot(b, self._product)
        return a_energy + b_energy - 2.0 * self._product.item()
