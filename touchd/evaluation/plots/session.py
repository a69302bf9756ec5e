"""Plot a replayed session (matplotlib, extra `train`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from touchd.evaluation.replay_scores import found_contacts
from touchd.evaluation.truth import true_touches
from touchd.event import TouchEvent
from touchd.files import replacing
from touchd.recording.data import Meta, Recording

TRUTH = "#b0b7bf"
COLOURS = ("#0b6e99", "#d1495b", "#3a7d44", "#e28413", "#6a4c93", "#2f4858", "#8f2d56", "#218380")


def draw_session(recording: Recording, events: list[TouchEvent], path: Path) -> None:
    """Plot true touches and published contacts on the plate, and x and y over time.

    Raises OutputError if the file cannot be written.
    """
    figure = Figure(figsize=(10.5, 5.0), layout="constrained")
    plate_axes = figure.add_subplot(1, 2, 1)
    x_axes = figure.add_subplot(2, 2, 2)
    y_axes = figure.add_subplot(2, 2, 4, sharex=x_axes)

    seconds = dict(zip(recording.sequence.tolist(), (recording.timestamp_ns * 1e-9).tolist(), strict=True))
    for number, touch in enumerate(true_touches(recording)):
        label = "truth" if number == 0 else None
        # A line through one place is not drawn: the mark shows a finger that rests.
        plate_axes.plot(
            *touch.position_mm.T, color=TRUTH, lw=7, solid_capstyle="round", marker="o", ms=9, markevery=[0],
            label=label,
        )  # fmt: skip
        when = [seconds[frame] for frame in touch.frames.tolist()]
        for axes, values in zip((x_axes, y_axes), touch.position_mm.T, strict=True):
            axes.plot(when, values, color=TRUTH, lw=6, solid_capstyle="round")
    contacts = found_contacts(events)
    for number, contact in enumerate(contacts):
        colour = COLOURS[number % len(COLOURS)]
        label = f"contact {number + 1}"
        if len(contacts) > len(COLOURS):  # colours repeat, so single names would be ambiguous
            label = f"{len(contacts)} contacts" if number == 0 else None
        position_mm = np.asarray(contact.position_mm)
        plate_axes.plot(*position_mm.T, color=colour, lw=1.2, marker="o", ms=2.5, label=label)
        plate_axes.plot(*position_mm[0], color=colour, marker="o", ms=6)  # marks the start; a tap is little more
        when = [seconds[frame] for frame in contact.frames]
        for axes, values in zip((x_axes, y_axes), position_mm.T, strict=True):
            axes.plot(when, values, color=colour, lw=1.2, marker="o", ms=2.5)

    plate = recording.meta.plate
    plate_axes.set(
        xlim=(0, plate.width_mm), ylim=(plate.height_mm, 0), aspect="equal", xlabel="x (mm)", ylabel="y (mm)",
        title=f"{plate.material} plate, {plate.width_mm:g} x {plate.height_mm:g} x {plate.thickness_mm:g} mm",
    )  # fmt: skip
    draw_transducers(recording.meta, plate_axes)
    if plate_axes.get_legend_handles_labels()[0]:
        # Below the plate, where it covers no touch.
        plate_axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=4, fontsize=8, frameon=False)
    x_axes.set(ylabel="x (mm)", ylim=(0, plate.width_mm), title="contacts over time")
    y_axes.set(ylabel="y (mm)", ylim=(plate.height_mm, 0), xlabel="time (s)", xlim=(0, max(seconds.values()) or 1.0))
    for axes in (plate_axes, x_axes, y_axes):
        axes.grid(alpha=0.25)
    save(figure, path)


def draw_transducers(meta: Meta, axes: Axes, colour: str = "black") -> None:
    """Mark emitter and receivers at the recording's positions; a black edge keeps light marks visible."""
    how: dict[str, Any] = {"color": colour, "ms": 7, "markeredgecolor": "black", "ls": "none"}
    if meta.emitter_mm:
        axes.plot(*meta.emitter_mm, "s", label="emitter", **how)
    if meta.receivers_mm:
        axes.plot(*np.transpose(meta.receivers_mm), "^", label="receivers", **how)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or SVG, by its name; raise OutputError if the file cannot be written."""
    kind = path.suffix.removeprefix(".") or "png"
    with replacing(path, fix="name a .png in an existing folder") as file:
        figure.savefig(file, format=kind, dpi=110, metadata={"Software": None} if kind == "png" else None)
