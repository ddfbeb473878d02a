"""Conditions that prescribe different values of one coordinate are refused, equal ones not."""

from mpi4py import MPI

import numpy as np
import pytest
from scenes import RUBBER, at, box

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi
BOTTOM, SIDE = at(2, 0.0), at(0, 0.0)


def cube(*bcs):
    return nts.Continuum(box(cells=1), RUBBER, density=1e3, name="cube", bcs=bcs)


def move(body):
    return nts.simulate(nts.System([body]), nts.EnergyMomentum(), dt=0.1, t_end=0.4)


def test_different_values_are_refused_at_the_start():
    text = r"bcs\[0\] and bcs\[2\] of 'cube': at t=0 they prescribe 0 and 0.1 along z "
    text += r"of the node at X = \(0, 0, 0\); leave that place"
    held = nts.Dirichlet(at(2, 1.0))
    with pytest.raises(ValueError, match=text):
        cube(nts.Dirichlet(BOTTOM), held, nts.Dirichlet(SIDE, (0, 0, 0.1), components=(2,)))
    with pytest.raises(ValueError, match=text):
        cube(nts.Dirichlet(BOTTOM), held, nts.Dirichlet(SIDE, lambda t: (0, 0, 0.1)))
    cube(nts.Dirichlet(BOTTOM), nts.Dirichlet(SIDE, (0, 0, 0.1), components=(0, 1)))


def test_values_that_come_apart_in_time_end_the_run():
    def late(t):
        return (0, 0, 0.1 * max(t - 0.25, 0.0))

    body = cube(nts.Dirichlet(BOTTOM), nts.Dirichlet(SIDE, late))
    run = move(body)
    assert "bcs[0] and bcs[1] of 'cube': at t=0.3 they prescribe 0 and 0.005 along" in run.status
    assert np.array_equal(run.balance["time"], [0, 0.1, 0.2]) and run.retries == 0


def test_values_that_are_equal_up_to_rounding_are_legal():
    def one(t):
        return (0, 0, np.sin(2 * t))

    def same(t):
        return (0, 0, 2 * np.sin(t) * np.cos(t))

    body = cube(nts.Dirichlet(BOTTOM, one), nts.Dirichlet(at(0, 0.0), same))
    run = move(body)
    assert run.status.startswith("completed")


@pytest.mark.fast_on_ranks()
def test_a_clamp_and_a_condition_of_a_beam():
    points = np.linspace(0, 1, 3)[:, None] * np.array([1.0, 0.0, 0.0])
    mine = slice(None if COMM.rank == 0 else 0)
    cells = np.array([[0, 1], [1, 2]])
    mesh = compat.create_mesh(COMM, cells[mine], points[mine], "interval")
    section = nts.Section(EA=1.0, GA=(1.0, 1.0), GJ=1.0, EI=(1.0, 1.0), rhoA=1.0, rhoI=(1.0, 1.0))
    end = at(0, 0.0)
    with pytest.raises(ValueError, match=r"bcs\[0\] and bcs\[1\] of 'beam'.* 0 and 0.1 along"):
        nts.Beam(mesh, section, bcs=[nts.Clamp(end), nts.Dirichlet(end, (0, 0.1, 0))])
    nts.Beam(mesh, section, bcs=[nts.Clamp(end), nts.Dirichlet(end)])
