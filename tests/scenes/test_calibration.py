from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from touchd.calibration.calibrate import Fitted, make_model
from touchd.calibration.emission import background_waves
from touchd.calibration.parameters import DISCS, PLATE, Reader
from touchd.calibration.physical_atlas import TIP, PhysicalField
from touchd.calibration.plate_file import PlateFile, check_plate_file
from touchd.calibration.plate_fit import PlateFit, fit_plate
from touchd.calibration.stages import GOOD_LEFT
from touchd.calibration.untouched import Untouched, untouched_mean
from touchd.calibration.untouched_model import UntouchedModel
from touchd.errors import CalibrationError
from touchd.evaluation.cramer_rao import twin_values
from touchd.evaluation.single_frames import find_with, see, touched_frames
from touchd.frame import ACQUISITIONS
from touchd.lab.plates.other_plate import Patch, missing, other_modes
from touchd.localization.model import Model
from touchd.training.field.bins import TAPER
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.material import ElasticPlate, Material
from touchd.twin.physics.mounting import FREE, Mounting, attach
from touchd.twin.physics.transducer import Layout
from touchd.twin.simulate import simulate_scene, simulate_touches

TRUE = ElasticPlate(width_mm=90.1, height_mm=69.9, thickness_mm=4.98, elastic=Material(71.3e9, 0.226, 2490.0))
LAYOUT = Layout(emitter_mm=(17.0, 36.0), receivers_mm=((9.0, 8.0), (80.0, 9.0), (79.0, 60.0), (8.0, 61.0)))
OFF_MM = np.array([[0.4, -0.3], [-0.5, 0.2], [0.3, 0.5], [0.1, -0.6], [-0.4, 0.3]])
"""How the ruler errs."""
SCALE, GAINS = 10_000.0, np.array([1.1, 0.7, 0.9, 1.3])
NOISE = 2.0
FRAMES = 300


def said(order: tuple[int, ...] = (0, 1, 2, 3, 4), scatterers: Any = (), **plate: Any) -> PlateFile:
    """PLATE.toml, with the discs' places in another order."""
    places = (LAYOUT.centres_mm + OFF_MM)[list(order)].tolist()
    facts = {"width_mm": 90, "height_mm": 70, "thickness_mm": 5, "material": "glass"} | plate
    return check_plate_file({
        "plate": facts, "discs": {"diameter_mm": 6, "emitter_mm": places[0], "receivers_mm": places[1:]},
        "scatterers": scatterers,
    })  # fmt: skip


def other(
    *patches: Patch,
    mounting: Mounting = FREE,
    feedthrough: tuple[tuple[float, float], ...] = (),
    name: str = "usb",
    plate: ElasticPlate = TRUE,
) -> Instrument:
    """A plate whose discs are stiff, and have beads of solder beside them."""
    beads = [Patch(float(x) + 5, float(y), 1.5, 1.5, mass_kg_m2=4.0) for x, y in LAYOUT.centres_mm]
    acquisition = ACQUISITIONS[name]
    modes = other_modes(plate, LAYOUT, [*beads, *patches], max(acquisition.chirp.band_hz))
    if mounting != FREE:
        modes = attach(modes, plate, mounting.on(plate), 7e-3, float(np.mean(acquisition.chirp.band_hz)))
    return Instrument(plate, layout=LAYOUT, loss=7e-3, modes=modes, feedthrough=feedthrough, acquisition=acquisition)


def heard(
    *patches: Patch, gains: NDArray[np.float64] = GAINS, mounting: Mounting = FREE,
    feedthrough: tuple[tuple[float, float], ...] = (), name: str = "usb",
    plate: ElasticPlate = TRUE, resting: tuple[Contact, ...] = (),
) -> Untouched:  # fmt: skip
    """Its untouched mean frame, or that with something that rests on it throughout."""
    instrument = other(*patches, mounting=mounting, feedthrough=feedthrough, name=name, plate=plate)
    signal = SCALE * gains[:, None] * (instrument.untouched([22.0])[0] + instrument.change([resting], [22.0])[0])
    error = NOISE / np.sqrt(FRAMES)
    noisy = signal + error * np.random.default_rng(0).standard_normal(signal.shape)
    return Untouched(noisy, np.full(4, error), FRAMES, instrument.acquisition)


@pytest.fixture(scope="module")
def fit() -> PlateFit:
    return fit_plate(said(), heard())


