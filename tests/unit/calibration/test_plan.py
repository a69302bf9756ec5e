"""`touchd plan`: the expected error of a layout, and a better one."""

from __future__ import annotations

import json
import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from tests.audiocard import SMALL_PLATE
from tests.command_line import touchd
from touchd.calibration.plan import AREA_MM2, FINGER, MIRRORED_MM, PlateMap, is_mirrored
from touchd.calibration.plate_file import PlateFile, check_plate_file
from touchd.evaluation.cramer_rao import position_covariance, rms_mm, twin_field
from touchd.frame import ACQUISITIONS, Acquisition, parse_acquisition
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact

SMALL: Acquisition = ACQUISITIONS["audio-96"].model_copy(update={"channels": 3})


@pytest.fixture(scope="module")
def said() -> PlateFile:
    return check_plate_file(
        {
            "plate": {"width_mm": 110, "height_mm": 90, "thickness_mm": 5, "material": "glass"},
            "discs": {
                "diameter_mm": 6, "emitter_mm": [20, 50], "receivers_mm": [[12, 12], [98, 18], [85, 78]],
            },
        }
    )  # fmt: skip


@pytest.fixture(scope="module")
def plate_map(said: PlateFile) -> PlateMap:
    return PlateMap(said, SMALL)


def test_bound(said: PlateFile, plate_map: PlateMap) -> None:
    """The map is the bound of the twin's own touches."""
    found = plate_map.plan(said.layout().centres_mm).error_mm
    twin = Instrument(said.twin_plate(), layout=said.layout(), acquisition=SMALL)
    rng = np.random.default_rng(3)
    places = rng.uniform(6.0, [104.0, 84.0], (60, 2))
    field = twin_field(twin, [Contact(x, y, AREA_MM2, FINGER) for x, y in places.tolist()])
    untouched = twin.untouched([REFERENCE_C])[0]
    noise = Electronics().peak * 2**15 * np.sqrt(1.5e-6 * np.square(untouched).mean())
    true = rms_mm(position_covariance(field, SMALL, float(noise)))
    assert np.median(found) == pytest.approx(np.median(true), rel=0.15)


def test_long_periods(said: PlateFile) -> None:
    """A period of 0.1 s is computed as ten of 0.01 s, with next to the same bound: it would take minutes and 20 GB."""
    discs = said.layout().centres_mm
    long, whole = (PlateMap(said, long_period(0.02), longest_s=longest_s).plan(discs) for longest_s in (0.01, 1.0))
    assert long.quantiles_mm == pytest.approx(whole.quantiles_mm, rel=0.05)
    tracemalloc.start()
    longest = PlateMap(said, long_period(0.1)).plan(discs)
    assert tracemalloc.get_traced_memory()[1] < 1e9
    tracemalloc.stop()
    assert longest.quantiles_mm[0] == pytest.approx(long.quantiles_mm[0] / math.sqrt(5), rel=0.01)


def long_period(period_s: float) -> Acquisition:
    """Return what an audio interface takes in one period of this length."""
    return parse_acquisition(f"96000:{round(96e3 * period_s)}:15000-44000:{period_s}:{period_s}").model_copy(
        update={"channels": 3}
    )


def test_discs_on_a_line(plate_map: PlateMap) -> None:
    """Discs in the middle of the plate's height cannot tell above from below there: nothing is infinite, nor fails."""
    found = plate_map.plan(np.array([(20.0, 45.0), (98.0, 45.0)]))
    assert np.isfinite(found.quantiles_mm).all()
    assert found.quantiles_mm[2] > 10


def test_suggestion(said: PlateFile, plate_map: PlateMap) -> None:
    """A suggested layout is no worse than the given one, on the plate, and has no mirrored discs."""
    given = plate_map.plan(said.layout().centres_mm)
    better = plate_map.suggest(given, moves=4)
    assert better.quantiles_mm[1] < given.quantiles_mm[1]
    size = np.array([110.0, 90.0])
    assert (better.discs_mm >= 9.0).all()
    assert (better.discs_mm <= size - 9.0).all()
    for k, place in enumerate(better.discs_mm):
        if not np.array_equal(place, given.discs_mm[k]):
            assert not is_mirrored(place, np.delete(better.discs_mm, k, axis=0), size)


@pytest.mark.parametrize(
    ("place", "size", "mirrored"),
    [
        ((80.0, 20.0), (100.0, 80.0), True), ((20.0, 60.0), (100.0, 80.0), True), ((80.0, 60.0), (100.0, 80.0), True),
        ((50.0, 33.0), (100.0, 80.0), True), ((33.0, 53.0), (100.0, 80.0), False),
        ((33.0, 53.0), (80.0, 80.0), False), ((30.0, 30.0), (80.0, 80.0), True),
    ],
)  # fmt: skip
def test_mirrored(place: tuple[float, float], size: tuple[float, float], mirrored: bool) -> None:
    """Discs at mirrored places, on an axis, or on a square's diagonal cannot tell mirrored touches."""
    assert MIRRORED_MM < 10
    assert is_mirrored(np.array(place), np.array([[20.0, 20.0]]), np.array(size)) is mirrored


def test_command(tmp_path: Path) -> None:
    """`touchd plan` prints both layouts, and draws them."""
    (tmp_path / "PLATE.toml").write_text(SMALL_PLATE)
    picture = tmp_path / "plan.png"
    done = touchd("plan", tmp_path / "PLATE.toml", "--acquisition", "audio-96", "-o", picture, "--json")
    found = json.loads(done.out)
    assert found["suggested"]["p95_mm"] <= found["given"]["p95_mm"]
    assert len(found["suggested"]["receivers_mm"]) == 3
    assert picture.stat().st_size > 1000
