"""Bodies inside each other: depths against brute force, edges that cross, scenes that are right."""

import copy
import itertools
import logging

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx.mesh import CellType, GhostMode, create_box
from integrators import MID_STEP
from measures import kinds
from rotations import random_rotation
from scenes import box as solid
from scipy import ndimage

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.contact import crossings, intrusion, obstacle_crossings, overlap
from dolfinx_nts.kernels import compiled
from dolfinx_nts.start.taken_over import state_from

COMM = MPI.COMM_WORLD
CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))
#: Cyclic facets of a cube of 8 corners as in `CORNERS`, seen from outside.
CUBE = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)


def well_joined(filled):
    """Whether cells, and the space between them, are joined by facets around every corner."""
    padded = np.pad(filled, 1)
    for window in np.lib.stride_tricks.sliding_window_view(padded, (2, 2, 2)).reshape(-1, 2, 2, 2):
        if ndimage.label(window)[1] > 1 or ndimage.label(~window)[1] > 1:
            return False
    return True


class Heap:
    """A rotated heap of cubic cells, of which any side tells what is inside; h is their size."""

    def __init__(self, rng, n, nc, h, centre):
        while True:
            self.filled = rng.random((n, n, n)) < 0.6
            if self.filled.any() and well_joined(self.filled):
                break
        self.n, self.h, self.turn, self.centre = n, h, random_rotation(rng), centre
        quads = (np.argwhere(self.filled)[:, None] + CORNERS)[:, CUBE].reshape(-1, 4, 3)
        number = quads @ [(n + 1) ** 2, n + 1, 1]
        _, inverse, count = np.unique(
            np.sort(number, axis=1), axis=0, return_inverse=True, return_counts=True
        )
        outer = count[inverse.ravel()] == 1
        self.squares, facets = quads[outer], number[outer]
        if nc == 3:
            facets = np.concatenate([facets[:, [0, 1, 2]], facets[:, [0, 2, 3]]])
        used, inverse = np.unique(facets, return_inverse=True)
        grid = np.array(list(itertools.product(range(n + 1), repeat=3)))[used]
        self.x = self.place(grid)
        self.boundary = intrusion.Boundary(inverse.reshape(facets.shape))
        self.placed = intrusion.Placed(self.boundary, self.x)
        # Of a square, or of the triangle that is half of it.
        self.size = h if nc == 4 else h * (2 + np.sqrt(2)) / 3

    def place(self, grid):
        """Points [m] from coordinates in cells."""
        return (self.h * (grid - self.n / 2)) @ self.turn.T + self.centre

    def depth(self, points):
        """Distance from the nearest square, negative outside all cells."""
        x = (points - self.centre) @ self.turn / self.h + self.n / 2
        low, high = self.squares.min(axis=1), self.squares.max(axis=1)
        distance = np.full(len(x), np.inf)
        for one, two in zip(low, high, strict=True):
            distance = np.minimum(distance, np.linalg.norm(x - x.clip(one, two), axis=1))
        cell = np.floor(x).astype(int)
        within = ((cell >= 0) & (cell < self.n)).all(axis=1)
        inside = np.zeros(len(x), dtype=bool)
        inside[within] = self.filled[tuple(cell[within].T)]
        return self.h * np.where(inside, distance, -distance)

    def normal_below(self, point):
        """Normal of the square nearest to a point."""
        x = (point - self.centre) @ self.turn / self.h + self.n / 2
        low, high = self.squares.min(axis=1), self.squares.max(axis=1)
        s = self.squares[np.linalg.norm(x - x.clip(low, high), axis=1).argmin()]
        return np.cross(s[1] - s[0], s[2] - s[1])


def heaps(seed, nc):
    rng = np.random.default_rng(seed)
    return Heap(rng, 2, nc, 0.5, np.zeros(3)), Heap(rng, 3, nc, 0.25, 0.3 * rng.normal(size=3))


@pytest.mark.parametrize("nc", [3, 4])
@pytest.mark.parametrize("seed", range(3))
def test_depth_of_points_is_that_of_a_heap_of_cells(seed, nc):
    rng = np.random.default_rng(seed + 100)
    for heap in heaps(seed, nc):
        grid = rng.uniform(-0.5, heap.n + 0.5, size=(400, 3))
        points = heap.place(grid)
        found = heap.placed.depth(points, np.inf)
        assert np.abs(found.value - heap.depth(points)).max() < 1e-13
        near, seen = heap.placed.depth(points, 0.1), np.abs(found.value) <= 0.1
        assert np.array_equal(near.value[seen], found.value[seen])
        assert (near.value[~seen] == -np.inf).all()


def test_points_in_the_plane_of_a_facet_beside_it_are_outside():
    """Rounding tells the side of that facet; the sum of the normals on its edge does not ask it."""
    rng = np.random.default_rng(7)
    for nc in (3, 4):
        cube = Heap(rng, 1, nc, 1.0, rng.normal(size=3))
        grid = rng.uniform(1.1, 1.5, size=(300, 3))
        grid[np.arange(300), rng.integers(3, size=300)] = rng.integers(2, size=300)
        assert (cube.placed.depth(cube.place(grid), np.inf).value < -0.09).all()


@pytest.mark.parametrize("nc", [3, 4])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.fast("0-3", "1-4")
def test_nodes_and_edges_inside_are_those_of_brute_force(seed, nc):
    """Edges are sampled densely; those within a hundredth of the least depth may be told or not."""
    heap = heaps(seed, nc)
    least, found_any = 0.1, 0
    # A facet counts up to six times the other body's volume by its area.
    bulk = [6.0 * h.h * h.filled.sum() / len(h.squares) for h in heap]
    scale = max(min(h.size, w) for h, w in zip(heap, bulk[::-1], strict=True))
    for a, b in (heap, heap[::-1]):
        found = intrusion.intrusions(a.placed, b.placed, least)
        assert np.abs(found.depth - b.depth(found.place)).max(initial=0.0) < 1e-13
        size = found.depth / scale
        assert np.allclose(found.size, np.where(found.middle, np.maximum(size, 0.5), size))
        node = found.select(found.is_node)
        deep = b.depth(a.x)
        assert sorted(node.nodes[:, 0]) == np.flatnonzero(deep > least * scale).tolist()
        edges = a.boundary.edges[(deep[a.boundary.edges] <= least * scale).all(axis=1)]
        t = np.linspace(0, 1, 401)[:, None]
        most = np.array([b.depth((1 - t) * a.x[i] + t * a.x[j]).max() for i, j in edges])
        told = {tuple(e): d for e, d in zip(*found.select(~found.is_node)[:3:2], strict=True)}
        for edge, depth in zip(map(tuple, edges), most, strict=True):
            if abs(depth / (least * scale) - 1) > 0.02:
                assert (edge in told) == (depth > least * scale)
            if edge in told:
                assert abs(told.pop(edge) / depth - 1) < 0.02
        # What is left passes the middle of a part as thick as two sides of it are apart.
        passing = {tuple(e) for e in found.nodes[found.middle]}
        for edge in told:
            one, two = (b.normal_below(a.x[i]) for i in edge)
            assert edge in passing and np.allclose(one, -two)
        found_any += len(found.depth)
    assert found_any > 0


def box(low, high, cells):
    """Boundary facets and points of a box."""
    n = np.array(cells)
    grid = np.array(list(itertools.product(*(range(k) for k in n))))
    step = [(n[1] + 1) * (n[2] + 1), n[2] + 1, 1]
    facets = ((grid[:, None] + CORNERS) @ step)[:, CUBE].reshape(-1, 4)
    key = np.sort(facets, axis=1)
    _, inverse, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    points = np.array(list(itertools.product(*(range(k + 1) for k in n)))) / n
    used, number = np.unique(facets[count[inverse.ravel()] == 1], return_inverse=True)
    x = np.array(low) + points[used] * np.subtract(high, low)
    return intrusion.Placed(intrusion.Boundary(number.reshape(-1, 4)), x)


