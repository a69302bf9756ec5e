"""A rig of NI hardware as a DAQ: one analog output for the chirp, simultaneous analog inputs. NOT TRIED ON HARDWARE.

The chirp is played again and again from the output's own buffer, which is one period of frames long. The inputs run all
the time and start with the output (its start trigger is routed to them in hardware), so frame n begins n periods after
the start, on the same timebase: chirp and samples keep their distance to the tick, whatever this computer does.

The vendor's package (extra `ni`) and driver are imported here and nowhere else. docs/integrator.md has the set-up.
"""

from __future__ import annotations

import contextlib
import re
from typing import Any

import nidaqmx
import numpy as np
from nidaqmx import stream_readers, stream_writers
from nidaqmx.constants import AcquisitionType, RegenerationMode
from nidaqmx.errors import DaqError, DaqNotFoundError, DaqNotSupportedError
from numpy.typing import NDArray

from touchd.chirp import waveform
from touchd.config.schema import NiSettings
from touchd.errors import ConfigError, SourceError
from touchd.frame import Acquisition
from touchd.sources.daq import DaqAbsent, DaqGone
from touchd.sources.usb_protocol import Header, Info, build_frame

_WHOLE = 1 << 30  # no packets: every read is a frame
_BUFFER_S = 1.0  # what the driver keeps for a computer that is late
_DRIVER_FIX = "install NI-DAQmx, which the package needs"


