"""Edges that cross between their nodes are kept apart (theory section 18)."""

from mpi4py import MPI

import numpy as np
import pytest
from cubes import HALF, ON_EDGE, about_z, turned
from dolfinx.mesh import CellType
from integrators import MID_STEP
from scenes import box, everywhere
from twins import edges as twin

import dolfinx_nts as nts
from dolfinx_nts.contact.edges import Pairs, sharp_edges, within

COMM = MPI.COMM_WORLD
HEX, TET = CellType.hexahedron, CellType.tetrahedron


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
    pair = nts.ContactPair(upper.surface(everywhere), lower.surface(everywhere), friction=friction)
    return nts.System([lower, upper], contacts=[pair])


@pytest.mark.mpi
@pytest.mark.parametrize(("angle", "friction", "kind"), [
    (90.0, 0.4, None), (67.0, 0.0, None), (67.0, 0.4, nts.RigidBody),
])  # fmt: skip
@pytest.mark.parametrize("rule", MID_STEP)
@pytest.mark.fast_on_ranks()
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
    assert not any(contact.force.any() for contact in run.state.contacts)
    assert nts.motion_of(run.system.bodies[0]).velocity[2] < -0.02
    assert table["friction_dissipation"][-1] >= 0.0


def bars(cells, **upper_options):
    """A bar of tetrahedra above another one across, whose ends are held, edge on edge."""
    side, length, long = 0.1, 1.2, (cells, 1, 1)
    soft = {"size": (length, side, side), "cells": long, "cell": TET, "young": 5e7}
    held = [nts.Dirichlet(lambda x: np.abs(x[0]) > 0.5 * length - 1e-6)]
    lower = turned(ON_EDGE, np.zeros(3), "lower", bcs=held, **soft)
    shift = np.array([0.5 * length / cells, 0.5 * length / cells, side / HALF + 0.005])
    upper = turned(about_z(90.0) @ ON_EDGE, shift, "upper", **upper_options, **soft)
    pair = nts.ContactPair(upper.surface(everywhere), lower.surface(everywhere), friction=0.2)
    return nts.System([lower, upper], contacts=[pair])


@pytest.mark.mpi
@pytest.mark.parametrize("cells", [6, 12, 24])
@pytest.mark.fast("6")
@pytest.mark.fast_on_ranks()
def test_crossed_bars_bounce(cells):
    """Without edges the upper bar falls through the lower one; no look finds them inside now."""
    system = bars(cells, velocity=(0, 0, -2.0))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2.5e-4, t_end=0.03, accuracy="balanced")
    assert run.status == "completed" and not run.warnings.keys() & {"bodies inside each other"}
    assert nts.motion_of(system.bodies[1]).velocity[2] > 0.0


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_crossed_bars_that_are_pressed_together_rest_in_balance():
    """What presses the ends of the upper one is what its edge bears."""
    ends = nts.Dirichlet(lambda x: np.abs(x[1] - 0.1) > 0.6 - 1e-6, lambda t: (0, 0, -0.03 * t))
    run = nts.equilibrium(bars(6, bcs=[ends]), load_steps=2)
    assert run.status == "completed"
    held = run.reactions["upper"][-1].sum(axis=0)
    borne = run.contact_forces[-1, 0]
    assert borne[2] > 100.0
    assert held[2] == pytest.approx(-borne[2], rel=1e-6)


def slide(facets, integration="nodes", front=0.1, cells=None, t_end=None):
    """Spin of a block of 1 m that slides at 2 m/s over the rim of a table, as its end gets there.

    Its face is so many facets long and wide, and its front so far beyond the rim at the start. A
    table of so many cells deforms.
    """
    mesh = box((-3, -1, -1), (0, 1, 0), cells or (3, 2, 1))
    if cells:
        held, stiff = nts.Dirichlet(lambda x: x[2] < -1 + 1e-9), nts.StVenantKirchhoff(1e9, 0.0)
        table = nts.Continuum(mesh, stiff, density=1e3, bcs=[held], name="table")
    else:
        still = {"motion": lambda t: (0, 0, 0), "rotation": lambda t: (0, 0, 0)}
        table = nts.RigidBody(mesh, density=1e3, **still)
    mesh = box((front - 1.0, -0.5, 0), (front, 0.5, 1), (*facets, 1))
    given = {"density": 1e3, "velocity": (2, 0, 0), "name": "block"}
    if integration == "nodes":
        block = nts.RigidBody(mesh, **given)
    else:
        # Of two rigid bodies none yields to a pressure.
        block = nts.Continuum(mesh, nts.StVenantKirchhoff(young=1e9, poisson=0.0), **given)
    faces = [b.surface(lambda x: np.abs(x[2]) < 1e-9) for b in (block, table)]
    pair = nts.ContactPair(*faces, integration=integration)
    system = nts.System([table, block], contacts=[pair], gravity=(0, 0, -9.81))
    t_end = t_end or 0.5 * (1.0 - front)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=t_end, accuracy="balanced")
    assert run.status == "completed"
    assert np.abs(run.balance["ledger_residual"]).max() < 1e-9 * run.balance["energy"][0]
    return nts.motion_of(block).spin[1]


