"""`touchd audio-check`: what it measures is what the card is."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from tests.audiocard import SMALL_PLATE, CableCard
from tests.command_line import touchd
from touchd.audio.check import Checked, check
from touchd.audio.delay import Doubtful
from touchd.cli.audio_check import result, text
from touchd.config.rigs import AudioSettings
from touchd.errors import ConfigError, SimulationError


def checked(card: CableCard, restarts: int = 1, seconds: float = 0.05) -> Checked:
    """What is measured of a card whose seconds are this computer's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("touchd.audio.check.time", SimpleNamespace(monotonic=lambda: card.seconds))
        return check(card, restarts=restarts, seconds=seconds, level_dbfs=-12.0)


@pytest.fixture(scope="module")
def found() -> Checked:
    return checked(CableCard(), restarts=5, seconds=0.2)


def test_the_table_says_what_the_card_is(found: Checked) -> None:
    """Input 2 at -6 dB, noise of -77 dBFS, crosstalk of -54 dB, harmonics that fall with the level."""
    assert found.cable == 2
    assert found.gain_db == pytest.approx(-6.0, abs=0.2)
    assert found.noise_dbfs == pytest.approx([-77.0] * 3, abs=0.5)
    assert found.crosstalk_db[0] == pytest.approx(-54.0, abs=1.0)
    distortion = [db for db in found.distortion_db.values() if db is not None][:3]  # less is noise
    assert distortion == sorted(distortion, reverse=True)
    # The third harmonic of x + 1e-3 x^3 has a quarter of 1e-3 of the square of the amplitude.
    assert found.distortion_db["-1"] == pytest.approx(-74.0, abs=1.0)
    assert found.resamples == ""
    assert (found.level_dbfs, found.xruns) == (-1.0, 0)


def test_the_delay_is_told_with_its_fraction(found: Checked) -> None:
    assert [delay % 1 for delay in found.delays] == pytest.approx([0.25] * 5, abs=2e-3)
    assert found.delay_spread < 2e-3


def test_the_table_and_the_object_are_whole(found: Checked) -> None:
    lines = text(found)
    assert [line.split()[0] for line in lines if line[0] != " "] == [
        "cable", "sample", "noise", "crosstalk", "distortion", "delay", "xruns", "use",
    ]  # fmt: skip
    assert not [line for line in lines if "->" in line], "nothing is wrong"
    assert {"band_hz", "level_dbfs", "delay_spread_samples", "response_db"} <= result(found).keys()


def test_what_it_says_to_use_can_be_pasted(found: Checked) -> None:
    """Below `use` stand settings of `[audio]` as the configuration takes them."""
    _, said = "\n".join(line[13:] for line in text(found)).split("[audio]")
    used = AudioSettings.model_validate(tomllib.loads(said))
    assert (used.sample_rate_hz, used.band_hz, used.level_dbfs) == (48_000, found.band_hz, -1.0)


def test_hum_outside_the_band_does_not_count() -> None:
    """The noise that a chirp's band brings is what says how far noise lies below the chirp."""
    card = CableCard()
    card.hum = 0.01
    found = check(card, restarts=1, seconds=0.05, level_dbfs=-12.0)
    assert found.noise_dbfs == pytest.approx([-40.0] * 3, abs=0.5)
    assert found.floor_dbfs == pytest.approx(-77.0, abs=0.5)
    assert found.snr_db == pytest.approx(-1.0 - 6.0 + 77.0, abs=0.7)


def test_a_remedy_follows_what_will_not_do() -> None:
    card = CableCard()
    card.noise = 3e-3
    lines = text(checked(card))
    (remedy,) = (line for line in lines if "->" in line)
    assert lines[lines.index(remedy) - 1].startswith("noise")
    assert "60 dB are wanted" in remedy


