from __future__ import annotations

import numpy as np
import pytest

from touchd.calibration.verdict import BONDED, Judgement, Parameter, judge

PLAIN = Parameter("thickness", "mm", 5.0, 5.01, 0.005, False)
GOOD = {
    "shares": np.full(4, 1e-3), "noise_share": 1e-6, "frame_noise": 1e-3, "wavelength_mm": 23.0, "parameters": (PLAIN,),
    "scale_mm": 0.05,
}  # fmt: skip


def judged(**other: object) -> Judgement:
    return judge(**(GOOD | other))  # type: ignore[arg-type]  # the fields vary


def test_good() -> None:
    """A fit that leaves a thousandth is good, and needs no reason."""
    found = judged()
    assert (found.verdict, found.reasons) == ("good", ())
    assert 0.05 < found.expected_mm < 0.1


def test_bonded() -> None:
    """A pane with a display bonded on it bends slowly: nobody is told to measure its wave speed again."""
    pulled = [Parameter(*one, 0.01, True) for one in (("wave speed", "m/s", 5300.0, 5000.0),
                                                      ("in-plane stiffness", "", 1.0, 1.12))]  # fmt: skip
    found = judged(parameters=(*pulled, PLAIN))
    assert (found.verdict, found.reasons) == ("usable", (BONDED,))


@pytest.mark.parametrize(
    ("other", "verdict", "reason"),
    [
        ({"shares": np.full(4, 0.03)}, "usable", "leave 3.0%"),
        ({"shares": np.full(4, 0.4)}, "poor", "rectangular pane"),
        ({"shares": np.array([1e-3, np.nan, 1e-3, 1e-3])}, "usable", "receiver 2 is dead"),
        ({"shares": np.array([1e-3, 1e-3, 3e-2, 1e-3])}, "usable", "receiver 3 does not fit"),
        ({"shares": np.array([np.nan, np.nan, np.nan, 1e-3])}, "poor", "receiver 1 is dead"),
        ({"parameters": (PLAIN._replace(fitted=5.2, at_prior=True),)}, "usable", "thickness: 5 mm was said, 5.2"),
        ({"parameters": (Parameter("wave speed", "m/s", 5092.0, 5333.0, 9.0, True),)}, "usable", "check material and"),
        ({"scale_mm": 0.5}, "usable", "the scale is known to 0.50 mm"),
        ({"frame_noise": 0.02}, "usable", "noise of -34 dB"),
        ({"wavelength_mm": 10.8}, "usable", "waves of 11 mm are shorter than a fingertip"),
        ({"clamped": ("left",)}, "usable", "left edge is clamped"),
        ({"found": ("a thickness of 4 mm fits",)}, "usable", "a thickness of 4 mm fits"),
    ],
)
def test_why_not_better(other: dict[str, object], verdict: str, reason: str) -> None:
    """What keeps a fit from being good is said, with what to do."""
    found = judged(**other)
    assert found.verdict == verdict
    assert any(reason in each for each in found.reasons)


def test_noise_alone_is_not_the_pane() -> None:
    """A poor fit whose physics lack nothing has the noise as its reason, not holes."""
    found = judged(frame_noise=0.1)
    assert found.verdict == "poor"
    assert found.reasons == ("noise of -20 dB: raise the gain, or shield the cables",)


def test_a_reason_that_matters() -> None:
    """A ruler that would do is not blamed beside what is really wrong."""
    assert judged(scale_mm=0.15).reasons == ()
    assert judged(scale_mm=0.15, found=("glass fits, not steel",)).reasons == ("glass fits, not steel",)


def test_sides_that_contradict_each_other() -> None:
    """A width said 2 mm too large, which only the height contradicts, is named, and the expected error has it."""
    sides = (Parameter("width", "mm", 112.0, 110.9, 0.2, True), Parameter("height", "mm", 90.0, 90.8, 0.2, True))
    found = judged(contradiction=3.7, scale_mm=0.09, parameters=(PLAIN, *sides))
    assert found.verdict == "usable"
    assert found.reasons == (
        "width and height contradict each other: with 112 mm of width 91.7 mm of height fit, with 90 mm of height "
        "109.9 mm of width: measure both again",
    )
    assert found.expected_mm > 3.7 * 0.09
    assert judged(contradiction=1.9).verdict == "good"
    other = judged(contradiction=3.7, parameters=(PLAIN, *sides), found=("a height of 90.8 mm fits, not 90 mm",))
    assert other.reasons == found.reasons, "one of two that may be wrong is not named alone"


def test_worse_physics_expect_more() -> None:
    """The expected error grows with what the fit leaves."""
    errors = [judged(shares=np.full(4, left)).expected_mm for left in (1e-4, 1e-3, 1e-2, 1e-1)]
    assert errors == sorted(errors)
    assert errors[-1] > 3 * errors[0]


def test_a_mirrored_drawing_is_undecided() -> None:
    """That a rectangle sounds as its mirror image is always said, with the tap that settles it."""
    assert any("mirrored" in each and "tap" in each for each in judged().undecided)
