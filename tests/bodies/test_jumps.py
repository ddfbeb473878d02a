"""Constant prescribed values that move a part of a body at once."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
REMEDY = "supports of 'high' move by {:.3g} at once, at the start: make that value a function of t"


def at(z):
    return lambda x: np.isclose(x[2], z)


def scene(value, metre=1.0, where=None, **options):
    """A cube over another one with a gap of 0.05 between them, whose upper face is prescribed."""
    bodies = []
    for name, z, n, held in (("low", 0.0, 1, 0.0), ("high", 1.05, 2, 2.05)):
        ends = np.array([[0.0, 0.0, z], [1.0, 1.0, z + 1.0]]) * metre
        upper = name == "high"
        marker = where if upper and where else at(held * metre)
        bcs = [nts.Dirichlet(marker, value if upper else (0, 0, 0))]
        bodies.append(nts.Continuum(
            create_box(COMM, list(ends), [n] * 3, CellType.hexahedron), nts.NeoHookean(1e6, 0.3),
            density=1e3, bcs=bcs, name=name, **(options if upper else {}),
        ))  # fmt: skip
    low, high = bodies
    pair = nts.ContactPair(high.surface(at(1.05 * metre)), low.surface(at(metre)))
    return nts.System(bodies, contacts=[pair])


@pytest.mark.mpi
@pytest.mark.parametrize("metre", [1.0, 1e3])
@pytest.mark.fast("1000.0")
@pytest.mark.fast_on_ranks()
def test_a_step_that_fails_with_a_jump_says_so(metre):
    """An upper half of cells of 0.5 is pushed in by 0.7: no step divides it."""
    for run in (
        nts.equilibrium(scene((0, 0, -0.7 * metre), metre), load_steps=2),
        nts.simulate(
            scene((0, 0, -0.7 * metre), metre), nts.EnergyMomentum(), dt=1e-2, t_end=2e-2
        ),
    ):
        assert REMEDY.format(0.7 * metre) in run.status and "smaller dt" not in run.status


@pytest.mark.mpi
def test_a_function_of_time_is_solved_without_a_word():
    run = nts.equilibrium(scene(lambda t: (0, 0, -0.2 * t)), load_steps=4)
    assert run.status == "completed" and run.reactions["low"][-1][0, 2] > 0.0


@pytest.mark.mpi
def test_constant_values_that_make_nodes_start_inside_say_so():
    """All of the upper cube's surface, 0.1 below where it lies, which ends 0.05 inside."""
    with pytest.raises(ValueError, match=r"start inside the master.*" + REMEDY.format(0.1)):
        scene((0, 0, -0.1), where=lambda x: x[2] > 0.0)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_bodies_that_start_where_they_are_held_are_no_jump():
    """The crash is of another cause: a body that is placed by `displacement` starts as meant."""
    system = scene((0, 0, 0.3), displacement=(0, 0, 0.3), velocity=(0, 0, -1e4))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-2, t_end=2e-2)
    assert run.status != "completed" and "at once" not in run.status
