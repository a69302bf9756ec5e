"""What localization says of one frame, and the contract of what says it."""

from __future__ import annotations

from typing import Protocol

from msgspec import Struct

from touchd.config.schema import Settings
from touchd.detection.baseline import Signal
from touchd.detection.detection import Detection
from touchd.keypad import Layout
from touchd.outcome import Outcome
from touchd.touch import PalmArea, Touch


class Localization(Struct, gc=False, frozen=True):
    """What came of one frame."""

    outcome: Outcome
    """UNTOUCHED, FAINT, STILL, TRACKED, INFERRED or UNCALIBRATED."""
    touches: tuple[Touch, ...] = ()
    departure: bool = False
    """Whether the negative of the residual is a finger: one that the baseline held has lifted."""
    plate_moved: bool = False
    """Whether the residual is the plate's own movement, of temperature, delay or gains, and no finger."""
    palm: PalmArea | None = None
    """Where a palm lies, if one does."""


UNTOUCHED = Localization(Outcome.UNTOUCHED)
RINGS = Localization(Outcome.FAINT)
"""Of a frame in which the plate rings from a knock: it hides the fingers that are down."""
SETTLES_NS = 50_000_000
"""Soon after such frames there may be fingers that are not found."""


class Localizer(Protocol):
    """Places fingers, frame by frame."""

    @property
    def model_fit(self) -> float | None:
        """Share of a touch's energy that the model explains, 0..1; None where it cannot be told."""

    @property
    def stretch(self) -> float | None:
        """Relative rise of the plate's resonances since training; None where it cannot be told."""

    def configure(self, settings: Settings, layout: Layout | None) -> None:
        """Take other thresholds and keys from the next frame on; fingers stay where that can be."""

    def reset(self) -> None:
        """Forget all fingers."""

    def update(self, baseline: Signal, residuals: Signal | None = None) -> None:
        """Take another baseline, (channels, samples), and residuals that tell its noise, (n, ...); else that stays."""

    def follow(self, detection: Detection) -> Localization | None:
        """Return the fingers of the last frame in a touched one, before anything else is looked for in it.

        None unless noise is all that they leave of it, beside what they left of the last one: `localize` it then.
        """

    def localize(self, detection: Detection, *, alive: bool, complete: bool = False) -> Localization:
        """Return the fingers of a touched frame.

        Parameters
        ----------
        detection : Detection
        alive : bool
            Whether a contact is down: less confidence is required then.
        complete : bool
            Whether to finish a search for further fingers in this frame, however long it takes.
        """
        ...

    def observe(self, detection: Detection) -> Localization:
        """Follow noise and temperature on an untouched frame."""
        ...

    def spectrum(self, detection: Detection) -> list[float]:
        """Return the model's input for a frame."""
        ...