def count(a, b):
    return len(intrusion.intrusions(a, b).depth)


def test_a_plate_too_thin_to_be_deep_in_it():
    """A plate of 1 cm with facets of 0.25 m: a post through it, one on it, posts beside it."""
    plate = box((-1, -1, -0.005), (1, 1, 0.005), (8, 8, 1))
    found = intrusion.intrusions(box((-0.1, -0.1, -0.3), (0.11, 0.12, 0.6), (1, 1, 1)), plate)
    assert len(found.depth) == 4 and not found.is_node.any()
    assert np.allclose(found.depth, 0.005, rtol=0.02)
    assert count(box((-0.1, -0.1, 0.0049), (0.1, 0.1, 0.6), (1, 1, 1)), plate) == 0
    for beside in (1.0, 1.0 - 1e-4):
        assert count(box((beside, -0.1, -0.3), (beside + 0.2, 0.1, 0.3), (1, 1, 1)), plate) == 0


@pytest.mark.parametrize("at", [(0.13, 0.14), (0.0, 0.0), (0.25, 0.13)])
@pytest.mark.parametrize("cells", [1, 8])
def test_a_post_that_ends_in_a_plate_is_told_from_its_middle_on(at, cells):
    """Also on corners and edges of the plate's facets; up to the middle it may be contact's."""
    plate = box((-1, -1, -0.01), (1, 1, 0.01), (8, 8, 1))
    for bottom, told in ((0.002, False), (-0.002, True), (-0.015, True)):
        post = box((*at, bottom), (*np.add(at, 0.2), 0.6), (1, 1, cells))
        found = intrusion.intrusions(post, plate)
        assert bool(len(found.depth)) == told
        if told:
            edges = len({tuple(n) for n in found.nodes})
            assert found.middle.all() and edges >= 4
            assert np.allclose(found.depth, 0.01, rtol=0.021) and np.allclose(found.size, 0.5)


@pytest.mark.parametrize(("above", "lean"), [(0.3, 0.0), (0.021, 0.0), (0.021, 0.2)])
def test_what_comes_a_little_into_the_narrow_side_of_a_plate_is_not_past_its_middle(above, lean):
    """Also where it is hardly longer than the plate is thick, as the tooth of a soft gear.

    Where it leans, its deepest point is as near to the upper side as to the narrow one.
    """
    plate = box((-1, -1, -0.02), (1, 1, 0.02), (8, 8, 1))
    for depth, told in ((0.004, False), (0.008, False), (0.015, False), (0.045, True)):
        post = box((1 - depth, -0.1, -above), (1.2, 0.13, above), (1, 1, 1))
        leaning = post.x - lean * post.x[:, 2:] * [1, 0, 0]
        assert bool(count(intrusion.Placed(post.boundary, leaning), plate)) == told


def test_a_facet_counts_up_to_the_width_of_a_body_in_it():
    """In a block with facets of 1 a pin 0.02 wide and a bead of 0.1 are told."""
    block = box((0, 0, -2), (2, 2, 0), (2, 2, 2))
    for cells in (1, 20):
        pin = box((0.3, 0.4, -0.15), (0.32, 0.42, 0.25), (1, 1, cells))
        found = intrusion.intrusions(pin, block)
        assert np.isclose(found.depth.max(), 0.15)
        # Of a square section any width up to the diagonal may count; or the pin's own facets, up
        # to six times its volume by its area.
        own = min((0.02 + 0.4 / cells) / 2, 6 * 0.02**2 * 0.4 / (2 * 0.02**2 + 4 * 0.02 * 0.4))
        counted = 0.15 / found.size.max()
        assert max(0.02, own) - 1e-12 <= counted <= max(0.02 * np.sqrt(2), own) + 1e-12
    bead = box((0.3, 0.4, -0.11), (0.4, 0.5, -0.01), (1, 1, 1))
    found = intrusion.intrusions(bead, block)
    assert np.isclose(found.depth.max(), 0.11)
    assert 1.1 / np.sqrt(3) - 1e-12 <= found.size.max() <= 1.1 + 1e-12


def test_a_body_wholly_inside_is_found():
    big, small = box((0, 0, 0), (1, 1, 1), (2, 2, 2)), box((0.4,) * 3, (0.55,) * 3, (1, 1, 1))
    found = intrusion.intrusions(small, big)
    assert len(found.depth) == 8 and np.isclose(found.depth.max(), 0.45)
    assert count(big, small) == 0


@pytest.mark.parametrize("metre", [1.0, 1e-6])
@pytest.mark.parametrize("distance", [-0.5, -1e-3, 0.0, 1e-3])
def test_touching_faces_are_no_overlap(metre, distance):
    """Nodes of both halfway between each other's, up to rounding or a little inside."""
    turn, shift = random_rotation(np.random.default_rng(3)), np.array([5.0, -3.0, 2.0])

    def placed(*arguments):
        body = box(*arguments)
        return intrusion.Placed(body.boundary, metre * (body.x @ turn.T + shift))

    lower = placed((0, 0, 0), (1, 1, 1), (4, 4, 4))
    upper = placed((0.1, 0.1, 1 + distance / 4), (0.9, 0.9, 1.8), (3, 3, 3))
    found = count(lower, upper), count(upper, lower)
    assert (min(found) > 0) if distance == -0.5 else found == (0, 0)


ROOT = np.sqrt(0.5)


