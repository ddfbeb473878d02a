"""Ties of shells' edges and beams' ends to rigid bodies and continua; seams of shells."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from scipy.optimize import brentq
from shells import grid, plate_nodes, surface_mesh

import dolfinx_nts as nts

LONG, DEEP, THICK, YOUNG = 1.0, 0.5, 0.1, 1.2e6
#: Of a width of one metre: bending, stretch and shear; Poisson's ratio is 0.
EI, EA, GA = YOUNG * THICK**3 / 12, YOUNG * THICK, 5 / 6 * YOUNG / 2 * THICK
EM = nts.EnergyMomentum()
SPIN = np.array([0.5, 1.0, 2.0])


def turning(x):
    return np.cross(SPIN, x.T).T


def at(axis, value, scale=1.0):
    return lambda x: np.abs(x[axis] - scale * value) < 1e-9 * scale


def sheet(x, n, m, name, scale=1.0, comm=MPI.COMM_WORLD, **options):
    """A shell of n x m cells on these nodes, in a unit of length 1/scale m."""
    return nts.Shell(
        surface_mesh(scale * x, grid(n, m), comm), young=YOUNG / scale, poisson=0.0,
        thickness=THICK * scale, density=1e3 / scale**3, name=name, **options,
    )  # fmt: skip


def strip(n=8, **options):
    """From x = 0 along x, two cells wide."""
    return sheet(plate_nodes(n, 2, LONG, DEEP), n, 2, "strip", **options)


def bar(n=8, scale=1.0, comm=MPI.COMM_WORLD, **options):
    """A beam in the strip's place, as wide as it is thick."""
    x = scale * np.linspace([0, DEEP / 2, 0], [LONG, DEEP / 2, 0], n + 1)
    mesh = surface_mesh(x, np.column_stack([np.arange(n), np.arange(1, n + 1)]), comm, "interval")
    section = nts.Rectangle(THICK * scale, THICK * scale).section(
        young=YOUNG / scale, poisson=0.0, density=1e3 / scale**3
    )
    return nts.Beam(mesh, section, direction=(0, 0, 1), name="bar", **options)


def block(cells, length, high=THICK, young=YOUNG, scale=1.0, comm=MPI.COMM_WORLD, **options):
    """Before x = 0, as wide as the strip."""
    low, top = scale * np.array([[-length, 0, -high / 2], [0, DEEP, high / 2]])
    mesh = create_box(comm, [low, top], cells, CellType.hexahedron)
    material = nts.StVenantKirchhoff(young=young / scale, poisson=0.0)
    return nts.Continuum(mesh, material, density=1e3 / scale**3, name="block", **options)


def root(thin, scale=1.0):
    """Surface of a strip's edge or a bar's end at x = 0."""
    side = {"side": "edge"} if isinstance(thin, nts.Shell) else {}
    return thin.surface(at(0, 0.0, scale), **side)


def moved(shell):
    start, now = shell.midsurface()
    return now - start


def tip_of(length, n):
    """Deflection under a unit force at the tip of a cantilever of n cells, 1 m wide [m/N].

    The points in the middles of the cells take the place of the integral of (L - x)^2 / EI.
    """
    return length**3 / (3 * EI) * (1 - 1 / (4 * n**2)) + length / GA


@pytest.mark.mpi
@pytest.mark.parametrize("to", ["stiff block", "higher block", "rigid body"])
@pytest.mark.fast_on_ranks("higher block")
def test_a_plate_tied_to_what_does_not_yield(to):
    """Its tip deflects as that of a cantilever."""
    force = 1e-3
    body = strip(forces=[nts.LineForce((0, 0, force), where=at(0, LONG))])
    joints = []
    if to == "rigid body":
        mass, inertia, centre = 1.0, (1.0,) * 3, (-0.1, 0.2, 0.0)
        base = nts.RigidBody.from_inertia(mass, inertia, centre, comm=MPI.COMM_WORLD)
        joints.append(nts.Fixed(base, None, point=centre))
    else:
        high = THICK if to == "stiff block" else 3 * THICK
        held = nts.Dirichlet(at(0, -0.2))
        base = block((2, 2, round(high / THICK)), 0.2, high, 1e9 * YOUNG, bcs=[held])
    joints.append(nts.Tie(base, root(body)))
    run = nts.equilibrium(nts.System([body, base], joints=joints))
    assert run.status == "completed"
    assert moved(body)[-1, 2] == pytest.approx(force * tip_of(LONG, 8), rel=1e-6)


