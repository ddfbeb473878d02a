"""Stresses as DOLFINx Functions, against closed forms of homogeneous deformations."""

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import io
from dolfinx.mesh import CellType
from scenes import CELLS, RUBBER, box

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

COMM = MPI.COMM_WORLD
SHEAR = np.array([[1.0, 0.3, 0.0], [0.0, 1.1, 0.0], [0.0, 0.1, 0.9]])
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])

pytestmark = pytest.mark.mpi
each_cell = pytest.mark.parametrize("cell", CELLS.values(), ids=CELLS)


def homogeneous(material, degree, cell=CellType.hexahedron, gradient=SHEAR):
    mesh = box(high=(1, 2, 1), cells=(2, 1, 2), cell=cell)
    body = nts.Continuum(mesh, material, density=1.0, degree=degree)
    body.u.interpolate(lambda x: (gradient - np.eye(3)) @ x)
    return body


def equivalent(stress):
    deviator = stress - np.trace(stress) / 3 * np.eye(3)
    return np.sqrt(1.5 * np.sum(deviator**2))


def neo_hooke(f):
    mu, lam = 1e6 / 2.6, 0.3e6 / (1.3 * 0.4)
    j = np.linalg.det(f)
    return (mu * (f @ f.T - np.eye(3)) + lam * np.log(j) * np.eye(3)) / j


def of_cells(function):
    """Values of this rank's cells and ghosts, shape (cells, 3, 3)."""
    index_map = function.function_space.mesh.topology.index_map(3)
    values = function.x.array.reshape(-1, 3, 3)
    assert len(values) == index_map.size_local + index_map.num_ghosts
    return values


@pytest.mark.parametrize("degree", [1, 2])
@each_cell
@pytest.mark.fast("tetrahedron-1")
def test_a_homogeneous_deformation(cell, degree):
    body = homogeneous(RUBBER, degree, cell)
    exact = neo_hooke(SHEAR)
    assert np.allclose(of_cells(nts.cauchy_stress(body, at="cells")), exact, rtol=0, atol=1e-6)
    for at in ("nodes", "cells"):
        assert np.allclose(nts.von_mises(body, at=at).x.array, equivalent(exact), rtol=1e-12)
    at_nodes = nts.cauchy_stress(body).x.array.reshape(-1, 3, 3)
    assert np.allclose(at_nodes, exact, rtol=0, atol=1e-6)


@pytest.mark.parametrize("degree", [1, 2])
@each_cell
@pytest.mark.fast("hexahedron-1", "tetrahedron-2")
def test_at_nodes_a_stress_that_is_linear_is_exact(cell, degree):
    """Of a bar bent to a slight arc, which elements of degree 2 follow, sigma = E z / R.

    Hexahedra of degree 1 have the right slope over the height in each cell, whose means know only
    a half of it at the skin; their moved corners add nothing to sigma_xx at nu = 0.
    """
    if cell == CellType.tetrahedron and degree == 1:
        pytest.skip("the stress in its cells is constant")
    law = nts.StVenantKirchhoff(young=1e6, poisson=0.0)
    mesh = box(high=(4, 1, 1), cells=(4, 1, 2), cell=cell)
    mesh.geometry.x[:, 2] -= 0.5
    body = nts.Continuum(mesh, law, density=1.0, degree=degree)
    bend = 1e-8  # squares of strains are 1e-8 of them
    body.u.interpolate(lambda x: bend * np.array([x[0] * x[2], 0 * x[0], -0.5 * x[0] ** 2]))
    function = nts.cauchy_stress(body)
    places = function.function_space.tabulate_dof_coordinates()
    found = function.x.array.reshape(-1, 3, 3)[:, 0, 0]
    assert np.allclose(found, 1e6 * bend * places[:, 2], rtol=0, atol=1e-8)
    measure = nts.von_mises(body)
    z = measure.function_space.tabulate_dof_coordinates()[:, 2]
    # Hexahedra of degree 1 cannot turn their sections with the axis, and shear.
    if degree == 2:
        assert np.allclose(measure.x.array, 1e6 * bend * np.abs(z), rtol=0, atol=1e-8)
    assert (measure.x.array >= 1e6 * bend * np.abs(z) - 1e-8).all()
    # After a change of the displacement, the same forms say what holds now.
    body.u.x.array[:] *= 2.0
    again = nts.cauchy_stress(body).x.array.reshape(-1, 3, 3)[:, 0, 0]
    assert np.allclose(again, 2.0 * found, rtol=0, atol=1e-8)


