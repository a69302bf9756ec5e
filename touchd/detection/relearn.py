"""When the baseline is relearned: what stays on the plate becomes part of it."""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import DTypeLike

from touchd.config.schema import BaselineSettings
from touchd.detection.baseline import Signal


class Reason(StrEnum):
    """Why the baseline is relearned."""

    ABSORBED = "absorbed"
    """The change has stayed the same for `absorb_s`: an object left on the plate, or a finger that rests there."""
    LIFTED = "lifted"
    """The negative of the change is a finger: one that was part of the baseline has lifted."""
    NOISE = "noise"
    """The change never repeats: the noise has grown."""


_SAME_BELOW = 0.25
"""The change is the same while less than this share of its energy differs."""
_NOISE_ABOVE, _INDEPENDENT = 1.5, 2.0
"""The change is noise while successive frames differ by more than this share; independent frames differ by 2, and one
that follows a far louder one, as after a knock, says no more."""
_LOOK_NS = 50_000_000
"""A tracked finger is compared with its reference this often: what stays does so for seconds."""
_GAP_NS = 2_000_000_000
"""What the plate did while no frame came for so long is unknown: nothing has stayed the same."""
_UNSTEADY_NS = 1_000_000_000
"""A change without a finger that never repeats for this long is noise."""
_RESTLESS_NS = 2_000_000_000
"""A change without a finger that goes on for this long, and has not stayed the same, is interference or water."""
_REST_NS = 300_000_000
"""What stays is not absorbed while another contact moves, lands or lifts, nor this soon after: the plate could not be
learned under it, and it would end. At most it waits as long again."""
_LIFTING_FRAMES, _LIFTED_FRAMES = 4, 16
"""What has lifted is gone after 4 frames, and the next 16 tell what it has left: with a sixteenth of one's noise."""
_PRESSED_NS = 10_000_000_000
"""They need not be in a row: a key that was held is pressed again before. What it left at most so long ago counts."""


class Relearn:
    """Follows the residual while the gate is open, and decides when it has become the normal state."""

    def __init__(self, shape: tuple[int, int], settings: BaselineSettings, dtype: DTypeLike = np.float32) -> None:
        self.configure(settings)
        size = shape[0] * shape[1]
        self._reference = np.zeros(size, dtype)
        self._reference_energy = 0.0
        self._previous = np.zeros(size, dtype)
        self._previous_energy = 0.0
        self._product = np.zeros((), dtype)
        self.left: Signal = np.zeros(shape, dtype)
        """What a finger leaves that was part of the baseline and has lifted, shape (channels, samples)."""
        self._left_frames = self._left_ns = 0  # frames that it is the mean of, and the last one's time
        self.reset()

    def configure(self, settings: BaselineSettings) -> None:
        """Take other times; a change already on the plate keeps its age."""
        self._absorb_ns = round(settings.absorb_s * 1e9)

    def reset(self) -> None:
        """Start with the next frame: the gate has closed."""
        self.active = False
        """Whether the gate has been open since the last reset."""
        self._same_since_ns: int | None = None
        self._noise_since_ns = self._looked_ns = self._fingerless_since_ns = 0
        self._moved_ns = -_REST_NS
        self._follows = False  # whether `_previous` is the predecessor
        self._unlike = 0.0
        self._lifted = 0

    def update(
        self, t_ns: int, residual: Signal, energy: float, finger: bool, departure: bool, moving: bool = False
    ) -> Reason | None:
        """Add a frame seen with the gate open, and return the reason to relearn the baseline, if there is one.

        Parameters
        ----------
        t_ns : int
        residual, energy : array of shape (channels, samples), float
            The frame less the baseline, and its energy.
        finger : bool
            Whether a finger was found in the frame, or a contact is down.
        departure : bool
            Whether the negative of the residual is a finger.
        moving : bool
            Whether a contact moves, lands or lifts.
        """
        self.active = True
        if moving:
            self._moved_ns = t_ns
        if self._same_since_ns is None or t_ns - self._looked_ns > _GAP_NS:
            self._begin(t_ns, residual.reshape(-1), energy)
            self._noise_since_ns = self._looked_ns = self._fingerless_since_ns = t_ns
            return None
        if finger:  # neither noise nor a departure: what the frame differs by is seldom needed
            self._noise_since_ns = self._fingerless_since_ns = t_ns
            self._follows, self._lifted = False, 0
            if 0 <= t_ns - self._looked_ns < _LOOK_NS and t_ns - self._same_since_ns < self._absorb_ns:
                return None
        self._looked_ns = t_ns
        flat = residual.reshape(-1)
        if self._distance(flat, energy, self._reference, self._reference_energy) > _SAME_BELOW * energy:
            self._begin(t_ns, flat, energy)
        if not finger:
            self._compare(t_ns, flat, energy)
            self._follow_departure(t_ns, residual, energy, departure)
        if self._left_frames == _LIFTED_FRAMES:
            self._left_frames = 0
            return Reason.LIFTED
        same_ns = t_ns - self._same_since_ns
        if same_ns >= self._absorb_ns:
            waits = same_ns < 2 * self._absorb_ns and 0 <= t_ns - self._moved_ns < _REST_NS
            return None if waits else Reason.ABSORBED
        if t_ns - self._noise_since_ns >= _UNSTEADY_NS:
            return Reason.NOISE
        return None

    @property
    def restless(self) -> bool:
        """Whether a change without a finger has gone on for 2 s, and was another one a second after it began."""
        since_ns = self._fingerless_since_ns
        return (
            self._same_since_ns is not None
            and self._looked_ns - since_ns >= _RESTLESS_NS
            and self._same_since_ns - since_ns >= _UNSTEADY_NS
        )

    def _follow_departure(self, t_ns: int, residual: Signal, energy: float, departure: bool) -> None:
        """Average what a finger has left that was part of the baseline, also beyond presses at its place."""
        self._lifted = self._lifted + 1 if departure else 0
        first = self._lifted - _LIFTING_FRAMES
        if first < 1:
            return
        if first == 1 and not (
            0 <= t_ns - self._left_ns < _PRESSED_NS
            and float(np.square(residual - self.left).sum()) < _SAME_BELOW * energy
        ):
            self._left_frames = 0
            self.left[...] = 0
        self._left_frames, self._left_ns = self._left_frames + 1, t_ns
        self.left += (residual - self.left) / self._left_frames

    def _begin(self, t_ns: int, flat: Signal, energy: float) -> None:
        self._same_since_ns = t_ns
        self._reference[...] = flat
        self._reference_energy = energy

    def _compare(self, t_ns: int, flat: Signal, energy: float) -> None:
        """Follow how much each frame differs from its predecessor."""
        if self._follows:
            # A running mean over some ten frames: one frame alone can resemble its predecessor by chance.
            unlike = self._distance(flat, energy, self._previous, self._previous_energy) / energy
            self._unlike += 0.1 * (min(unlike, _INDEPENDENT) - self._unlike)
        if self._unlike < _NOISE_ABOVE:
            self._noise_since_ns = t_ns
        self._previous[...] = flat
        self._previous_energy = energy
        self._follows = True

    def _distance(self, a: Signal, a_energy: float, b: Signal, b_energy: float) -> float:
        """Return the energy of the difference, by one product: a millionth of the energies is lost to rounding."""
        a.dot(b, self._product)
        product: float = self._product.item()
        return a_energy + b_energy - 2.0 * product
