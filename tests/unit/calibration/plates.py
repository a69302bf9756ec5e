"""A small plate of the twin, and what a fit would find on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from touchd.calibration.loads import Edges, Loss
from touchd.calibration.physical_atlas import TIP, PhysicalField, make_physical_atlas
from touchd.calibration.plate_fit import PlateFit
from touchd.calibration.reduced_plate import ReducedPlate
from touchd.calibration.start_scan import start_scan
from touchd.evaluation.cramer_rao import twin_values
from touchd.frame import Plate
from touchd.localization.atlas import Atlas, atlas_path, save_atlas
from touchd.localization.model import Description
from touchd.localization.model_file import put_model
from touchd.training.field.bins import TAPER
from touchd.training.field.place import complex_nodes, real_nodes
from touchd.twin.instrument import REFERENCE_C, Instrument
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.material import ElasticPlate, material_of
from touchd.twin.physics.transducer import Layout

PEAK_COUNTS = 0.6 * 2**15
PLATE = Plate(width_mm=110, height_mm=90, thickness_mm=5)
LAYOUT = Layout(emitter_mm=(20, 50), receivers_mm=((12, 12), (98, 18), (85, 78)))


def elastic(plate: Plate) -> ElasticPlate:
    """The plate with its constants."""
    return ElasticPlate(**plate.model_dump(), elastic=material_of(plate))


def basis_of(plate: Plate) -> ReducedPlate:
    """The basis of a fit whose reference is the plate itself."""
    return ReducedPlate(elastic(plate), 100e3)


def exact_fit(instrument: Instrument, loss_factor: float = 5e-3) -> PlateFit:
    """The twin's own parameters, as if a fit had found them exactly; a touch tells the gain from units to counts."""
    a = instrument.acquisition
    plate = elastic(instrument.plate)
    untouched = PEAK_COUNTS * instrument.untouched([REFERENCE_C])[0]
    loss = Loss(loss_factor, 0.0, np.pi * (a.chirp.start_hz + a.chirp.stop_hz))
    unit = PlateFit(
        plate=plate, layout=instrument.layout, acquisition=a, loss=loss,
        gains=np.tile(np.array([1.0, 0, 0], complex), (a.channels, 1)), parameters=(), verdict="good", expected_mm=0.05,
        reasons=(), undecided=(), scale_error=0.0, unexplained=1e-6, noise_share=1e-6, measured=untouched,
        fitted=untouched, basis=basis_of(instrument.plate), edges=Edges({}, {}, 1.0),
    )  # fmt: skip
    touch = PhysicalField(unit).at(np.array([[50.0, 40.0]]), TIP)
    exact = twin_values(instrument, [Contact(50.0, 40.0, TIP.area_mm2, TIP.tissue)], TAPER)
    return replace(unit, gains=unit.gains * (np.vdot(touch, exact) / np.vdot(touch, touch)).real)


def model_of(fit: PlateFit, path: Path) -> Path:
    """A model made from a fit, at `path`."""
    atlas = make_physical_atlas(fit, 1e-3 * float(np.sqrt(np.square(fit.measured).mean())))
    d = atlas.description
    description = Description(
        name="calibrated", head="regression", domain="frequency", input="residual", acquisition=d.acquisition,
        plate=d.plate, taper=d.taper,
    )  # fmt: skip
    save_atlas(atlas, atlas_path(path))
    put_model(start_scan(atlas, description).SerializeToString(), path)
    return path


def off_channels(atlas: Atlas) -> Atlas:
    """Return a field whose channels are off."""
    bins = np.linspace(-1, 1, len(atlas.description.bins))
    off = np.exp(1j * np.outer([0.5, -0.4, 0.3], bins**2)) * (1 + np.outer([0.2, -0.2, 0.1], bins))
    return replace(atlas, coefficients=real_nodes(complex_nodes(atlas) * off))
