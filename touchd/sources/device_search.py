"""Choose among the devices that are there: one that cannot be used does not keep another from being used."""

from __future__ import annotations

from collections.abc import Callable

import structlog

from touchd.config.schema import DeviceSettings
from touchd.errors import ConfigError, DeviceBusy, DeviceLost, TouchdError
from touchd.frame import Acquisition
from touchd.sources.daq import Candidates, Daq, DaqAbsent, DaqBusy, DaqGone, DaqUnfit

log = structlog.get_logger()


class DeviceSearch:
    """Opens the first device that fits. After a connection that brought no frame it begins with the next one.

    `check` raises a TouchdError if a device with this acquisition must not be used.
    """

    def __init__(self, candidates: Candidates, settings: DeviceSettings, check: Callable[[Acquisition], None]) -> None:
        self.skipped = ""
        """Which devices the last search skipped, and why."""
        self._candidates, self._settings, self._check = candidates, settings, check
        self._first = 0

    def find(self) -> Daq:
        """Return an open device that fits; raises DaqAbsent with what is wrong with each."""
        openers = list(self._candidates())
        first = self._first % max(len(openers), 1)
        unfit, absent = [], []
        for opener in openers[first:] + openers[:first]:
            try:
                daq = opener()
                self._accept(daq)
            except DaqUnfit as why:
                unfit.append(str(why))
            except (DaqAbsent, DaqGone) as why:
                absent.append(str(why))
            else:
                self._note("; ".join(unfit))
                self._first += 1
                return daq
        self._note("; ".join(unfit))
        raise DaqAbsent("; ".join(unfit + absent))

    def keep(self) -> None:
        """Begin the next search where the last one began: its device has sent a frame."""
        self._first -= 1

    def _accept(self, daq: Daq) -> None:
        """Close and refuse a device that the model does not fit, or that does not have the frame rate."""
        try:
            self._check(daq.acquisition)
            check_rate(daq, self._settings)
        except BaseException as error:
            daq.close()
            if isinstance(error, TouchdError):
                raise DaqUnfit(f"device {daq.device.serial!r} is skipped: {error}") from error
            raise

    def _note(self, why: str) -> None:
        if why and why != self.skipped:
            log.warning("device skipped", why=why)
        self.skipped = why


def open_first(candidates: Candidates) -> Daq:
    """Return the first device that can be opened; raises DeviceLost or DeviceBusy."""
    absent: list[DaqAbsent | DaqGone] = []
    try:
        for opener in candidates():
            try:
                return opener()
            except (DaqAbsent, DaqGone) as why:
                absent.append(why)
    except DaqAbsent as why:  # devices cannot be listed
        absent.append(why)
    what = "; ".join(map(str, absent))
    if any(isinstance(why, DaqBusy) for why in absent):
        fix = "stop the daemon, or set control.socket, for it and this command alike: it then hands out its frames"
        raise DeviceBusy(what, "device", fix)
    raise DeviceLost(what, "device", "plug it in, or add --replay FILE or --simulate SCENE")


def check_rate(daq: Daq, settings: DeviceSettings) -> None:
    """Raise ConfigError unless a device has the frame rate that is set."""
    if not daq.min_rate_hz <= settings.rate_hz <= daq.max_rate_hz:
        raise ConfigError(
            f"is {settings.rate_hz}, but the DAQ takes {daq.min_rate_hz} to {daq.max_rate_hz} frames a second",
            "device.rate_hz", "set it within this range",
        )  # fmt: skip
