"""From positions, frame by frame, to contacts that go down, move, hold and come up."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, sqrt

from msgspec.structs import replace

from touchd.config.schema import TrackerSettings
from touchd.event import Contact
from touchd.touch import PalmArea, Touch
from touchd.tracking.assignment import assign
from touchd.tracking.face import FaceAverage, SteadyKind, ellipse_of
from touchd.tracking.one_euro import OneEuro

_NEVER = 1e9  # mm: finite, as the assignment asks
_GOING, _LONGEST_S = 0.25, 0.1
"""A finger is looked for where it was, and where it was going, at this price for the way there, in mm per mm: else one
that lifts as it comes near another takes that one's place. It is predicted so far ahead at most."""
_LEAP_MM, _LEAP_FRAMES, _LEAP_MM_S2 = 8.0, 4.0, 30_000.0
"""From one frame to the next a finger goes no farther than this, with its speed for so many frames, which the filter
knows late, and an acceleration of three times gravity (assumed). Farther away another finger has landed as this one
lifted. In its first frame no speed is known."""
_RELEASE_FRAMES = 2
_SURE_CONFIDENCE, _SURE_SIGMA_MM = 0.99, 0.3
"""One frame is enough for a lone finger surer than this. Of fingertips, 96 in 100 are in the first frame that shows
them; palms, drops, tones and drift stay below (twin)."""
_SURE_FRAMES = 2
"""But not where more frames than these were asked for."""
_LIFTING_NS = 100_000_000
"""Nor so soon after a contact has ended: a finger that lifts may show up once more."""
_HELD_NS = 150_000_000
"""Longest time for which contacts are kept by frames that do not tell where they are."""
_MOST_CONTACTS = 10
_REFRESH_NS = 100_000_000
_SETTLED_MM, _SETTLED_MM_S, _SETTLED_SHARE = 1e-3, 1e-3, 0.01
"""A finger that rests has settled once its place, speed and face (a share of it) would change by less."""
_DEAD_SIGMAS = 1.5
"""The dead band is at least this many standard errors wide."""


class Track:
    """One finger from its first frame to its last."""

    __slots__ = ("contact", "face", "filter", "kind", "missing", "of_palm", "seen")

    def __init__(self, touch: Touch, settings: TrackerSettings) -> None:
        self.filter = OneEuro(touch.x_mm, touch.y_mm, settings.min_cutoff_hz, settings.beta)
        self.face, self.kind = FaceAverage(touch.face), SteadyKind(touch.kind)
        self.seen = 1
        self.missing = 0
        self.of_palm = False
        self.contact: Contact | None = None  # until it is confirmed

    def has_settled(self, touch: Touch) -> bool:
        """Return whether the same touch again would change next to nothing."""
        at, seen, face = self.filter, touch.face, self.face.face
        return (
            hypot(at.x_mm - touch.x_mm, at.y_mm - touch.y_mm) < _SETTLED_MM
            and hypot(at.vx_mm_s, at.vy_mm_s) < _SETTLED_MM_S
            and touch.kind in (None, self.kind.kind)
            and (seen is face is None or (
                seen is not None and face is not None
                and abs(seen.mean_mm2 - face.mean_mm2) < _SETTLED_SHARE * face.mean_mm2
            ))
        )  # fmt: skip


