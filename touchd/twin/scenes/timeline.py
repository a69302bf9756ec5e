"""The timeline of a scene: contacts, temperature and electronics, frame by frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchd.frame import Plate
from touchd.twin.electronics import Electronics
from touchd.twin.physics.finger import TISSUES, Contact, area_of, force_of, is_compliant

Floats = NDArray[np.float64]
Path = Callable[[Floats], tuple[ArrayLike, ArrayLike]]

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


@dataclass(slots=True)
class Stage:
    """Contacts, temperature and electronics in n frames, with at most k contacts at once."""

    plate: Plate
    rate_hz: float
    sequence: NDArray[np.int64]
    """The device's frame counter, shape (n,)."""
    temperature_c: Floats
    """Shape (n,)."""
    rng: np.random.Generator
    """Generator for the scene's random choices."""
    electronics: Electronics
    notes: str = ""
    kinds: list[str] = field(default_factory=list)
    """Kind of each contact."""
    x_mm: list[Floats] = field(default_factory=list)
    """x of each contact, shape (n,); NaN while up."""
    y_mm: list[Floats] = field(default_factory=list)
    area_mm2: list[Floats] = field(default_factory=list)
    force_n: list[Floats] = field(default_factory=list)
    ovals: dict[int, tuple[Floats, Floats]] = field(default_factory=dict)
    """Ratio of the axes and direction of the long one, rad, of each compliant contact, both of shape (n,)."""
    columns: list[list[int]] = field(default_factory=list)
    """Contacts of each label column; contacts of one column never overlap in time."""
    label_error_mm: Floats | None = None
    """Label error, shape (n, k, 2)."""

    @property
    def time_s(self) -> Floats:
        """Start of each frame relative to the first, shape (n,)."""
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

        The area grows for 10-30 ms at the start and shrinks for as long at the end.

        Parameters
        ----------
        kind : a kind of `touchd.twin.physics.finger.TISSUES`, "palm" or "drop"
            A compliant one lands on its tip, round, rolls to its pad and becomes an oval as it spreads.
        start_s, stop_s : float
        path : callable
            Maps seconds since the start, shape (m,), to x and y in mm.
        force_n : float, optional
            Settled force of a finger; left out for a patch of a palm.
        area_mm2 : float, optional
            Settled area of a palm, a drop, or a palm's patch.
        creep : float
            Share by which the area keeps growing over tens of seconds.
        column : int
            Label column of the contact.
        land_s : float, optional
            Time in which the area grows.
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
        self.kinds.append(kind)
        self.area_mm2.append(self._row(on, pressed * (1 + creep * (1 - np.exp(-t / 7)))))
        self.force_n.append(self._row(on, force_of(kind, pressed) if finger else np.full(len(t), np.nan)))
        x, y = (np.asarray(value, dtype=float) for value in path(t))
        if is_compliant(kind):
            ratio, angle, (roll_x, roll_y) = self._spread(kind, t, ramp)
            self.ovals[len(self.kinds) - 1] = self._row(on, ratio), self._row(on, angle)
            self.area_mm2[-1] *= 1 + PULSE * np.sin(2 * np.pi * self.rng.uniform(0.9, 1.4) * time_s)
            x, y = x + roll_x, y + roll_y
        self.x_mm.append(self._row(on, x))
        self.y_mm.append(self._row(on, y))
        while len(self.columns) <= column:
            self.columns.append([])
        self.columns[column].append(len(self.kinds) - 1)

    def _spread(self, kind: str, t: Floats, ramp: Floats) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
        """Return ratio, direction and way of the middle while a finger lands and rests, each of shape (m,)."""
        settled, angle = self.rng.uniform(*RATIOS[kind]), self.rng.uniform(0, np.pi)
        turn = self.rng.uniform(-TURN_RAD, TURN_RAD) * (1 - np.exp(-t))
        # It rolls less where it has less room: a tenth of the long axis of a small contact.
        roll = (ramp - 1) * self.rng.uniform(0, min(ROLL_MM, 0.1 * TISSUES[kind].area_mm2 / np.pi))
        return 1 + (settled - 1) * ramp, angle + turn, (roll * np.cos(angle), roll * np.sin(angle))

    def _row(self, on: NDArray[np.bool_], value: ArrayLike) -> Floats:
        row = np.full(len(self.sequence), np.nan)
        row[on] = value
        return row

    def touches(self, start: int, stop: int) -> list[list[Contact]]:
        """Return the contacts in each of the frames start .. stop - 1."""
        result: list[list[Contact]] = [[] for _ in range(start, stop)]
        for k, (kind, *rows) in enumerate(zip(self.kinds, self.x_mm, self.y_mm, self.area_mm2, strict=True)):
            x, y, area = (row[start:stop] for row in rows)
            oval = [row[start:stop] for row in self.ovals.get(k, ())]
            for i in np.flatnonzero(~np.isnan(x)):
                shape = [float(row[i]) for row in oval]
                result[i].append(Contact(float(x[i]), float(y[i]), float(area[i]), kind, *shape))
        return result

    def truth(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the labels `contacts_mm` of shape (n, k, 2) and `force_n` of shape (n, k).

        Labels with an error are clamped to the plate.
        """
        n, k = len(self.sequence), max(len(self.columns), 1)
        contacts = np.full((n, k, 2), np.nan, dtype=np.float32)
        force = np.full((n, k), np.nan, dtype=np.float32)
        for column, members in enumerate(self.columns):
            for i in members:
                on = ~np.isnan(self.x_mm[i])
                contacts[on, column, 0] = self.x_mm[i][on]
                contacts[on, column, 1] = self.y_mm[i][on]
                force[on, column] = self.force_n[i][on]
        if self.label_error_mm is not None:
            size_mm = np.array([self.plate.width_mm, self.plate.height_mm])
            contacts = np.clip(contacts + self.label_error_mm, 0, size_mm).astype(np.float32)
        return contacts, force

    def faces(self) -> NDArray[np.float32]:
        """Return the labels `faces` of shape (n, k, 3): those of fingers."""
        found = np.full((len(self.sequence), max(len(self.columns), 1), 3), np.nan, dtype=np.float32)
        for column, members in enumerate(self.columns):
            for i in members:
                on = np.isfinite(self.force_n[i])
                ratio, angle_rad = (row[on] for row in self.ovals.get(i, (np.ones(len(on)), np.zeros(len(on)))))
                major_mm = 2 * np.sqrt(self.area_mm2[i][on] * ratio / np.pi)
                found[on, column] = np.stack([major_mm, major_mm / ratio, np.degrees(angle_rad)], axis=1)
        return found
