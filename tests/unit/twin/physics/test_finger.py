"""Fingers have the impedances of the table."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special

from touchd.errors import SimulationError
from touchd.twin.physics.finger import Contact, area_of, drop_mass_mg, force_of, impedance, patches, poisson_integral

TABLE = [
    ("silicone", np.pi * 2.5**2, 75e3, 12 + 15j),
    ("human", 40, 50e3, 16 + 34j),
    ("human", 40, 75e3, 32 + 43j),
    ("human", 40, 100e3, 49 + 43j),
    ("human", 80, 75e3, 104 + 84j),
]


@pytest.mark.parametrize(("kind", "area_mm2", "frequency_hz", "z"), TABLE)
def test_impedances_are_those_of_the_table(kind: str, area_mm2: float, frequency_hz: float, z: complex) -> None:
    found = complex(impedance(kind, 2 * np.pi * frequency_hz, area_mm2))
    assert abs(found.real - z.real) <= 0.6
    assert abs(found.imag - z.imag) <= 0.6


def bessel_struve(x: np.ndarray) -> np.ndarray:
    """J1(x) - i H1(x)."""
    return 2 * x / np.pi * poisson_integral(x)


def test_bessels_and_struves_functions_are_scipys() -> None:
    x = np.linspace(0.01, 12, 200)
    np.testing.assert_allclose(bessel_struve(x), special.j1(x) - 1j * special.struve(1, x), atol=1e-9)


def test_bessels_function_is_scipys_at_complex_arguments() -> None:
    x = np.linspace(0.01, 8, 50) - 0.3j
    # Real at real x, so J1 is half of f(x) + conj(f(conj(x))).
    both = (bessel_struve(x) + np.conj(bessel_struve(np.conj(x)))) / 2
    np.testing.assert_allclose(both, special.jv(1, x), atol=1e-9)


def test_area_grows_as_the_root_of_the_force() -> None:
    assert area_of("human", 1.0) == pytest.approx(100)
    assert area_of("human", 0.25) == pytest.approx(50)
    assert force_of("silicone", area_of("silicone", 2.5)) == pytest.approx(2.5)


def test_a_hard_foot_is_a_spring() -> None:
    """Its force lags the velocity by a right angle, less its loss, and falls with the frequency, of any area."""
    one, other = (complex(impedance("object", omega_rad_s, 4.0)) for omega_rad_s in (2e5, 4e5))
    assert one == pytest.approx(2 * other)
    assert np.degrees(np.angle(one)) == pytest.approx(-90 + np.degrees(np.arctan(0.05)))
    assert abs(other) == pytest.approx(3e6 / 4e5, rel=0.01)
    np.testing.assert_array_equal(impedance("object", 2e5, [2.0, 9.0]), [one, one])


def test_a_drop_is_its_mass() -> None:
    assert drop_mass_mg(18.1) == pytest.approx(29, abs=0.1)
    assert complex(impedance("drop", 1e5, 18.1)) == pytest.approx(1e5j * float(drop_mass_mg(18.1)) * 1e-6)


def test_a_palm_is_many_patches_and_a_finger_is_one() -> None:
    assert len(patches(Contact(100, 100, 90, "palm"))) > 10
    assert patches(Contact(100, 100, 20, "silicone")) == [Contact(100, 100, 20, "silicone")]


def test_an_unknown_finger_is_refused_by_name() -> None:
    with pytest.raises(SimulationError, match="toe"):
        impedance("toe", 1e5, 10.0)
