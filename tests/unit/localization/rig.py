"""An atlas localizer on the plate of `tests.fields`, shown one residual after the other."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from tests.fields import RIG, Field, Finger, make_atlas
from touchd.config.schema import Settings
from touchd.detection.detection import Detection
from touchd.localization.atlas import Atlas
from touchd.localization.atlas_localizer import AtlasLocalizer
from touchd.localization.localization import Localization
from touchd.localization.model import Estimate, Model
from touchd.outcome import Outcome
from touchd.touch import Touch

FIELD = Field()
ATLAS = make_atlas(FIELD)
FRAME_NS = 4_000_000
QUIET = 0.5
"""Standard deviation of a sample's noise, ADC counts."""
NO_SKIP = Settings.model_validate({"skip": {"still": False}})


class Network:
    """Stands in for a network: it sees a finger at `near_mm`, and counts its runs."""

    description = SimpleNamespace(acquisition=RIG, domain="time", taper=1.0, input="residual")
    dtype = np.dtype(np.float32)

    def __init__(self) -> None:
        self.features = np.zeros((1, RIG.channels * RIG.samples), np.float32)
        self.near_mm = (60.0, 45.0)
        self.runs = 0

    def estimate(self) -> Estimate:
        self.runs += 1
        return Estimate(*self.near_mm, 1.0, 1.0)


class Rig:
    """A localizer that knows the noise of its untouched plate. Time goes on by `frame_ns` a frame."""

    def __init__(
        self,
        noise: float = QUIET,
        atlas: Atlas = ATLAS,
        *,
        frame_ns: int = FRAME_NS,
        settings: Settings = NO_SKIP,
    ) -> None:
        self.noise, self.atlas, self.frame_ns = noise, atlas, frame_ns
        self.t_ns, self._seed = 0, 0
        self.baseline, self.live = atlas.baseline, np.ones(RIG.channels, bool)
        self.network = Network()
        self.localizer: Any = AtlasLocalizer(cast(Model, self.network), atlas, settings, None)
        self.learn()

    def learn(self) -> None:
        self.localizer.update(self.baseline, np.stack([self.residual() for _ in range(64)]))

    def residual(self, *fingers: Finger) -> np.ndarray:
        self._seed += 1
        return FIELD.residual(list(fingers), self.noise, self._seed)

    def detection(self, residual: np.ndarray, outcome: Outcome = Outcome.TOUCHED) -> Detection:
        """The next frame."""
        self.t_ns += self.frame_ns
        residual = residual.astype(np.float32)
        energy = float(residual.ravel() @ residual.ravel())
        noise_root = (self.noise**2 * residual.size) ** (1 / 3)
        return Detection(
            outcome, self.t_ns, energy, noise_root, 0.0, residual + self.baseline, residual, self.baseline, self.live
        )

    def see(self, residual: np.ndarray, near_mm: tuple[float, float] = (60.0, 45.0)) -> Localization:
        """Localize a frame in which the network sees a finger near a position."""
        self.network.near_mm = near_mm
        found: Localization = self.localizer.localize(self.detection(residual), alive=False)
        return found

    def touch(self, *fingers: Finger) -> tuple[Touch, ...]:
        """Localize a frame of fingers, of which the network sees the first, a millimetre off."""
        near_mm = (fingers[0][0] + 0.7, fingers[0][1] - 0.7) if fingers else (60.0, 45.0)
        touches: tuple[Touch, ...] = self.see(self.residual(*fingers), near_mm).touches
        return touches

    def land(self, *fingers: Finger) -> tuple[Touch, ...]:
        """Localize frames of fingers until a search for what has come has surely ended; return the last one's."""
        return [self.touch(*fingers) for _ in range(8)][-1]

    def lift(self, frames: int = 1) -> None:
        """Show an untouched plate with the gate closed."""
        for _ in range(frames):
            self.localizer.observe(self.detection(self.residual(), Outcome.UNTOUCHED))


def at(touches: tuple[Touch, ...], *positions_mm: tuple[float, float], within_mm: float = 0.2) -> bool:
    """Whether there is one touch at each position, and no other."""
    return len(touches) == len(positions_mm) and all(
        any(math.dist((t.x_mm, t.y_mm), position) < within_mm for t in touches) for position in positions_mm
    )
