"""Contact that ends at the last slave node before a master's rim: told, and nothing else is."""

import numpy as np
import pytest
from scenes import at, box, everywhere
from scipy.spatial.transform import Rotation

import dolfinx_nts as nts
from dolfinx_nts.contact.overhang import overhang

#: The top of a table, 2 m by 1 m, whose rim is at x = 2.
TABLE = np.array([[[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]]], dtype=float)
#: Its side at that rim.
SIDE = np.array([[[2, 0, 0], [2, 0, -1], [2, 1, -1], [2, 1, 0]]], dtype=float)


def face(n, start=1.62, width=0.6, tilt=0.0, about=None):
    """Points and facets of a square face of n x n facets over the table, seen from below.

    It begins at x = `start` and is turned down by `tilt` about the line x = `about`.
    """
    x, y = np.meshgrid(np.linspace(0, width, n + 1), np.linspace(0.2, 0.8, n + 1), indexing="ij")
    points = np.column_stack([x.ravel() + start, y.ravel(), np.zeros(x.size)])
    if tilt:
        arm = points[:, 0] - about
        points[:, 0], points[:, 2] = about + arm * np.cos(tilt), -arm * np.sin(tilt)
    number = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
    return points, np.stack([c.ravel() for c in corners], axis=1)


def last_row(points):
    """Unit forces on the last nodes before the rim, all others carry nothing."""
    last = points[points[:, 0] < 2.0, 0].max()
    return (np.abs(points[:, 0] - last) < 1e-9).astype(float), last


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize(
    "tilt, side", [(0.0, False), (0.05, False), (0.15, False), (0.0, True), (0.05, True)]
)
def test_distance_from_the_rim_is_told(n, tilt, side):
    points, facets = face(n)
    force, last = last_row(points)
    points, _ = face(n, tilt=tilt, about=last)
    master = np.concatenate([TABLE, SIDE]) if side else TABLE
    found = overhang(points, facets, force, master)
    # Of the side the place as low as the next nodes is the nearest to these.
    low = 0.6 / n * np.sin(tilt) if side else 0.0
    distance = np.hypot(2.0 - last, low)
    assert found.distance == pytest.approx(distance, rel=1e-9)
    assert found.size == pytest.approx(distance / np.ptp(points, axis=0).max(), rel=1e-9)
    assert force[found.node] == 1.0


def test_triangles():
    points, facets = face(2)
    force, last = last_row(points)
    split = np.concatenate([facets[:, [0, 1, 2]], facets[:, [0, 2, 3]]])
    table = np.concatenate([TABLE[:, [0, 1, 2]], TABLE[:, [0, 2, 3]]])
    found = overhang(points, split, force, table)
    assert found.distance == pytest.approx(2.0 - last, rel=1e-9)


def forces_elsewhere(points):
    """Row before the last one carries a part."""
    force, last = last_row(points)
    return force + 0.1 * (points[:, 0] < last - 1e-9)


@pytest.mark.parametrize(
    "points, facets, force",
    [
        pytest.param(*face(3), forces_elsewhere(face(3)[0]), id="other nodes carry"),
        pytest.param(*face(3, start=1.0), last_row(face(3, start=1.0)[0])[0], id="all over it"),
        pytest.param(*face(3), np.zeros(16), id="no force"),
        pytest.param(*face(3), -1e-20 * last_row(face(3)[0])[0], id="rounding of no force"),
        # With the edge x = 1 down: the nodes that carry nothing hang above the table.
        pytest.param(
            *face(3, start=1.0, tilt=-0.5, about=1.0), (face(3)[0][:, 0] < 1.63) * 1.0,
            id="on its edge",
        ),
        pytest.param(
            *face(3, tilt=-0.5, about=1.82), last_row(face(3)[0])[0],
            id="far above the rim",
        ),
        # A ball near the rim: its facet rises by a tenth of the way to there.
        pytest.param(*face(3, tilt=-0.1, about=1.82), last_row(face(3)[0])[0], id="round"),
        # 20 facets: 0.01 of 0.6 m.
        pytest.param(*face(20, start=1.69), last_row(face(20, start=1.69)[0])[0], id="fine mesh"),
    ],
)  # fmt: skip
def test_nothing_is_told(points, facets, force):
    assert overhang(points, facets, force, TABLE) is None