def cube(axis, lift, cells, comm=COMM):
    """Mesh of a unit cube that stands on an edge along the axis (0, 1), and its centre's height."""
    mesh = create_box(
        comm, [[-0.5] * 3, [0.5] * 3], [cells] * 3,
        cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    turn = np.array([[[1, 0, 0], [0, ROOT, -ROOT], [0, ROOT, ROOT]],
                     [[ROOT, 0, ROOT], [0, 1, 0], [-ROOT, 0, ROOT]]])[axis]  # fmt: skip
    mesh.geometry.x[:] = mesh.geometry.x @ turn.T + [0, 0, lift]
    return mesh


def edge_on_edge(cells=3, gap=0.01, speed=2.0, contact=True, bcs=((), ()), facing=True):
    """Two cubes that meet edge on edge, the upper one's along y, the lower one's along x.

    Where the surfaces face away from each other these edges are none of theirs.
    """
    sign = 1.0 if facing else -1.0
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    upper = nts.Continuum(
        cube(1, ROOT + gap, cells), rubber,
        density=1e3, velocity=(0, 0, -speed), bcs=bcs[0], name="upper",
    )  # fmt: skip
    lower = nts.Continuum(cube(0, -ROOT, cells), rubber, density=1e3, bcs=bcs[1], name="lower")

    def of_upper(x):
        return (x[2] - gap - ROOT) * sign, np.abs(x[0]) - ROOT

    def of_lower(x):
        return (-x[2] - ROOT) * sign, np.abs(x[1]) - ROOT

    pair = nts.ContactPair(
        slave=upper.surface(lambda x: np.isclose(*of_upper(x))),
        master=lower.surface(lambda x: np.isclose(*of_lower(x))),
    )
    return nts.System([upper, lower], contacts=[pair] if contact else [])


def moved(system, *translations):
    """Displacements of the bodies by translations."""
    return [
        np.tile(np.array(t, dtype=float), b.num_owned // 3)
        for b, t in zip(system.bodies, translations, strict=True)
    ]


@pytest.mark.mpi
def test_edges_that_cross_are_told_with_place_and_depth():
    system = edge_on_edge()
    crossing, aside = 0.15, np.array([0.02, -0.03, 0.0])
    down = np.array([0.0, 0.0, -0.01 - crossing])
    (found,) = overlap.OverlapWatch(system).look(moved(system, aside + down, (0, 0, 0)))
    assert found.kind == "edge through a body"
    # The deepest point of an edge lies under the other edge, whose flanks stand at 45 degrees.
    assert abs(found.depth - crossing * ROOT) < 0.01 * crossing
    assert abs(found.size - 3 * found.depth) < 1e-9
    over = [0.02, 0.0, -crossing] if found.bodies == ("upper", "lower") else [0.02, 0.0, 0.0]
    assert np.abs(found.place - over).max() < 0.02 * crossing
    body = next(b for b in system.bodies if b.name == found.bodies[0])
    number = np.asarray(body.mesh.geometry.input_global_indices)
    x = body.mesh.geometry.x[np.isin(number, found.nodes)]
    ends = np.unique(np.concatenate(COMM.allgather(x)).round(9), axis=0)
    along = 1 if body.name == "upper" else 0
    assert np.allclose(ends[:, along], [-1 / 6, 1 / 6]) and len(found.nodes) == 2
    assert all(text in found.text for text in ("'upper'", "'lower'", "finer mesh of the slave"))


@pytest.mark.mpi
def test_a_look_tells_of_each_pair():
    """Blocks that reach 0.3 m and 0.25 m into the two sides of a larger one."""

    def block(name, low, high, n):
        mesh = create_box(COMM, [low, high], n, CellType.hexahedron)
        return nts.Continuum(mesh, lambda c: 1e6 * ufl.tr(c), density=1e3, name=name)

    left = block("left", [-2, 0, 0], [-1, 1, 1], (1, 1, 1))
    right = block("right", [2, 0, 0], [3, 1, 1], (1, 1, 1))
    middle = block("middle", [0, -0.5, -0.5], [1, 1.5, 1.5], (4, 8, 8))
    pairs = [nts.ContactPair(slave=b.boundary(), master=middle.boundary()) for b in (left, right)]
    system = nts.System([left, middle, right], contacts=pairs)
    there = moved(system, (1.3, 0, 0), (0, 0, 0), (-1.25, 0, 0))
    found = overlap.OverlapWatch(system).look(there)
    depths = {f.about: f.depth for f in found if f.kind == "node inside a body"}
    assert depths == {
        ("left", "middle"): pytest.approx(0.3, rel=1e-12),
        ("middle", "right"): pytest.approx(0.25, rel=1e-12),
    }


def fly(t_end=0.06, scene=None, integrator=MID_STEP["energy-momentum"], **options):
    """Free flight until then: nothing declared has touched, and the edges cross by 0.11 m."""
    scene = scene or edge_on_edge(facing=False)
    return nts.simulate(scene, integrator, dt=5e-3, t_end=t_end, **options)


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
def test_a_run_in_which_edges_cross_says_so(integrator, caplog):
    caplog.set_level(logging.CRITICAL)
    run = fly(integrator=integrator)
    assert run.balance["active"].max() == 0
    assert run.status.startswith("completed, but the edge between nodes")
    (kind,) = kinds(run)
    assert kind == "edge through a body" and run.warnings[kind].grave
    assert abs(run.warnings[kind].worst - 0.11 * ROOT) < 0.0011


def test_adapted_steps_are_watched_and_the_watch_can_be_switched_off(caplog):
    caplog.set_level(logging.CRITICAL)
    run = fly(adapt=nts.Adapt())
    assert abs(run.warnings["edge through a body"].worst - 0.11 * ROOT) < 0.0011
    assert fly(watch_overlap=False).status == "completed"
    with pytest.raises(TypeError, match="^watch_overlap=1: pass True or False"):
        fly(watch_overlap=1)


def test_bodies_without_a_contact_may_pass(caplog):
    assert fly(scene=edge_on_edge(contact=False)).status == "completed"


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_load_steps_are_watched(caplog):
    caplog.set_level(logging.CRITICAL)
    down = nts.Dirichlet(lambda x: x[0] < 9, value=lambda t: (0.0, 0.0, -0.12 * t))
    stay = nts.Dirichlet(lambda x: x[0] < 9)
    run = nts.equilibrium(edge_on_edge(speed=0.0, bcs=([down], [stay])), load_steps=3)
    assert run.status.startswith("completed, but the edge between nodes")
    assert abs(run.warnings["edge through a body"].worst - 0.11 * ROOT) < 0.0011


def blocks(above, *, slave=None, master=None, offset=(0.0, 0.0, 0.0)):
    """Two cubes with a surface each; of the upper one the nodes are held out of the lower one."""
    rubber, meshes = nts.NeoHookean(young=1e6, poisson=0.3), []
    for n, corner in ((2, np.add([0.2, 0.2, 1 + above], offset)), (3, np.zeros(3))):
        ends = [corner, corner + (0.6 if n == 2 else 1.0)]
        kind = dict(cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet)
        meshes.append(create_box(COMM, ends, [n] * 3, **kind))
    upper, lower = (
        nts.Continuum(m, rubber, density=1e3, name=name)
        for m, name in zip(meshes, ("upper", "lower"), strict=True)
    )
    pair = nts.ContactPair(
        slave=upper.surface(slave or (lambda x: x[2] < 1 + above + 1e-9)),
        master=lower.surface(master or (lambda x: x[2] > 1 - 1e-9)),
    )
    return nts.System([upper, lower], contacts=[pair])


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("slave", "master", "remedy"),
    [
        (None, None, "did not hold it: use a smaller dt"),
        (None, lambda x: x[0] < 1e-9, "extend the markers of the contact's surfaces to both"),
        (lambda x: x[2] > 1.6, None, "extend the markers of the contact's surfaces to both"),
    ],
)
def test_a_node_inside_is_told_with_what_to_do(slave, master, remedy):
    system = blocks(0.1, slave=slave, master=master)
    found = overlap.OverlapWatch(system).look(moved(system, (0, 0, -0.25), (0, 0, 0)))
    (node,) = [f for f in found if f.kind == "node inside a body"]
    assert abs(node.depth - 0.15) < 1e-12 and abs(node.place[2] - 0.85) < 1e-12
    assert node.bodies == ("upper", "lower") and len(node.nodes) == 1
    assert abs(node.size - 0.15 / (1 / 3)) < 1e-12
    assert remedy in node.text


@pytest.mark.mpi
def test_bodies_that_pass_or_touch_are_not_warned_of():
    """Past each other at a distance of 1e-3 facets and flush, beside each other on edge."""
    for aside in (0.0, 3e-4):
        system = blocks(0.1, offset=(0.0, 0.0, aside - 0.1))
        watch = overlap.OverlapWatch(system)
        for x in np.linspace(-1.5, 1.5, 13):
            assert watch.look(moved(system, (x, 0.1 * x, 0), (0, 0, 0))) == []
    system = edge_on_edge()
    watch = overlap.OverlapWatch(system)
    beside = moved(system, (0.0, 2 * ROOT + 0.01, -0.6), (0.0, 0.0, 0.0))
    assert watch.look(beside) == []


@pytest.mark.mpi
def test_looks_are_as_rare_as_the_motion_allows(monkeypatch):
    """Not while nothing moves relatively or boxes are apart; else 4 a facet (of 1/3 m)."""
    system, looks = blocks(0.1), []
    true = intrusion.intrusions
    monkeypatch.setattr(crossings, "intrusions", lambda *a: looks.append(len(looks)) or true(*a))
    watch = overlap.OverlapWatch(system)

    def look(x, z, **options):
        watch.look(moved(system, (x, 0, z), (30, 0, 0)), **options)
        done = len(looks)
        looks.clear()
        return done

    for x in np.linspace(0.0, 30.0, 31):
        watch.look(moved(system, (x, 0, 0.5), (x, 0, 0)))
    assert not looks
    assert look(30.0, -0.2) == 2  # at the nodes and edges of each
    assert sum(look(30 + x, -0.2) for x in np.linspace(0.0, 0.3, 31)) == 6
    assert [look(30 + x, -0.2) for x in (0.3, 0.36, 0.36, 0.4, 0.45, 0.55)] == [0, 2, 0, 0, 2, 2]
    assert [look(30.56, -0.2, last=True) for _ in range(2)] == [2, 0]


def shot(thick):
    """A block of 0.2 above a facet of 0.5 of a plate, whose nodes alone are held out of it."""
    rubber, bodies = nts.NeoHookean(young=1e6, poisson=0.3), []
    for low, high, cells, name in (
        ([0.15, 0.15, 0.05], [0.35, 0.35, 0.25], [2, 2, 2], "block"),
        ([0, 0, -thick], [1, 1, 0], [2, 2, 1], "plate"),
    ):
        kind = dict(cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet)
        mesh = create_box(COMM, [np.array(low, float), np.array(high, float)], cells, **kind)
        down = (0, 0, -3.0 if name == "block" else 0.0)
        bodies.append(nts.Continuum(mesh, rubber, density=1e3, velocity=down, name=name))
    block, plate = bodies
    pair = nts.ContactPair(
        slave=plate.surface(lambda x: x[2] > -1e-9), master=block.surface(lambda x: x[2] < 0.05001),
        edges=False,
    )  # fmt: skip
    return nts.System(bodies, contacts=[pair])


@pytest.mark.mpi
@pytest.mark.parametrize("thick", [0.01, 0.04, 0.1, 0.3])
@pytest.mark.parametrize("step", [0.003, 0.03, 0.3, 3.0])
@pytest.mark.fast("0.003-0.04", "0.03-0.3", "0.3-0.01", "3.0-0.1")
def test_a_block_that_passes_a_thin_plate_between_its_nodes_is_told(thick, step):
    """However long the steps are: also of all of the way in one."""
    system, found = shot(thick), []
    watch = overlap.OverlapWatch(system)
    for z in np.arange(0.0, max(1.0, 1.5 * step), step):
        found += watch.look(moved(system, (0, 0, -z), (0, 0, 0)))
    assert {f.bodies for f in found} == {("block", "plate")}
    # To the next side of the plate, at most half of its thickness.
    assert max(f.depth for f in found) <= 0.5 * thick + 1e-12
    assert max(f.size for f in found) >= 0.2
    assert all(-thick <= f.place[2] <= 0.0 for f in found)


@pytest.mark.mpi
@pytest.mark.parametrize("step", [0.03, 0.3, 3.0])
def test_a_block_that_passes_beside_a_thin_plate_is_not_warned_of(step):
    system = shot(0.01)
    watch = overlap.OverlapWatch(system)
    for z in np.arange(0.0, max(1.0, 1.5 * step), step):
        assert watch.look(moved(system, (0.851, 0, -z), (0, 0, 0))) == []


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_run_in_which_a_block_passes_a_thin_plate_says_so(caplog):
    caplog.set_level(logging.CRITICAL)
    run = nts.simulate(shot(0.01), nts.EnergyMomentum(), dt=1e-3, t_end=0.12)
    assert run.balance["active"].max() == 0
    assert run.status.startswith("completed, but the edge between nodes")
    assert abs(run.warnings["edge through a body"].worst - 0.005) < 1e-4


@pytest.mark.parametrize("part", [0.2, 0.4, 1.0])
def test_a_thin_plate_bent_over_an_edge_is_not_warned_of(part):
    """The edge of a block is between the plate's nodes, four hundredths of a facet inside."""
    plate = box((-1, -1, 0), (1, 1, 0.25 * part), (8, 8, 1))
    x = plate.x + [0.125, 0.0, 0.0]
    x[:, 2] -= 0.08 * np.abs(x[:, 0])
    bent, flank = intrusion.Placed(plate.boundary, x), 0.08 * 0.125
    roof = box((-1, -2, -1), (1, 2, 0), (2, 8, 2))
    y = roof.x.copy()
    y[:, 2] -= 0.08 * np.abs(y[:, 0]) * (y[:, 2] == 0)
    block = intrusion.Placed(roof.boundary, y)
    assert flank == 0.04 * 0.25
    assert count(bent, block) == count(block, bent) == 0


def two_in_one(low):
    """One body of two cubes, one above the other by 0.2 m, and the contact between them."""
    cells = np.array([[0, 4, 2, 6, 1, 5, 3, 7]])
    cells = np.concatenate([cells, cells + 8]) if COMM.rank == 0 else cells[:0]
    x = np.concatenate([CORNERS, CORNERS + [0, 0, 1.2]]) if COMM.rank == 0 else np.empty((0, 3))
    mesh = compat.create_mesh(COMM, cells, x.astype(float), "hexahedron")
    body = nts.Continuum(mesh, nts.NeoHookean(young=1e6, poisson=0.3), density=1e3, name="two")
    pair = nts.ContactPair(
        slave=body.surface(lambda x: np.isclose(x[2], 1.2)),
        master=body.surface(lambda x: np.isclose(x[2], low)),
    )
    return nts.System([body], contacts=[pair])


@pytest.mark.mpi
def test_a_body_inside_itself_is_found():
    system = two_in_one(low=1.0)
    body = system.bodies[0]
    watch = overlap.OverlapWatch(system)
    above = body.reference.reshape(-1, 3)[:, 2] > 1.1
    motion = np.array([0.3, 0.2, -1.0]) * above[:, None]
    assert watch.look([0.19 * motion.ravel()]) == []
    found = watch.look([0.5 * motion.ravel()], last=True)
    assert {f.bodies for f in found} == {("two", "two")}
    (node,) = [f for f in found if f.kind == "node inside a body"]
    assert abs(node.depth - 0.1) < 1e-12 or abs(node.depth - 0.3) < 1e-12


@pytest.mark.mpi
def test_what_is_behind_an_open_surface_but_outside_is_no_overlap():
    """The bottom of a cube lies behind the facets that face the other way, beyond the body."""
    system = two_in_one(low=2.2)
    assert overlap.OverlapWatch(system).look(moved(system, (0.0, 0.0, 0.0))) == []


# ---- obstacles
class Ball(nts.Obstacle):
    """A ball as a user may write it: by its gap alone."""

    def __init__(self, centre, radius, width=np.inf):
        self.name, self.motion, self._width = "ball", None, width
        self.centre, self.radius = np.array(centre), radius

    @property
    def extent(self):
        return self.radius

    @property
    def width(self):
        return self._width

    def about(self, origin):
        return Ball(self.centre - origin, self.radius, self._width)

    def gap(self, x):
        y = x - self.centre
        r = np.linalg.norm(y, axis=1)
        unit = y / r[:, None]
        bend = (np.eye(3) - unit[:, :, None] * unit[:, None]) / r[:, None, None]
        return nts.Gap(r - self.radius, unit[:, None], bend)


class Broken(Ball):
    """A ball whose gap raises on the last rank once it is told to."""

    breaks: list = []

    def about(self, origin):
        return Broken(self.centre - origin, self.radius, self._width)

    def gap(self, x):
        if self.breaks and COMM.rank == COMM.size - 1:
            raise KeyError("no table")
        return super().gap(x)


@pytest.mark.mpi
def test_a_gap_that_raises_on_one_rank_is_told_on_all(monkeypatch):
    """A rigid slave's nodes ask all ranks what they carry, also those of the rank that raises."""
    mesh = create_box(COMM, [np.zeros(3), np.ones(3)], [3, 3, 1], CellType.hexahedron)
    body = nts.RigidBody(mesh, density=1e3, velocity=(0.0, 0.0, -500.0))
    pair = nts.ContactPair(body.surface(lambda x: x[2] < 1e-9), Broken((0.5, 0.5, -5.0), 5.0))
    stepper = nts.Stepper(nts.System([body], contacts=[pair]), nts.Midpoint())
    stepper.start(1e-3)
    stepper.problem.begin(stepper.state, 1e-3)
    contact = stepper.problem.couplings.contacts.elements[0]
    assert pair.redundant and contact.num_elements > 0
    monkeypatch.setattr(Broken, "breaks", [True])
    with pytest.raises(nts.UserFunctionError, match=r"its elements raised KeyError\('no table'\)"):
        stepper.problem.evaluate(stepper.problem.x)
    stepper.close()


def obstacles(rng):
    """Obstacles among facets of size 1 about the origin, and distances of facets from them."""
    centre, axis = 0.5 * rng.normal(size=3), rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    radius, far = rng.uniform(0.2, 2.0), 5.0

    def from_centre(corners):
        return compiled.closest_point(np.tile(centre, (len(corners), 1)), corners)[1]

    def sampled(corners, distance):
        s, t = (a.ravel()[:, None] for a in np.meshgrid(*[np.linspace(-1, 1, 201)] * 2))
        if corners.shape[1] == 3:
            s, t = 0.5 * (1 + s), 0.25 * (1 + s) * (1 + t)
            weights = np.hstack([1 - s, s - t, t])
        else:
            weights = 0.25 * np.hstack([(1 - s) * (1 - t), (1 + s) * (1 - t),
                                        (1 + s) * (1 + t), (1 - s) * (1 + t)])  # fmt: skip
        return np.array([distance(weights @ c).min() for c in corners])

    yield nts.Sphere(centre, radius), lambda c: from_centre(c) - radius
    yield Ball(centre, radius), lambda c: from_centre(c) - radius
    yield nts.Cylinder(centre, axis, radius), lambda c: sampled(
        c, lambda x: np.linalg.norm(np.cross(x - centre, axis), axis=1)
    ) - radius
    # What is farthest from a point or a line is a corner.
    yield nts.Sphere(centre, far, inside=True), lambda c: (
        far - np.linalg.norm(c - centre, axis=2).max(axis=1)
    )
    yield nts.Cylinder(centre, axis, far, inside=True), lambda c: (
        far - np.linalg.norm(np.cross(c - centre, axis), axis=2).max(axis=1)
    )
    yield nts.Plane(centre, axis), lambda c: ((c - centre) @ axis).min(axis=1)


@pytest.mark.parametrize("nc", [3, 4])
@pytest.mark.parametrize("metre", [1.0, 1e-6])
@pytest.mark.fast("1.0-4", "1e-06-3")
def test_facets_in_obstacles_are_as_deep_as_their_distance_tells(nc, metre):
    """Warped facets of any shape; a twisted one may be seen edge on."""
    rng, found_any = np.random.default_rng(nc), 0
    shape = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=float)[:nc]
    for _ in range(4):
        turned = np.array([shape @ random_rotation(rng).T for _ in range(30)])
        c = turned + 0.2 * rng.normal(size=(30, nc, 3)) + 2 * rng.normal(size=(30, 1, 3))
        for obstacle, lowest in obstacles(rng):
            limit, true = np.full(len(c), 0.05), -lowest(c)
            scaled = copy.copy(obstacle)
            for name in ("centre", "point", "radius"):
                if hasattr(scaled, name):
                    object.__setattr__(scaled, name, metre * np.array(getattr(scaled, name)))
            place, depth = (
                v / metre for v in obstacle_crossings.sunk(scaled, metre * c, metre * limit)
            )
            deep = depth > limit
            sure = np.abs(true / limit - 1) > 0.02
            assert np.array_equal(deep[sure], (true > limit)[sure])
            assert np.allclose(depth[deep], true[deep], rtol=0.011)
            assert np.allclose(-obstacle.gap(place[deep]).value, depth[deep], rtol=0.011)
            found_any += deep.sum()
    assert found_any > 100