def places_off_mm(fit: PlateFit, layout: Layout = LAYOUT) -> float:
    """RMS error of the discs' places, less the scale, which the ruler alone tells."""
    true, found = layout.centres_mm, fit.layout.centres_mm
    scale = (found * true).sum() / (true**2).sum()
    return float(np.sqrt(np.mean((found / scale - true) ** 2)))


def test_a_free_plate(fit: PlateFit) -> None:
    """From a ruler's places, 0.4 mm off, the discs of another simulator's plate are found five times closer."""
    assert np.sqrt(np.mean(OFF_MM**2)) > 0.35
    assert places_off_mm(fit) < 0.07
    assert fit.verdict == "good"
    assert fit.unexplained < 3e-4


def test_a_bead_beside_each_disc(fit: PlateFit) -> None:
    """Solder where the cable leaves is found: 28 mg, 5 mm right of each disc; its mass to two standard errors."""
    found = {parameter.name: parameter for parameter in fit.parameters}
    for disc in ("emitter", *(f"receiver {k}" for k in range(1, 5))):
        x, y, mass = (found[f"disc bead{axis}, {disc}"] for axis in (" x", " y", ""))
        assert math.dist((x.fitted, y.fitted), (5.0, 0.0)) < 3.5, disc
        assert abs(mass.fitted - 0.028) < 2 * mass.standard_error < 0.05, disc


def test_waves_in_the_plates_plane(fit: PlateFit) -> None:
    """Discs stretch the plate besides bending it, at their height over its middle: 3.5 mm, to a tenth."""
    found = {parameter.name: parameter for parameter in fit.parameters}
    assert 1 / found["disc stretch"].fitted == pytest.approx(3.5, rel=0.1)


def test_a_plate_without_waves_in_its_plane() -> None:
    """Where discs bend the plate and do not stretch it, as those of the twin, what they would is not made up."""
    plate = Instrument(TRUE, layout=LAYOUT, loss=7e-3)
    signal, error = SCALE * GAINS[:, None] * plate.untouched([22.0])[0], np.full(4, NOISE / np.sqrt(FRAMES))
    fit = fit_plate(said(), Untouched(signal, error, FRAMES, plate.acquisition))
    found = {parameter.name: parameter.fitted for parameter in fit.parameters}
    assert (3.5 * found["disc stretch"]) ** 2 < 0.05
    assert fit.verdict == "good"
    assert fit.unexplained < 5e-5


def test_a_touch_has_its_size(fit: PlateFit) -> None:
    """The field is as large as what a touch changes; it was as much larger as the plate is lighter than 1 kg."""
    at_mm, plate = np.array([[30.0, 25.0], [45.0, 50.0], [60.0, 35.0]]), other()
    touches = [Contact(x, y, 20.0, "silicone") for x, y in at_mm.tolist()]
    peak = Electronics().peak * 2 ** (plate.acquisition.bits - 1)
    exact = SCALE / peak * GAINS[:, None] * twin_values(plate, touches, TAPER)
    assert np.vdot(exact, PhysicalField(fit).at(at_mm, TIP)).real / np.vdot(exact, exact).real == pytest.approx(1, 0.3)


@pytest.fixture(scope="module")
def touched() -> Instrument:
    """The same plate, which remembers its modes."""
    return other()


@pytest.fixture(scope="module")
def calibrated(fit: PlateFit, touched: Instrument, tmp_path_factory: pytest.TempPathFactory) -> Model:
    """The model of the same fit."""
    return model_of(fit, touched, tmp_path_factory.mktemp("calibrated") / "plate.onnx")


def model_of(fit: PlateFit, plate: Instrument, path: Path) -> Model:
    """The model of a fit to a plate, in the counts of the twin's electronics."""
    idle = simulate_scene("idle", seed=4, instrument=plate, electronics=Electronics(gains=tuple(GAINS)), frames=300)
    mean = idle.frames.mean(axis=0)
    scale = (mean * fit.measured).sum(axis=1, keepdims=True) / np.square(fit.measured).sum(axis=1, keepdims=True)
    scaled = replace(fit, gains=fit.gains * scale, measured=fit.measured * scale, fitted=fit.fitted * scale)
    return make_model(Fitted(idle, untouched_mean(idle, said()), scaled, 0.0), path).model


