"""Recipes of `touchd train`: network, features and schedule."""

from __future__ import annotations

from dataclasses import dataclass

from touchd.localization.features import Domain
from touchd.localization.model import Head

TRUNK = (400, 300, 200, 100)
"""Widths of the paper's regression and grid networks."""
BEST_TRUNK = (400, 300, 200, 64)
"""The paper's widths, except for the last: with two histograms, sigma, confidence and one projected drift direction the
network needs no more multiply-adds than the paper's regression."""
SMALL_TRUNK = (64, 48, 40, 40)
"""A tenth of the multiply-adds of `BEST_TRUNK`."""
KEYPAD_TRUNK = (100, 50)
"""Widths of the paper's keypad network."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """One way to train a model."""

    name: str
    head: Head
    what: str
    """One line for the help text."""
    domain: Domain = "frequency"
    widths: tuple[int, ...] = TRUNK
    paper: bool = False
    """Train as in the paper: plain features, dropout, Adam, no augmentation. Otherwise train on normalised residuals,
    with touches drawn from the learned field and augmented by all disturbances."""
    epochs: int = 800
    atlas: bool = False
    """Whether to train a field atlas beside the network."""


RECIPES = {
    recipe.name: recipe
    for recipe in (
        Recipe("best", "regression", "position, standard error and confidence of one finger", widths=BEST_TRUNK),
        Recipe(
            "atlas",
            "regression",
            "best, with a field atlas that is ten times more precise",
            widths=BEST_TRUNK,
            atlas=True,
        ),
        Recipe("small", "regression", "best with a tenth of the multiply-adds", widths=SMALL_TRUNK),
        Recipe("grid", "grid", "zones of an N x N grid, trained like best", epochs=400),
        Recipe("keypad", "keypad", "keys of a layout, trained like best, mostly near their borders", widths=BEST_TRUNK),
        Recipe("paper-regression", "regression", "the paper's regression network", paper=True, epochs=120),
        Recipe("paper-grid", "grid", "the paper's grid classifier C-N", paper=True, epochs=120),
        Recipe("paper-keypad", "keypad", "the paper's keypad", widths=KEYPAD_TRUNK, paper=True, epochs=120),
        Recipe("time-regression", "regression", "the paper's, in the time domain", "time", paper=True, epochs=120),
        Recipe("time-grid", "grid", "the paper's C-N in the time domain", "time", paper=True, epochs=120),
        Recipe("time-keypad", "keypad", "the paper's keypad in the time domain", "time", KEYPAD_TRUNK, True, 120),
    )
}