@pytest.mark.parametrize("nc", [3, 4])
@pytest.mark.parametrize("known", [True, False], ids=["width", "no width"])
@pytest.mark.fast("no width-3")
def test_a_ball_between_nodes_is_found_by_its_gap_alone(nc, known):
    """Also one that no side of the facet meets, so that samples tell nothing of those."""
    rng = np.random.default_rng(0)
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=float)[None, :nc]
    found_any = 0
    for _ in range(100):
        x, y = np.sort(rng.uniform(0.1, 0.9, 2))[::-1]
        centre, r = np.array((x, y, rng.uniform(-0.1, 0.1))), rng.uniform(0.02, 0.4)
        depth, limit = r - abs(centre[2]), 0.2 * r
        if depth > 1.02 * limit:
            ball = Ball(centre, r, width=r if known else np.inf)
            _, found = obstacle_crossings.sunk(ball, corners, np.array([limit]))
            assert abs(found[0] - depth) < 0.011 * depth
            found_any += 1
    assert found_any > 33


@pytest.mark.parametrize("far", [1.0, 30.0])
def test_paths_through_an_obstacle_that_is_known_by_its_gap_alone(far):
    """Also through one far smaller than the path, if it tells its width."""
    rng = np.random.default_rng(5)
    centre, radius = np.array([0.1, -0.2, 0.3]), 0.5
    start = centre + far * rng.uniform(-1, 1, size=(200, 3))
    aim = centre + rng.uniform(-0.4, 0.4, size=(200, 3))
    end = start + rng.uniform(1.0, 2.0, size=(200, 1)) * (aim - start)
    true = nts.Sphere(centre, radius).lowest_gap(start, end)
    found = Ball(centre, radius, width=radius).lowest_gap(start, end)
    least = 0.05 * np.minimum(radius, np.linalg.norm(end - start, axis=1))
    deep = true < -least
    assert deep.sum() > 50 and (found >= true - 1e-12).all()
    assert np.allclose(found[deep], true[deep], rtol=0.011)


