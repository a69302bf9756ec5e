"""The plates: each with constants, places and physics that its PLATE.toml does not tell."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from touchd.calibration.plate_file import PlateFile, check_plate_file
from touchd.frame import ACQUISITIONS, Plate
from touchd.lab.plates.other_plate import Patch, disc_patches, missing, other_modes
from touchd.lab.plates.solid_instrument import SolidInstrument
from touchd.twin.electronics import Electronics
from touchd.twin.instrument import Instrument
from touchd.twin.physics.material import ElasticPlate, Material
from touchd.twin.physics.mounting import Mounting, attach
from touchd.twin.physics.transducer import Layout, default_layout

GLASS, ACRYLIC, ALUMINIUM, STEEL = (
    Material(71.1e9, 0.226, 2490.0),
    Material(3.25e9, 0.346, 1185.0),
    Material(69.2e9, 0.335, 2705.0),
    Material(197e9, 0.285, 7830.0),
)
ACRYLIC_SAID = (("material", None), ("young_gpa", 3.3), ("poisson", 0.34), ("density_kg_m3", 1190.0))
GAINS = (1.1, -0.8, 0.95, 0.7)
"""Gain of each channel; the second disc is inverted."""
_JOINTS = 7
"""Seed of the discs' joints: all plates have the same."""


class Case(NamedTuple):
    """A plate to prove a calibration on."""

    size_mm: tuple[float, float, float]
    """Width, height and thickness, as PLATE.toml says them; the true ones are off by what a ruler is."""
    material: str = "glass"
    elastic: Material = GLASS
    loss: float = 6e-3
    mounting: Mounting = Mounting()
    tilts: tuple[tuple[float, float], ...] = ()
    feedthrough: tuple[tuple[float, float], ...] = ()
    noise_db: float = 60.0
    flaw: str = ""
    """What the fit's physics lack altogether: `hole`, `rib` or `corner`."""
    edge: str | dict[str, str] = "free"
    """What PLATE.toml says of the mounting."""
    said: tuple[tuple[str, object], ...] = ()
    """Keys of `[plate]` that are said wrongly."""
    swapped: bool = False
    """Whether two receivers' cables are swapped."""
    acquisition: str = "usb"
    """A name of `touchd.frame.ACQUISITIONS`."""
    solid: bool = False
    """Whether `touchd.lab.plates.solid_plate` simulated it, as three-dimensional elasticity."""


G220 = (220.0, 160.0, 5.0)
CASES = {
    "glass-200x200x5": Case((200.0, 200.0, 5.0)),
    "glass-220x160x5": Case(G220),
    "glass-250x210x4": Case((250.0, 210.0, 4.0)),
    "glass-180x180x3": Case((180.0, 180.0, 3.0)),
    "acrylic-190x140x6": Case((190.0, 140.0, 6.0), "acrylic", ACRYLIC, 0.03, said=ACRYLIC_SAID),
    "aluminium-300x200x3": Case((300.0, 200.0, 3.0), "aluminium", ALUMINIUM, 3e-3),
    "pads": Case(G220, mounting=Mounting(left="pads", right="pads", top="pads", bottom="pads"), edge="pads"),
    "tape": Case(G220, mounting=Mounting(left="tape"), edge={"left": "tape"}),
    "jaw": Case(G220, mounting=Mounting(left="clamped"), edge={"left": "clamped"}),
    "pane": Case(G220, mounting=Mounting(pane=True)),
    "tilted": Case(G220, tilts=((15.0, 1.0), (-10.0, -0.5), (20.0, 1.5), (-5.0, 0.5))),
    "40-db": Case(G220, noise_db=40.0),
    "hole": Case(G220, flaw="hole"),
    "rib": Case(G220, flaw="rib"),
    "corner": Case(G220, flaw="corner"),
    "clamped": Case(G220, mounting=Mounting(left="clamped")),
    "said-4-mm": Case(G220, said=(("thickness_mm", 4.0),)),
    "said-aluminium": Case(G220, said=(("material", "aluminium"),)),
    "swapped": Case(G220, swapped=True),
    "audio-192": Case((200.0, 200.0, 5.0), acquisition="audio-192"),
    "audio-96": Case((200.0, 200.0, 5.0), acquisition="audio-96"),
    "tape-not-said": Case(G220, mounting=Mounting(left="tape")),
    "acrylic-audio-96": Case((190.0, 140.0, 6.0), "acrylic", ACRYLIC, 0.03, said=ACRYLIC_SAID, acquisition="audio-96"),
    "solid-glass-5": Case(G220, solid=True),
    "solid-glass-3": Case((180.0, 180.0, 3.0), solid=True),
    "solid-acrylic-6": Case((190.0, 140.0, 6.0), "acrylic", ACRYLIC, said=ACRYLIC_SAID, solid=True),
    "solid-discs-10": Case(G220, solid=True),
    "solid-discs-15": Case(G220, solid=True),
    "feedthrough": Case(G220, feedthrough=((0.0, 20.0), (-3.0, 200.0), (3.0, 60.0), (0.0, 340.0))),
    "steel-150x110x2-audio-96": Case((150.0, 110.0, 2.0), "steel", STEEL, 3e-3, acquisition="audio-96"),
    "rolled-steel-150x110x2": Case(
        (150.0, 110.0, 2.0), "steel", STEEL._replace(orthotropy=1.06, shear_ratio=0.94), 3e-3
    ),
    "glass-150x110x2-audio-96": Case((150.0, 110.0, 2.0), acquisition="audio-96"),
}