@pytest.mark.parametrize(("noise_db", "seed"), [(50.0, 6), (60.0, 6), (60.0, 9)])
def test_no_frame_alone_is_sure_of_a_place_a_centimetre_off(
    noise_db: float, seed: int, calibrated: Model, touched: Instrument
) -> None:
    """Near an edge the field repeats itself after half a wavelength: 9 of these frames were placed there once."""
    electronics = Electronics(noise_db=noise_db, gains=tuple(GAINS))
    recording = simulate_touches(640, seed=seed, instrument=touched, finger="glove", electronics=electronics)
    frames = touched_frames(recording)
    seen = see(find_with(calibrated, calibrated.atlas, frames), frames)
    off_mm = [
        max((math.dist(one.true_mm[0], (t.x_mm, t.y_mm)) for t in one.found if t.confidence > 0.9), default=0.0)
        for one in seen
    ]
    assert sum(bool(one.found) for one in seen) > 380
    assert max(off_mm) < 10.0


def test_errors_within_sigma(calibrated: Model, touched: Instrument) -> None:
    """Two thirds of a calibrated plate's errors are within their standard errors."""
    assert 0.55 < within_sigma(calibrated, touched) < 0.85


def test_standard_errors(fit: PlateFit) -> None:
    """What is known is within three standard errors, and the scale's is that of a ruler."""
    by_name = {parameter.name: parameter for parameter in fit.parameters}
    true = {"width": 90.1, "height": 69.9, "thickness": 4.98, "Poisson's ratio": 0.226, "loss factor": 7e-3}
    for name, value in true.items():
        assert abs(by_name[name].fitted - value) < 3 * by_name[name].standard_error + 0.01 * abs(value), name
    assert 5e-4 < fit.scale_error < 0.3 / 70


def test_an_inverted_disc(fit: PlateFit) -> None:
    """A disc upside down changes the sign of a gain, and no step of the fit."""
    plain, signs = heard(), np.array([1.0, -1.0, 1.0, 1.0])
    found = []
    for untouched in (plain, plain._replace(mean=plain.mean * signs[:, None])):
        reader = Reader(said(), untouched.acquisition)
        model = UntouchedModel(fit.basis, reader, untouched)
        found.append(model.fit(reader.start, np.ones(plain.mean.shape[1]), (*PLATE, *DISCS, *reader.places)))
    one, other = found
    np.testing.assert_allclose(other.gains, one.gains * signs[:, None], rtol=1e-9)
    np.testing.assert_allclose(other.residual, one.residual * signs[:, None], rtol=1e-9, atol=1e-9 * SCALE)
    np.testing.assert_allclose(other.slopes, one.slopes * signs[:, None], rtol=1e-9, atol=1e-9 * SCALE)


def test_a_dead_channel() -> None:
    """A dead channel is named; the others carry the fit."""
    fit = fit_plate(said(), heard(gains=GAINS * [1, 1, 0, 1]))
    assert fit.verdict == "usable"
    assert any("receiver 3 is dead" in reason for reason in fit.reasons)
    assert places_off_mm(fit) < 0.5


def test_the_drive_in_the_cables(fit: PlateFit) -> None:
    """What each channel hears of the drive itself, up to ten times what the plate sends it, changes nothing.

    Nor does an ADC's offset.
    """
    untouched = heard(feedthrough=((-10.0, 0.0), (20.0, 90.0), (0.0, 200.0), (6.0, 45.0)))
    offset = 0.5 * SCALE * np.array([[1.0], [-1.0], [0.3], [0.0]])
    driven = fit_plate(said(), untouched._replace(mean=untouched.mean + offset))
    assert driven.verdict == "good"
    assert driven.unexplained < 1.1 * fit.unexplained
    np.testing.assert_allclose(driven.layout.centres_mm, fit.layout.centres_mm, atol=0.03)


def test_a_disc_that_came_off() -> None:
    """A channel that hears the drive alone is dead."""
    untouched = heard(feedthrough=((0.0, 0.0), (0.0, 90.0), (0.0, 0.0), (0.0, 0.0)))
    untouched.mean[2] = (
        1000 * background_waves(untouched.acquisition)[0] / background_waves(untouched.acquisition).max()
    )
    assert untouched.dead.tolist() == [False, False, True, False]


def test_no_channel_hears_anything() -> None:
    """Silence is refused with what to check."""
    with pytest.raises(CalibrationError, match="emitter's cable"):
        fit_plate(said(), heard(gains=0 * GAINS))


