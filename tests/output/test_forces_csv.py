"""The file of the forces of joints that are constraints."""

import csv

from mpi4py import MPI

import numpy as np
import pytest

import dolfinx_nts as nts
from dolfinx_nts.output import ForcesCSV

COMM = MPI.COMM_WORLD
G = 9.81


@pytest.mark.mpi
def test_forces_of_a_hinge_and_a_ball_joint_that_hold_two_weights(mpi_tmp_path):
    """A rod hangs from a hinge, off its centre by a quarter of a metre, and a ball from the rod.

    The hinge's axis is along the way by which they are off, so that it holds the moment, too.
    """
    path = mpi_tmp_path / "forces.csv"
    rod = nts.RigidBody.from_inertia(2.0, (1, 1, 1), name="rod")
    ball = nts.RigidBody.from_inertia(1.0, (1, 1, 1), centre=(0.25, 0, -1.0), name="ball")
    hinge = nts.Revolute(rod, None, point=(-0.25, 0, 1.0), axis=(1, 0, 0), name="hinge")
    string = nts.Spherical(ball, rod, point=(0.25, 0, -1.0), name="string")
    system = nts.System([rod, ball], joints=[hinge, string], gravity=(0, 0, -G))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.05, output=[ForcesCSV(path)])
    assert run.status == "completed"
    if COMM.rank == 0:
        with path.open() as file:
            rows = list(csv.DictReader(line for line in file if line[0] != "#"))
        assert len(rows) == 6
        last = {name: float(value) for name, value in rows[-1].items()}

        def vector(name, unit):
            return np.array([last[f"{name}_{axis} [{unit}]"] for axis in "xyz"])

        tolerance = 1e-9 * 3 * G
        assert np.abs(vector("hinge_force", "N") - [0, 0, 3 * G]).max() < tolerance
        # About the hinge's point the weights turn by x cross f, which the hinge resists.
        moment = -np.cross([0.25, 0, -1.0], [0, 0, -2 * G]) - np.cross([0.5, 0, -2], [0, 0, -G])
        assert np.abs(vector("hinge_moment", "N m") - moment).max() < tolerance
        assert np.abs(vector("string_force", "N") - [0, 0, G]).max() < tolerance
        assert np.abs(vector("string_moment", "N m")).max() < tolerance
