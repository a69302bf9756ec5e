"""Keeps the last seconds of frames in memory, so that a ghost touch becomes a recording that can be replayed."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import structlog

from touchd.config.schema import PreRollSettings
from touchd.event import Contact
from touchd.files import state_folder
from touchd.frame import Frame
from touchd.recording.data import Meta
from touchd.sources.recorder import recording_of, write_beside

AFTER_NS = 1_000_000_000
"""From a doubtful touch until it is saved, ns: the recording shows how the touch went on."""
_OURS = re.compile(r"preroll-\d{8}T\d{6}Z-[a-z0-9]+(-\d+)?\.npz")

log = structlog.get_logger()


class PreRoll:
    """Keeps a copy of each frame for some seconds, and writes them as a recording on request.

    They are dropped by age and, in case their times are wrong, by number. A thread of its own writes them, and logs
    what goes wrong. `meta` returns the description of a recording, dated now. Between two files go at least
    `interval_s`: a plate full of doubtful touches must not fill the disk.
    """

    def __init__(
        self,
        rate_hz: float,
        meta: Callable[[], Meta],
        settings: PreRollSettings,
        clock: Callable[[], int] = time.monotonic_ns,
        interval_s: float = 10.0,
    ) -> None:
        self._meta = meta
        self._rate_hz = rate_hz
        self._clock = clock
        self._interval_ns = round(interval_s * 1e9)
        self._frames: deque[Frame] = deque()
        self._asked = ""
        self._due_ns: int | None = None
        self._saved_ns: int | None = None
        self._writing: Future[None] | None = None
        self._written: dict[Path, int] = {}  # by this process, in order
        self._writer = ThreadPoolExecutor(1, "touchd-preroll")
        self.configure(settings)

    def configure(self, settings: PreRollSettings) -> None:
        """Take other settings; with `seconds` 0 drop all frames, and write none that was asked for before."""
        self._settings = settings
        self._folder = settings.folder or state_folder("preroll")
        self._span_ns = round(settings.seconds * 1e9)
        self._max_frames = round((settings.seconds + 1) * self._rate_hz) + 1
        if not settings.seconds:
            self._frames.clear()
            self._due_ns = None
            if self._writing is not None:
                self._writing.cancel()

    def keep(self, frame: Frame, contacts: Sequence[Contact]) -> None:
        """Copy a frame, and schedule a save if one of its contacts goes down with little confidence."""
        if not self._span_ns:
            self.poll()
            return
        frames = self._frames
        if frames and (frame.sequence <= frames[-1].sequence or frame.t_ns <= frames[-1].t_ns):
            if frame.sequence == frames[-1].sequence:
                return  # seen already
            frames.clear()  # the device counts from its start again: no recording holds both
        frames.append(frame.copy())
        while len(frames) > self._max_frames or frame.t_ns - frames[0].t_ns > self._span_ns:
            frames.popleft()
        if contacts and self._due_ns is None and self._is_doubtful(contacts):
            self._due_ns = self._clock() + AFTER_NS
        if self._asked or self._due_ns is not None:
            self.poll()

    def request(self, reason: str) -> None:
        """Request a save at the next `poll`; safe to call from a signal handler."""
        self._asked = reason

    def poll(self) -> None:
        """Save if a save was requested and is due; called also while no frame comes."""
        if self._asked:
            reason, self._asked = self._asked, ""
            self._save(reason)
        elif self._due_ns is not None and self._clock() >= self._due_ns:
            self._due_ns = None
            self._save("doubtful")

    def close(self) -> None:
        """Save what is still due, and wait until it is written."""
        if self._due_ns is not None:
            self._due_ns = self._clock()
        self.poll()
        self._writer.shutdown()

    def _is_doubtful(self, contacts: Sequence[Contact]) -> bool:
        least = self._settings.min_confidence
        return any(contact.phase == "down" and contact.confidence < least for contact in contacts)

    def _save(self, reason: str) -> None:
        now_ns = self._clock()
        frames = list(self._frames)
        too_soon = self._saved_ns is not None and now_ns - self._saved_ns < self._interval_ns
        if not frames or too_soon or (self._writing is not None and not self._writing.done()):
            empty = "no frames yet" if self._span_ns else "preroll.seconds is 0"
            why = "the last one was tried just now" if frames else empty
            log.warning("pre-roll not saved", reason=reason, why=why)
            return
        self._saved_ns = now_ns
        self._writing = self._writer.submit(self._write, reason, frames)

    def _write(self, reason: str, frames: list[Frame]) -> None:
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
            made = recording_of(self._meta(), frames, frames[0].t_ns)
            path = write_beside(self._folder / f"preroll-{stamp}-{reason}.npz", made, compress=False)
            if not self._span_ns:  # switched off meanwhile
                path.unlink()
                return
            self._written[path] = max(self._written.values(), default=0) + 1
            log.info("pre-roll saved: it can reveal a PIN", path=path, frames=len(frames), reason=reason)
            self._prune()
        except Exception as error:
            # A full disk, for example: touches go on.
            log.warning("pre-roll not saved", reason=reason, why=str(error))

    def _prune(self) -> None:
        """Delete the oldest of the pre-roll's own files, all but the last `keep`.

        A file that this process wrote is newer than all others: the clock in their names may have been set back.
        """
        ours = [path for path in self._folder.iterdir() if _OURS.fullmatch(path.name)]
        ours.sort(key=lambda path: (self._written.get(path, -1), path.name))
        for path in ours[: -self._settings.keep]:
            path.unlink(missing_ok=True)
        kept = ours[-self._settings.keep :]  # others have gone: somebody collects them, or they were old
        self._written = {path: number for path, number in self._written.items() if path in kept}
        for path in self._folder.glob(".preroll-*.tmp"):
            path.unlink(missing_ok=True)  # half a file of a daemon that was killed