class NiDaq:
    """The rig, opened; frames leave it in the form of those on USB.

    Parameters
    ----------
    settings : NiSettings
    acquisition : Acquisition
        What to play and to sample.

    Raises
    ------
    DaqAbsent
        The driver does not find the device.
    SourceError
        There is no driver, or the inputs are not sampled simultaneously.
    ConfigError
        The voltages are beyond what can be.
    """

    packet_bytes = _WHOLE

    def __init__(self, settings: NiSettings, acquisition: Acquisition) -> None:
        self._settings, self._acquisition = settings, acquisition
        if settings.amplitude_v > settings.output_limit_v:
            raise ConfigError(
                f"is {settings.amplitude_v:g} V, above ni.output_limit_v", "ni.amplitude_v", "play the chirp lower"
            )
        self._tasks: list[Any] = []
        try:
            device = nidaqmx.system.device.Device(settings.inputs.partition("/")[0])
            self.serial = f"{device.serial_num:08X}"
            simultaneous = device.ai_simultaneous_sampling_supported
        except (DaqNotFoundError, DaqNotSupportedError) as error:
            raise SourceError("there is no NI-DAQmx driver", "ni", _DRIVER_FIX) from error
        except DaqError as error:
            raise DaqAbsent(f"the driver does not find {settings.inputs} ({error.error_code})") from error
        if not simultaneous:
            raise SourceError(
                f"{settings.inputs} samples its channels one after the other", "ni.inputs",
                "use inputs that are sampled at the same time, such as those of an NI-9223",
            )  # fmt: skip
        self.info = self._describe()

    def start(self, rate_hz: int) -> None:
        """Play and sample anew; the first frame begins with the start trigger."""
        self.stop()
        acquisition, settings = self._acquisition, self._settings
        period = _whole(acquisition.sample_rate_hz / rate_hz, "the sample rate", rate_hz)
        played = _whole(acquisition.chirp.dac_rate_hz / rate_hz, "the DAC's rate", rate_hz)
        chirp = settings.amplitude_v * waveform(acquisition.chirp)
        if len(chirp) > played or acquisition.samples > period:
            raise ConfigError(f"is {rate_hz}: a frame lasts longer than that", "device.rate_hz", "lower it")
        try:
            output, inputs = self._task(), self._task()
            output.ao_channels.add_ao_voltage_chan(
                settings.output, min_val=-settings.output_limit_v, max_val=settings.output_limit_v
            )
            output.timing.cfg_samp_clk_timing(
                acquisition.chirp.dac_rate_hz, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=played
            )
            output.out_stream.regen_mode = RegenerationMode.ALLOW_REGENERATION
            stream_writers.AnalogSingleChannelWriter(output.out_stream, auto_start=False).write_many_sample(
                np.concatenate([chirp, np.zeros(played - len(chirp))])
            )
            inputs.ai_channels.add_ai_voltage_chan(
                settings.inputs, min_val=-acquisition.full_scale_v, max_val=acquisition.full_scale_v
            )
            if inputs.number_of_channels != acquisition.channels:
                raise ConfigError(
                    f"names {inputs.number_of_channels} channels, not {acquisition.channels}", "ni.inputs",
                    "name one for each receiver, in the order of the model's",
                )  # fmt: skip
            inputs.timing.cfg_samp_clk_timing(
                acquisition.sample_rate_hz, sample_mode=AcquisitionType.CONTINUOUS,
                samps_per_chan=round(_BUFFER_S * acquisition.sample_rate_hz),
            )  # fmt: skip
            inputs.triggers.start_trigger.cfg_dig_edge_start_trig(settings.trigger or _start_of(settings.output))
            self._reader = stream_readers.AnalogUnscaledReader(inputs.in_stream)
            inputs.start()  # armed first: it waits for the output
            output.start()
        except DaqError as error:
            self.stop()
            raise DaqGone(f"it cannot be started ({error.error_code})") from error
        shape = acquisition.channels, acquisition.samples
        self._counts: NDArray[np.int16] = np.zeros(shape, np.int16)
        self._rest: NDArray[np.int16] = np.zeros((acquisition.channels, period - acquisition.samples), np.int16)
        self._period_s, self._frame = 1 / rate_hz, 0

    def read(self, timeout_s: float) -> memoryview | None:
        """Return the next frame as soon as its last sample is there."""
        timeout_s = max(timeout_s, 3 * self._period_s)
        try:
            if self._frame and self._rest.size:  # what came after the last frame, up to this one
                self._reader.read_int16(self._rest, self._rest.shape[1], timeout_s)
            self._reader.read_int16(self._counts, self._counts.shape[1], timeout_s)
        except DaqError as error:
            # Also a time-out: part of a frame may have been read, and only a new start finds the beginning of one.
            raise DaqGone(f"reading fails ({error.error_code})") from error
        header = Header(self._frame, round(self._frame * self._period_s * 1e6), flags=self._clipped())
        self._frame += 1
        return memoryview(build_frame(self.info, header, self._counts.T.astype("<i2").tobytes()))

    def stop(self) -> None:
        """End both tasks."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            with contextlib.suppress(DaqError):
                task.close()

    def clear_halt(self) -> None:
        """Do nothing: there is no endpoint."""

    def reset(self) -> None:
        """Reset the device."""
        self.stop()
        with contextlib.suppress(DaqError):
            nidaqmx.system.device.Device(self._settings.inputs.partition("/")[0]).reset_device()

    def close(self) -> None:
        """Let go of the device; never fails."""
        self.stop()

    def _task(self) -> Any:
        task = nidaqmx.Task()
        self._tasks.append(task)
        return task

    def _clipped(self) -> int:
        return int(bool((np.abs(self._counts.astype(np.int32)) >= 2 ** (self.info.bits - 1) - 1).any()))

    def _describe(self) -> Info:
        a = self._acquisition
        return Info(
            channels=a.channels, samples=a.samples, sample_rate_hz=round(a.sample_rate_hz), bits=a.bits,
            dac_rate_hz=round(a.chirp.dac_rate_hz), chirp_start_hz=round(a.chirp.start_hz),
            chirp_stop_hz=round(a.chirp.stop_hz), chirp_us=round(a.chirp.duration_s * 1e6),
            full_scale_mv=round(a.full_scale_v * 1e3), max_frame_rate_hz=int(a.sample_rate_hz // a.samples),
            min_frame_rate_hz=1,
        )  # fmt: skip


def _start_of(output: str) -> str:
    """Return the terminal of an output's start trigger; modules share that of their chassis."""
    chassis = re.sub(r"Mod\d+$", "", output.partition("/")[0])
    return f"/{chassis}/ao/StartTrigger"


def _whole(samples: float, what: str, rate_hz: int) -> int:
    if samples != round(samples):
        raise ConfigError(
            f"is {rate_hz}, which {what} is no multiple of", "device.rate_hz", "use a divisor, such as 100 or 125"
        )
    return round(samples)
