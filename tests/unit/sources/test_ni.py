"""The rig of NI hardware, against the vendor's package: each call is one that the package has, with its arguments.

The driver is not there, so nothing here shows that hardware does what it is told.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import nidaqmx
import numpy as np
import pytest
from nidaqmx import stream_readers, stream_writers
from nidaqmx.constants import AcquisitionType, RegenerationMode
from nidaqmx.errors import DaqError, DaqFunctionNotSupportedError, DaqNotFoundError
from nidaqmx.system.device import Device
from nidaqmx.task import InStream, OutStream, Task
from nidaqmx.task.collections import AIChannelCollection, AOChannelCollection
from nidaqmx.task.triggering import StartTrigger, Triggers
from numpy.typing import NDArray

from touchd.config.rigs import NiSettings
from touchd.config.schema import DeviceSettings
from touchd.errors import ConfigError, SourceError
from touchd.frame import Acquisition
from touchd.sources.daq import DaqAbsent, DaqGone
from touchd.sources.live import DaqSource
from touchd.sources.ni import NiDaq

ACQUISITION = Acquisition(channels=4, samples=250, sample_rate_hz=250e3)
SETTINGS = NiSettings()


def spec(kind: type, **attributes: Any) -> MagicMock:
    """A mock that has what the class has, no more, and checks the arguments of each call."""
    # Not unittest.mock's autospec, which also parses the signatures of all that hangs on a class.
    made = MagicMock(spec_set=[name for name in dir(kind) if not name.startswith("__")])
    for name in dir(kind):
        function = inspect.getattr_static(kind, name)
        if inspect.isfunction(function) and not name.startswith("_"):
            setattr(made, name, MagicMock(side_effect=checked(function)))
    for name, value in attributes.items():
        setattr(made, name, value)
    return made


def checked(method: Callable[..., Any]) -> Callable[..., None]:
    """A function that takes what the method takes, and nothing else."""
    signature = inspect.signature(method)

    def call(*arguments: Any, **named: Any) -> None:
        signature.bind(None, *arguments, **named)

    return call


def test_the_mock_is_strict() -> None:
    """A call that the vendor's package does not have fails."""
    timing = spec(nidaqmx.task._timing.Timing)
    with pytest.raises(TypeError):
        timing.cfg_samp_clk_timing(250e3, sampling="continuous")
    with pytest.raises(AttributeError):
        timing.configure(250e3)