@pytest.mark.parametrize("rows, told", [((0.4, 0.6), False), ((0.4,), True)])
def test_what_stands_between_two_rims_does_not_tip(rows, told):
    """On a wall along x of 0.3 m, with rows of nodes 0.05 m inside its rims."""
    points, facets = face(3, start=1.0)
    wall = TABLE * [1, 0.3, 1] + [0, 0.35, 0]
    force = np.isclose(points[:, 1, None], rows).any(axis=1) * 1.0
    found = overhang(points, facets, force, wall)
    assert (found is not None) == told
    if told:
        assert found.distance == pytest.approx(0.05, rel=1e-9)


def test_what_another_contact_holds_does_not_tip():
    """A brick of one cell with its ends on two others; nodes between its ends reach beyond."""
    points, facets = face(1)
    force, last = last_row(points)
    held = points[:, 0] > last
    assert overhang(points, facets, force, TABLE) is not None
    assert overhang(points, facets, force, TABLE, held) is None
    points, facets = face(2, start=1.7, width=0.8)
    force = (points[:, 0] < 1.71) * 1.0
    held = points[:, 0] > 2.4
    assert overhang(points, facets, force, TABLE, held).distance == pytest.approx(0.3, rel=1e-9)


def slide(n, exchange=False, cells=(5, 3, 1), width=1.0, edges=True, dt=4e-3):
    """A rigid block leaves a table at 2 m/s (n x n facets); half a second.

    If the table is narrower than the block, 0.4 m, none of the block's edges cross its end; one
    row of nodes stands on it.
    """
    rows = n if width > 0.4 else 2
    options = dict(motion=lambda t: (0, 0, 0), rotation=lambda t: (0, 0, 0))
    table = nts.RigidBody(
        box([0, -width / 2, -0.4], [2, width / 2, 0], cells), density=1e3, name="table", **options
    )
    block = nts.RigidBody(
        box([1.4, -0.2, 0], [1.8, 0.2, 0.2], [n, rows, 1]), density=1e3, velocity=(2, 0, 0),
        name="block",
    )  # fmt: skip
    surfaces = [block.surface(at(2, 0.0)), table.surface(at(2, 0.0))]
    pair = nts.ContactPair(*(surfaces[::-1] if exchange else surfaces), edges=edges)
    system = nts.System([table, block], contacts=[pair], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=dt, t_end=0.4, progress=False)
    return run, float(np.linalg.norm(block.angular_velocity))


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_block_that_tips_too_early():
    """By nodes alone it turns about the last of them and leaves the table too early: told."""
    run, _ = slide(1, width=0.38, edges=False)
    told = run.warnings["contact inside a rim"]
    assert told.grave and told.about == ("block", "table")
    assert run.status.startswith("completed, but facets of 'block' reach over the rim of 'table'")
    assert f"inside the rim by {told.worst:.3g}, or " in told.text
    # The centre is over the rim when 0.2 m of the block are; the nodes before it are farther in.
    assert 0.1 < told.worst < 0.4


@pytest.mark.parametrize("edges", [False, True])
def test_a_cube_that_comes_down_on_a_rim_by_its_vertex(edges):
    """Its edges cross the rim: they will carry there, unless edges are left out of the contact."""
    down = Rotation.from_euler("zy", [50, 2], degrees=True).as_matrix()
    mesh = box([0, 0, 0], [1, 1, 1], [1, 1, 1])
    mesh.geometry.x[:] = mesh.geometry.x @ down.T
    lowest = mesh.geometry.x[mesh.geometry.x[:, 2].argmin()]
    mesh.geometry.x[:] += [0.5, 0.5, 0.0] - lowest
    table = nts.RigidBody(
        box([0, -1, -1], [1, 2, 0], [1, 1, 1]), density=1.0, motion=lambda t: (0, 0, 0),
        rotation=lambda t: (0, 0, 0), name="table",
    )  # fmt: skip
    cube = nts.RigidBody(mesh, density=1.0, name="cube")
    pair = nts.ContactPair(cube.surface(everywhere), table.surface(at(2, 0.0)), edges=edges)
    system = nts.System([table, cube], contacts=[pair], gravity=(0, 0, -9.81))
    run = nts.simulate(system, nts.EnergyMomentum(), dt=2e-3, t_end=2e-2, progress=False)
    assert (run.contact_forces[:, 0, 2] != 0.0).any()
    assert ("contact inside a rim" in run.warnings) is not edges
