from __future__ import annotations

import numpy as np
import pytest

from touchd.lab.plates.other_plate import missing, other_modes
from touchd.twin.physics import in_plane
from touchd.twin.physics.material import MATERIALS, ElasticPlate
from touchd.twin.physics.plate import solve
from touchd.twin.physics.transducer import Layout

PLATE = ElasticPlate(width_mm=50, height_mm=40, thickness_mm=5, elastic=MATERIALS["glass"])
LAYOUT = Layout(emitter_mm=(12, 20), receivers_mm=((38, 8),), diameter_mm=1e-2)
WHOLE = {"x_mm": 25.0, "y_mm": 20.0, "half_x_mm": 25.0, "half_y_mm": 20.0, "round": False}


@pytest.mark.parametrize(("stiff", "heavy"), [(True, False), (False, True), (True, True)])
def test_a_patch_as_large_as_the_plate(stiff: bool, heavy: bool) -> None:
    """A patch that takes a fifth of the whole plate's stiffness or mass changes all frequencies as closed form says."""
    patch = missing(PLATE, 0.2, **WHOLE)
    if not stiff:
        patch = patch._replace(bending_n_m=0.0, shear_n_m=0.0, stretch_n_m=0.0)
    if not heavy:
        patch = patch._replace(mass_kg_m2=0.0, rotary_kg=0.0)
    found = other_modes(PLATE, LAYOUT, [patch], 60e3).omega_rad_s
    bare = [each.omega_rad_s for each in (solve(PLATE, (24, 22), 110e3), in_plane.solve(PLATE, 60e3, (24, 22), 110e3))]
    assert min(map(len, bare)) > 10
    expected = np.sort(np.concatenate(bare)) * np.sqrt((0.8 if stiff else 1) / (0.8 if heavy else 1))
    count = int(np.searchsorted(expected, 2 * np.pi * 90e3))
    np.testing.assert_allclose(found[6:count], expected[6:count], rtol=1e-4)
