"""ALSA's own library below the audio source: a card made of files, since computers for tests have no sound device."""

from __future__ import annotations

import ctypes
import os
import select
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import alsaaudio
import numpy as np
import pytest

from tests.processes import PATIENCE_S, ROOT, environment
from touchd.audio import alsa
from touchd.audio.alsa import AHEAD_S, AlsaCard
from touchd.audio.card import CardAbsent, CardGone, CardXrun

CONFIG = """
</usr/share/alsa/alsa.conf>
pcm.bench {{
    type asym
    playback.pcm {{ type file slave.pcm null file "{home}/out.raw" format "raw" }}
    capture.pcm {{ type file slave.pcm null file "/dev/null" infile "{home}/in.raw" format "raw" }}
}}
pcm.ten {{ type asym; playback.pcm null; capture.pcm five_and_five }}
pcm.five_and_five {{
    type multi
    slaves.a {{ pcm null channels 5 }}
    slaves.b {{ pcm null channels 5 }}
    bindings [ {bindings} ]
}}
"""
PROGRAM = """
import sys
import numpy as np
from touchd.audio.alsa import AlsaCard
from touchd.audio.card import CardAbsent
card = AlsaCard("bench", 48000, 4)
loop = np.sin(2 * np.pi * np.arange(480) / 48) / 2
card.start(loop)
blocks = []
while len(blocks) < 100:
    block = card.exchange(0.1)
    if block is not None:
        blocks.append(block.copy())
card.close()
np.save(sys.argv[1], np.concatenate(blocks))
ten = AlsaCard("ten", 48000, 4)
ten.start(loop)
np.save(sys.argv[1].replace("captured", "ten"), ten.exchange(0.1))
ten.close()
import touchd.audio.alsa
from pathlib import Path
for cards in ("none", "cards"):
    touchd.audio.alsa.CARDS = Path(sys.argv[1]).parent / cards
    for name in ("hw:CARD=Nowhere,DEV=0", "Nowhere", "hw:Nowhere", "hw:7,0", "hw:99", "plughw:99,0"):
        try:
            AlsaCard(name, 48000, 4)
        except CardAbsent as absent:
            print(absent)
try:
    AlsaCard("hw:CARD=Denied,DEV=0", 48000, 4)
except CardAbsent as absent:
    print(absent)
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what was captured and played, and with what was said of a card that is not there."""
    home = tmp_path_factory.mktemp("alsa")
    (home / "cards" / "card0").mkdir(parents=True)
    (home / "cards" / "Denied").symlink_to("card0")
    bindings = " ".join(f"{{ slave {slave} channel {at} }}" for slave in "ab" for at in range(5))
    (home / "asound.conf").write_text(CONFIG.format(home=home, bindings=bindings))
    (np.arange(4 * 48_000).reshape(-1, 4) << 12).astype("<i4").tofile(home / "in.raw")
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, home / "captured.npy"], capture_output=True, text=True, timeout=PATIENCE_S,
        cwd=ROOT, env={**environment(), "ALSA_CONFIG_PATH": str(home / "asound.conf")},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (home / "said").write_text(done.stdout + done.stderr)
    return home


