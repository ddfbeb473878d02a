"""Nodes in an inner edge of a master, where one contact holds them out of one face alone."""

import numpy as np
import pytest
from rotations import random_rotation
from scenes import RUBBER, at, box, everywhere

import dolfinx_nts as nts
from dolfinx_nts.contact.inner_edge import InnerEdges

#: A floor up to x = 1 and a wall from there up, seen from inside, with their common edge.
NODES = np.array(
    [[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0], [1, 0, 2], [1, 2, 2]]
    # The outer side of a wall of 1 cm.
    + [[1.01, 0, 0], [1.01, 2, 0], [1.01, 0, 2], [1.01, 2, 2]], dtype=float
)
FACETS = np.array([[0, 1, 2, 3], [1, 4, 5, 2]])
#: Off the edge on the floor, in the edge behind the wall, and far beyond it.
POINTS = np.array([[0.5, 1, 0], [1.01, 1, 0], [6, 1, 0]], dtype=float)


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e6])
@pytest.mark.parametrize("triangles", [False, True])
def test_depth_behind_the_other_face(unit, triangles):
    turn = unit * random_rotation(np.random.default_rng(5))
    facets = np.concatenate([FACETS[:, [0, 1, 2]], FACETS[:, [0, 2, 3]]]) if triangles else FACETS
    y = NODES @ turn.T
    points = POINTS @ turn.T
    found = InnerEdges(facets, y).behind(points, np.ones(3), y)
    assert found.node == 1 and set(facets[found.facet]) >= {1, 5}
    assert found.depth == pytest.approx(0.01 * unit, rel=1e-9)


@pytest.mark.parametrize(
    "facets, points, force",
    [
        pytest.param(FACETS, POINTS, [1.0, 0.0, 0.0], id="what is behind carries nothing"),
        pytest.param(FACETS, POINTS - [0.01, 0, 0], np.ones(3), id="touches both"),
        pytest.param(FACETS[:, ::-1], POINTS, np.ones(3), id="outer edge"),
        pytest.param(FACETS[:1], POINTS, np.ones(3), id="one face"),
        pytest.param(
            np.concatenate([FACETS, [[6, 7, 9, 8]]]), POINTS, np.ones(3), id="beyond a thin wall"
        ),
    ],
)
def test_nothing_is_told(facets, points, force):
    assert InnerEdges(facets, NODES).behind(points, np.array(force), NODES) is None


def test_a_bore_of_many_facets_has_no_inner_edges():
    """Sixteen facets around, of 22.5 degrees each; eight are told apart."""
    for n, count in ((16, 0), (7, 7)):
        angle = 2 * np.pi * np.arange(n) / n
        ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
        y, k = np.concatenate([ring, ring + [0, 0, 1]]), np.arange(n)
        facets = np.stack([k, k + n, (k + 1) % n + n, (k + 1) % n], axis=1)
        assert len(InnerEdges(facets, y)) == count


def room():
    """Floor and wall as one body of two cells, the inner side from z = 1 of a box."""
    mesh = box([0, 0, 0], [2, 1, 1], [2, 1, 1])
    places = {(0, 0): (-1, -0.3), (0, 1): (-1, 0), (1, 0): (1.3, -0.3)}
    places |= {(1, 1): (1, 0), (2, 0): (1.3, 1), (2, 1): (1, 1)}
    x = mesh.geometry.x
    x[:, ::2] = [places[int(round(a)), int(round(b))] for a, b in x[:, ::2]]
    return nts.RigidBody(
        mesh, density=1e3, motion=(0, 0, 0), rotation=(0, 0, 0), name="room"
    )  # fmt: skip


def pressed(masters):
    """Equilibrium of a rubber cube that its weight presses into the edge, and its energy [J]."""
    cube = nts.Continuum(
        box([0.5, 0.2, 0], [1, 0.7, 0.5]), RUBBER, density=1e3, name="cube",
        bcs=[nts.Dirichlet(at(1, 0.2), components=(1,))],
    )  # fmt: skip
    body, surfaces = masters()
    pairs = [nts.ContactPair(cube.surface(everywhere), s) for s in surfaces]
    system = nts.System([cube, *body], contacts=pairs, gravity=(5, 0, -9.81))
    run = nts.equilibrium(system, load_steps=2)
    return run, run.balance["potential"][-1]


@pytest.mark.mpi
def test_a_cube_in_the_edge_of_a_room():
    """With a contact for each face as between two planes; with one for both it is told."""

    def whole():
        body = room()
        floor, wall = at(2, 0.0), at(0, 1.0)
        return [body], [body.surface(lambda x: (floor(x) & (x[0] < 1.1)) | (wall(x)))]

    def each():
        body = room()
        return [body], [body.surface(at(2, 0.0)), body.surface(at(0, 1.0))]

    def planes():
        return [], [nts.Plane((0, 0, 0), (0, 0, 1)), nts.Plane((1, 0, 0), (-1, 0, 0), name="wall")]

    run, right = pressed(planes)
    assert run.status == "completed"
    run, energy = pressed(each)
    assert energy == pytest.approx(right, rel=1e-9)
    assert run.status == "completed"
    run, energy = pressed(whole)
    assert energy > 1.02 * right
    told = run.warnings["node in an inner edge"]
    assert told.grave and told.about == ("cube", "room")
    assert "declare a contact for each of the faces of 'room' that meet there" in run.status
