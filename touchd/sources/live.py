"""A DAQ as a source: a thread that reads it, and a state machine that reports every state of the device.

::

    starting --frame--> streaming <--frame-- stalled
        |                |  |  ^                ^ |
        |            gone|  |  +-frame-- lost   | |gone, or reset
        |                v  +--no frame---------+ v
        +--no device---> lost <-------------------+

`touchd.sources.daq.Daq` is the connection to the device: it returns decoded frames.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable

import structlog

from touchd.config.schema import DeviceSettings
from touchd.errors import ReaderFailed, SourceError, TouchdError
from touchd.event import State
from touchd.frame import Acquisition, Frame
from touchd.recording.data import Device
from touchd.sources.daq import WAITS, Candidates, Daq, DaqAbsent, DaqFrame, DaqGone, DeviceSearch, Waits
from touchd.sources.frame_ring import FrameRing, Lending
from touchd.sources.intake import Intake
from touchd.sources.source import Change, EndOfStream, Source, Tally

_JOIN_S = 0.5
"""`close` waits this long for a thread that a wedged device holds: the service must end within 1 s of SIGTERM."""
_DIRECT_HZ, _STEADY_FRAMES = 250, 8
"""Up to this rate the caller of `read` reads the device itself once 8 frames have come: a device keeps a few for it."""
_STALL_FRAMES = 3  # that a stalled device has left out, however low its rate

log = structlog.get_logger()


class DaqSource(Source):
    """Frames from a device that may stall, be unplugged, or be plugged in later.

    The first of the `candidates` that can be used is; its frames must look like `acquisition`. `check` raises a
    TouchdError if a device with another acquisition must not be used, by default every one: it is skipped. `device` has
    serial number and firmware, if the device was open before. If it can wait for its reader (`direct`), the caller of
    `read` may read it.
    """

    def __init__(
        self,
        candidates: Candidates,
        settings: DeviceSettings,
        acquisition: Acquisition,
        check: Callable[[Acquisition], None] | None = None,
        device: Device | None = None,
        *,
        waits: Waits = WAITS,
        clock: Callable[[], int] = time.monotonic_ns,
        direct: bool = True,
    ) -> None:
        self.acquisition, self.rate_hz = acquisition, settings.rate_hz
        self._intake = Intake(settings.rate_hz)
        self.tally: Tally = self._intake.tally
        self.device = device or Device()
        """The device that was opened last."""
        self._settings, self._waits, self._clock = settings, waits, clock
        self._search = DeviceSearch(candidates, settings, check or self._refuse_another)
        self._stall_ns = round(settings.stall_s * 1e9)
        self._rate_hz = settings.rate_hz
        self._lending = Lending()
        self._streaming: Daq | None = None
        self._commanding = threading.Lock()  # of `_streaming`: no device is closed while it is commanded
        self._ring: FrameRing[Change] = FrameRing(settings.queue_frames)
        self._state: State = "starting"
        self._reason, self._direct, self._wanted = "", direct, False
        self._alive_ns = self._seen_ns = clock()
        self._delay_s = 0.0  # before the next look for a device; grows until a frame comes
        self._clock_fault: str | None = None
        self._error: TouchdError | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="touchd-daq", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame; None if none came in time, or once the state has changed (see `changes`).

        Raises EndOfStream after `close`, ReaderFailed if the thread has died, SourceError if no device will ever be
        found.
        """
        if self._closing.is_set():
            raise EndOfStream
        self._wanted = True
        lent, ring = self._lending.lent, self._ring
        if lent is None or ring.waiting:
            frame = ring.take(timeout_s, lambda: self._lending.lent)
            lent = self._lending.lent
            if frame is not None or lent is None or ring.waiting:
                return frame if lent is not None else self._checked(frame)
        wait_s = max(timeout_s, _STALL_FRAMES / self._rate_hz)  # a loan does not end between two frames
        away_ns = self._clock() - self._alive_ns
        found = self._lending.read(wait_s)
        self._alive_ns = self._clock()  # the thread sleeps meanwhile
        if found is None:  # the thread has the device again, or another one already
            return None
        self._intake.count_corrupt(lent)
        self._seen_ns = self._alive_ns
        return self._take(found, self._seen_ns, away_ns=away_ns, direct=True)

    def _refuse_another(self, found: Acquisition) -> None:
        if found != self.acquisition:
            what = f"another DAQ, whose frames are {found}, not {self.acquisition}"
            raise SourceError(what, "device", "plug in the first one, or restart touchd")

    def _checked(self, frame: Frame | None) -> Frame | None:
        """Return what came from the thread, unless it can bring no more."""
        if frame is None and not self._thread.is_alive():
            raise self._error or ReaderFailed("the thread that reads the DAQ has ended", "device", "restart touchd")
        if frame is None and self._clock() - self._alive_ns > self._waits.hang_s * 1e9:
            raise ReaderFailed(
                f"the thread that reads the DAQ has hung for {self._waits.hang_s:.0f} s", "device",
                "restart touchd; if it comes again, replug the DAQ and look at the kernel's log",
            )  # fmt: skip
        return frame

    def changes(self) -> list[Change]:
        """Take the changes of state that come before the next waiting frame."""
        return self._ring.marks()

    def set_rate(self, rate_hz: int) -> bool:
        """Ask the device for this rate at once; return whether it has taken it, or will once it is there.

        A device that has one rate alone keeps it.
        """
        with self._commanding:
            self._rate_hz = rate_hz
            if self._streaming is not None:
                try:
                    self._streaming.set_rate(rate_hz)
                except DaqGone:  # the thread that reads finds out whether it is
                    return False
        return True

    def close(self) -> None:
        """Stop the device's stream and release the device; further calls do nothing."""
        self._closing.set()
        self._lending.close()
        self._thread.join(_JOIN_S)

    def _run(self) -> None:
        try:
            while (daq := self._connect()) is not None:
                try:
                    self._stream(daq)
                except DaqGone as gone:
                    # Before `close`, which may take its time: contacts are lifted now.
                    self._enter("lost", str(gone))
                finally:
                    with self._commanding:
                        self._streaming = None
                    daq.close()
        except TouchdError as error:
            self._error = error
        except BaseException as error:
            what = f"the thread that reads the DAQ died of {error!r}"
            self._error = ReaderFailed(what, "device", "restart touchd, and report this")
            self._error.__cause__ = error

    def _connect(self) -> Daq | None:
        """Wait for a device that fits, and return it; None once the source is closed."""
        retry_s, max_retry_s = self._waits.retry_s, self._waits.max_retry_s
        while not self._closing.wait(self._delay_s):
            self._alive_ns = self._clock()
            self._delay_s = min(max(retry_s, 1.5 * self._delay_s), max_retry_s)
            try:
                daq = self._search.find()
            except (DaqAbsent, DaqGone) as absent:
                self._enter("lost", str(absent))
                continue
            self.device, rate_hz = daq.device, self._settings.rate_hz
            log.info("device opened", serial=self.device.serial, firmware=self.device.firmware, rate_hz=rate_hz)
            return daq
        return None

    def _stream(self, daq: Daq) -> None:
        """Queue frames until the source is closed or the device is gone; restart, then reset a device that stalls."""
        self._start(daq)
        self._intake.connect(daq)
        restarted, frames = False, 0
        self._seen_ns = self._clock()
        while not self._closing.is_set():
            try:
                frame = daq.read(self._waits.read_s)
            finally:
                self._intake.count_corrupt(daq)
            now_ns = self._alive_ns = self._clock()
            if frame is not None:
                self._take(frame, now_ns)
                self._seen_ns, restarted = now_ns, False
                frames += 1
                if self._delay_s:
                    self._delay_s = 0.0
                    self._search.keep()
                # Not to a caller that is busy: the device would keep a few frames for it, the ring keeps many.
                if self._direct and self._wanted and frames >= _STEADY_FRAMES and self._settings.rate_hz <= _DIRECT_HZ:
                    frames, self._wanted = 0, False
                    try:
                        self._lending.lend(daq, self._ring.wake)
                    finally:
                        self._intake.count_corrupt(daq)
            elif now_ns - self._seen_ns > max(self._stall_ns, _STALL_FRAMES * 1e9 / self._rate_hz):
                self._enter("stalled", f"no frame for {self._settings.stall_s:g} s")
                if restarted:
                    log.warning("resetting the device")
                    daq.reset()
                    raise DaqGone("it was reset, since no frame came")
                log.warning("restarting the stream")
                self._seen_ns, restarted = now_ns, True
                self._start(daq)
        with contextlib.suppress(DaqGone):
            daq.stop()

    def _start(self, daq: Daq) -> None:
        daq.start(self._settings.rate_hz)
        self._intake.restart()
        with self._commanding:
            self._streaming = daq
            if self._rate_hz != self._settings.rate_hz:
                daq.set_rate(self._rate_hz)

    def _take(self, frame: DaqFrame, received_ns: int, *, away_ns: int = 0, direct: bool = False) -> Frame | None:
        """Take a frame in and queue it; return it instead if it goes on directly and nothing waits."""
        taken = self._intake.take(frame, received_ns, away_ns)
        if self._state != "streaming" or self._intake.fault != self._clock_fault:
            self._enter_streaming(self._intake.fault)
        if direct and not self._ring.waiting:
            return taken
        if taken is not None:
            dropped = self._ring.dropped
            self._ring.put(taken)
            self.tally.behind += self._ring.dropped - dropped
        return None

    def _enter_streaming(self, fault: str | None) -> None:
        if fault and fault != self._clock_fault:
            log.warning("device clock not used", why=fault)
        self._clock_fault = fault
        self._enter("streaming", "; ".join(filter(None, (fault, self._search.skipped))))

    def _enter(self, state: State, reason: str) -> None:
        """Queue a change of state, or of its reason."""
        if (state, reason) != (self._state, self._reason):
            self._state, self._reason = state, reason
            self._ring.mark(Change(state, reason))