#: By the closed form of small angles, m g x^2 / (2 v (I + m x^2)), I = m/6, at x = 1/2.
TIPS = 9.81 * 0.25 / (4.0 * (1.0 / 6.0 + 0.25))


@pytest.mark.parametrize("facets", [1, 2, 4, 6])
def test_a_block_tips_about_the_rim_however_it_is_meshed(facets):
    assert slide((facets, 1)) == pytest.approx(TIPS, rel=0.03)


@pytest.mark.parametrize(("facets", "front", "cells", "t_end"), [
    ((4, 1), 0.1, (3, 1, 1), 0.36), ((2, 1), 0.0, (12, 4, 3), 0.6),
])  # fmt: skip
@pytest.mark.slow
def test_a_block_leaves_a_stiff_table_as_it_leaves_a_rigid_one(facets, front, cells, t_end):
    """Planes beyond the rim threw it: in the first case a seventh too fast, in the second twice."""
    right = slide(facets, front=front, t_end=t_end)
    assert slide(facets, "nodes", front, cells, t_end) == pytest.approx(right, rel=0.03)


@pytest.mark.parametrize(("facets", "front"), [
    ((1, 1), 0.1), ((2, 1), 0.1), ((4, 1), 0.0), ((3, 3), 0.05),
])  # fmt: skip
@pytest.mark.fast("facets0-0.1", "facets1-0.1")
def test_a_surface_tips_about_the_rim_however_it_is_meshed(facets, front):
    """Also where rows of its nodes lie on the rim as steps begin (theory 17.6)."""
    assert slide(facets, "surface", front) == pytest.approx(TIPS, rel=0.03)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_run_goes_on_from_its_checkpoint_with_the_forces_of_edges(mpi_tmp_path):
    """To the bit in serial; on several ranks MUMPS rounds anew in every run."""
    path, rule = mpi_tmp_path / "edges.h5", nts.EnergyMomentum()
    file = nts.Checkpoint(path, every=6)
    options = {"dt": 2e-3, "accuracy": "exact"}
    whole = nts.simulate(crossed(67.0, 0.4), rule, t_end=0.04, **options)
    first = nts.simulate(crossed(67.0, 0.4), rule, t_end=0.012, checkpoint=file, **options)
    pressing = sum(COMM.allgather(len(first.state.edges[0].pair)))
    system = crossed(67.0, 0.4)
    rest = nts.simulate(system, rule, t_end=0.04, start=nts.restart(path, system), **options)
    assert pressing > 0
    same = {"rtol": 0.0, "atol": 0.0 if COMM.size == 1 else 1e-12}
    for a, b in zip(whole.state.u, rest.state.u, strict=True):
        np.testing.assert_allclose(a, b, **same)
    most = np.abs(whole.contact_forces).max()
    np.testing.assert_allclose(rest.contact_forces / most, whole.contact_forces / most, **same)


def cubes_with_aligned_rims(edges):
    """A cube hits another one of its size flat, spinning and sliding over its rim by 3 mm."""

    def velocity(x):
        return np.array([2.0 + 0.5 * (x[2] - 0.5), 0.0 * x[0], -0.5 * (x[0] - 0.5)])

    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    left = nts.Continuum(
        box((0, 0, 0), (1, 1, 1), 4, HEX, COMM), rubber, density=1e3, velocity=velocity, name="left"
    )
    right = nts.Continuum(
        box((1.004, 0, 0), (2.004, 1, 1), 5, HEX, COMM), rubber, density=1e3, name="right"
    )
    pair = nts.ContactPair(
        left.surface(lambda x: x[0] > 1 - 1e-9), right.surface(lambda x: x[0] < 1.004 + 1e-9),
        edges=edges,
    )  # fmt: skip
    return nts.System([left, right], contacts=[pair])


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_flat_faces_whose_rims_meet_give_what_they_give_without_edges():
    """The lower row of nodes slides over the rim, which crosses the edges beside these nodes."""
    runs = [
        nts.simulate(
            cubes_with_aligned_rims(edges), nts.EnergyMomentum(), dt=1e-3, t_end=0.012,
            accuracy="exact",
        )
        for edges in (True, False)
    ]  # fmt: skip
    forces = [run.contact_forces for run in runs]
    assert np.abs(forces[0]).max() > 1e3
    np.testing.assert_allclose(*forces, rtol=0.0, atol=1e-9 * np.abs(forces[0]).max())