@pytest.mark.parametrize("fault", ["hum", "offset", "muted_s"])
def test_what_inputs_hear_beside_the_output(found: Checked, fault: str) -> None:
    """Mains hum, of which inputs without a cable hear most, and an offset, each stronger than the cable's signal, hide
    no cable; nor does an output that is silent at first."""
    card = CableCard()
    setattr(card, fault, 0.4)
    heard = checked(card, restarts=5)
    assert heard.cable == 2
    assert heard.gain_db == pytest.approx(found.gain_db, abs=0.1)
    assert heard.delays == pytest.approx(found.delays, abs=2e-3)


@pytest.mark.parametrize(
    ("change", "row", "told"),
    [
        ({"automatic": 0.5}, "cable", "changes by 9.5 dB with the level: switch automatic gain off"),
        ({"gains": np.array([0.3, 0.5, 0.0])}, "crosstalk", "the output is mixed to input 1, too"),
        ({"monitored": 0.5}, "delay", "heard again 2.0 ms later, at -12 dB: switch direct monitoring off"),
        ({"gains": np.array([0.0, 3e-3, 0.0])}, "noise", "60 dB are wanted"),
        ({"gains": np.array([0.0, 8.0, 0.0])}, "distortion", "turn the input's gain down"),
    ],
)
def test_what_a_card_does_on_its_own_account(change: dict[str, Any], row: str, told: str) -> None:
    """Automatic gain, a mixer inside and an input that clips are told with their remedy; noise is not called mixing."""
    card = CableCard()
    for name, value in change.items():
        setattr(card, name, value)
    lines = text(checked(card))
    (remedy,) = (line for line in lines if "->" in line)
    assert told in remedy
    assert lines[lines.index(remedy) - 1].startswith(row)


def test_an_input_that_clips_in_silence() -> None:
    """As where direct monitoring howls: no cable is blamed."""
    card = CableCard()
    card.noise = 1.0
    with pytest.raises(Doubtful, match="input 1, 2, 3 clips while nothing is played: switch direct monitoring off"):
        checked(card)


@pytest.mark.parametrize(("apart_ppm", "told"), [(-50.0, r"(4|5)\d"), (10.0, r"1\d")])
def test_two_clocks(apart_ppm: float, told: str) -> None:
    """Where the output's clock is not the input's, no delay lasts: nothing else is worth a table."""
    card = CableCard()
    card.apart_ppm = apart_ppm
    with pytest.raises(Doubtful, match=f"on clocks of their own, {told} ppm apart"):
        checked(card)


def test_a_table_of_many_inputs_is_no_wider_than_a_terminal() -> None:
    card = CableCard(inputs=18)
    assert max(map(len, text(checked(card)))) <= 120


def test_the_expected_error_on_a_plate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With PLATE.toml the table ends with what noise leaves of a fingertip's place, and the picture has a map of it."""
    (tmp_path / "PLATE.toml").write_text(SMALL_PLATE)
    (tmp_path / "touchd.toml").write_text("[audio]\nsample_rate_hz = 96000\nband_hz = [15e3, 44e3]\nchirp_s = 0.001\n")
    expected = []
    for noise in (1e-4, 1e-3):
        card = CableCard(96_000)
        card.noise = noise
        monkeypatch.setattr("touchd.audio.alsa.AlsaCard", lambda *_, card=card: card)
        done = touchd(
            "audio-check", "hw:CARD=Fake", "--config", tmp_path / "touchd.toml", "--plate", tmp_path / "PLATE.toml",
            "--restarts", 1, "--seconds", 0.1, "-o", tmp_path / "card.png", "--json",
        )  # fmt: skip
        assert done.code == 0, done.err
        expected.append(json.loads(done.out)["expected"])
    assert expected[0]["median_mm"] < expected[0]["p95_mm"] < expected[0]["worst_mm"] < 0.3
    assert expected[1]["median_mm"] == pytest.approx(10 * expected[0]["median_mm"], rel=0.1)
    assert (tmp_path / "card.png").stat().st_size > 10_000


