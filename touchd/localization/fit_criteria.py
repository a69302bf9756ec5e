"""When a fit is good, and when it is a finger: every threshold of the fits in one place."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FitCriteria:
    """Thresholds on what a fit leaves unexplained. Shares are of the signal's energy unless stated otherwise.

    The figures come from the twin: up to five fingers, silicone and human, 40 to 70 dB.
    """

    enough: float = 0.004
    """Complete: the field is not known better than this."""
    good: float = 0.03
    """The positions are right: fingers unlike those of the training leave up to this much."""
    good_of_thumbs: float = 0.06
    """The same of one or two thumbs that press: their shapes leave more."""
    search_above: float = 0.015
    """More than this calls for a search for further fingers."""
    fair: float = 0.1
    """More than this calls for other starting positions."""
    half_confidence: float = 0.25
    """At this share a fit is as likely no finger: unusual fingers leave up to 0.1, palms more than 0.6."""
    poor: float = 0.2
    """More than this at touch-down calls for a comparison with other positions."""
    most_poor: float = 0.1
    """And a larger change of the untouched plate's energy by what has landed, if it is not fitted fairly, is no finger.
    Thumbs change 0.03 of it on a square of 200 mm, two palms 0.3 (twin)."""
    rival: float = 2.0
    """The position is ambiguous if another one leaves less than this multiple of what it leaves: right positions of
    which this holds are 0.03 to 0.2 %, faint and at the edge; wrong ones 18 in 22 (twin)."""
    rival_noise: float = 15.0
    """Of a faint finger in white noise also if it leaves no more beyond that than this, in variances of a value's
    noise: of right positions 0 to 1 %, of those a decimetre off all (twin, 3 to 8 mm2 at 50 dB)."""
    seen: float = 0.2
    """Share of the unexplained energy that the best scan position must explain for a search to go on after a fair fit.
    A missing finger explains more; model error of a human finger explains 0.13 to 0.17."""
    seen_beside: float = 0.15
    """The same after fingers were found together that leave a good fit: a fifth explains 0.168 or more (twin)."""
    worth: float = 0.42
    """A further finger has to leave less than this share of what was left without it. An existing finger leaves
    less than 0.35 of it, a false one more than 0.44."""
    shaped_worth: float = 0.47
    """The same of a good fit where fewer have shapes already, which explain part of a missing finger (twin)."""
    weak: float = 1.4
    """A finger whose energy is less than this many times what the fit leaves is no finger."""
    noise_spread: float = 0.25
    """One frame's noise seldom has more energy than its mean by this share: two standard deviations."""
    noise_margin: float = 0.6
    """The same for five standard deviations."""
    faint: float = 6.0
    """Below this multiple of the noise energy the network may see a finger at a wrong position."""
    most_size_mm2: float = 12.0
    """A contact with a larger second moment is no finger. Thumbs have up to 7 (twin)."""
    shape_above: float = 0.004
    """Points that leave less than this share pay for no shape: a robot's soft tip leaves 0.003 to 0.01 (twin)."""
    lone_shape_above: float = 0.0005
    """The same of one point."""
    large_above: float = 0.1
    """Where contacts of typical size leave more than this share, large ones may leave less: thumbs that press."""
    missing: float = 0.5
    """Contacts of a usual size that leave more than this share have fingers missing beside them."""
    shape_grown: float = 0.15
    """A followed finger's shape has changed if another one leaves less than this share of what its own leaves."""
    shape_worth: float = 0.4
    """Shapes have to leave less than this share of what points leave. Fingers' leave 0.02 to 0.15 of it; more may be
    those that make up for a missing finger."""
    lone_shape_worth: float = 0.75
    """The same of one point: a soft robot's tip leaves 0.6 of it, and is placed better by a fifth (twin)."""
    shape_noise: float = 16.0
    """And as much less, in variances of a value's noise: its eight numbers explain 8 of noise alone."""
    shape_older: float = 1.2
    """A followed finger's shape is fitted again once it leaves this many times what it left when it was fitted, ..."""
    shape_worn: float = 0.001
    """... and this share more."""
    most_elongation: float = 0.5
    """Of a fit that is not good: faint fingers at an edge, misplaced by more than 10 mm, have 0.5 to 5 (twin)."""
    most_oval_mm2: float = 5.5
    """Several shapes of which one is more oval are none of fingers: those of right positions have up to 4, five that
    make up a palm 8 (twin)."""
    shapes_apart_mm: float = 9.0
    """Two contacts with shapes that are closer than this are one: so much wider than a point is a child's finger."""
    plate: float = 0.06
    """Share of the plate's own movement that its directions may miss. They miss 0.02 of a change of temperature; of a
    finger on the emitter 0.14 or more, of 99 in 100 elsewhere over 0.68 (twin)."""
    most_moved: float = 0.01
    """Larger movement, in shares of the untouched plate's energy, is a fault: 5 K on glass have less, a channel that
    dies has 0.25."""
    merged_mm: float = 4.0
    """Two fingers closer than this are one."""

    def confidence(self, excess: float) -> float:
        """Return how much a fit that leaves this share beyond the noise looks like fingers, 0..1."""
        return 1 / (1 + (max(excess, 0.0) / self.half_confidence) ** 2)


CRITERIA = FitCriteria()
"""The criteria in use."""