def test_edges_may_be_left_out():
    body = turned(np.eye(3), np.zeros(3), "cube")
    plane = nts.Plane((0, 0, -1), (0, 0, 1))
    with pytest.raises(TypeError, match="edges"):
        nts.ContactPair(body.surface(everywhere), plane, edges="yes")
    assert not nts.ContactPair(body.surface(everywhere), plane).has_edges


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
    edges = tuple(sharp_edges(s, s) for s in pair.surfaces)
    places = tuple(s.reference for s in pair.surfaces)
    pairs = within(edges, places, 0.1)
    still = tuple(np.zeros_like(x) for x in places)
    found = Pairs(edges, pairs).closest(places, still, 0.1)
    assert found.meet[:, 0].sum() == 1
    i = int(np.flatnonzero(found.meet[:, 0])[0])
    both = zip(places, edges, pairs[i], strict=True)
    (a1, a2), (b1, b2) = (x[e.ends[k]] for x, e, k in both)
    part = np.linspace(0.0, 1.0, 1001)[:, None]
    one, two = a1 + part * (a2 - a1), b1 + part * (b2 - b1)
    distance = np.linalg.norm(one[:, None] - two[None], axis=2).min()
    assert found.gap[i, 0] == pytest.approx(distance, abs=1e-5)
    assert found.gap[i, 0] == pytest.approx(0.02, abs=1e-12)


def test_the_kernel_finds_what_its_twin_does():
    """Edges of two cubes in random places, half of them turned to lie flat on each other."""
    random, met, through = np.random.default_rng(3), 0, 0
    pair = crossed(67.0, 0.0).contacts[0]
    edges = tuple(sharp_edges(s, s) for s in pair.surfaces)
    pairs = np.stack(np.meshgrid(*(np.arange(len(e.ends)) for e in edges)), axis=2).reshape(-1, 2)
    middle = [s.reference - s.reference.mean(axis=0) for s in pair.surfaces]
    for k in range(40):
        turn = about_z(random.uniform(0, 180))
        if k % 2:
            above = random.uniform(-1, 1, 3)
            turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
            turn[0] *= np.linalg.det(turn)
        above = random.uniform((-0.2, -0.2, 1.4), (0.2, 0.2, 1.6))
        x = middle[0] @ turn.T + above, middle[1]
        ways = tuple(random.uniform(-0.3, 0.3, 3) * np.ones_like(p) for p in x)
        found = Pairs(edges, pairs).closest(x, ways, np.inf)
        for n, part in ((0, 0.0), (1, 1.0)):
            places = tuple(p + part * way for p, way in zip(x, ways, strict=True))
            gap, meet, turned, *nodes = twin.closest(edges, places, pairs)
            assert np.array_equal(found.meet[:, n], meet)
            assert n or np.array_equal(found.turned[meet], turned[meet])
            for one, two in zip((found.node, found.beyond), nodes, strict=True):
                assert not n or np.array_equal(one[meet], two[meet])
            np.testing.assert_allclose(found.gap[meet, n], gap[meet], atol=1e-12)
            met += meet.sum()
        for i in np.flatnonzero((found.gap[:, 0] > 0.0) & (found.gap[:, 1] < 0.0)):
            part = found.gap[i, 0] / (found.gap[i, 0] - found.gap[i, 1])
            places = tuple(p + part * way for p, way in zip(x, ways, strict=True))
            meet = twin.closest(edges, places, pairs[i : i + 1])[1][0]
            assert meet == found.meet[i, 2]
            through += found.meet[i, 2]
        assert not found.meet[~((found.gap[:, 0] > 0.0) & (found.gap[:, 1] < 0.0)), 2].any()
    assert met > 40 and through > 3