@pytest.mark.mpi
@pytest.mark.parametrize("n", [10, 20])
@pytest.mark.fast_on_ranks("10")
def test_a_constant_moment_passes_a_tie(n):
    """From a strip to a block of the same section: both bend as each does alone.

    Trilinear hexahedra of length a and height t are stiffer by 1 + (a/t)^2 / 2 where nu = 0.
    """
    moment, length = 1e-3, 1.0
    body = strip(forces=[nts.LineMoment((0, -moment, 0), where=at(0, LONG))])
    base = block((n, 2, 1), length, bcs=[nts.Dirichlet(at(0, -length))])
    run = nts.equilibrium(nts.System([body, base], joints=[nts.Tie(base, root(body))]))
    bend = moment / EI
    locked = bend / (1 + 0.5 * (length / n / THICK) ** 2)
    x, now = body.midsurface()
    expected = 0.5 * locked * length**2 + locked * length * x[:, 0] + 0.5 * bend * x[:, 0] ** 2
    assert run.status == "completed"
    assert now[:, 2] == pytest.approx(expected, rel=1e-9, abs=1e-9 * expected.max())


@pytest.mark.mpi
def test_a_constant_pull_passes_a_tie():
    """By a third: S = E e with e = (s^2 - 1)/2 and a force of s S in both bodies."""
    pull = 0.4 * EA
    body = strip(forces=[nts.LineForce((pull, 0, 0), where=at(0, LONG))])
    base = block((3, 2, 1), 1.0, bcs=[nts.Dirichlet(at(0, -1.0))])
    run = nts.equilibrium(nts.System([body, base], joints=[nts.Tie(base, root(body))]))
    stretch = brentq(lambda s: 0.5 * s * (s**2 - 1) * EA - pull, 1.0, 2.0)
    x, now = body.midsurface()
    expected = np.column_stack([stretch * (x[:, 0] + 1) - 1, x[:, 1:]])
    assert run.status == "completed"
    assert now == pytest.approx(expected, abs=1e-9)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_the_end_of_a_beam_in_a_stiff_block():
    force = 1e-3
    beam = bar(forces=[nts.PointForce(at(0, LONG), (0, 0, force))])
    base = block((2, 4, 2), 0.2, 0.3, 1e9 * YOUNG, bcs=[nts.Dirichlet(at(0, -0.2))])
    run = nts.equilibrium(nts.System([beam, base], joints=[nts.Tie(base, root(beam))]))
    _, now = beam.centreline()
    assert run.status == "completed"
    assert now[-1, 2] == pytest.approx(force / THICK * tip_of(LONG, 8), rel=1e-6)


# ---- seams
def tee(angle, n, clamped, scale=1.0, comm=MPI.COMM_WORLD, force=0.0, **options):
    """A wall that stands on the middle of a floor at an angle [degrees]."""
    a = np.deg2rad(angle)
    x = plate_nodes(2 * n, 2, LONG, DEEP) - np.array([LONG / 2, 0, 0])
    along, across, _ = plate_nodes(n, 2, LONG, DEEP).T
    y = np.column_stack([along * np.cos(a), across, along * np.sin(a)])
    ends = [nts.Clamp(lambda x: np.abs(x[0]) > LONG / 2 - 1e-9)] if clamped else []
    load = [nts.LineForce((force, 0, 0), where=at(2, np.sin(a) * LONG))] if force else []
    common = {"scale": scale, "comm": comm, **options}
    floor = sheet(x, 2 * n, 2, "floor", bcs=ends, **common)
    wall = sheet(y, n, 2, "wall", forces=load, **common)
    return floor, wall, nts.Seam(floor, wall.surface(at(2, 0.0, scale), side="edge"))


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_a_wall_on_a_clamped_floor():
    """A force on its top turns the seam and moves it; both halves of the floor share the moment."""
    force, n, half = 1e-3, 8, LONG / 2
    floor, wall, seam = tee(90, n, True, force=force)
    run = nts.equilibrium(nts.System([floor, wall], joints=[seam]))
    moment = 0.5 * force * LONG
    # Each half: a cantilever whose tip turns by the moment and is kept where it is by a force.
    mixed = half**2 / (2 * EI)
    turn = moment * (half / EI - mixed**2 / tip_of(half, n))
    expected = force * tip_of(LONG, n) + turn * LONG + force * half / (2 * EA)
    assert run.status == "completed"
    assert moved(wall)[-1, 0] == pytest.approx(expected, rel=1e-9)