def test_a_place_that_is_none():
    with pytest.raises(ValueError, match="at='points': choose one of 'nodes', 'cells'"):
        nts.cauchy_stress(homogeneous(RUBBER, 1), at="points")


def test_a_users_energy():
    body = homogeneous(lambda c: 5.0 * ufl.tr(c * c), 1)
    c = SHEAR.T @ SHEAR
    exact = SHEAR @ (2 * 10.0 * c) @ SHEAR.T / np.linalg.det(SHEAR)
    assert np.allclose(of_cells(nts.cauchy_stress(body, at="cells")), exact, rtol=1e-12, atol=1e-12)
    assert np.allclose(nts.von_mises(body).x.array, equivalent(exact), rtol=1e-12)


def test_stress_turns_with_the_body():
    still, turned = homogeneous(RUBBER, 1), homogeneous(RUBBER, 1, gradient=TURN @ SHEAR)
    expected = TURN @ of_cells(nts.cauchy_stress(still, at="cells")) @ TURN.T
    assert np.allclose(of_cells(nts.cauchy_stress(turned, at="cells")), expected, rtol=0, atol=1e-6)


def test_cells_have_means():
    """Of W = tr C / 2 - ln J with the stress (F F^T - 1) / J, F_xx = 1 + a y and F_xy = a x.

    Cells are 1 long in x and y and have two Gauss points in each direction.
    """
    body = nts.Continuum(
        box(high=(1, 2, 1), cells=(1, 2, 1)),
        lambda c: 0.5 * ufl.tr(c) - 0.5 * ufl.ln(ufl.det(c)),
        density=1.0,
    )
    a = 0.01
    body.u.interpolate(lambda x: np.array([a * x[0] * x[1], 0 * x[0], 0 * x[0]]))
    values = of_cells(nts.cauchy_stress(body, at="cells"))
    middles = body.mesh.geometry.x[compat.geometry_dofmap(body.mesh)].mean(axis=1)
    assert len(middles) == len(values)
    gauss = 0.5 / np.sqrt(3)
    for middle, value in zip(middles, values, strict=True):
        stretch = 1 + a * (middle[1] + np.array([-gauss, gauss]))
        slope = a * (0.5 + np.array([-gauss, gauss]))
        xx = (stretch[:, None] ** 2 + slope**2 - 1) / stretch[:, None]
        xy = slope / stretch[:, None]
        expected = np.zeros((3, 3))
        expected[0, 0], expected[0, 1], expected[1, 0] = xx.mean(), xy.mean(), xy.mean()
        assert np.allclose(value, expected, rtol=0, atol=1e-14)


def test_dolfinx_writes_them(mpi_tmp_path):
    """Beside the displacement, in the file that DOLFINx makes of Functions."""
    h5py = pytest.importorskip("h5py")
    body = homogeneous(RUBBER, 1)
    with io.XDMFFile(COMM, str(mpi_tmp_path / "stress.xdmf"), "w") as file:
        file.write_mesh(body.mesh)
        file.write_function(nts.cauchy_stress(body, at="cells"), 0.5)
        file.write_function(nts.von_mises(body, at="cells"), 0.5)
    with h5py.File(mpi_tmp_path / "stress.h5") as file:
        stress = np.array(file["Function/cauchy_stress/0_5"]).reshape(-1, 3, 3)
        scalar = np.array(file["Function/von_mises/0_5"])
    assert len(stress) == 4 and np.allclose(stress, neo_hooke(SHEAR), rtol=0, atol=1e-6)
    assert np.allclose(scalar, equivalent(neo_hooke(SHEAR)), rtol=1e-12)
