"""Edges that cross between their nodes are kept apart (theory section 18)."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType
from integrators import MID_STEP
from scenes import box, everywhere

import dolfinx_nts as nts
from dolfinx_nts.contact.edges import near, sharp_edges

COMM = MPI.COMM_WORLD
HEX, TET = CellType.hexahedron, CellType.tetrahedron
HALF = np.sqrt(0.5)


def turned(
    matrix, centre, name, size=(1, 1, 1), cells=2, cell=HEX, kind=None, metre=1.0, young=1e5,
    **options,
):  # fmt: skip
    """A block about a centre, turned by a matrix."""
    size = np.array(size)
    mesh = box(-0.5 * size, 0.5 * size, cells, cell, COMM)
    mesh.geometry.x[:] = metre * (mesh.geometry.x @ np.transpose(matrix) + centre)
    if kind is nts.RigidBody:
        return nts.RigidBody(mesh, density=1e3, name=name, **options)
    material = nts.NeoHookean(young / metre, 0.3)
    return nts.Continuum(mesh, material, density=1e3 / metre**3, name=name, **options)


#: By 45 degrees about x: an edge along x is on top, and one below.
ON_EDGE = np.array([[1, 0, 0], [0, HALF, -HALF], [0, HALF, HALF]])


def about_z(degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def crossed(angle, friction, metre=1.0, kind=None):
    """A cube on its edge that falls on the edge of another one, spinning, away from the nodes."""
    centre, spin = np.array([0.03, 0.05, 2 * HALF + 0.02]), np.array([0.3, -0.2, 0.8])

    def velocity(x):
        way = (x / metre).T - centre
        return metre * (np.array([0.2, 0.1, -2.0]) + np.cross(spin, way)).T

    moves = {"velocity": velocity}
    if kind is nts.RigidBody:
        moves = {"velocity": (0.2, 0.1, -2.0), "angular_velocity": spin}
    lower = turned(ON_EDGE, np.zeros(3), "lower", kind=kind, metre=metre)
    upper = turned(about_z(angle) @ ON_EDGE, centre, "upper", kind=kind, metre=metre, **moves)
    pair = nts.ContactPair(
        upper.surface(everywhere), lower.surface(everywhere), friction=friction, edges=True
    )
    return nts.System([lower, upper], contacts=[pair])


@pytest.mark.mpi
@pytest.mark.parametrize(("angle", "friction", "kind"), [
    (90.0, 0.4, None), (67.0, 0.0, None), (67.0, 0.4, nts.RigidBody),
])  # fmt: skip
@pytest.mark.parametrize("rule", MID_STEP)
def test_crossed_edges_rebound_and_keep_energy_and_momenta(rule, angle, friction, kind):
    """Forces act between the edges alone: no node of either cube comes near the other one."""
    run = nts.simulate(
        crossed(angle, friction, kind=kind), MID_STEP[rule], dt=2e-3, t_end=0.06, accuracy="exact"
    )
    assert run.status == "completed"
    table, energy = run.balance, run.balance["energy"][0]
    assert table["min_gap"].min() > -1e-12 and np.isfinite(table["min_gap"].min())
    if rule == "energy-momentum":
        assert np.abs(table["ledger_residual"]).max() < 1e-11 * energy
    for name in ("linear_momentum", "angular_momentum"):
        off = np.abs(table[name] - table[name][0]).max()
        assert off < 1e-12 * np.abs(table[name]).max()
    # Nodes alone would do nothing: what is below would stay at rest.
    assert not np.any(run.contact_forces)
    assert nts.motion_of(run.system.bodies[0]).velocity[2] < -0.02
    assert table["friction_dissipation"][-1] >= 0.0


@pytest.mark.parametrize("metre", [1e3, 1e-3])
def test_edges_meet_alike_in_other_units(metre):
    """The same cubes in millimetres or kilometres, with the same mass."""
    runs = [
        nts.simulate(
            crossed(67.0, 0.4, m), nts.EnergyMomentum(), dt=2e-3, t_end=0.04, accuracy="exact"
        )
        for m in (1.0, metre)
    ]
    ends = [np.array([nts.motion_of(b).velocity for b in run.system.bodies]) for run in runs]
    np.testing.assert_allclose(ends[1] / metre, ends[0], rtol=1e-9, atol=1e-10)


def bars(cells, **upper_options):
    """A bar of tetrahedra above another one across, whose ends are held, edge on edge."""
    side, length, long = 0.1, 1.2, (cells, 1, 1)
    soft = {"size": (length, side, side), "cells": long, "cell": TET, "young": 5e7}
    held = [nts.Dirichlet(lambda x: np.abs(x[0]) > 0.5 * length - 1e-6)]
    lower = turned(ON_EDGE, np.zeros(3), "lower", bcs=held, **soft)
    shift = np.array([0.5 * length / cells, 0.5 * length / cells, side / HALF + 0.005])
    upper = turned(about_z(90.0) @ ON_EDGE, shift, "upper", **upper_options, **soft)
    pair = nts.ContactPair(
        upper.surface(everywhere), lower.surface(everywhere), friction=0.2, edges=True
    )
    return nts.System([lower, upper], contacts=[pair])


@pytest.mark.mpi
def test_crossed_bars_bounce():
    """Without edges the upper bar falls through the lower one; no look finds them inside now."""
    system = bars(6, velocity=(0, 0, -2.0))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2.5e-4, t_end=0.03, accuracy="balanced")
    assert run.status == "completed" and not run.warnings.keys() & {"bodies inside each other"}
    assert nts.motion_of(system.bodies[1]).velocity[2] > 0.0


@pytest.mark.mpi
def test_crossed_bars_that_are_pressed_together_rest_in_balance():
    """What presses the ends of the upper one is what its edge bears."""
    ends = nts.Dirichlet(lambda x: np.abs(x[1] - 0.1) > 0.6 - 1e-6, lambda t: (0, 0, -0.03 * t))
    run = nts.equilibrium(bars(6, bcs=[ends]), load_steps=2)
    assert run.status == "completed"
    held = run.reactions["upper"][-1].sum(axis=0)
    borne = run.reactions["edges of contact 0, upper-lower"][-1, 0]
    assert borne[2] > 100.0
    assert held[2] == pytest.approx(-borne[2], rel=1e-6)


def slide(facets):
    """Spin of a block of 1 m that slides at 2 m/s over the rim of a table, as its end gets there.

    Its face is so many facets long, and one wide.
    """
    still = {"motion": lambda t: (0, 0, 0), "rotation": lambda t: (0, 0, 0)}
    table = nts.RigidBody(box((-3, -1, -1), (0, 1, 0), (3, 2, 1)), density=1e3, **still)
    block = nts.RigidBody(
        box((-0.9, -0.5, 0), (0.1, 0.5, 1), (facets, 1, 1)), density=1e3, velocity=(2, 0, 0),
        name="block",
    )  # fmt: skip
    faces = [b.surface(lambda x: np.abs(x[2]) < 1e-9) for b in (block, table)]
    pair = nts.ContactPair(*faces, edges=True)
    system = nts.System([table, block], contacts=[pair], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=0.45, accuracy="balanced")
    assert run.status == "completed"
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-9 * run.balance["energy"][0]
    return block.angular_velocity[1]


@pytest.mark.parametrize("facets", [1, 2, 4])
def test_a_block_tips_about_the_rim_however_it_is_meshed(facets):
    """By the closed form of small angles, m g x^2 / (2 v (I + m x^2)), I = m/6, at x = 1/2."""
    right = 9.81 * 0.25 / (4.0 * (1.0 / 6.0 + 0.25))
    assert slide(facets) == pytest.approx(right, rel=0.03)


@pytest.mark.parametrize("cell", [HEX, TET])
def test_a_cube_has_twelve_sharp_edges_divided_by_its_nodes(cell):
    body = turned(np.eye(3), np.zeros(3), "cube", cells=3, cell=cell)
    surface = body.surface(everywhere)
    edges = sharp_edges(surface, surface)
    ends = surface.reference[edges.ends]
    assert len(edges.ends) == 12 * 3
    on_faces = (np.abs(np.abs(ends) - 0.5) < 1e-12).sum(axis=2)
    assert (on_faces >= 2).all()
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    np.testing.assert_allclose(lengths, 1.0 / 3.0, rtol=1e-12)


def test_closest_points_of_edges_are_those_of_a_fine_search():
    """Distances between ends of sticks that a search over both in steps of a thousandth finds."""
    system = crossed(67.0, 0.0)
    pair = system.contacts[0]
    sides = [(s, sharp_edges(s, s), s.reference) for s in pair.surfaces]
    found = near(*sides, 0.1)
    assert found.inside.sum() == 1
    i = int(np.flatnonzero(found.inside)[0])
    a1, a2, b1, b2 = found.ends[i]
    part = np.linspace(0.0, 1.0, 1001)[:, None]
    one, two = a1 + part * (a2 - a1), b1 + part * (b2 - b1)
    distance = np.linalg.norm(one[:, None] - two[None], axis=2).min()
    assert found.gap[i] == pytest.approx(distance, abs=1e-5)
    assert found.gap[i] == pytest.approx(0.02, abs=1e-12)


def test_what_has_no_edges_is_refused():
    body = turned(np.eye(3), np.zeros(3), "cube")
    with pytest.raises(ValueError, match="edges=True: 'plane' has no edges; leave edges out"):
        nts.ContactPair(body.surface(everywhere), nts.Plane((0, 0, -1), (0, 0, 1)), edges=True)
    with pytest.raises(TypeError, match="edges"):
        nts.ContactPair(body.surface(everywhere), nts.Plane((0, 0, -1), (0, 0, 1)), edges="yes")