@pytest.fixture(scope="module")
def swapped() -> tuple[PlateFit, list[tuple[str, float]]]:
    """The fit of two cables swapped, and its progress."""
    told: list[tuple[str, float]] = []
    return fit_plate(said((0, 2, 1, 3, 4)), heard(), lambda *at: told.append(at)), told


def test_progress(swapped: tuple[PlateFit, list[tuple[str, float]]]) -> None:
    """Progress goes on and never back, from the plate that is said to the others that are tried, to the end."""
    _, told = swapped
    for stage in ("fit", "candidates"):
        shares = [share for each, share in told if each == stage]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0
    assert [stage for stage, _ in told] == sorted((stage for stage, _ in told), reverse=True)


def test_swapped_cables(fit: PlateFit, swapped: tuple[PlateFit, list[tuple[str, float]]]) -> None:
    """Two cables swapped are found and named, and the fit is that of the right order."""
    other, _ = swapped
    assert other.verdict == "usable"
    assert any("receiver 1 at the place of receiver 2" in reason for reason in other.reasons)
    np.testing.assert_allclose(other.layout.centres_mm, fit.layout.centres_mm, atol=0.02)


@pytest.mark.parametrize(
    ("plate", "reason"),
    [({"thickness_mm": 4}, "a thickness of 5 mm fits"), ({"material": "aluminium"}, "glass fits, not aluminium")],
)
def test_a_wrong_plate(plate: dict[str, Any], reason: str) -> None:
    """A wrong thickness or material is named with the one that fits."""
    fit = fit_plate(said(**plate), heard())
    assert fit.verdict != "good"
    assert any(reason in each for each in fit.reasons)


def moved(disc: int, x_mm: float, y_mm: float, order: tuple[int, ...] = (0, 1, 2, 3, 4)) -> dict[str, Any]:
    """PLATE.toml's discs, one of them measured wrongly, in another order."""
    places = LAYOUT.centres_mm + OFF_MM
    places[disc] += (x_mm, y_mm)
    places = places[list(order)]
    return {"emitter_mm": tuple(places[0].tolist()), "receivers_mm": tuple(map(tuple, places[1:].tolist()))}


@pytest.mark.parametrize(
    ("plate", "order", "discs", "reasons"),
    [
        ({"width_mm": 94}, (0, 1, 2, 3, 4), {}, ("a width of 90",)),
        ({}, (0, 1, 2, 3, 4), moved(0, 12, 3), ("the emitter fits at (17, 36) mm, not at (29.4, 38.7) mm: ",)),
        ({"thickness_mm": 4, "material": "aluminium"}, (0, 1, 2, 3, 4), {}, (
            "a thickness of 5 mm fits, not 4 mm", "glass fits, not aluminium: correct the material",
        )),
        ({}, (0, 1, 2, 3, 4), moved(3, 0, -12, (0, 2, 1, 3, 4)), (
            "receiver 1 at the place of receiver 2", "receiver 3 fits at (79, 60) mm, not at (79.1, 47.4) mm",
        )),
        ({"height_mm": 73}, (0, 2, 1, 3, 4), {}, ("a height of 70", "receiver 1 at the place of receiver 2")),
    ],
)  # fmt: skip
def test_wrong_facts(
    plate: dict[str, Any], order: tuple[int, ...], discs: dict[str, Any], reasons: tuple[str, ...]
) -> None:
    """A side that is 3 mm off, a disc elsewhere, two wrong facts: each is named once, and nothing else is."""
    wrong = said(order, **plate)
    fit = fit_plate(wrong.model_copy(update={"discs": wrong.discs.model_copy(update=discs)}), heard())
    assert fit.verdict == "usable"
    assert fit.unexplained < 1e-3
    assert len(fit.reasons) == len(reasons), fit.reasons
    for reason, found in zip(reasons, fit.reasons, strict=True):
        assert reason in found
    assert places_off_mm(fit) < 0.1
    measured = {parameter.name: parameter.said for parameter in fit.parameters}
    assert measured["width"] == wrong.plate.width_mm
    assert measured["thickness"] == wrong.plate.thickness_mm


TAPED, CLAMPED = Mounting(left="tape", bottom="tape"), Mounting(left="clamped")