def above(master, *, cells=(2, 2), height=0.5, cell_type=CellType.hexahedron, turn=None, **options):
    """A plate of 2 x 2 in the plane z = 0 with facets of 1, or others, held out of an obstacle."""
    mesh = create_box(
        COMM, [[-1, -1, 0], [1, 1, height]], [*cells, 1],
        cell_type=cell_type, ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    body = nts.Continuum(mesh, rubber, density=1e3, degree=1, name="plate", **options)
    pair = nts.ContactPair(slave=body.surface(lambda x: x[2] < 1e-9), master=master)
    return nts.System([body], contacts=[pair])


@pytest.mark.mpi
@pytest.mark.parametrize("cell_type", [CellType.hexahedron, CellType.tetrahedron])
@pytest.mark.parametrize(
    ("master", "up", "place"),
    [
        (nts.Sphere((0.4, 0.55, -1.0), 0.8), 0.6, (0.4, 0.55)),
        (nts.Sphere((0.5, 0.0, -1.0), 0.4), 0.9, (0.5, 0.0)),
        (nts.Cylinder((0.5, 0.5, -1.0), (0, 1, 0), 0.3), 1.0, (0.5, None)),
        # Thinner than a fifth of a facet.
        (nts.Cylinder((0.5, 0.3, -1.0), (1, 0.1, 0), 0.05), 0.97, (None, None)),
    ],
    ids=["under a facet", "under an edge", "roller", "wire"],
)
def test_an_obstacle_between_the_nodes_is_told_with_place_and_depth(master, up, place, cell_type):
    """Its top comes from below to a height of `up` + radius - 1 above the plane of the facets."""
    depth = up + master.radius - 1.0
    system = above(master, cell_type=cell_type)
    (found,) = overlap.OverlapWatch(system).look(moved(system, (0, 0, -up)))
    assert found.kind == "facet in an obstacle" and found.bodies == ("plate", master.name)
    assert abs(found.depth - depth) < 0.011 * depth
    expected = np.array([np.nan if v is None else v for v in (*place, -up)], dtype=float)
    off = np.abs(found.place - expected)
    # A point whose depth is right to 1 % may lie beside the deepest.
    assert np.nanmax(off) < np.sqrt(2 * 0.022 * depth * master.radius)
    assert "finer mesh of the slave" in found.text and f"inside {master.name!r}" in found.text
    body = system.bodies[0]
    number = np.asarray(body.mesh.geometry.input_global_indices)
    x = np.concatenate(COMM.allgather(body.mesh.geometry.x[np.isin(number, found.nodes)]))
    assert (x[:, 2] == 0).all() and (x.min(axis=0)[:2] - 0.02 <= found.place[:2]).all()
    assert (found.place[:2] <= x.max(axis=0)[:2] + 0.02).all()


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", MID_STEP.values(), ids=MID_STEP)
@pytest.mark.parametrize("moving", ["plate", "ball"])
@pytest.mark.fast_on_ranks("plate-energy-momentum", "ball-midpoint")
def test_a_run_in_which_a_ball_comes_through_a_facet_says_so(moving, integrator, caplog):
    """A ball of radius 0.4 between four nodes of a facet of 1: nothing holds them apart."""
    caplog.set_level(logging.CRITICAL)
    path = (lambda t: (0.0, 0.0, 5.0 * t)) if moving == "ball" else None
    ball = nts.Sphere((0.5, 0.5, -0.45), 0.4, motion=path)
    down = (0, 0, -5.0) if moving == "plate" else (0, 0, 0)
    run = nts.simulate(above(ball, velocity=down), integrator, dt=5e-3, t_end=0.06)
    assert run.balance["active"].max() == 0
    assert run.status.startswith("completed, but the facet of nodes")
    (kind,) = kinds(run)
    assert kind == "facet in an obstacle" and run.warnings[kind].grave
    assert abs(run.warnings[kind].worst - 0.25) < 0.0028


@pytest.mark.mpi
def test_load_steps_of_a_ball_through_a_facet_are_watched(caplog):
    caplog.set_level(logging.CRITICAL)
    ball = nts.Sphere((0.5, 0.5, -0.45), 0.4, motion=lambda t: (0.0, 0.0, 0.3 * t))
    held = nts.Dirichlet(lambda x: x[2] > 0.49)
    run = nts.equilibrium(above(ball, bcs=[held]), load_steps=3)
    assert run.status.startswith("completed, but the facet of nodes")
    assert abs(run.warnings["facet in an obstacle"].worst - 0.25) < 0.0028


@pytest.mark.mpi
def test_what_lies_on_an_obstacle_is_not_warned_of():
    """Flush on a floor and a little below; four nodes of each facet on a ball of two facets."""
    system = above(nts.Plane((0, 0, 0), (0, 0, 1)), cells=(6, 6))
    watch = overlap.OverlapWatch(system)
    for down in (0.0, 1e-12, 1e-3):
        assert watch.look(moved(system, (0, 0, -down)), last=True) == []
    ball = nts.Sphere((0.0, 0.0, -0.6 - 1e-9), 0.6)
    system = above(ball, cells=(8, 8))
    body = system.bodies[0]
    x = body.reference.reshape(-1, 3)
    r = np.hypot(x[:, 0], x[:, 1])
    arc = np.minimum(r, 0.5) / 0.6
    u = np.where(r > 0, 0.6 * np.sin(arc) / np.where(r > 0, r, 1.0), 1.0)[:, None] * x
    u[:, 2] = x[:, 2] + 0.6 * (np.cos(arc) - 1)
    assert overlap.OverlapWatch(system).look([(u - x).ravel()]) == []


@pytest.mark.mpi
@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
@pytest.mark.slow
def test_what_passes_between_two_looks_is_told(shape):
    """A thin obstacle that goes through a large facet in few steps, which no node of it meets."""
    ends = [np.zeros(3), np.ones(3)]
    mesh = create_box(
        COMM, ends, [1, 1, 1], CellType.hexahedron, ghost_mode=GhostMode.shared_facet
    )
    random = np.random.default_rng(3)
    scenes = [(0.0688, -0.3512, 0.2059, 0.5, 0.5), (0.1663, -0.2139, 0.3555, 0.5, 0.5),
              (0.0625, -0.1875, 0.0625, 0.5, 0.5)]  # fmt: skip
    for _ in range(9):
        r, far = random.uniform(0.03, 0.2), random.uniform(0.01, 0.5)
        scenes.append((r, -r - far, r * random.uniform(0.5, 4.0), *random.uniform(0.3, 0.7, 2)))
    for r, z, step, x, y in scenes:
        cube = nts.RigidBody(mesh, density=1e3, velocity=(0, 0, -1), name="cube")
        obstacle = nts.Sphere((x, y, z), r)
        if shape == "cylinder":
            obstacle = nts.Cylinder((x, y, z), (1, 0.3, 0), r)
        pair = nts.ContactPair(slave=cube.surface(lambda x: x[2] < 1e-9), master=obstacle)
        t_end = step * np.ceil((1.3 - z) / step)
        run = nts.simulate(
            nts.System([cube], contacts=[pair]), nts.EnergyMomentum(), dt=step, t_end=t_end
        )
        kept = run.balance["linear_momentum"][-1, 2] == pytest.approx(-1e3, rel=1e-9)
        assert not kept or "facet in an obstacle" in run.warnings, (r, z, step)


def test_a_corner_in_an_obstacle_asks_for_a_smaller_step():
    system = above(nts.Plane((0, 0, 0), (0, 0, 1)))
    (found,) = overlap.OverlapWatch(system).look(moved(system, (0, 0, -0.3)))
    assert abs(found.depth - 0.3) < 0.0031 and "use a smaller dt" in found.text


@pytest.mark.mpi
def test_obstacles_are_looked_at_as_rarely_as_the_motion_allows(monkeypatch):
    """Not far away; else after a quarter of the radius."""
    ball, looks = nts.Sphere((0.5, 0.5, -0.45), 0.4), []
    system = above(ball)
    watch, true = overlap.OverlapWatch(system), obstacle_crossings.sunk
    monkeypatch.setattr(obstacle_crossings, "sunk", lambda *a: looks.append(1) or true(*a))

    def look(z, **options):
        watch.look(moved(system, (0, 0, z)), **options)
        done = len(looks)
        looks.clear()
        return done

    # First at what starts in the ball.
    assert look(30.0) == 1
    # Some node is within a facet of the ball from a height of 0.6 on.
    assert sum(look(z) for z in np.linspace(29.0, 1.0, 29)) == 0
    # The way is longer than the ball: its ends, four places on the last 0.6 m, and where it is.
    assert look(0.0) == 2 + 4 + 1
    assert [look(-z) for z in (0.05, 0.12, 0.12, 0.13)] == [0, 1, 0, 0]
    assert look(-0.6) == 2 + 4 + 1
    assert [look(-0.61, last=True) for _ in range(2)] == [1, 0]


@pytest.mark.mpi
def test_what_no_contact_holds_of_a_body_is_told_in_an_obstacle(caplog):
    """The top is the slave, and the bottom falls 0.25 m into a floor 0.05 m below it."""
    caplog.set_level(logging.CRITICAL)
    floor = nts.Plane((0, 0, -0.05), (0, 0, 1))
    mesh = create_box(
        COMM, [[-1, -1, 0], [1, 1, 1]], [2, 2, 1],
        cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    rubber = nts.NeoHookean(young=1e6, poisson=0.3)
    body = nts.Continuum(mesh, rubber, density=1e3, velocity=(0, 0, -5.0), name="block")
    pair = nts.ContactPair(slave=body.surface(lambda x: x[2] > 0.99), master=floor)
    system = nts.System([body], contacts=[pair])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=0.06)
    assert run.status.startswith("completed, but node")
    (kind,) = kinds(run)
    assert kind == "node in an obstacle" and run.warnings[kind].grave
    assert abs(run.warnings[kind].worst - 0.25) < 1e-9
    text = run.warnings[kind].text
    assert "inside 'plane'" in text and "no contact is declared of it with 'plane'" in text


@pytest.mark.mpi
def test_nodes_that_another_contact_holds_or_that_start_in_an_obstacle_are_not_told():
    """A plate with two slaves on the same floor, and one whose upper half is behind a wall."""
    floor = nts.Plane((0, 0, 0), (0, 0, 1))
    system = above(floor)
    body = system.bodies[0]
    alike = nts.Plane((0, 0, 0), (0, 0, 1))
    rest = nts.ContactPair(slave=body.surface(lambda x: x[2] > 0.49), master=alike)
    both = nts.System([body], contacts=[*system.contacts, rest])
    (found,) = overlap.OverlapWatch(both).look(moved(both, (0, 0, -0.8)))
    assert found.kind == "facet in an obstacle"
    wall = above(nts.Plane((0, 0, 0.25), (0, 0, -1)))
    assert overlap.OverlapWatch(wall).look(moved(wall, (0, 0, -0.2))) == []


def unit_cube(master, where=lambda x: x[2] < 1e-9, *, rigid=True, cells=1, metre=1.0, **options):
    """A unit cube of which a part, or all, is the slave of an obstacle."""
    mesh = create_box(
        COMM, [np.zeros(3), metre * np.ones(3)], [cells] * 3, CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    options = {"density": 1e3, "name": "cube"} | options
    if rigid:
        body = nts.RigidBody(mesh, **options)
    else:
        body = nts.Continuum(mesh, nts.NeoHookean(young=1e6, poisson=0.3), **options)
    return nts.System([body], contacts=[nts.ContactPair(slave=body.surface(where), master=master)])


def everywhere(x):
    return x[0] > -np.inf


@pytest.mark.mpi
@pytest.mark.parametrize("shape", ["sphere", "roller"])
@pytest.mark.parametrize("moving", ["rigid", "flexible", "obstacle"])
@pytest.mark.fast_on_ranks("flexible-roller")
@pytest.mark.fast("rigid-sphere")
def test_an_obstacle_that_comes_in_where_no_contact_is_says_so(shape, moving, caplog):
    """Through the side x = 1 of a cube of one cell, whose bottom is the slave, in many steps."""
    caplog.set_level(logging.CRITICAL)
    path = (lambda t: (-3.0 * t, 0.0, 0.0)) if moving == "obstacle" else None
    master = nts.Sphere((2.0, 0.5, 0.5), 0.45, motion=path)
    if shape == "roller":
        master = nts.Cylinder((2.0, 0.5, 0.5), (0, 1, 0), 0.45, motion=path)
    velocity = (0, 0, 0) if moving == "obstacle" else (3.0, 0, 0)
    for t_end in (0.25, 1.2):
        system = unit_cube(master, rigid=moving != "flexible", velocity=velocity)
        run = nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=t_end)
        assert run.balance["active"].max() == 0
        assert run.status.startswith("completed, but the facet of nodes")
        found = run.warnings["facet in an obstacle"]
        assert found.grave and "no contact is declared of it with" in found.text
        # It began 0.55 m away.
        if t_end == 0.25:
            assert abs(found.worst - 0.2) < 0.011 * 0.2


@pytest.mark.mpi
@pytest.mark.parametrize("metre", [1.0, 1e-6])
@pytest.mark.parametrize("step", [0.03, 0.3, 1.5, 3.0])
@pytest.mark.fast_on_ranks("0.03-1.0", "3.0-1.0")
@pytest.mark.fast("3.0-1.0")
def test_an_obstacle_that_gets_inside_a_body_is_told(step, metre):
    """On a way of 3 m over a ball, which is inside the cube for 0.6 m, in steps of any length."""
    r, told = 0.2 * metre, []
    for ball in (nts.Sphere(metre * np.array((2, 0.5, 0.5)), r),
                 Ball(metre * np.array((2, 0.5, 0.5)), r, width=r)):  # fmt: skip
        system = unit_cube(ball, rigid=False, metre=metre)
        watch, found = overlap.OverlapWatch(system), {}
        for way in np.arange(0.0, 3.0 + step / 2, step):
            for f in watch.look(moved(system, (metre * way, 0, 0))):
                assert f.bodies == ("cube", ball.name) and f.grave
                found.setdefault(f.kind, []).append(f.depth / metre)
        assert set(found) == {"facet in an obstacle", "obstacle in a body"}
        assert max(found["facet in an obstacle"]) < 0.2 * 1.011
        # The centre is 0.5 m deep at most, and points half as far from it as the surface 0.6 m.
        assert 0.2 < max(found["obstacle in a body"]) < 0.6
        told.append({kind: len(depths) for kind, depths in found.items()})
    assert told[0] == told[1]


@pytest.mark.mpi
def test_an_obstacle_of_unknown_width_inside_a_body_is_told():
    """What is known by its gap alone is found next to nodes, a fifth of a facet deep or more."""
    system = unit_cube(Ball((2.0, 0.5, 0.5), 0.2), rigid=False)
    watch = overlap.OverlapWatch(system)
    assert watch.look(moved(system, (0, 0, 0))) == []
    (found,) = watch.look(moved(system, (1.5, 0, 0)))
    assert found.kind == "obstacle in a body" and found.text.startswith("'ball' lies inside 'cube'")
    x = found.place - (1.5, 0, 0)
    assert abs(found.depth - min(x.min(), 1 - x.max())) < 1e-12 and found.depth > 0.2
    assert np.linalg.norm(found.place - (2.0, 0.5, 0.5)) < 0.2


@pytest.mark.mpi
def test_a_roller_that_begins_between_nodes_of_the_rest_is_told_but_not_as_grave(caplog):
    """It has no end, but what it stands for may have; a facet that it begins in is left out."""
    caplog.set_level(logging.CRITICAL)
    roller = nts.Cylinder((0.5, 0.5, 0.5), (0, 1, 0), 0.2)
    run = nts.simulate(
        unit_cube(roller, velocity=(1.0, 0, 0)), nts.EnergyMomentum(), dt=0.01, t_end=0.02
    )
    (kind,) = kinds(run)
    assert run.status == "completed" and not run.warnings[kind].grave
    assert kind == "facet starts in an obstacle" and abs(run.warnings[kind].worst - 0.2) < 0.0022
    assert "it is not looked at" in run.warnings[kind].text


@pytest.mark.mpi
def test_what_is_in_an_obstacle_where_the_scene_starts_is_left_out_not_where_the_mesh_is():
    """A cube whose mesh is in the floor, and which starts 0.7 m higher, 0.2 m over it."""
    floor = nts.Plane((0, 0, 0.5), (0, 0, 1))
    top, lifted = (lambda x: x[2] > 1 - 1e-9), (lambda x: np.tile([[0], [0], [0.7]], len(x[0])))
    system = unit_cube(floor, top, rigid=False, displacement=lifted)
    watch = overlap.OverlapWatch(system)
    assert watch.look(moved(system, (0, 0, 0.7))) == []
    (found,) = watch.look(moved(system, (0, 0, 0.2)), last=True)
    assert found.kind == "node in an obstacle" and abs(found.depth - 0.3) < 1e-12


def with_a_hole(through):
    """A body of cubic cells of 1, without the one in the middle of 3 x 3 x 1 or 3 x 3 x 3."""
    shape = (3, 3, 1 if through else 3)
    number = np.arange(np.prod(np.add(shape, 1))).reshape(np.add(shape, 1))
    middle = (1, 1, 0) if through else (1, 1, 1)
    corner = [c for c in np.ndindex(*shape) if c != middle]
    order = [(i, j, k) for k in (0, 1) for j in (0, 1) for i in (0, 1)]
    cells = np.array([[number[tuple(np.add(c, o))] for o in order] for c in corner])
    x = np.array(list(np.ndindex(*number.shape)), dtype=float)
    if COMM.rank:
        cells, x = cells[:0], x[:0]
    mesh = compat.create_mesh(COMM, cells, x, "hexahedron")
    return nts.RigidBody(mesh, density=1e3, velocity=(0.2, 0.1, 0.05), name="holed")


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("through", "obstacle"),
    [
        (True, nts.Sphere((1.5, 1.5, 0.5), 0.4)),
        (True, nts.Cylinder((1.5, 1.5, 0.0), (0, 0, 1), 0.45)),
        (True, nts.Cylinder((1.5, 1.5, 0.0), (0.1, 0, 1), 0.3)),
        (False, nts.Sphere((1.5, 1.5, 1.5), 0.49)),
        (False, nts.Sphere((1.5, 1.5, 1.5), 0.01)),
        (False, nts.Sphere((1.5, 1.5, 1.5), 9.0, inside=True)),
        (False, nts.Cylinder((1.5, 1.5, 0.0), (0, 0, 1), 9.0, inside=True)),
        (False, nts.Plane((1.5, 1.5, 0.0), (0, 0, 1))),
        (False, nts.Plane((1.5, 1.5, -1e-3), (1e-3, 0, 1))),
        (False, nts.Sphere((1.5, 1.5, -50.0), 50.0)),
        (False, nts.Sphere((1.5, 1.5, -0.02), 0.02)),
    ],
)
@pytest.mark.parametrize("where", [everywhere, lambda x: x[2] < 1e-9], ids=["all", "bottom"])
@pytest.mark.fast_on_ranks("all-True-obstacle0", "bottom-False-obstacle5")
def test_what_is_in_a_hole_or_around_or_below_is_not_inside(through, obstacle, where):
    body = with_a_hole(through)
    pair = nts.ContactPair(slave=body.surface(where), master=obstacle)
    run = nts.simulate(
        nts.System([body], contacts=[pair]), nts.EnergyMomentum(), dt=0.01, t_end=0.03
    )
    assert run.status == "completed" and not run.warnings