class Made(NamedTuple):
    """A case made: the true instrument, what PLATE.toml says, and the electronics."""

    instrument: Instrument
    said: PlateFile
    electronics: Electronics


def make(name: str, seed: int = 0, solids: Path = Path()) -> Made:
    """Return a case; `seed` draws how the ruler errs, and solid plates lie in the folder `solids`."""
    case = CASES[name]
    rng = np.random.default_rng([seed, list(CASES).index(name)])
    instrument = SolidInstrument(solids / f"{name}.npz") if case.solid else _plate(case)
    plate, layout = instrument.plate, instrument.layout
    wide = plate.width_mm + 0.15 * rng.standard_normal(), plate.height_mm + 0.15 * rng.standard_normal()
    thick = plate.thickness_mm + 0.015 * rng.standard_normal()
    places = layout.centres_mm + 0.5 * rng.standard_normal((5, 2))
    places[1:] = places[[2, 1, 3, 4]] if case.swapped else places[1:]
    said = {
        "width_mm": round(wide[0], 1), "height_mm": round(wide[1], 1), "thickness_mm": round(thick, 2),
        "material": case.material, "edge": case.edge,
    }  # fmt: skip
    content = {
        "plate": said | dict(case.said),
        "discs": {
            "diameter_mm": layout.diameter_mm, "emitter_mm": places[0].round(1).tolist(),
            "receivers_mm": places[1:].round(1).tolist(),
        },
    }  # fmt: skip
    return Made(instrument, check_plate_file(content), Electronics(noise_db=case.noise_db, gains=GAINS))


def _plate(case: Case) -> Instrument:
    width, height, thickness = case.size_mm
    # The plate itself keeps its constants for all seeds, so that its modes are computed once.
    plate = ElasticPlate(
        width_mm=width + 0.13, height_mm=height - 0.11, thickness_mm=thickness * 0.996,
        material=case.material, elastic=case.elastic,
    )  # fmt: skip
    layout = default_layout(Plate(width_mm=width, height_mm=height))
    acquisition = ACQUISITIONS[case.acquisition]
    modes = other_modes(plate, layout, [*_joints(layout), *_flaws(case, plate)], acquisition.chirp.band_hz[1])
    attachments = case.mounting.on(plate)
    if attachments:
        modes = attach(modes, plate, attachments, case.loss, 75e3)
    return Instrument(
        plate, layout=layout, loss=case.loss, tilts=case.tilts, feedthrough=case.feedthrough, modes=modes,
        acquisition=acquisition,
    )  # fmt: skip


def _joints(layout: Layout) -> list[Patch]:
    """Return what differs from disc to disc: solder, glue, and how stiff the bond is.

    A bead of 0.03 to 0.07 g where the cable leaves, outside the rim; a joint of 0.01 to 0.025 g on the face; and up to
    40 % more or less of the bond's stiffness. A fit knows a bead and a stiffness of each disc, but no second joint.
    """
    rng = np.random.default_rng(_JOINTS)
    angles, kg_m2 = rng.uniform(0, 2 * np.pi, 5), rng.uniform(4.2, 9.9, 5)
    on_face, face_kg_m2, bonds = rng.uniform(0, 2 * np.pi, 5), rng.uniform(3.2, 8.0, 5), rng.uniform(-0.4, 0.4, 5)
    found = []
    for angle, at_mm, half_mm, masses in ((angles, 5.1, 1.5, kg_m2), (on_face, 2.0, 1.0, face_kg_m2)):
        places = layout.centres_mm + at_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        found += [Patch(float(x), float(y), half_mm, half_mm, mass_kg_m2=float(mass))
                  for (x, y), mass in zip(places, masses, strict=True)]  # fmt: skip
    for disc, change in zip(disc_patches(layout), bonds, strict=True):
        found.append(disc._replace(mass_kg_m2=0.0, rotary_kg=0.0, bending_n_m=float(change) * disc.bending_n_m))
    return found


def _flaws(case: Case, plate: Plate) -> list[Patch]:
    if case.flaw == "hole":
        return [missing(plate, 0.9, x_mm=120.0, y_mm=70.0, half_x_mm=8.0, half_y_mm=8.0)]
    if case.flaw == "corner":
        return [missing(plate, 0.9, x_mm=15.0, y_mm=15.0, half_x_mm=15.0, half_y_mm=15.0, round=False, corner=True)]
    if case.flaw == "rib":
        # 10 x 5 mm of the same glass, bonded across the plate.
        return [Patch(140.0, plate.height_mm / 2, 5.0, plate.height_mm / 2, 12.5, 12.5 * 25e-6, 9000.0, 1.5e8,
                      round=False)]  # fmt: skip
    return []