@pytest.mark.parametrize(
    ("plate", "order", "mounting", "reason"),
    [
        ({"thickness_mm": 4}, (0, 1, 2, 3, 4), FREE, "a thickness of 5 mm fits"),
        ({"material": "aluminium"}, (0, 1, 2, 3, 4), FREE, "glass fits, not aluminium"),
        ({}, (0, 2, 1, 3, 4), FREE, "receiver 1 at the place of receiver 2"),
        ({}, (0, 1, 2, 3, 4), TAPED, "tape or pads along the edges fit"),
        ({}, (0, 1, 2, 3, 4), CLAMPED, "a clamped left edge fits"),
    ],
)
def test_an_audio_interface(plate: dict[str, Any], order: tuple[int, ...], mounting: Mounting, reason: str) -> None:
    """In steady state no part of a frame has first arrivals alone: what is wrong is named by the whole of it.

    Of the inertia at its low frequencies a clamp's stiffness is much more.
    """
    fit = fit_plate(said(order, **plate), heard(mounting=mounting, name="audio-96"))
    assert fit.verdict == "usable"
    assert [reason in each for each in fit.reasons].count(True) == 1
    assert fit.unexplained < 3e-3


def test_taped_edges() -> None:
    """Tape that is said is part of the physics; tape that is not said is found and named."""
    heard_taped = heard(mounting=TAPED)
    known = fit_plate(said(edge={"left": "tape", "bottom": "tape"}), heard_taped)
    assert known.verdict == "good"
    assert known.unexplained < 4e-3
    assert places_off_mm(known) < 0.1
    by_name = {parameter.name: parameter for parameter in known.parameters}
    damping = by_name["edge damping, left"]
    assert damping.standard_error < 0.01
    assert abs(damping.fitted - 0.036) < 2 * damping.standard_error  # of the plate's inertia at 75 kHz
    unknown = fit_plate(said(), heard_taped)
    assert unknown.verdict == "usable"
    assert any("along the edges" in reason for reason in unknown.reasons)
    assert unknown.unexplained < 6e-3


def test_a_clamped_edge() -> None:
    """A clamp is never good: said or not it is named, as it shifts all places."""
    heard_clamped = heard(mounting=CLAMPED)
    known = fit_plate(said(edge={"left": "clamped"}), heard_clamped)
    assert known.verdict == "usable"
    assert known.expected_mm > 0.5
    unknown = fit_plate(said(), heard_clamped)
    assert unknown.verdict != "good"
    assert any("clamped left edge fits" in reason for reason in unknown.reasons)


def test_a_plastic_plate() -> None:
    """On acrylic, where a disc is three quarters of a wavelength wide and heavier than the plate, discs are found.

    Solder beside them, nearly half a wavelength from their centres, is looked for: fits that began in the centres left
    4.2 % of the energy.
    """
    acrylic = Material(3.25e9, 0.346, 1185.0)
    plate = ElasticPlate(width_mm=60.1, height_mm=46.9, thickness_mm=5.98, elastic=acrylic)
    layout = Layout(emitter_mm=(15.0, 25.0), receivers_mm=((9.0, 8.0), (50.0, 10.0), (51.0, 37.0), (10.0, 38.0)))
    beads = [Patch(x + dx, y + dy, 1.5, 1.5, mass_kg_m2=7.0) for (x, y), (dx, dy) in zip(
        layout.centres_mm.tolist(), [(-3.6, -3.6), (4.1, -3.1), (0.8, -5.0), (0.8, 5.0), (-1.6, 4.8)], strict=True
    )]  # fmt: skip
    instrument = Instrument(plate, layout=layout, loss=0.03, modes=other_modes(plate, layout, beads))
    signal = SCALE * GAINS[:, None] * instrument.untouched([22.0])[0]
    facts = {"young_gpa": 3.3, "poisson": 0.34, "density_kg_m3": 1190}
    asked = check_plate_file({
        "plate": {"width_mm": 60, "height_mm": 47, "thickness_mm": 6} | facts,
        "discs": {
            "diameter_mm": 6, "emitter_mm": (layout.centres_mm + OFF_MM)[0].tolist(),
            "receivers_mm": (layout.centres_mm + OFF_MM)[1:].tolist(),
        },
    })  # fmt: skip
    fit = fit_plate(asked, Untouched(signal, np.full(4, NOISE), FRAMES, instrument.acquisition))
    assert places_off_mm(fit, layout) < 0.3
    assert fit.unexplained < 0.035
    assert fit.loss.factor == pytest.approx(0.03, rel=0.1)