@pytest.mark.mpi
@pytest.mark.parametrize("where", [everywhere, lambda x: x[2] < 1e-9], ids=["all", "bottom"])
@pytest.mark.parametrize("through", [True, False])
@pytest.mark.parametrize("place", [(0.5, 1.5, 0.5), (2.6, 2.4, 0.5), (0.5, 0.5, 0.1)])
@pytest.mark.fast_on_ranks("place0-True-bottom", "place2-False-all")
def test_a_start_around_an_obstacle_is_refused(place, through, where):
    body, r = with_a_hole(through), 0.09
    for ball in (nts.Sphere(place, r), Ball(place, r, width=r)):
        pair = nts.ContactPair(slave=body.surface(where), master=ball)
        message = (
            rf"^contact 'holed-{ball.name}': '{ball.name}' starts inside 'holed' as a whole, at "
            r"\(.*\), 0\.\d+ from the boundary; move the two apart"
        )
        with pytest.raises(ValueError, match=message):
            nts.System([body], contacts=[pair])


@pytest.mark.mpi
@pytest.mark.parametrize("cells", [1, 4])
def test_a_start_from_another_run_around_an_obstacle_is_refused(cells, caplog):
    """A settled block and one that moves, in a scene to which a ball is added where it is now."""
    caplog.set_level(logging.CRITICAL)
    free = unit_cube(nts.Plane((0, 0, -9.0), (0, 0, 1)), cells=cells, velocity=(2.0, 0, 0))
    run = nts.simulate(free, nts.EnergyMomentum(), dt=0.25, t_end=1.0)
    ball = nts.Sphere((2.5, 0.5, 0.5), 0.2)
    start = unit_cube(ball, cells=cells, velocity=(2.0, 0, 0))
    with pytest.raises(ValueError, match="^contact 'cube-sphere': 'sphere' starts inside 'cube'"):
        state_from(start, free, run.state, moving=False)
    options = {"dt": 1e-3, "t_end": run.state.time + 2e-3, "start": run}
    told = nts.simulate(start, nts.EnergyMomentum(), **options)
    assert told.status.startswith("completed, but 'sphere' lies inside 'cube'")


