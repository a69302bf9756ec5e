"""`touchd audio-check`: what it measures is what the card is."""

from __future__ import annotations

import pytest

from tests.audiocard import CableCard
from touchd.audio.check import Checked, check
from touchd.audio.delay import Doubtful
from touchd.cli.audio_check import result, text


@pytest.fixture(scope="module")
def found() -> Checked:
    return check(CableCard(), restarts=5, seconds=0.2, level_dbfs=-12.0)


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
    assert [line.split()[0] for line in text(found)] == [
        "cable", "sample", "noise", "crosstalk", "distortion", "delay", "xruns", "use",
    ]  # fmt: skip
    assert {"band_hz", "level_dbfs", "delay_spread_samples", "response_db"} <= result(found).keys()


def test_the_band_ends_where_less_passes() -> None:
    card = CableCard(192_000)
    card.lowpass_hz = 70_000
    found = check(card, restarts=1, seconds=0.05, level_dbfs=-12.0)
    assert found.band_hz[0] == 20_000
    assert 60_000 < found.band_hz[1] < 70_500


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


def test_without_a_cable_it_says_so() -> None:
    card = CableCard()
    card.gains[:] = 0
    with pytest.raises(Doubtful, match="with a cable"):
        check(card, restarts=1, seconds=0.05, level_dbfs=-12.0)


def test_xruns_are_counted() -> None:
    card = CableCard()
    card.xruns = 2  # during the first measurement, which is repeated
    assert check(card, restarts=1, seconds=0.05, level_dbfs=-12.0).xruns == 0