HOLE = missing(TRUE, 0.9, x_mm=50.0, y_mm=30.0, half_x_mm=6.0, half_y_mm=6.0)


def test_a_hole(tmp_path: Path) -> None:
    """A hole that PLATE.toml does not name is found, to a millimetre; named, it leaves the plate good.

    Standard errors know how wrong places are, beside the hole, too.
    """
    heard_hole = heard(HOLE)
    unknown = fit_plate(said(), heard_hole)
    assert unknown.verdict == "usable"
    assert re.search(r"something at \((49|50|51), (29|30|31)\) mm", unknown.reasons[0])
    found = {parameter.name: parameter.fitted for parameter in unknown.parameters}
    assert math.dist((found["scatterer 1 x"], found["scatterer 1 y"]), (50, 30)) < 1
    assert found["scatterer 1 mass"] < 0
    plate = other(HOLE)
    assert 0.5 < within_sigma(model_of(unknown, plate, tmp_path / "plate.onnx"), plate) < 0.85
    known = fit_plate(said(scatterers=[{"at_mm": [50.6, 29.5], "diameter_mm": 12}]), heard_hole)
    assert known.verdict == "good"
    assert known.unexplained < 1e-3
    assert places_off_mm(known) < 0.12


def beyond_arcs(radius_mm: float, strips: int = 32) -> list[Patch]:
    """What rounded corners of a radius leave out, in strips."""
    ends = radius_mm * np.linspace(0, 1, strips + 1) ** 2
    middle, half = (ends[1:] + ends[:-1]) / 2, np.diff(ends) / 2
    high = radius_mm - np.sqrt(radius_mm**2 - (radius_mm - middle) ** 2)
    return [
        missing(TRUE, 0.999, x_mm=x_mm, y_mm=y_mm, half_x_mm=half_x_mm, half_y_mm=h_mm / 2, round=False)
        for at_mm, half_x_mm, h_mm in zip(middle.tolist(), half.tolist(), high.tolist(), strict=True)
        for x_mm in (at_mm, TRUE.width_mm - at_mm)
        for y_mm in (h_mm / 2, TRUE.height_mm - h_mm / 2)
    ]


@pytest.mark.parametrize(("radius_mm", "off_mm"), [(5.0, 0.09), (10.0, 0.18)])
def test_rounded_corners(radius_mm: float, off_mm: float) -> None:
    """Rounded corners that PLATE.toml does not name are found, with their radius; named, they leave a plate good.

    Taken for sharp, those of 5 mm leave 8 % of the energy, and discs 0.6 mm off.
    """
    rounded = heard(*beyond_arcs(radius_mm))
    unknown = fit_plate(said(), rounded)
    assert unknown.verdict == "usable"
    (told,) = filter(None, (re.search(r"corners fit, with a radius of ([\d.]+) mm", each) for each in unknown.reasons))
    assert float(told[1]) == pytest.approx(radius_mm, abs=0.2)
    known = fit_plate(said(corner_radius_mm=radius_mm + 0.6), rounded)
    assert known.verdict == "good"
    for fit in (unknown, known):
        assert fit.plate.corner_radius_mm == pytest.approx(radius_mm, abs=0.2)
        assert fit.unexplained < 1e-3
        assert places_off_mm(fit) < off_mm


def test_touches_beside_rounded_corners(tmp_path: Path) -> None:
    """The field of a plate with rounded corners holds near their arcs as elsewhere, and knows how wrong it is."""
    patches = beyond_arcs(5.0)
    plate = other(*patches)
    fit = fit_plate(said(corner_radius_mm=5.4), heard(*patches))
    for x_mm, y_mm in ((4.0, 4.0), (85.0, 65.0), (40.0, 30.0)):
        touch = PhysicalField(fit).at(np.array([[x_mm, y_mm]]), TIP)
        exact = GAINS[:, None] * twin_values(plate, [Contact(x_mm, y_mm, TIP.area_mm2, TIP.tissue)], TAPER)
        alike = abs(np.vdot(exact, touch)) ** 2 / (np.vdot(exact, exact) * np.vdot(touch, touch)).real
        assert alike > 0.99, (x_mm, y_mm)
    assert 0.5 < within_sigma(model_of(fit, plate, tmp_path / "plate.onnx"), plate) < 0.85