def test_a_chirp_that_no_frame_can_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With PLATE.toml a chirp that the daemon would refuse is refused before the card is measured, by its remedy."""
    (tmp_path / "PLATE.toml").write_text(SMALL_PLATE)
    monkeypatch.setattr("touchd.audio.alsa.AlsaCard", Mock(side_effect=AssertionError("it was opened")))
    done = touchd(
        "audio-check", "hw:CARD=Fake", "--plate", tmp_path / "PLATE.toml",
        TOUCHD_AUDIO__SAMPLE_RATE_HZ="44100", TOUCHD_AUDIO__BAND_HZ="[1000, 20000]",
    )  # fmt: skip
    assert done.code == ConfigError.exit_code
    assert "set audio.chirp_s = 0.00396825" in done.err


def test_a_plate_that_is_too_thin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is refused before a minute of measuring, too."""
    (tmp_path / "PLATE.toml").write_text(SMALL_PLATE.replace("= 110", "= 1100").replace("= 5", "= 1"))
    monkeypatch.setattr("touchd.audio.alsa.AlsaCard", Mock(side_effect=AssertionError("it was opened")))
    done = touchd("audio-check", "hw:CARD=Fake", "--plate", tmp_path / "PLATE.toml")
    assert done.code == SimulationError.exit_code
    assert "make it smaller or thicker" in done.err


@pytest.mark.parametrize("lowpass_hz", [70_000, 40_000])
def test_the_band_ends_where_less_passes(lowpass_hz: int) -> None:
    """Also where most of what 192 kHz could hold does not pass, as with many interfaces: no cable is blamed for it."""
    card = CableCard(192_000)
    card.lowpass_hz = lowpass_hz
    found = check(card, restarts=2, seconds=0.05, level_dbfs=-12.0)
    assert found.band_hz[0] == 20_000
    assert 0.9 * lowpass_hz < found.band_hz[1] < 1.01 * lowpass_hz
    assert [delay % 1 for delay in found.delays] == pytest.approx([0.25] * 2, abs=2e-3)


def test_a_rate_in_name_alone_is_told() -> None:
    card = CableCard(192_000)
    card.lowpass_hz = 48_000
    found = check(card, restarts=1, seconds=0.05, level_dbfs=-12.0)
    assert "audio.sample_rate_hz = 96000" in found.resamples


def test_clipping_lowers_the_level() -> None:
    card = CableCard()
    card.gains[1] = 1.3
    found = check(card, restarts=1, seconds=0.05, level_dbfs=-12.0)
    assert found.distortion_db["-1"] is None
    assert found.level_dbfs == -3.0


@pytest.mark.parametrize("noise", [1e-4, 0.0])
def test_without_a_cable_it_says_so(noise: float) -> None:
    """Of a muted card, too, which has not even noise."""
    card = CableCard()
    card.noise = noise
    card.gains[:] = 0
    with pytest.raises(Doubtful, match=r"with a cable, unmute it \(alsamixer\)"):
        check(card, restarts=1, seconds=0.05, level_dbfs=-12.0)


def test_xruns_are_counted() -> None:
    """Those of the time that is asked for; a measurement that one hits is repeated."""
    card = CableCard()
    card.xruns = 2

    def progress(what: str) -> None:
        card.xruns = 3 if what.startswith("xruns") else card.xruns

    assert check(card, restarts=1, seconds=0.05, level_dbfs=-12.0, progress=progress).xruns == 3


def test_the_true_rate_is_told() -> None:
    """By this computer's clock, which here is the card's true one; one that is far off has a remedy."""
    card = CableCard()
    card.true_rate_hz = 48_005.0
    found = checked(card, seconds=1.0)
    assert found.true_rate_hz == pytest.approx(48_005.0, abs=0.1)
    lines = text(found)
    assert "48005.0 Hz, +104 ppm" in lines[1]
    assert "->" not in lines[2]
    card = CableCard()
    card.true_rate_hz = 44_100.0
    assert "-> the card takes other samples than it says" in text(checked(card, seconds=1.0))[2]


def test_an_inverted_cable(found: Checked) -> None:
    """A cable, or a card, that inverts the signal tells delays as any other."""
    card = CableCard()
    card.gains *= -1
    assert checked(card, restarts=5).delays == pytest.approx(found.delays, abs=2e-3)
