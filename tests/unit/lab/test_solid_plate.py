from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import eigsh

from touchd.frame import Plate
from touchd.lab.plates.cases import GLASS
from touchd.lab.plates.solid_instrument import SolidInstrument
from touchd.lab.plates.solid_plate import default_solid, save, simulate
from touchd.lab.plates.spectral_elements import Mesh, Solid
from touchd.twin.physics.finger import Contact
from touchd.twin.physics.material import ElasticPlate, Material
from touchd.twin.physics.plate import solve
from touchd.twin.physics.transducer import default_layout

Floats = NDArray[np.float64]
SMALL = Solid((36.0, 30.0, 5.0), np.array([[9.0, 15.0], [28.0, 8.0]]))
THIN = Solid((100.0, 100.0, 2.0), np.array([[50.0, 50.0]]), E_pa=72e9, nu=0.3, rho_kg_m3=2500.0)


def stiffness_of(mesh: Mesh) -> tuple[sparse.csc_array, Floats]:
    """Return the stiffness by square roots of the masses, and these."""
    count, rows = 3 * int(np.prod(mesh.shape)), []
    for some in np.array_split(np.arange(count), math.ceil(count / 500)):
        u = torch.zeros(len(some), count, dtype=torch.float64)
        u[np.arange(len(some)), some] = 1
        moved = -mesh.acceleration(u.reshape(-1, 3, *mesh.shape).transpose(0, 1)).transpose(0, 1)
        rows.append(sparse.csc_array(moved.reshape(len(some), count).numpy()))
    root = np.sqrt(np.broadcast_to(mesh.mass_kg, (3, *mesh.shape)).ravel())
    stiff = sparse.diags_array(1 / root) @ sparse.vstack(rows) @ sparse.diags_array(root)
    assert abs(stiff - stiff.T).max() < 1e-10 * abs(stiff).max()
    return sparse.csc_array((stiff + stiff.T) / 2), root


def test_bending_as_mindlin() -> None:
    """At the edges a bent solid differs within a thickness: the mesh has to resolve that."""
    side_mm, thick_mm = 40.0, 1.6
    solid = THIN._replace(size_mm=(side_mm, side_mm, thick_mm), discs_mm=THIN.discs_mm * side_mm / 100)
    stiff, _ = stiffness_of(Mesh(solid, double=True, discs=False, elements=(3, 3), orders=(7, 3)))
    squared = eigsh(stiff, 18, sigma=-1e8, return_eigenvectors=False)
    plate = ElasticPlate(
        width_mm=side_mm, height_mm=side_mm, thickness_mm=thick_mm, elastic=Material(72e9, 0.3, 2500.0)
    )
    expected = solve(plate, (24, 24)).omega_rad_s[3:15]
    found = np.sqrt(np.sort(squared)[6:])
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_in_plane_as_bardell() -> None:
    """Natural frequencies of a free square plate in its plane: Bardell, Langley & Dunsdon, J. Sound Vib. 191, 1996."""
    mesh = Mesh(THIN, double=True, discs=False, elements=(2, 2), orders=(6, 3))
    stiff, root = stiffness_of(mesh)
    squared, vectors = eigsh(stiff, 46, sigma=(2.7 / 0.1) ** 2 * 72e9 / (2500.0 * (1 - 0.3**2)))
    order = np.argsort(squared)
    # Bending moves the plate's middle up and down, not in its plane.
    shape = (root[:, None] * vectors[:, order]).reshape(3, *mesh.shape, -1)[:2].sum(axis=1)
    in_plane = (shape**2 / mesh.mass_kg.sum(axis=0)[..., None]).sum(axis=(0, 1, 2)) > 0.5
    found = np.sqrt(squared[order][in_plane]) * 0.1 * np.sqrt(2500.0 * (1 - 0.3**2) / 72e9)
    np.testing.assert_allclose(found[:6], [2.321, 2.472, 2.472, 2.628, 2.987, 3.452], rtol=1e-3)


def test_rigid_motions_cost_nothing() -> None:
    """Six rigid motions, of the plate with its discs, against a motion as large that strains it."""
    mesh = Mesh(SMALL, double=True)
    z, x, y = np.meshgrid(mesh.z.nodes_m, mesh.x.nodes_m, mesh.y.nodes_m, indexing="ij")
    o, one = np.zeros_like(x), np.full_like(x, 0.03)
    rigid = [(one, o, o), (o, one, o), (o, o, one), (y, -x, o), (z, o, -x), (o, z, -y)]
    u = torch.as_tensor(np.array([*rigid, (x, y, o)])).transpose(0, 1)
    force = mesh.acceleration(u).numpy() * mesh.mass_kg
    energy = np.abs((force * u.numpy()).sum(axis=(0, 2, 3, 4)))
    assert energy[:6].max() < 1e-12 * energy[6]
    assert np.abs(force[:, :6]).max() < 1e-9 * np.abs(force[:, 6]).max()


def test_a_disc_adds_its_mass_and_drives_as_it_senses() -> None:
    mesh = Mesh(SMALL, double=True)
    plate_kg = 2490 * 36e-3 * 30e-3 * 5e-3
    assert mesh.mass_kg.sum() == pytest.approx(plate_kg + 2 * 0.43e-3, rel=1e-12)
    push = mesh.acceleration(mesh.rest(2), 1.0).numpy() * mesh.mass_kg
    u = mesh.rest(2)
    u[0, :, -1] = torch.as_tensor(mesh.x.nodes_m)[:, None]
    u[1, :, -1] = torch.as_tensor(mesh.y.nodes_m)
    # A displacement equal to the place stretches each rim by its radius, which is the work of one newton.
    np.testing.assert_allclose(mesh.sense(u).numpy(), 3e-3, rtol=1e-10)
    np.testing.assert_allclose((push * u.numpy()).sum(axis=(0, 2, 3, 4)), 3e-3, rtol=1e-10)


def test_default_layout() -> None:
    found = default_solid(220, 160, 5)
    np.testing.assert_allclose(found.discs_mm, default_layout(Plate(width_mm=220, height_mm=160)).centres_mm)
    assert (found.E_pa, found.nu, found.rho_kg_m3) == GLASS[:3]


@pytest.mark.parametrize("loss", [0.0, 6e-3])
def test_reciprocity_and_energy(loss: float) -> None:
    """What one disc sends to the other it gets back; without loss the plate rings on, with loss it does not."""
    mesh = Mesh(SMALL._replace(loss=loss), double=True)
    run = simulate(mesh, length_s=0.15e-3)
    peak = np.abs(run.signals).max()
    np.testing.assert_allclose(run.signals[0, 1], run.signals[1, 0], atol=1e-9 * peak)
    strength = (run.face**2).sum(axis=(0, 2, 3))
    early, late = strength[30:40].mean(), strength[-10:].mean()
    assert 0.7 < late / early < 1.3 if loss == 0 else late < 0.9 * early


def test_an_instrument_of_a_saved_run(tmp_path: Path) -> None:
    mesh = Mesh(SMALL, elements=(3, 3), orders=(4, 3))
    save(tmp_path / "run.npz", SMALL, simulate(mesh))
    instrument = SolidInstrument(tmp_path / "run.npz")
    assert np.abs(instrument.untouched([22.0])).max() == pytest.approx(1.0)
    touch = [Contact(18.0, 20.0, 20.0, "silicone")]
    changes = instrument.change([touch, []], [22.0, 22.0])
    share = np.linalg.norm(changes[0]) / np.linalg.norm(instrument.untouched([22.0]))
    assert 0.003 < share < 0.3
    assert not changes[1].any()
