"""Fingers become the events that the kernel's multi-touch protocol asks for."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from tests.unit.bridges.events import contact
from tests.unit.bridges.kernel import Kernel
from touchd.bridges import uinput
from touchd.bridges.area import Area, Place
from touchd.bridges.screen import Screen
from touchd.bridges.uinput import Finger, Slots, encode, fingers_at, lift_all
from touchd.config.schema import InputSettings

FINGER = st.builds(
    Finger, st.integers(0, 20000), st.integers(0, 20000), st.integers(1, 1000),
    st.tuples(st.integers(1, 10000), st.integers(1, 10000), st.integers(-90, 90)),
)  # fmt: skip
# Few numbers, so that fingers stay, go and come again in any order; more of them than slots.
FRAMES = st.lists(st.dictionaries(st.integers(65530, 65545), FINGER, max_size=8), max_size=30)


def values(number: int, one: Finger) -> dict[str, int]:
    size = dict(zip(("major", "minor", "angle"), one.size, strict=True))
    return {"id": number & 0xFFFF, "x": one.x, "y": one.y, "pressure": one.pressure, **size}


@given(FRAMES)
def test_slots_equal_fingers(frames: list[dict[int, Finger]]) -> None:
    """After each frame the kernel's slots hold the fingers that are down, each in its own slot, and nobody else."""
    kernel, held = Kernel(), Slots()
    for fingers in frames:
        before = held
        frame, held = encode(held, fingers)
        kernel.write(frame)
        assert held.keys() <= fingers.keys()
        kept = {number: slot for number, slot in before.items() if number in fingers}
        assert kept.items() <= held.items()
        assert len(held) == min(len(fingers), uinput.SLOTS - len(before) + len(kept)), "no slot stays empty"
        assert kernel.live == {slot: values(number, fingers[number]) for number, slot in held.items()}
        report = kernel.reports[-1]
        assert report.touched == bool(held)
        if held:
            oldest = fingers[min(held)]
            assert report.pointer == (oldest.x, oldest.y, oldest.pressure)
        else:
            assert report.pointer[2] == 0
    assert kernel.writes == len(kernel.reports) == len(frames), "one write and one SYN_REPORT a frame"


@given(FRAMES)
def test_lift_all(frames: list[dict[int, Finger]]) -> None:
    """The frame that lifts all empties every slot, whoever has it."""
    kernel, held = Kernel(), Slots()
    for fingers in frames:
        frame, held = encode(held, fingers)
        kernel.write(frame)
    kernel.write(lift_all())
    assert kernel.live == {}
    assert not kernel.reports[-1].touched


def test_a_slot_waits_a_frame() -> None:
    """A finger that comes while another goes gets another slot, so that no reader takes both for one."""
    full: Slots = {1: 0, 2: 1, 3: 2, 4: 3, 5: 4}
    at = Finger(1, 2, 3)
    _, held = encode(full, {2: at, 3: at, 4: at, 5: at, 6: at})
    assert held == {2: 1, 3: 2, 4: 3, 5: 4}
    _, held = encode(held, {2: at, 3: at, 4: at, 5: at, 6: at})
    assert held == {2: 1, 3: 2, 4: 3, 5: 4, 6: 0}


def test_units() -> None:
    """Positions are hundredths of a millimetre, pressure is force in thousandths and never 0."""
    down = contact(1, "down")
    place = Place(12.34, 56.78, 0.0, 0.0, 0.0, down)
    assert fingers_at({1: place})[1] == Finger(1234, 5678, 500)
    down.force = 0.0
    assert fingers_at({1: place})[1].pressure == 1
    for force in (7.0, 1e307):
        down.force = down.major_mm = down.minor_mm = force
        assert fingers_at({1: place})[1].pressure == uinput.PRESSURE_MAX
    assert fingers_at({1: place})[1].size[:2] == (uinput.SIZE_MAX, uinput.SIZE_MAX)


def test_size() -> None:
    """The contact's axes are lengths, its orientation the long axis against the screen's y axis, clockwise."""
    sized = replace(contact(1), major_mm=12.0, minor_mm=8.0)
    for angle_deg, orientation in ((90.0, 0), (-90.0, 0), (45.0, -45), (-80.0, 10), (100.0, 10)):
        place = Place(1.0, 1.0, 0.0, 0.0, angle_deg, sized)
        assert fingers_at({1: place})[1].size == (1200, 800, orientation)
    unknown = Place(1.0, 1.0, 0.0, 0.0, 0.0, contact(1))
    assert fingers_at({1: unknown})[1].size == (1, 1, 0), "never 0 while down"


def test_resting() -> None:
    """A finger that rests, or moves by less than the device's unit, writes nothing; its lift does."""
    written: list[bytes] = []

    class Device(Kernel):
        def write(self, frame: bytes) -> None:
            written.append(frame)
            super().write(frame)

    kernel = Device()
    screen, counts = Screen(Area(InputSettings(screen_mm=(0, 0, 200, 100))), kernel), []
    for x_mm in (50.0, 50.0, 50.004, 50.02, 50.02, None):
        screen.show({} if x_mm is None else {1: contact(1, x_mm=x_mm)}, 0)
        counts.append(len(written))
    assert counts == [1, 1, 1, 2, 2, 3]
    for numbers in (range(6), range(1, 6), range(1, 6)):
        screen.show({number: contact(number) for number in numbers}, 0)
    assert len(kernel.live) == 5, "the sixth has the slot that was free in the frame before"
