"""Jobs of each recording, by name."""

from __future__ import annotations

from touchd.jobs import Job
from touchd.keypad import Layout
from touchd.lab.reproduction.experiments import looked_up, trained

DOMAINS = ("frequency", "time")
GRIDS = tuple(range(2, 11))
HEADS = ("R", *(f"C-{n}" for n in GRIDS))
SHARES = (1.0, 0.8, 0.6, 0.4, 0.2)
KEYPAD_RECIPE, PLATE_RECIPE = "keypad", "best"
"""Recipes compared with the paper's."""
KEYPAD_SEEDS = (0, 1, 2)
"""Seeds of the repeated keypad trainings and splits, because the differences there are small."""


def head_jobs(seed: int, epochs: int | None) -> list[Job]:
    """Return the trainings of the paper's regression and grid networks, in both domains."""
    jobs = []
    for domain in DOMAINS:
        prefix = "paper" if domain == "frequency" else "time"
        for head in HEADS:
            grid = int(head[2:]) if head != "R" else 0
            recipe = f"{prefix}-grid" if grid else f"{prefix}-regression"
            arguments = {"recipe": recipe, "grid": grid, "seed": seed, "epochs": epochs}
            jobs.append(Job(head_name(head, domain), trained, arguments, ("recording",)))
    return jobs


def keypad_jobs(seed: int, epochs: int | None, layout: Layout) -> list[Job]:
    """Return the trainings of the keypad on shares of the training part, and the kNN look-ups on them."""
    jobs = []
    for share in SHARES:
        for more in KEYPAD_SEEDS:
            chosen = {"seed": seed + more, "share": share}
            arguments = {"recipe": "paper-keypad", "layout": layout, "epochs": epochs, **chosen}
            jobs.append(Job(keypad_name(share, more), trained, arguments, ("recording",)))
            lookup = {"method": "kNN", "residual": False, **chosen}
            jobs.append(Job(lookup_name(share, more), looked_up, lookup, ("recording",)))
    return jobs


def better_jobs(seed: int, epochs: int | None, layout: Layout) -> list[Job]:
    """Return our keypad on the smallest share, and the dictionaries of spectra and residuals."""
    arguments = {"recipe": KEYPAD_RECIPE, "layout": layout, "epochs": epochs, "seed": seed}
    jobs = [Job(BETTER_KEYPAD, trained, arguments | {"share": SHARES[-1]}, ("recording",))]
    for method in ("kNN", "GCC"):
        for residual in (False, True):
            lookup = {"method": method, "residual": residual, "seed": seed}
            jobs.append(Job(dictionary_name(method, residual), looked_up, lookup, ("recording",)))
    return jobs


def plate_jobs(seed: int, epochs: int | None) -> list[Job]:
    """Return the training on another plate, for which nothing was tuned."""
    return [Job(OTHER_PLATE, trained, {"recipe": PLATE_RECIPE, "epochs": epochs, "seed": seed}, ("recording",))]


BETTER_KEYPAD = f"keypad, {SHARES[-1]:.0%} of the touches"
OTHER_PLATE = "best, another plate"


def head_name(head: str, domain: str) -> str:
    """Return the name of a head's job."""
    return f"{head}, {domain}"


def keypad_name(share: float, seed: int) -> str:
    """Return the name of a keypad training."""
    return f"paper-keypad, {share:.0%}, seed {seed}"


def lookup_name(share: float, seed: int) -> str:
    """Return the name of a kNN look-up on a share of the touches."""
    return f"kNN, {share:.0%}, seed {seed}"


def dictionary_name(method: str, residual: bool) -> str:
    """Return the name of a look-up among all touches."""
    return f"{method} on {'residuals' if residual else 'spectra'}"