def test_what_is_played_is_the_loop_again_and_again(home: Path) -> None:
    """On both outputs, to the last bit, without a gap at the loop's end."""
    played = np.fromfile(home / "out.raw", "<i4").reshape(-1, 2)
    loop = np.sin(2 * np.pi * np.arange(480) / 48) / 2
    expected = np.tile(loop, len(played) // 480 + 1)[: len(played), None] * 2**31
    assert len(played) > 4800
    assert np.abs(played - expected).max() <= 0.5


def test_what_is_captured_is_the_upper_16_bits_in_order(home: Path) -> None:
    captured = np.load(home / "captured.npy").ravel()
    assert len(captured) == 4 * 4800
    assert (captured == (captured[0] * 16 + np.arange(len(captured))) // 16).all()


def test_a_card_that_has_ten_inputs_and_no_fewer(home: Path) -> None:
    """ALSA's own library is asked how many there are: most interfaces have one number of inputs."""
    assert np.load(home / "ten.npy").shape[1] == 10


def test_a_card_that_is_not_there_is_told_in_one_line(home: Path) -> None:
    """ALSA's library would print lines of its own each time that the daemon looks."""
    lines = (home / "said").read_text().splitlines()[:-1]
    names = ["hw:CARD=Nowhere,DEV=0", "Nowhere", "hw:Nowhere", "hw:7,0", "hw:99", "plughw:99,0"]
    there = "; no card is", ", or name a card that is there: hw:CARD=Denied"
    assert lines == [f"there is no {name}: plug it in{those}" for those in there for name in names]


def test_a_card_that_may_not_be_opened_is_not_called_absent(home: Path) -> None:
    """ALSA's library lists no card that this user may not open."""
    line = (home / "said").read_text().splitlines()[-1]
    assert line.startswith("hw:CARD=Denied,DEV=0 is there, but may not be opened: join the group audio")


class Driver:
    """A stream of a card whose driver answers as a test says; other answers are those of a card that works."""

    said: dict[str, object]

    def __init__(self, **asked: object) -> None:
        if isinstance(refusal := self.said.get("open"), Exception):
            raise refusal
        if asked["format"] in (self.said.get("too wide") or ()):  # type: ignore[operator]  # of objects
            raise alsaaudio.ALSAAudioError("No space left on device [hw:CARD=U18]")
        self._asked = asked
        self._ready = os.eventfd(1)

    def info(self) -> dict[str, object]:
        return {
            "rate": self.said.get("rate", self._asked["rate"]), "channels": self._asked["channels"],
            "format": self._asked["format"], "buffer_size": self.said.get("buffer_size", 96), "period_size": 48,
        }  # fmt: skip

    def polldescriptors(self) -> list[tuple[int, int]]:
        if isinstance(refusal := self.said.get("poll"), Exception):
            raise refusal
        return [(self._ready, select.POLLIN)]

    def drop(self) -> None:
        pass

    def read(self) -> tuple[int, bytes]:
        answer = self.said.get("read", (0, b""))
        if isinstance(answer, Exception):
            raise answer
        assert isinstance(answer, tuple)
        return answer

    def write(self, data: bytes) -> int:
        answer = self.said.get("write", len(data) // 8)
        assert isinstance(answer, int)
        self.said["written"] = int(str(self.said.get("written", 0))) + answer
        return answer

    def close(self) -> None:
        os.close(self._ready)
        self.said["closed"] = int(str(self.said.get("closed", 0))) + 1


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, object]]:
    """What the driver answers."""
    Driver.said = {}
    monkeypatch.setattr(alsaaudio, "PCM", Driver)
    yield Driver.said
    Driver.said = {}


Modes = list[tuple[int, int, tuple[int, ...]]]
"""Format, number of channels and sample rates of each mode of a USB interface."""
MODES: Modes = [
    (alsaaudio.PCM_FORMAT_S16_LE, 2, (44_100, 48_000, 96_000, 192_000)),
    (alsaaudio.PCM_FORMAT_S24_3LE, 10, (88_200, 96_000)),
    (alsaaudio.PCM_FORMAT_S24_3LE, 18, (44_100, 48_000)),
]


class Library:
    """ALSA's library over a USB interface, which has its modes and none between them."""

    def __init__(self, modes: Modes) -> None:
        self._all = self._left = modes
        self.open = 0

    def snd_pcm_open(self, *_: object) -> int:
        self.open += 1
        return 0

    def snd_pcm_close(self, *_: object) -> None:
        self.open -= 1

    def snd_pcm_hw_params_malloc(self, *_: object) -> None:
        self.open += 1

    def snd_pcm_hw_params_free(self, *_: object) -> None:
        self.open -= 1

    def snd_pcm_hw_params_any(self, *_: object) -> int:
        self._left = self._all
        return 0

    def snd_pcm_hw_params_set_format(self, _stream: object, _params: object, sample: int) -> int:
        return self._narrow([mode for mode in self._left if mode[0] == sample])

    def snd_pcm_hw_params_set_rate(self, _stream: object, _params: object, rate_hz: int, _beside: int) -> int:
        return self._narrow([mode for mode in self._left if rate_hz in mode[2]])

    def snd_pcm_hw_params_set_channels_min(self, _stream: object, _params: object, least: Reference) -> int:
        return self._narrow([mode for mode in self._left if mode[1] >= least._obj.value])

    def snd_pcm_hw_params_get_channels_min(self, _params: object, found: Reference) -> None:
        found._obj.value = min(mode[1] for mode in self._left)

    def snd_pcm_hw_params_get_channels_max(self, _params: object, found: Reference) -> None:
        found._obj.value = max(mode[1] for mode in self._left)

    def _narrow(self, left: Modes) -> int:
        self._left = left or self._left
        return 0 if left else -22


class Reference(Protocol):
    """What `ctypes.byref` returns."""

    _obj: ctypes.c_uint


@pytest.mark.parametrize(("rate_hz", "inputs", "channels"), [(48_000, 12, 18), (96_000, 5, 10), (192_000, 2, 2)])
def test_a_card_opens_in_the_mode_that_has_the_inputs(
    driver: dict[str, object], monkeypatch: pytest.MonkeyPatch, rate_hz: int, inputs: int, channels: int
) -> None:
    """An interface has 2, 10 or 18 inputs, by its mode: a disc at input 12 is heard although none has 12."""
    library = Library(MODES)
    monkeypatch.setattr(alsa, "_LIBRARY", library)
    driver["read"] = (48, bytes(48 * channels * 4))
    card = AlsaCard("hw:CARD=U18", rate_hz, inputs)
    card.start(np.zeros(480))
    block = card.exchange(0.1)
    card.close()
    assert block is not None
    assert block.shape == (48, channels)
    assert library.open == 0


def test_a_port_that_is_too_narrow_for_24_bits(driver: dict[str, object]) -> None:
    """A USB port may have no room for 32 or 24 bits a sample, and some for 16, of which touchd uses no more."""
    driver["too wide"] = (alsaaudio.PCM_FORMAT_S32_LE, alsaaudio.PCM_FORMAT_S24_3LE)
    driver["read"] = (48, bytes(48 * 4 * 2))
    card = AlsaCard("null", 48_000, 4)
    card.start(np.zeros(480))
    block = card.exchange(0.1)
    card.close()
    assert block is not None
    assert block.shape == (48, 4)


@pytest.mark.parametrize(
    ("rate_hz", "inputs", "told"),
    [
        (192_000, 4, "has 2 channels at 192000 samples a second, not 4"),
        (48_000, 20, "has 18 channels at 48000 samples a second, not 20"),
        (
            176_400,
            2,
            "takes 44100, 48000, 88200, 96000, 192000 samples a second, not 176400: set another audio.sample_",
        ),
    ],
)
def test_what_a_card_has_instead_is_told(monkeypatch: pytest.MonkeyPatch, rate_hz: int, inputs: int, told: str) -> None:
    """The rates that it takes, and the most inputs that it has at this one."""
    library = Library(MODES)
    monkeypatch.setattr(alsa, "_LIBRARY", library)
    with pytest.raises(CardAbsent, match=told):
        AlsaCard("hw:CARD=U18", rate_hz, inputs)
    assert library.open == 0


def test_a_long_buffer_is_filled_as_far_as_a_short_one(driver: dict[str, object]) -> None:
    """A card whose outputs follow the clock of its inputs plays from a buffer as long as theirs, half a second.

    Full, it would let nothing be heard for so long that each start was given up.
    """
    driver["buffer_size"] = 24_000
    card = AlsaCard("null", 48_000, 4)
    card.start(np.zeros(480))
    assert driver["written"] == AHEAD_S * 48_000
    assert card.ahead == AHEAD_S * 48_000 + 48
    card.close()


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"open": alsaaudio.ALSAAudioError("No such device or address [hw:CARD=U18]")}, "has no valid clock: set its"),
        (
            {"open": alsaaudio.ALSAAudioError("No space left on device [hw:CARD=U18]")},
            "too little of its USB port: use",
        ),
        ({"open": alsaaudio.ALSAAudioError("Invalid argument [hw:CARD=U18]")}, r"^Invalid argument \[hw:CARD=U18\]$"),
    ],
)
def test_a_card_that_does_not_run_is_not_called_absent(
    driver: dict[str, object], monkeypatch: pytest.MonkeyPatch, said: dict[str, object], told: str
) -> None:
    """Plugging in a card that is there mends no clock that waits for S/PDIF."""
    monkeypatch.setattr(alsa, "_LIBRARY", Library(MODES))
    driver |= said
    with pytest.raises(CardAbsent, match=told):
        AlsaCard("hw:CARD=U18", 96_000, 4)


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ({"open": alsaaudio.ALSAAudioError("Device or resource busy [null]")}, "null is in use by another program"),
        ({"open": alsaaudio.ALSAAudioError("Permission denied [null]")}, "null is there, but may not be opened"),
        ({"rate": 44_100}, "null takes 44100 samples a second and 4 channels, not as it said"),
    ],
)
def test_a_card_that_cannot_be_used_says_why(driver: dict[str, object], said: dict[str, object], told: str) -> None:
    driver |= said
    with pytest.raises(CardAbsent, match=told):
        AlsaCard("null", 48_000, 4)