# ---- dynamics
def flight(kind, scale=1.0, comm=MPI.COMM_WORLD):
    """Bodies that are joined and turn."""
    common = {"scale": scale, "comm": comm, "velocity": turning}
    if kind == "tee":
        *bodies, joint = tee(90, 4, False, **common)
    elif kind == "leaning wall":
        *bodies, joint = tee(45, 4, False, **common)
    else:
        thin = (strip if "shell" in kind else bar)(4, **common)
        if "rigid" in kind:
            base = nts.RigidBody.from_inertia(
                5.0, (0.1 * scale**2, 0.2 * scale**2, 0.25 * scale**2),
                (-0.1 * scale, 0.0, 0.0), angular_velocity=SPIN, comm=comm,
                velocity=np.cross(SPIN, (-0.1 * scale, 0.0, 0.0)),
            )  # fmt: skip
        else:
            base = block((2, 2, 2), 0.2, 0.3, **common)
        bodies, joint = [thin, base], nts.Tie(base, root(thin, scale))
    run = nts.simulate(nts.System(bodies, joints=[joint]), EM, dt=0.01, t_end=0.2,
                       project_start=True)  # fmt: skip
    thin = bodies[0]
    places = (thin.centreline if isinstance(thin, nts.Beam) else thin.midsurface)()[1]
    return run, places / scale


FLIGHTS = [
    "shell on continuum", "shell on rigid", "beam on continuum", "beam on rigid", "tee",
    "leaning wall",
]  # fmt: skip


@pytest.mark.mpi
@pytest.mark.parametrize("kind", FLIGHTS)
@pytest.mark.fast_on_ranks()
@pytest.mark.fast("tee")
def test_joined_bodies_in_flight_keep_what_is_kept(kind):
    """Energy, momentum and angular momentum; ranks give the motion of one."""
    run, x = flight(kind)
    balance = run.balance
    assert run.status == "completed" and run.retries == 0
    assert balance["energy"] == pytest.approx(balance["energy"][0], rel=1e-12)
    assert balance["potential"].max() > 1e-4 * balance["energy"][0]
    for name in ("linear_momentum", "angular_momentum"):
        size = np.abs(balance[name]).max()
        assert np.abs(balance[name] - balance[name][0]).max() < 1e-12 * size
    _, alone = flight(kind, comm=MPI.COMM_SELF)
    assert np.abs(x - alone).max() < 1e-9


# ---- bad input
@pytest.mark.mpi
@pytest.mark.parametrize(
    ("make", "kind", "text"),
    [
        (lambda: nts.Tie(strip(), root(bar())), ValueError,
         r"body='strip': only nodes of a beam or shell are points of it; .*join shells by Seam"),
        (lambda: nts.Tie(block((1, 1, 1), 1.0), strip().surface(at(0, LONG), side="edge")),
         ValueError, "surface of 'tie of block and strip': x=.*lies in no cell of body 'block'"),
        (lambda: nts.Seam(block((1, 1, 1), 1.0), root(strip())), TypeError, "pass a Shell; Tie"),
        (lambda: nts.Seam(strip(), root(bar())), TypeError, "of a shell"),
        (lambda: nts.Seam(strip(), strip().midsurface), TypeError, "of a shell"),
        (lambda: nts.Seam(tee(90, 4, False)[0], tee(90, 4, False)[1].surface()), ValueError,
         "edge: is the top or the bottom of shell 'wall'; pass other.surface.*side=.edge"),
        (lambda: tee(15, 2, False), ValueError,
         "meets shell 'floor' at 15 degrees at x=.*make one mesh of both"),
        (lambda: nts.Seam(tee(90, 4, False)[0], tee(90, 4, False)[1].surface(
            at(2, LONG), side="edge")), ValueError,
         "edge of 'seam of floor and wall': x=.*is no node of shell 'floor'"),
    ],
)  # fmt: skip
def test_bad_input_is_told(make, kind, text):
    with pytest.raises(kind, match=text):
        make()


@pytest.mark.mpi
def test_surfaces_of_the_body_itself_are_told():
    cube, plate = block((1, 1, 1), 1.0), strip(2)
    with pytest.raises(ValueError, match="surface: is one of body 'block' itself"):
        nts.Tie(cube, cube.surface(at(0, 0.0)))
    with pytest.raises(ValueError, match="edge: is one of shell 'strip' itself"):
        nts.Seam(plate, root(plate))


@pytest.mark.mpi
@pytest.mark.parametrize(("cells", "free"), [((4, 4, 2), 9), ((3, 4, 1), 4)])
def test_a_body_finer_than_what_is_tied_to_it_is_refused(cells, free):
    """Its free nodes on the edge would let the tie give way: by 8 % of (4, 4, 2) cells."""
    body, base = strip(), block(cells, 1.0)
    with pytest.raises(ValueError, match=f"^surface of 'tie of .*': {free} nodes of 'block' lie"):
        nts.Tie(base, root(body))