class Rig:
    """The vendor's package with a rig behind it: each sample of channel c is its number, plus 1000 c."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.tasks: list[MagicMock] = []
        self.order: list[str] = []
        self.written: list[NDArray[np.float64]] = []
        self.next = 0
        self.fail: Exception | None = None
        self.device = spec(Device, serial_num=0x1234ABCD, ai_simultaneous_sampling_supported=True)
        self.found: Callable[[str], MagicMock] = lambda _name: self.device
        monkeypatch.setattr(nidaqmx, "Task", self.task)
        monkeypatch.setattr(nidaqmx.system.device, "Device", lambda name: self.found(name))
        monkeypatch.setattr(stream_readers, "AnalogUnscaledReader", self.reader)
        monkeypatch.setattr(stream_writers, "AnalogSingleChannelWriter", self.writer)

    def task(self) -> MagicMock:
        number = len(self.tasks)
        task = spec(
            Task, ai_channels=spec(AIChannelCollection), ao_channels=spec(AOChannelCollection),
            timing=spec(nidaqmx.task._timing.Timing), in_stream=spec(InStream), out_stream=spec(OutStream),
            number_of_channels=4,
            triggers=SimpleNamespace(start_trigger=spec(StartTrigger)),
        )  # fmt: skip
        assert hasattr(Triggers, "start_trigger")
        task.start.side_effect = lambda: self.order.append("output" if number % 2 == 0 else "inputs")
        self.tasks.append(task)
        return task

    def reader(self, stream: Any) -> MagicMock:
        assert stream is self.tasks[-1].in_stream
        reader = spec(REAL_READER)

        def read_int16(data: NDArray[np.int16], number_of_samples_per_channel: int = -1, timeout: float = 10.0) -> int:
            assert timeout > 0
            if self.fail:
                raise self.fail
            assert data.shape == (4, number_of_samples_per_channel)
            data[:] = self.next + np.arange(data.shape[1]) + 1000 * np.arange(4)[:, None]
            self.next += data.shape[1]
            return data.shape[1]

        reader.read_int16.side_effect = read_int16
        return reader

    def writer(self, stream: Any, auto_start: bool) -> MagicMock:
        assert stream is self.tasks[-2].out_stream
        assert auto_start is False
        writer = spec(REAL_WRITER)
        writer.write_many_sample.side_effect = lambda data, timeout=10.0: self.written.append(data)  # noqa: ARG005 - its
        return writer


REAL_READER, REAL_WRITER = stream_readers.AnalogUnscaledReader, stream_writers.AnalogSingleChannelWriter


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    made = Rig(monkeypatch)
    yield made
    for task in made.tasks:
        task.close.assert_called_once_with()


def started(rate_hz: int = 125) -> NiDaq:
    daq = NiDaq(SETTINGS, ACQUISITION)
    daq.start(rate_hz)
    return daq


def test_output(rig: Rig) -> None:
    """The output plays one period, the chirp first, again and again."""
    started().close()
    output = rig.tasks[0]
    output.ao_channels.add_ao_voltage_chan.assert_called_once_with("cDAQ1Mod2/ao0", min_val=-10.0, max_val=10.0)
    output.timing.cfg_samp_clk_timing.assert_called_once_with(
        500e3, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=4000
    )
    assert output.out_stream.regen_mode == RegenerationMode.ALLOW_REGENERATION
    (played,) = rig.written
    np.testing.assert_allclose(played[:500], 5.0 * ACQUISITION.chirp.waveform())
    assert not played[500:].any()
    assert len(played) == 4000


def test_inputs(rig: Rig) -> None:
    """The inputs are armed first, and wait for the output's start trigger."""
    started().close()
    inputs = rig.tasks[1]
    inputs.ai_channels.add_ai_voltage_chan.assert_called_once_with("cDAQ1Mod1/ai0:3", min_val=-10.0, max_val=10.0)
    inputs.timing.cfg_samp_clk_timing.assert_called_once_with(
        250e3, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=250_000
    )
    inputs.triggers.start_trigger.cfg_dig_edge_start_trig.assert_called_once_with("/cDAQ1/ao/StartTrigger")
    assert rig.order == ["inputs", "output"]


def test_frames(rig: Rig) -> None:
    """Each frame begins a period after the last one, and is returned before the pause behind it."""
    daq = started()
    for i in range(5):
        frame = daq.read(0.1)
        assert frame is not None
        assert (frame.sequence, frame.timestamp_us, frame.clipped, frame.withheld) == (i, i * 8000, False, "")
        assert frame.counts.shape == ACQUISITION.shape
        np.testing.assert_array_equal(frame.counts[2], np.arange(250) + 2000 * i + 2000)
        # Nothing of the pause is waited for before the frame is handed out.
        assert rig.next == 2000 * i + 250
    daq.close()


@pytest.mark.parametrize(
    ("first", "clipped"), [(0, False), (32767 - 3249, True), (32766 - 3249, False), (-32767, True), (-32766, False)]
)
def test_clipped(rig: Rig, first: int, clipped: bool) -> None:
    """A sample at either limit of the ADC sets `clipped`; the counts span `first` to `first` + 3249."""
    daq = started()
    rig.next = first
    frame = daq.read(0.1)
    assert frame is not None
    assert frame.clipped is clipped
    daq.close()