def test_a_card_that_is_pulled_while_it_is_opened_is_absent(driver: dict[str, object]) -> None:
    """Both streams are closed, and the card is looked for again."""
    driver["poll"] = alsaaudio.ALSAAudioError("Can't get poll descriptors [null]")
    with pytest.raises(CardAbsent, match="poll descriptors"):
        AlsaCard("null", 48_000, 4)
    assert driver["closed"] == 2


def test_a_playback_that_runs_dry_while_it_starts_ends_the_connection(driver: dict[str, object]) -> None:
    """A start that fails is tried again like a card that is gone."""
    card = AlsaCard("null", 48_000, 4)
    driver["write"] = -32
    with pytest.raises(CardGone, match="too late to write"):
        card.start(np.zeros(480))
    card.close()


def test_a_card_that_is_away_is_looked_for_without_pyalsaaudio(driver: dict[str, object]) -> None:
    """It loses memory with each stream that does not open."""
    driver["open"] = AssertionError("opened")
    with pytest.raises(CardAbsent, match="there is no hw:CARD=Nowhere: plug it in"):
        AlsaCard("hw:CARD=Nowhere", 48_000, 4)


@pytest.mark.parametrize(
    ("said", "kind", "told"),
    [
        ({"read": (-32, b"")}, CardXrun, "too late to read"),
        ({"read": (48, bytes(768)), "write": -32}, CardXrun, "too late to write"),
        ({"read": alsaaudio.ALSAAudioError("No such device [null]")}, CardGone, "there is no null: plug it in"),
    ],
)
def test_what_happens_to_a_stream_is_told(
    driver: dict[str, object], said: dict[str, object], kind: type[Exception], told: str
) -> None:
    """Samples lost on either side are an xrun, after which the card is started again; a card that is pulled is gone."""
    card = AlsaCard("null", 48_000, 4)
    card.start(np.zeros(480))
    driver |= said
    with pytest.raises(kind, match=told):
        card.exchange(0.1)
    card.close()
