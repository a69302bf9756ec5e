from __future__ import annotations

import numpy as np
import pytest

from touchd.frame import Plate
from touchd.twin.instrument import Instrument
from touchd.twin.physics import in_plane
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.material import ElasticPlate, Material
from touchd.twin.physics.transducer import Layout

SQUARE = ElasticPlate(width_mm=200, height_mm=200, thickness_mm=5, elastic=Material(72e9, 0.3, 2500.0))
PLATE = Plate(width_mm=70, height_mm=60, thickness_mm=5)
LAYOUT = Layout(emitter_mm=(15, 40), receivers_mm=((10, 11), (58, 12), (55, 50), (30, 8)))


def test_published_frequencies() -> None:
    """A free square has the frequencies of Bardell et al. (1996), w a sqrt(rho (1 - nu^2) / E), to all their digits."""
    omega = np.sort(in_plane.solve(SQUARE, 30e3, (24, 24), 30e3).omega_rad_s)
    found = omega * 0.2 * np.sqrt(2500 * (1 - 0.3**2) / 72e9)
    assert (omega[:3] == 0).all()  # rigid motions
    np.testing.assert_allclose(found[3:9], [2.321, 2.472, 2.472, 2.628, 2.987, 3.452], atol=6e-4)


@pytest.mark.parametrize("more", [0, 4])
def test_converged(more: int) -> None:
    """More polynomials than asked for change no frequency in the band by 1e-4."""
    nx, ny = in_plane.polynomials_for(PLATE, 100e3)
    found, finer = (
        np.sort(np.concatenate([each.omega_rad_s for each in in_plane.solve_classes(PLATE, counts, 100e3)]))
        for counts in ((nx, ny), (nx + 4 + more, ny + 4 + more))
    )
    np.testing.assert_allclose(found, finer, rtol=1e-4)


def test_what_a_disc_stretches() -> None:
    """Discs that stretch the plate as well hear more, of which a touch changes nothing."""
    bends, stretches = (
        Instrument(PLATE, layout=LAYOUT.model_copy(update={"stretch_per_mm": per_mm})) for per_mm in (0.0, 2 / 7)
    )
    one, other = (each.untouched([22.0]) * each.peak for each in (bends, stretches))
    assert 0.003 < ((other - one) ** 2).sum() / (one**2).sum() < 0.1
    touch = [[Contact(40.0, 30.0, 20.0, "silicone")]]
    one, other = (each.change(touch, [22.0]) * each.peak for each in (bends, stretches))
    np.testing.assert_allclose(other, one, atol=1e-9 * np.abs(one).max())