@pytest.mark.mpi
@pytest.mark.fast_on_ranks("obstacle")
@pytest.mark.parametrize("other", ["obstacle", "body"])
def test_points_of_a_driven_arm_move_farther_than_its_coordinates(other):
    """Its tip passes through what no contact holds: how far it moves decides when to look.

    Directors are as long as the gyration of the body, so that they move by half as much.
    """
    rate, end = 90.0, 0.01
    place = 1.95 * np.array([np.cos(0.45), np.sin(0.45), 0.0])
    arm = nts.RigidBody(
        solid((0.2, -0.05, -0.2), (2.0, 0.05, 0.2), (18, 1, 4)), density=1e3, name="arm",
        motion=lambda t: (1.1 * (np.cos(rate * t) - 1), 1.1 * np.sin(rate * t), 0.0),
        rotation=lambda t: (0, 0, rate * t),
    )  # fmt: skip
    if other == "obstacle":
        ball = nts.Sphere(place, 0.06, name="ball")
        bodies, pair = [arm], nts.ContactPair(arm.surface(lambda x: x[2] < np.inf), ball)
    else:
        stone = nts.RigidBody(solid(place - 0.06, place + 0.06, 1), density=1e3, name="stone")
        bodies = [arm, stone]
        pair = nts.ContactPair(
            stone.surface(lambda x: x[2] > 0.0599), arm.surface(lambda x: x[2] > 0.199)
        )
    run = nts.simulate(
        nts.System(bodies, contacts=[pair]), nts.EnergyMomentum(), dt=5e-4, t_end=end
    )
    assert run.status.startswith("completed, but")
    worst = max(w.worst for w in run.warnings.every if w.grave)
    assert 0.03 < worst < 0.08


