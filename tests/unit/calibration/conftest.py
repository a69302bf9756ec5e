"""A small plate, and the atlas of its own physics: tests of a file share both."""

from __future__ import annotations

import numpy as np
import pytest

from tests.unit.calibration.plates import LAYOUT, PLATE, basis_of, elastic, exact_fit
from touchd.calibration.physical_atlas import make_physical_atlas
from touchd.calibration.plate_fit import PlateFit
from touchd.localization.atlas import Atlas
from touchd.twin.instrument import Instrument


@pytest.fixture(scope="module")
def instrument() -> Instrument:
    """The twin in the modes of the fit, so that both can agree to rounding."""
    modes = basis_of(PLATE).loaded(elastic(PLATE), LAYOUT)
    return Instrument(PLATE, layout=LAYOUT, modes=modes)


@pytest.fixture(scope="module")
def fit(instrument: Instrument) -> PlateFit:
    return exact_fit(instrument)


@pytest.fixture(scope="module")
def atlas(fit: PlateFit) -> Atlas:
    return make_physical_atlas(fit, 1e-3 * float(np.sqrt(np.square(fit.measured).mean())))
