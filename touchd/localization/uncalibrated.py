"""What localizes while there is no model: nothing is placed, and baseline, gate and health go on."""

from __future__ import annotations

from touchd.config.schema import Settings
from touchd.detection.baseline import Signal
from touchd.detection.detection import Detection
from touchd.keypad import Layout
from touchd.localization.localization import UNTOUCHED, Localization
from touchd.outcome import Outcome

_NOTHING = Localization(Outcome.UNCALIBRATED)


class Uncalibrated:
    """Places no finger; see `Localizer`."""

    model_fit: float | None = None
    stretch: float | None = None

    def configure(self, settings: Settings, layout: Layout | None) -> None:
        """Take nothing."""

    def reset(self) -> None:
        """Forget nothing."""

    def update(self, baseline: Signal, residuals: Signal | None = None) -> None:
        """Take nothing."""

    def follow(self, detection: Detection) -> None:
        """Follow no finger."""

    def localize(self, detection: Detection, *, alive: bool, complete: bool = False) -> Localization:  # noqa: ARG002 - the protocol's
        """Say that there is no model."""
        return _NOTHING

    def observe(self, detection: Detection) -> Localization:  # noqa: ARG002 - the protocol's
        """Say that the plate is untouched."""
        return UNTOUCHED

    def spectrum(self, detection: Detection) -> list[float]:  # noqa: ARG002 - the protocol's
        """Return nothing: a spectrum is a model's input."""
        return []