class Tracker:
    """Keeps the contacts of a plate.

    A finger is reported `down` once it was found in `confirm_frames` frames in a row, a lone and sure one in its first
    frame, and `up` once it was missing from 2 of them. Which finger is which is decided by the assignment of
    positions to contacts with the smallest total distance, from where they were or were going. None comes farther than
    `reach_mm`, and one at rest less far.
    """

    def __init__(self, settings: TrackerSettings) -> None:
        self._touches: Sequence[Touch] = ()  # of the last frame
        self._settled = False  # whether the same ones would change nothing
        self.configure(settings)
        self.tracks: list[Track] = []
        """Fingers that are followed, confirmed or not."""
        self._missed = False  # whether a track may have ended
        self.alive = False
        """Whether any contact is down."""
        self._next_id = 1
        self._last_ns = self._seen_ns = self._heard_ns = 0  # the last of them of frames that say nothing, too
        self._reported_ns = 0
        self._ended_ns = -_LIFTING_NS

    def configure(self, settings: TrackerSettings) -> None:
        """Take other settings; those of the filter hold from the next contact on."""
        self._settings = settings
        self._reach_mm, self._dead_band_mm = settings.reach_mm, settings.dead_band_mm

    def track(self, t_ns: int, touches: Sequence[Touch], palm: PalmArea | None = None) -> list[Contact]:
        """Assign the touches of a frame to contacts; one that is missing where a palm lies was the palm's.

        Returns
        -------
        list of Contact
            All contacts alive and those that ended in this frame, if a message is due: a contact went down, moved
            beyond the dead band or went up, or the next frame would come later than 0.1 s after the last message.
            Else empty.
        """
        elapsed_ns, same = max(t_ns - self._last_ns, 1), touches is self._touches
        self._last_ns, self._touches = t_ns, touches
        self._heard_ns = t_ns
        if touches:
            self._seen_ns = t_ns
        if same and self._settled and 0 <= t_ns - self._reported_ns <= _REFRESH_NS - elapsed_ns:
            return []
        elapsed_s = elapsed_ns * 1e-9
        if len(self.tracks) == len(touches) == 1 and self._cost(self.tracks[0], touches[0], elapsed_s) < _NEVER:
            # One finger and one touch within its reach: there is nothing to choose.
            due = self._advance(self.tracks[0], touches[0], elapsed_s)
            self._settled = same and not due and self.tracks[0].has_settled(touches[0])
            return self._report(t_ns, due, elapsed_s)
        self._settled = due = False
        matched = self._match(touches, elapsed_s)
        for track, touch in zip(self.tracks, matched, strict=True):
            due |= self._miss(track, palm) if touch is None else self._advance(track, touch, elapsed_s)
        for touch in touches:
            if touch not in matched and len(self.tracks) < _MOST_CONTACTS:
                self.tracks.append(Track(touch, self._settings))
                sure = len(self.tracks) == len(touches) == 1 and self._is_sure(touch, t_ns)
                due |= self._confirm(self.tracks[-1], touch, sure=sure)
        return self._report(t_ns, due, elapsed_s)

    def holds(self, t_ns: int) -> bool:
        """Return whether there are contacts, and the last touches so fresh that they may stay without more of them."""
        return self.alive and 0 <= t_ns - self._seen_ns < _HELD_NS

    def hold(self, t_ns: int) -> list[Contact]:
        """Keep all contacts in a frame that says nothing of fingers; return the same as `track`."""
        elapsed_ns, self._heard_ns = max(t_ns - self._heard_ns, 1), t_ns
        for track in self.tracks:
            if track.contact:
                track.contact.phase = "hold"
        return self._report(t_ns, False, elapsed_ns * 1e-9)

    def release_all(self, t_ns: int) -> list[Contact]:
        """End every contact, as when the frames stop; return the same as `track`."""
        self._last_ns, self._settled = t_ns, False
        for track in self.tracks:
            track.missing = _RELEASE_FRAMES - 1
        ends = [self._miss(track) for track in self.tracks]
        return self._report(t_ns, any(ends), 0.0)

    def _match(self, touches: Sequence[Touch], elapsed_s: float) -> list[Touch | None]:
        """Return, for each track, the touch that continues it."""
        tracks = self.tracks
        if not tracks or not touches:
            return [None] * len(tracks)
        costs = [[self._cost(track, touch, elapsed_s) for touch in touches] for track in tracks]
        nearest = [row.index(min(row)) for row in costs]
        if len(set(nearest)) == len(nearest) and all(min(row) < _NEVER for row in costs):
            # Each has one nearest to it, and no two the same: no choice can be cheaper.
            return [touches[j] for j in nearest]
        # A track may also stay without a touch, at the price of the reach: a column of its own for each.
        alone = [self._reach_mm] * len(tracks)
        columns = assign([row + alone for row in costs])
        return [touches[j] if j < len(touches) else None for j in columns]

    def _cost(self, track: Track, touch: Touch, elapsed_s: float) -> float:
        at = track.filter
        x_mm, y_mm = touch.x_mm - at.x_mm, touch.y_mm - at.y_mm
        distance_mm = hypot(x_mm, y_mm)
        if distance_mm > self._reach_mm:
            return _NEVER
        if distance_mm > _LEAP_MM and track.contact is not None and track.contact.phase != "down":
            speed_mm_s = _LEAP_FRAMES * hypot(at.vx_mm_s, at.vy_mm_s) + 0.5 * _LEAP_MM_S2 * elapsed_s
            if distance_mm > _LEAP_MM + speed_mm_s * elapsed_s:
                return _NEVER
        ahead_s = min(elapsed_s * (1 + track.missing), _LONGEST_S)
        off_mm = hypot(x_mm - at.vx_mm_s * ahead_s, y_mm - at.vy_mm_s * ahead_s)
        return min(distance_mm, off_mm + _GOING * distance_mm)

    def _advance(self, track: Track, touch: Touch, elapsed_s: float) -> bool:
        track.missing = 0
        track.filter.update(touch.x_mm, touch.y_mm, elapsed_s, touch.sigma_mm)
        if touch.face is not None or track.face.face is not None:
            track.face.update(touch.face, elapsed_s)
        if touch.kind is not None:
            track.kind.update(touch.kind, elapsed_s)
        contact = track.contact
        if contact is None:
            track.seen += 1
            return self._confirm(track, touch)
        at = track.filter
        contact.confidence, contact.force = touch.confidence, touch.force
        contact.vx_mm_s, contact.vy_mm_s = at.vx_mm_s, at.vy_mm_s
        dead_band_mm = max(self._dead_band_mm, _DEAD_SIGMAS * touch.sigma_mm)
        moved_mm = hypot(contact.x_mm - at.x_mm, contact.y_mm - at.y_mm)
        if moved_mm <= dead_band_mm:
            contact.phase = "hold"
            # It is said to be where it was: that much more, per axis, may it be off.
            contact.sigma_mm = hypot(touch.sigma_mm, moved_mm * sqrt(0.5))
            return False
        contact.phase = "move"
        contact.sigma_mm = touch.sigma_mm
        contact.x_mm, contact.y_mm, contact.key = at.x_mm, at.y_mm, touch.key
        return True

    def _is_sure(self, touch: Touch, t_ns: int) -> bool:
        """Return whether one frame is enough evidence for a lone finger."""
        return (
            touch.confidence > _SURE_CONFIDENCE
            and touch.sigma_mm < _SURE_SIGMA_MM
            and self._settings.confirm_frames <= _SURE_FRAMES
            and not 0 <= t_ns - self._ended_ns < _LIFTING_NS
        )

    def _confirm(self, track: Track, touch: Touch, *, sure: bool = False) -> bool:
        if track.seen < self._settings.confirm_frames and not sure:
            return False
        at = track.filter
        track.contact = Contact(
            self._next_id, "down", at.x_mm, at.y_mm, touch.force, touch.sigma_mm, touch.confidence,
            at.vx_mm_s, at.vy_mm_s, touch.key,
        )  # fmt: skip
        self._next_id += 1
        self.alive = True
        return True

    def _miss(self, track: Track, palm: PalmArea | None = None) -> bool:
        track.missing += 1
        self._missed = True
        contact = track.contact
        if contact is None:
            return False
        contact.phase = "hold"
        # Its first frame tells: what a finger that has lifted leaves there may look like a palm in the next one.
        track.of_palm = track.missing == 1 and palm is not None and palm.has(contact.x_mm, contact.y_mm)
        if track.missing < _RELEASE_FRAMES and not track.of_palm:
            return False
        contact.phase = "up"
        contact.vx_mm_s = contact.vy_mm_s = 0.0
        return True

    def _report(self, t_ns: int, due: bool, elapsed_s: float) -> list[Contact]:
        # The next frame is expected as long after this one as this one came after the last.
        quiet_ns = t_ns - self._reported_ns
        # Below 0 the clock stepped back: it may never catch up.
        due = due or quiet_ns < 0 or quiet_ns + round(elapsed_s * 1e9) > _REFRESH_NS
        contacts = [_copy(track.contact, track) for track in self.tracks if track.contact] if due else []
        if self._missed:
            self._missed = False
            self.tracks = [track for track in self.tracks if _lives(track)]
            was_alive, self.alive = self.alive, any(track.contact is not None for track in self.tracks)
            if was_alive and not self.alive:
                self._ended_ns = t_ns
        if contacts:
            self._reported_ns = t_ns
        return contacts


def _copy(contact: Contact, track: Track) -> Contact:
    """Return a contact with the size and direction of its face where known; a message must not change once made."""
    c, kind, face = contact, "palm" if track.of_palm else track.kind.kind, track.face.face
    if face is None:
        return replace(c, kind=kind)
    e = ellipse_of(face)
    # By position: by name it takes twice as long.
    return Contact(
        c.id, c.phase, c.x_mm, c.y_mm, c.force, c.sigma_mm, c.confidence, c.vx_mm_s, c.vy_mm_s, c.key, e.area_mm2,
        e.major_mm, e.minor_mm, e.angle_deg, e.sigma_area_mm2, e.sigma_major_mm, e.sigma_minor_mm, e.sigma_angle_deg,
        kind,
    )  # fmt: skip


def _lives(track: Track) -> bool:
    if track.contact is None:
        # An unconfirmed finger that misses one frame was not one.
        return track.missing == 0
    return track.contact.phase != "up"