def test_source(rig: Rig) -> None:
    """`DaqSource` reads it like any DAQ."""
    device = DeviceSettings(queue_frames=1000)
    source = DaqSource(lambda: iter([lambda: NiDaq(SETTINGS, ACQUISITION)]), device, ACQUISITION, lambda _: None)
    numbers: list[int] = []
    while len(numbers) < 10:
        frame = source.read(60.0)
        if frame is None:
            assert source.changes()
        else:
            numbers.append(frame.sequence)
    source.close()
    assert numbers == list(range(10))
    assert source.device.serial == "1234ABCD"
    assert len(rig.tasks) == 2


def test_read_fails(rig: Rig) -> None:
    """A read that fails, or is late, ends the connection, and a new start makes new tasks."""
    daq = started()
    rig.fail = DaqError("no samples", -200284)
    with pytest.raises(DaqGone, match="-200284"):
        daq.read(0.1)
    rig.fail = None
    daq.start(125)
    assert len(rig.tasks) == 4
    daq.close()


@pytest.mark.parametrize("rate_hz", [300, 1001])
def test_impossible_rate(rig: Rig, rate_hz: int) -> None:
    """A rate that does not divide the sample rates, or is too high, is refused."""
    daq = NiDaq(SETTINGS, ACQUISITION)
    with pytest.raises(ConfigError, match=r"device\.rate_hz"):
        daq.start(rate_hz)
    assert rig.tasks == []


def test_other_inputs(rig: Rig) -> None:
    """Another number of inputs than channels is refused."""
    assert rig.tasks == []
    daq = NiDaq(SETTINGS, Acquisition(channels=3, samples=250, sample_rate_hz=250e3))
    with pytest.raises(ConfigError, match="names 4 channels, not 3"):
        daq.start(125)
    daq.close()


def test_multiplexed_inputs(rig: Rig) -> None:
    """Inputs that are sampled one after the other are refused."""
    rig.device.ai_simultaneous_sampling_supported = False
    with pytest.raises(SourceError, match="one after the other"):
        NiDaq(SETTINGS, ACQUISITION)


def test_absent(rig: Rig) -> None:
    """A device that the driver does not find is absent: `DaqSource` looks again."""

    def missing(_name: str) -> MagicMock:
        raise DaqError("invalid device", -200220)

    rig.found = missing
    with pytest.raises(DaqAbsent, match="-200220"):
        NiDaq(SETTINGS, ACQUISITION)


def test_no_driver() -> None:
    """Without the driver the error says what to install."""
    try:
        nidaqmx.system.System.local().driver_version  # noqa: B018 - asks for the driver
    except DaqNotFoundError:
        with pytest.raises(SourceError, match="install NI-DAQmx"):
            NiDaq(SETTINGS, ACQUISITION)


def test_old_driver(rig: Rig) -> None:
    """A driver without a function that the rig needs is named, not taken for a fault of touchd."""

    def old(_name: str) -> MagicMock:
        raise DaqFunctionNotSupportedError("update the driver")

    rig.found = old
    with pytest.raises(SourceError, match="too old"):
        NiDaq(SETTINGS, ACQUISITION)


def test_reset(rig: Rig) -> None:
    """`reset` ends the tasks, then resets the device."""
    daq = started()
    daq.reset()
    rig.device.reset_device.assert_called_once_with()
    daq.close()


@pytest.mark.usefixtures("rig")
def test_lower_rate() -> None:
    """At a lower rate it passes on every n-th chirp, and times tell."""
    daq = started()
    assert daq.read(0.1) is not None
    daq.set_rate(50)
    found = [daq.read(0.1) for _ in range(2)]
    daq.set_rate(125)
    found.append(daq.read(0.1))
    assert [(one.sequence, one.timestamp_us) for one in found if one] == [(1, 16_000), (2, 32_000), (3, 40_000)]
    np.testing.assert_array_equal(found[-1].counts[0] if found[-1] else [], np.arange(250) + 2000 * 5)
    daq.close()
