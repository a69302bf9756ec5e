"""Measures how fast the drift correction follows a step of the plate under a finger."""

from __future__ import annotations

import numpy as np
import pytest

from touchd.localization.atlas import Atlas
from touchd.localization.drift import Drift

LEAST = 0.15
"""A smaller share of the step is too near to the noise to be fitted."""


class Updates:
    """Records the updates of the correction: their times, and what the fingers left of the bins then."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.t_ns: list[int] = []
        self.unexplained: list[np.ndarray] = []
        update = Drift.update

        def recorded(drift: Drift, unexplained: np.ndarray, t_ns: int) -> None:
            self.t_ns.append(t_ns)
            self.unexplained.append(unexplained.copy())
            update(drift, unexplained, t_ns)

        monkeypatch.setattr(Drift, "update", recorded)

    def time_constant_s(self, atlas: Atlas, step: np.ndarray, step_ns: int) -> float:
        """The time constant of what is left of a step of the residual, (channels, samples), from a time on.

        An update removes what has come since the one before it. So before update k, the first after the step being 0,
        exp(-t / time constant) of the step is left, t from the last update before the step to update k - 1.
        """
        bins = np.zeros(atlas.size, atlas.coefficients.dtype)
        Drift(atlas).correct(step.astype(bins.dtype), bins)
        left = np.array([row @ bins / (bins @ bins) for row in self.unexplained])
        first = int(np.searchsorted(self.t_ns, step_ns))
        left -= left[first - 20 : first].mean() if first > 20 else 0.0
        before_s = (np.array(self.t_ns[first - 1 : -1]) - self.t_ns[first - 1]) * 1e-9
        share = left[first:] / left[first]
        use = np.cumsum(share < LEAST) == 0
        print(np.round(before_s[use], 3), np.round(share[use], 3))
        return float(-1 / np.polyfit(before_s[use], np.log(share[use]), 1)[0])
