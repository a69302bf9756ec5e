"""A rig of NI hardware as a DAQ: one analog output for the chirp, simultaneous analog inputs. NOT TRIED ON HARDWARE.

The output plays its own buffer, one period of frames, again and again. The inputs run continuously and start on the
output's start trigger, which the chassis routes to them, so frame n begins n periods after the start, on the same
timebase: the delay from chirp to samples is constant to the tick at any load of this computer.

This module alone imports the vendor's package (extra `ni`) and driver. docs/integrator.md has the set-up.
"""

from __future__ import annotations

import contextlib
import re
from typing import Any

import nidaqmx
import numpy as np
from nidaqmx import stream_readers, stream_writers
from nidaqmx.constants import AcquisitionType, RegenerationMode
from nidaqmx.errors import DaqError, DaqFunctionNotSupportedError, DaqNotFoundError, DaqNotSupportedError
from numpy.typing import NDArray

from touchd.config.rigs import NiSettings
from touchd.errors import ConfigError, SourceError
from touchd.frame import Acquisition
from touchd.recording.data import Device
from touchd.sources.daq import Daq, DaqAbsent, DaqFrame, DaqGone

_BUFFER_S = 1.0  # of the driver, for a computer that is late
_DRIVER_FIX = "install NI-DAQmx, which the package needs"


class NiDaq(Daq):
    """An open rig, which plays the chirp of `acquisition` and samples its frames.

    Raises DaqAbsent if the driver does not find the device; SourceError if there is no driver, or the inputs are not
    sampled simultaneously.
    """

    def __init__(self, settings: NiSettings, acquisition: Acquisition) -> None:
        self.acquisition = acquisition
        self.max_rate_hz = int(acquisition.sample_rate_hz // acquisition.samples)
        self._settings = settings
        self._tasks: list[Any] = []
        try:
            device = nidaqmx.system.device.Device(settings.inputs.partition("/")[0])
            self.device = Device(serial=f"{device.serial_num:08X}")
            simultaneous = device.ai_simultaneous_sampling_supported
        except (DaqNotFoundError, DaqNotSupportedError) as error:
            raise SourceError("there is no NI-DAQmx driver", "ni", _DRIVER_FIX) from error
        except DaqFunctionNotSupportedError as error:
            raise SourceError("the NI-DAQmx driver is too old", "ni", _DRIVER_FIX) from error
        except DaqError as error:
            raise DaqAbsent(f"the driver does not find {settings.inputs} ({error.error_code})") from error
        if not simultaneous:
            raise SourceError(
                f"{settings.inputs} samples its channels one after the other", "ni.inputs",
                "use inputs that are sampled at the same time, such as those of an NI-9223",
            )  # fmt: skip

    def start(self, rate_hz: int) -> None:
        """Play and sample from the start trigger on, with which the first frame begins."""
        self.stop()
        acquisition = self.acquisition
        period = _whole(acquisition.sample_rate_hz / rate_hz, "the sample rate", rate_hz)
        played = _whole(acquisition.chirp.dac_rate_hz / rate_hz, "the DAC's rate", rate_hz)
        chirp = self._settings.amplitude_v * acquisition.chirp.waveform()
        if len(chirp) > played or acquisition.samples > period:
            raise ConfigError(f"is {rate_hz}: a frame lasts longer than that", "device.rate_hz", "lower it")
        try:
            output, inputs = self._task(), self._task()
            self._prepare_output(output, np.concatenate([chirp, np.zeros(played - len(chirp))]))
            self._prepare_inputs(inputs)
            self._reader = stream_readers.AnalogUnscaledReader(inputs.in_stream)
            inputs.start()  # armed first: it waits for the output
            output.start()
        except DaqError as error:
            self.stop()
            raise DaqGone(f"it cannot be started ({error.error_code})") from error
        self._counts: NDArray[np.int16] = np.zeros(acquisition.shape, np.int16)
        self._rest: NDArray[np.int16] = np.zeros((acquisition.channels, period - acquisition.samples), np.int16)
        self._period_s, self._frame = 1 / rate_hz, 0
        self._periods, self._every = 0, 1

    def read(self, timeout_s: float) -> DaqFrame | None:
        """Return the next frame as soon as its last sample is taken."""
        timeout_s = max(timeout_s, 3 * self._period_s)
        try:
            every = self._every if self._frame else 0
            for _ in range(max(every, 1)):
                if self._frame and self._rest.size:  # from the end of the last frame to the beginning of the next one
                    self._reader.read_int16(self._rest, self._rest.shape[1], timeout_s)
                self._reader.read_int16(self._counts, self._counts.shape[1], timeout_s)
        except DaqError as error:
            # A time-out, too, may come within a frame: only a new start finds the beginning of one.
            raise DaqGone(f"reading fails ({error.error_code})") from error
        sequence, self._frame = self._frame, self._frame + 1
        self._periods += every
        return DaqFrame(self._counts, sequence, round(self._periods * self._period_s * 1e6), clipped=self._clipped())

    def set_rate(self, rate_hz: int) -> None:
        """Pass on every n-th frame: the output's buffer goes on unchanged, and is sampled at its own rate."""
        self._every = max(1, round(1 / (rate_hz * self._period_s)))

    def stop(self) -> None:
        """End both tasks."""
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            with contextlib.suppress(DaqError):
                task.close()

    def reset(self) -> None:
        """Reset the device."""
        self.stop()
        with contextlib.suppress(DaqError):
            nidaqmx.system.device.Device(self._settings.inputs.partition("/")[0]).reset_device()

    def close(self) -> None:
        """Release the device; never fails."""
        self.stop()

    def _task(self) -> Any:
        task = nidaqmx.Task()
        self._tasks.append(task)
        return task

    def _prepare_output(self, output: Any, period_v: NDArray[np.float64]) -> None:
        """Load one period into the output's buffer, to be played again and again."""
        limit_v = self._settings.output_limit_v
        output.ao_channels.add_ao_voltage_chan(self._settings.output, min_val=-limit_v, max_val=limit_v)
        output.timing.cfg_samp_clk_timing(
            self.acquisition.chirp.dac_rate_hz, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=len(period_v)
        )
        output.out_stream.regen_mode = RegenerationMode.ALLOW_REGENERATION
        stream_writers.AnalogSingleChannelWriter(output.out_stream, auto_start=False).write_many_sample(period_v)

    def _prepare_inputs(self, inputs: Any) -> None:
        """Let the inputs sample continuously from the output's start trigger on."""
        acquisition, settings = self.acquisition, self._settings
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

    def _clipped(self) -> bool:
        limit = 2 ** (self.acquisition.bits - 1) - 1
        return bool(self._counts.max() >= limit or self._counts.min() <= -limit)


def _start_of(output: str) -> str:
    """Return the terminal of an output's start trigger, which the modules of a chassis share."""
    chassis = re.sub(r"Mod\d+$", "", output.partition("/")[0])
    return f"/{chassis}/ao/StartTrigger"


def _whole(samples: float, what: str, rate_hz: int) -> int:
    if samples != round(samples):
        raise ConfigError(
            f"is {rate_hz}, which {what} is no multiple of", "device.rate_hz", "use a divisor, such as 100 or 125"
        )
    return round(samples)