@pytest.mark.parametrize("late", [3, 20])
def test_frames_that_begin_before_the_chirp(late: int) -> None:
    """The delay of a converter's filter is found, and leaves a plate good: of 12 us physics left 0.6 %."""
    on_time = heard()
    moved = np.roll(on_time.mean, late, axis=1)
    moved[:, :late] = 0.0
    told = list[float]()
    fit = fit_plate(said(), on_time._replace(mean=moved), lambda stage, share: told.append(share + (stage != "fit")))
    assert told == sorted(told)
    assert told[-1] == 2.0
    assert fit.verdict == "good"
    assert fit.unexplained < 3e-4
    assert fit.late_us == pytest.approx(4 * late, abs=8.1)
    assert places_off_mm(fit) < 0.08


def test_a_button() -> None:
    """A button of steel that somebody has glued on is found likewise, as a mass."""
    steel = Patch(60.0, 45.0, 5.0, 5.0, mass_kg_m2=7800 * 3e-3, bending_n_m=40.0)
    fit = fit_plate(said(), heard(steel))
    found = {parameter.name: parameter.fitted for parameter in fit.parameters}
    assert fit.verdict == "usable"
    assert math.dist((found["scatterer 1 x"], found["scatterer 1 y"]), (60, 45)) < 1
    assert found["scatterer 1 mass"] == pytest.approx(1.84, rel=0.3)


@pytest.mark.parametrize(("x_mm", "y_mm", "area_mm2"), [(55.0, 40.0, 60.0), (30.0, 22.0, 100.0)])
def test_a_finger_that_rests(x_mm: float, y_mm: float, area_mm2: float) -> None:
    """A fingertip that rests on the plate through the whole recording keeps a fit from being good, and is placed."""
    resting = fit_plate(said(), heard(resting=(Contact(x_mm, y_mm, area_mm2, "fingertip"),)))
    assert resting.verdict != "good"
    (place,) = filter(None, (re.search(r"at \((\d+), (\d+)\) mm damps waves", each) for each in resting.reasons))
    assert math.dist(map(float, place.groups()), (x_mm, y_mm)) < 2.0


def within_sigma(model: Model, plate: Instrument) -> float:
    """Share of the errors of silicone tips, per axis, within the standard errors; less the ruler's scale."""
    recording = simulate_touches(120, seed=11, instrument=plate, electronics=Electronics(gains=tuple(GAINS)))
    frames = touched_frames(recording)
    seen = [one for one in see(find_with(model, model.atlas, frames), frames) if len(one.found) == 1]
    true, found, sigma_mm = (
        np.array([getter(one) for one in seen])
        for getter in (
            lambda one: one.true_mm[0], lambda one: (one.found[0].x_mm, one.found[0].y_mm),
            lambda one: (one.found[0].sigma_mm,),
        )
    )  # fmt: skip
    scale = (found * true).sum() / (true**2).sum()
    return float(np.mean(np.abs(found / scale - true) < sigma_mm))


def test_rolled_sheet() -> None:
    """Steel that rolling left 6 % stiffer along its width is found to be; taken for isotropic, discs are 0.7 mm off."""
    steel = Material(197e9, 0.285, 7830.0, orthotropy=1.06, shear_ratio=0.95)
    sheet = TRUE.model_copy(update={"elastic": steel, "thickness_mm": 2.99})
    fit = fit_plate(said(material="steel", thickness_mm=3), heard(plate=sheet, name="audio-96"))
    assert fit.verdict == "usable"
    assert fit.left < 1e-4
    assert [reason for reason in fit.reasons if "stiffer along one side" in reason]
    found = fit.plate.elastic
    assert found.orthotropy == pytest.approx(1.06, abs=0.03)
    assert found.shear_ratio == pytest.approx(0.95, abs=0.02)
    assert places_off_mm(fit) < 0.1


def test_thin_rolled_steel_with_an_audio_interface() -> None:
    """On 2 mm of steel a disc stiffens the plate a ninth as much as on 5 mm of glass: the fit starts from there."""
    steel = Material(197e9, 0.285, 7830.0, orthotropy=0.95, shear_ratio=1.02)
    sheet = TRUE.model_copy(update={"elastic": steel, "thickness_mm": 1.99})
    fit = fit_plate(said(material="steel", thickness_mm=2, rolled=True), heard(plate=sheet, name="audio-96"))
    assert fit.left < GOOD_LEFT
    assert fit.verdict != "poor"
    assert fit.plate.elastic.orthotropy == pytest.approx(0.95, abs=0.03)
    assert places_off_mm(fit) < 0.2