@pytest.mark.mpi
@pytest.mark.parametrize("on", ["plane", "block"])
def test_a_thin_plate_that_is_held_at_its_far_face_is_told(on):
    """Its upper face is the slave, so that all of it sinks in, which is a tenth of a facet."""
    thick, kind = 0.03, dict(cell_type=CellType.hexahedron, ghost_mode=GhostMode.shared_facet)
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, thick]], [3, 3, 1], **kind)
    plate = nts.RigidBody(mesh, density=1e3, name="plate")
    bodies, master = [plate], nts.Plane((0, 0, 0), (0, 0, 1))
    if on == "block":
        mesh = create_box(COMM, [[-0.5, -0.5, -1], [1.5, 1.5, 0]], [3, 3, 2], **kind)
        still = dict(motion=(0, 0, 0), rotation=(0, 0, 0))
        bodies.append(nts.RigidBody(mesh, density=1e3, name="block", **still))
        master = bodies[1].surface(lambda x: x[2] > -1e-9)
    pair = nts.ContactPair(plate.surface(lambda x: x[2] > thick - 1e-9), master)
    system = nts.System(bodies, contacts=[pair], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=4e-3, t_end=0.1)
    assert run.status.startswith("completed, but node")
    kind = "node in an obstacle" if on == "plane" else "node inside a body"
    assert 0.9 * thick < run.warnings[kind].worst <= (1 + 1e-9) * thick
