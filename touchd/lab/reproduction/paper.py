"""Figures of the source paper: Bahrami, Moriot, Masson and Grondin, Sensors 22:3183, 2022 (arXiv 2202.08947)."""

from __future__ import annotations

from typing import NamedTuple


class Reported(NamedTuple):
    """A mean error with its standard deviation, mm."""

    mean_mm: float
    sd_mm: float | None


HEADS: dict[tuple[str, str], Reported] = {
    ("C-2", "frequency"): Reported(21.8, 8.5),
    ("C-2", "time"): Reported(21.0, 8.0),
    ("C-10", "frequency"): Reported(4.1, 2.5),
    ("C-10", "time"): Reported(4.0, 2.4),
    ("R", "frequency"): Reported(4.4, 2.0),
    ("R", "time"): Reported(4.5, 2.1),
}
"""By head and domain; the paper gives C-3 to C-9 as a curve only."""
C10_ACCURACY = 0.90
CIRCLE: dict[str, Reported] = {"R": Reported(4.7, 1.8), "C-10": Reported(6.9, 2.9), "C-5": Reported(10.0, 5.4)}
"""A human finger on models trained with the silicone finger; the paper states "over 1 cm" for C-5."""
REGRESSION_MS, KEYPAD_MS = 0.44, 0.28
KEYPAD_MATRIX_ACCURACY = 595 / 627
KEYPAD_LEARNING = {1.0: (0.97, 0.96), 0.2: (0.89, 0.87)}
"""Accuracy of network and kNN, by share of the training data."""
KNN_SLOWER = 11.67

CENTRAL_MM = 110.0
"""Side of the central square that the paper's figures for C-N imply."""


def perfect_mean_mm(side_mm: float, n: int) -> float:
    """Return the mean distance of a point to the centre of its zone, on an n x n grid over a square.

    The mean distance of a square's points to its centre is side * (sqrt(2) + arsinh(1)) / 6.
    """
    return side_mm / n * 0.3825978582
