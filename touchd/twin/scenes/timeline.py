"""The timeline of a scene: contacts, temperature and electronics, frame by frame; and paths of a finger on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.frame import Plate
from touchd.twin.electronics import Electronics
from touchd.twin.physics.body import Body
from touchd.twin.physics.film import Film
from touchd.twin.physics.finger import TISSUES, Contact, area_of, force_of, is_compliant
from touchd.twin.physics.friction import Rub
from touchd.twin.physics.knock import Knock
from touchd.twin.physics.other_pane import OtherPane

Floats = NDArray[np.float64]
Path = Callable[[Floats], tuple[ArrayLike, ArrayLike]]
"""Maps seconds since landing, shape (m,), to x and y in mm."""

SMALLEST_MM2 = 2.0
"""Contact area at the first moment of a touch."""
RATIOS = {"robot": (1.0, 1.1), "fingertip": (1.1, 1.5), "thumb": (1.1, 1.5), "child": (1.1, 1.4), "glove": (1.0, 1.5)}
"""Range of long over short axis of a settled compliant contact."""
ROLL_MM = 1.5
"""Largest way of a compliant contact's middle along its long axis, while the finger rolls from its tip to its pad."""
TURN_RAD = 0.1
"""Largest turn of a finger about its own axis while it rests."""
PULSE = 0.01
"""Share of the area that comes and goes with the heart."""


class Laid(NamedTuple):
    """A contact in n frames: rows of shape (n,), NaN while it is up."""

    kind: str
    column: int
    """Its column of the labels; contacts of one column never overlap in time."""
    x_mm: Floats
    y_mm: Floats
    area_mm2: Floats
    force_n: Floats
    """NaN of what is no finger."""
    ratio: Floats
    """Long axis over short axis; 1 unless it is compliant."""
    angle_rad: Floats
    """Direction of the long axis."""


