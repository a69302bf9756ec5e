"""A DAQ as a source: a thread that reads it, and a state machine that never falls silent.

::

    starting --frame--> streaming <--frame-- stalled
        |                |  |  ^                ^ |
        |            gone|  |  +-frame-- lost   | |gone, or reset
        |                v  +--no frame---------+ v
        +--none there--> lost <-------------------+

How frames come from the device is the business of a `touchd.sources.daq.Daq`.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable

import numpy as np
import structlog

from touchd.config.schema import DeviceSettings
from touchd.errors import ConfigError, DeviceLost, ReaderFailed, SourceError, TouchdError
from touchd.event import State
from touchd.frame import Acquisition, Frame
from touchd.recording.data import Device
from touchd.sources.daq import Daq, DaqAbsent, DaqGone, DaqHalted, DaqOverflow, acquisition_of, device_of
from touchd.sources.device_clock import DeviceClock
from touchd.sources.frame_ring import FrameRing
from touchd.sources.source import Change, EndOfStream, Tally
from touchd.sources.usb_protocol import SEQUENCE_SPAN, Flag, FrameReader, Header, Info

READ_TIMEOUT_S = 0.1
"""How soon the thread notices that it shall end, while no frame comes."""
RETRY_S = 0.1
MAX_RETRY_S = 0.5
"""A device that is not there is looked for at this interval, after a few quicker looks."""
HANG_S = 10.0
"""A thread that has not come round for so long hangs in the kernel, and only a new process helps."""
_JOIN_S = 0.5
"""A thread that a wedged device holds is left behind: the service has to end within a second of SIGTERM."""
_HALT_PAUSE_S = 0.01

log = structlog.get_logger()


class DaqSource:
    """Frames from a device that may be unplugged, stall, or not be there yet.

    Parameters
    ----------
    find : callable
        Returns an open device, or raises DaqAbsent.
    settings : DeviceSettings
    acquisition : Acquisition
        What the frames must look like.
    check : callable
        Raises a TouchdError if a device with another acquisition must not be used; it comes out of `read`.
    device : Device, optional
        What is known of it already.
    clock : callable
        Monotonic time, ns.
    """

    def __init__(
        self,
        find: Callable[[], Daq],
        settings: DeviceSettings,
        acquisition: Acquisition,
        check: Callable[[Acquisition], None],
        device: Device | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.acquisition = acquisition
        self.tally = Tally()
        self.device = device or Device()
        """The one that was opened last."""
        self._find, self._settings, self._check, self._clock = find, settings, check, clock
        self._stall_ns = round(settings.stall_s * 1e9)
        self._ring: FrameRing[Change] = FrameRing(settings.queue_frames, acquisition.shape)
        self._state: State = "starting"
        self._reason = ""
        self._last_sequence: int | None = None  # as the device counts
        self._last_number: int | None = None  # as this source counts
        self._numbered_corrupt = 0  # corrupt frames up to the last number
        self._alive_ns = clock()
        self._fruitless = 0  # connections in a row that brought no frame
        self._error: TouchdError | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="touchd-daq", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next frame; None if there is none in time, or once the state has changed (see `changes`).

        Raises
        ------
        EndOfStream
            After `close`.
        TouchdError
            The thread has failed: the device does not fit (ModelMismatch, SourceError), or it died (ReaderFailed).
        """
        if self._closing.is_set():
            raise EndOfStream
        frame = self._ring.take(timeout_s)
        if frame is None and not self._thread.is_alive():
            raise self._error or ReaderFailed("the thread that reads the DAQ has ended", "device", "restart touchd")
        if frame is None and self._clock() - self._alive_ns > HANG_S * 1e9:
            raise ReaderFailed(
                f"the thread that reads the DAQ has hung for {HANG_S:.0f} s", "device",
                "restart touchd; if it comes again, replug the DAQ and look at the kernel's log",
            )  # fmt: skip
        return frame

    def changes(self) -> list[Change]:
        """Take the changes of state that no waiting frame comes before."""
        return self._ring.marks()

    def close(self) -> None:
        """Stop the device's stream and let go of it; further calls do nothing."""
        self._closing.set()
        self._thread.join(_JOIN_S)

    # -- the thread -------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while (daq := self._connect()) is not None:
                try:
                    self._stream(daq)
                except DaqGone as gone:
                    # Said before the device is closed, which may take its time: contacts are lifted now.
                    self._enter("lost", str(gone))
                finally:
                    daq.close()
        except TouchdError as error:
            self._error = error
        except BaseException as error:
            self._error = ReaderFailed(
                f"the thread that reads the DAQ died of {error!r}", "device", "restart touchd, and report this"
            )
            self._error.__cause__ = error

    def _connect(self) -> Daq | None:
        """Return a device that fits, however long it takes to appear; None if the source is to be closed."""
        delay_s = min(RETRY_S * 2**self._fruitless, MAX_RETRY_S) if self._fruitless else 0.0
        self._fruitless += 1
        while not self._closing.wait(delay_s):
            self._alive_ns = self._clock()
            try:
                daq = self._find()
            except (DaqAbsent, DaqGone) as absent:
                self._enter("lost", str(absent))
                delay_s = min(max(RETRY_S, 1.5 * delay_s), MAX_RETRY_S)
                continue
            try:
                self._accept(daq)
            except BaseException:
                daq.close()
                raise
            return daq
        return None

    def _accept(self, daq: Daq) -> None:
        """Refuse a device that the model does not fit, or that cannot keep the pace."""
        info, rate_hz = daq.info, self._settings.rate_hz
        self._check(acquisition_of(info))
        if not info.min_frame_rate_hz <= rate_hz <= info.max_frame_rate_hz:
            raise ConfigError(
                f"is {rate_hz}, but the DAQ takes {info.min_frame_rate_hz} to {info.max_frame_rate_hz} frames a second",
                "device.rate_hz", "set it within this range",
            )  # fmt: skip
        self.device = device_of(daq)
        log.info("device opened", serial=daq.serial, firmware=self.device.firmware, rate_hz=rate_hz)

    def _stream(self, daq: Daq) -> None:
        """Pass frames on until the source is to be closed, or the device is gone."""
        self._start(daq)
        complete_ns = round(1e9 * daq.info.samples / daq.info.sample_rate_hz)
        reader, device_clock = FrameReader(daq.info), DeviceClock(complete_ns)
        corrupt = self.tally.corrupt
        halts = attempts = 0
        seen_ns = self._clock()
        while not self._closing.is_set():
            data: memoryview | None = None
            try:
                data = daq.read(READ_TIMEOUT_S)
            except DaqHalted:
                halts += 1
                reader.reset()
                daq.clear_halt()
                if halts & (halts - 1) == 0:  # the 1st, 2nd, 4th, 8th
                    log.warning("endpoint halted, cleared", halts=halts)
                self._closing.wait(_HALT_PAUSE_S)
            except DaqOverflow:
                reader.reset()
                reader.corrupt += 1
            now_ns = self._alive_ns = self._clock()
            if data is not None:
                ended = len(data) % daq.packet_bytes != 0 or len(data) == 0
                for header, samples in reader.feed(data, ended=ended):
                    self.tally.corrupt = corrupt + reader.corrupt
                    self._take(header, samples, daq.info, device_clock, now_ns)
                    seen_ns, attempts, self._fruitless = now_ns, 0, 0
                self.tally.corrupt = corrupt + reader.corrupt
            if now_ns - seen_ns > self._stall_ns:
                self._enter("stalled", f"no frame for {self._settings.stall_s:g} s")
                attempts += 1
                seen_ns = now_ns
                self._revive(daq, attempts)
                reader.reset()
        with contextlib.suppress(DaqGone):
            daq.stop()

    def _start(self, daq: Daq) -> None:
        """Begin a stream, whose first frame may have any number."""
        daq.start(self._settings.rate_hz)
        self._last_sequence = None

    def _revive(self, daq: Daq, attempt: int) -> None:
        """Bring a stream back: begin it anew, and if that does not help, reset the device."""
        if attempt == 1:
            log.warning("restarting the stream")
            with contextlib.suppress(DaqHalted):
                daq.clear_halt()
                self._start(daq)
            return
        log.warning("resetting the device")
        daq.reset()
        raise DaqGone("it was reset, since no frame came")

    def _take(self, header: Header, samples: memoryview, info: Info, clock: DeviceClock, received_ns: int) -> None:
        """Number, date and count a valid frame, and hand it on."""
        if self._state != "streaming":
            self._enter("streaming", "frames arrive")
        number = self._number(header.sequence)
        tally = self.tally
        if header.flags & (Flag.TEST_PATTERN | Flag.EMITTER_FAULT):
            why = "test_pattern" if header.flags & Flag.TEST_PATTERN else "emitter_fault"
            tally.withheld[why] = tally.withheld.get(why, 0) + 1
            return
        t_ns = clock.map(header.timestamp_us, received_ns)
        tally.clipped += bool(header.flags & Flag.CLIPPED)
        tally.late += clock.delay_ns * self._settings.rate_hz > 1_000_000_000
        counts = np.frombuffer(samples, "<i2").reshape(info.samples, info.channels).T
        self._ring.put(counts, number, t_ns, received_ns)
        tally.behind = self._ring.dropped

    def _number(self, sequence: int) -> int:
        """Return the frame's number, which goes on over the counter's wrap and over a reconnection.

        A number that is not new is passed on as it is: the pipeline knows a repetition from a device that restarts.
        """
        corrupt = self.tally.corrupt - self._numbered_corrupt
        self._numbered_corrupt += corrupt
        if self._last_number is None:
            self._last_number = sequence
        elif self._last_sequence is None:  # the first one after START may be any
            self._last_number += 1
        else:
            step = (sequence - self._last_sequence + SEQUENCE_SPAN // 2) % SEQUENCE_SPAN - SEQUENCE_SPAN // 2
            self.tally.lost += max(0, step - 1 - corrupt)
            self._last_number += step
        self._last_sequence = sequence
        return self._last_number

    def _enter(self, state: State, reason: str) -> None:
        """Tell the reader of a new state, or of a new reason for it."""
        if (state, reason) != (self._state, self._reason):
            self._state, self._reason = state, reason
            self._ring.mark(Change(state, reason))


def open_live(find: Callable[[], Daq], settings: DeviceSettings) -> DaqSource:
    """Return the source of a device that has to be there, and decides what its frames look like.

    Raises
    ------
    DeviceLost
        No device is there.
    """
    try:
        daq = find()
    except (DaqAbsent, DaqGone) as absent:
        raise DeviceLost(str(absent), "device", "plug it in, or add --replay FILE or --simulate SCENE") from absent
    acquisition, device = acquisition_of(daq.info), device_of(daq)
    daq.close()

    def check(found: Acquisition) -> None:
        if found != acquisition:
            raise SourceError(
                f"another DAQ, whose frames are {found}, not {acquisition}", "device", "plug in the first one"
            )

    return DaqSource(find, settings, acquisition, check, device)