@dataclass(slots=True)
class Stage:
    """Contacts, temperature and electronics in n frames, with labels of at most k contacts at once."""

    plate: Plate
    rate_hz: float
    sequence: NDArray[np.int64]
    """The device's frame counter, shape (n,)."""
    temperature_c: Floats
    """Shape (n,)."""
    rng: np.random.Generator
    electronics: Electronics
    notes: str = ""
    laid: list[Laid] = field(default_factory=list)
    knocks: list[Knock] = field(default_factory=list)
    rubs: list[Rub] = field(default_factory=list)
    other_panes: list[OtherPane] = field(default_factory=list)
    films: list[Film] = field(default_factory=list)
    bodies: list[Body] = field(default_factory=list)
    label_error_mm: Floats | None = None
    """Label error, shape (n, k, 2)."""

    @property
    def time_s(self) -> Floats:
        """Time of each frame relative to the first, shape (n,); contacts and temperature are those of its middle."""
        return np.asarray((self.sequence - self.sequence[0]) / self.rate_hz)

    @property
    def end_s(self) -> float:
        """End of the last frame."""
        return float(self.time_s[-1]) + 1 / self.rate_hz

    def lay(
        self,
        kind: str,
        start_s: float,
        stop_s: float,
        path: Path,
        *,
        force_n: float | None = 1.0,
        area_mm2: float | None = None,
        creep: float = 0.0,
        column: int = 0,
        land_s: float | None = None,
    ) -> None:
        """Add a contact that comes down at `start_s` and lifts at `stop_s`.

        The area grows for `land_s`, by default 10-30 ms, at the start, and shrinks for 10-30 ms at the end; `creep` is
        the share by which it keeps growing over tens of seconds. A compliant contact lands on its tip, round, rolls to
        its pad and becomes an oval as it spreads. A finger settles at a force; a palm, a drop, and a palm's patch,
        which has no force, at an area. `column` is that of the contact's labels.
        """
        rise_s, fall_s = self.rng.uniform(0.010, 0.030, 2)
        rise_s = rise_s if land_s is None else land_s
        time_s = self.time_s
        on = (time_s >= start_s) & (time_s < stop_s)
        t = time_s[on] - start_s
        ramp = np.minimum(np.minimum((t + 1e-3) / rise_s, (stop_s - start_s - t) / fall_s), 1.0)
        ramp = np.sin(np.pi / 2 * ramp) ** 2
        finger = kind in TISSUES and force_n is not None
        settled = float(area_of(kind, force_n or 0.0)) if area_mm2 is None else area_mm2
        pressed = np.maximum(settled * ramp, SMALLEST_MM2)
        area = pressed * (1 + creep * (1 - np.exp(-t / 7)))
        x, y = (np.asarray(value, dtype=float) for value in path(t))
        ratio, angle = np.ones(len(t)), np.zeros(len(t))
        if is_compliant(kind):
            ratio, angle, (roll_x, roll_y) = self._spread(kind, t, ramp)
            area = area * (1 + PULSE * np.sin(2 * np.pi * self.rng.uniform(0.9, 1.4) * time_s))[on]
            x, y = x + roll_x, y + roll_y
        force = force_of(kind, pressed) if finger else np.full(len(t), np.nan)
        rows = np.full((6, len(on)), np.nan)
        rows[:, on] = x, y, area, force, ratio, angle
        self.laid.append(Laid(kind, column, *rows))

    def _spread(self, kind: str, t: Floats, ramp: Floats) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
        """Return ratio, direction and way of the middle while a finger lands and rests, each of shape (m,)."""
        settled, angle = self.rng.uniform(*RATIOS[kind]), self.rng.uniform(0, np.pi)
        turn = self.rng.uniform(-TURN_RAD, TURN_RAD) * (1 - np.exp(-t))
        # It rolls less where it has less room: a tenth of the long axis of a small contact.
        roll = (ramp - 1) * self.rng.uniform(0, min(ROLL_MM, 0.1 * TISSUES[kind].area_mm2 / np.pi))
        return 1 + (settled - 1) * ramp, angle + turn, (roll * np.cos(angle), roll * np.sin(angle))

    def touches(self, start: int, stop: int, off_s: float = 0.0) -> list[list[Contact]]:
        """Return the contacts `off_s` from the middle of each of the frames start .. stop - 1."""
        result: list[list[Contact]] = [[] for _ in range(start, stop)]
        window = np.clip(np.arange(start - 1, stop + 1), 0, len(self.sequence) - 1)  # with a frame on either side
        spent_s = np.diff(self.time_s[window])
        for kind, _, *columns in self.laid:
            rows = np.stack([column[window] for column in columns])
            x, y, area, _, ratio, angle = rows[:, 1:-1] + off_s * _per_s(rows, spent_s)
            area, ratio = np.maximum(area, SMALLEST_MM2), np.maximum(ratio, 1.0)
            for i in np.flatnonzero(~np.isnan(x)):
                shape = float(area[i]), kind, float(ratio[i]), float(angle[i])
                result[i].append(Contact(float(x[i]), float(y[i]), *shape))
        return result

    def truth(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the labels `contacts_mm` of shape (n, k, 2) and `force_n` of shape (n, k).

        Labels with an error are clamped to the plate.
        """
        contacts, force = self._labels(2), self._labels(1)[..., 0]
        for one in self.laid:
            on = ~np.isnan(one.x_mm)
            contacts[on, one.column] = np.stack([one.x_mm[on], one.y_mm[on]], axis=1)
            force[on, one.column] = one.force_n[on]
        if self.label_error_mm is not None:
            size_mm = np.array([self.plate.width_mm, self.plate.height_mm])
            contacts = np.clip(contacts + self.label_error_mm, 0, size_mm).astype(np.float32)
        return contacts, force

    def faces(self) -> NDArray[np.float32]:
        """Return the labels `faces` of shape (n, k, 3): those of fingers."""
        found = self._labels(3)
        for one in self.laid:
            on = np.isfinite(one.force_n)
            ratio, angle_deg = one.ratio[on], np.degrees(one.angle_rad[on])
            major_mm = 2 * np.sqrt(one.area_mm2[on] * ratio / np.pi)
            found[on, one.column] = np.stack([major_mm, major_mm / ratio, angle_deg], axis=1)
        return found

    def _labels(self, values: int) -> NDArray[np.float32]:
        columns = max((one.column + 1 for one in self.laid), default=1)
        return np.full((len(self.sequence), columns, values), np.nan, dtype=np.float32)


def _per_s(rows: Floats, spent_s: Floats) -> Floats:
    """Return the rate of change of rows (k, m + 2) at the inner m, by the neighbours that are known; 0 without one."""
    steps = np.diff(rows, axis=1) / np.where(spent_s > 0, spent_s, np.nan)
    both = np.stack([steps[:, :-1], steps[:, 1:]])
    return np.asarray(np.nansum(both, axis=0) / np.maximum(np.isfinite(both).sum(axis=0), 1))


def still(x_mm: float, y_mm: float) -> Path:
    """Stay at a position."""
    return lambda t: (np.full(len(t), x_mm), np.full(len(t), y_mm))


def line(start: ArrayLike, stop: ArrayLike, seconds: float) -> Path:
    """Move between two positions, with zero speed at both ends."""
    a, b = np.asarray(start, dtype=float), np.asarray(stop, dtype=float)

    def path(t: Floats) -> tuple[ArrayLike, ArrayLike]:
        part = 0.5 - 0.5 * np.cos(np.pi * np.clip(t / seconds, 0, 1))
        return a[0] + (b[0] - a[0]) * part, a[1] + (b[1] - a[1]) * part

    return path


def arc(stage: Stage, seconds: float, turns: float) -> Path:
    """Draw a circle around the centre, clockwise from the top; radius 60 mm, less on a small plate."""
    cx, cy = stage.plate.width_mm / 2, stage.plate.height_mm / 2
    radius = min(60.0, cx - 15, cy - 15)

    def path(t: Floats) -> tuple[ArrayLike, ArrayLike]:
        angle = 2 * np.pi * turns * np.clip(t / seconds, 0, 1)
        return cx + radius * np.sin(angle), cy - radius * np.cos(angle)

    return path


def anywhere(stage: Stage, margin_mm: float = 12.0) -> tuple[float, float]:
    """Return a random position, x and y in mm, at least `margin_mm` from the edge."""
    x, y = stage.rng.uniform(size=2)
    p = stage.plate
    return margin_mm + x * (p.width_mm - 2 * margin_mm), margin_mm + y * (p.height_mm - 2 * margin_mm)
