"""`sleep=True`: what nothing moves costs nothing, and the run is the one without it."""

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box
from mpi4py import MPI
from test_friction import difference

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
INTEGRATORS = {"midpoint": nts.Midpoint(), "energy-momentum": nts.EnergyMomentum()}
DT = 2e-3


def cube(low, name, *, cells=2, metre=1.0, **options):
    """A unit cube at rest unless said otherwise."""
    low = metre * np.asarray(low, dtype=float)
    mesh = create_box(
        COMM, [low, low + metre], [cells] * 3, CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    rubber = nts.NeoHookean(young=1e6 / metre, poisson=0.3)
    return nts.Continuum(mesh, rubber, density=1e3 / metre**3, name=name, **options)


def face(body, end):
    """Surface of a cube in a row that looks back (0) or ahead (1) along x."""
    x = body.mesh.geometry.x[:, 0]
    place = COMM.allreduce(float(x[:].max(initial=-np.inf)), op=MPI.MAX)
    if end == 0:
        place = COMM.allreduce(float(x[:].min(initial=np.inf)), op=MPI.MIN)
    width = 1e-9 * max(1.0, abs(place))
    return body.surface(lambda x: np.abs(x[0] - place) < width)


def pair(slave, master, **options):
    return nts.ContactPair(face(slave, 1), face(master, 0), **options)


def row(metre=1.0, friction=(0.0, 0.0, 0.0), gaps=(0.05, 0.02, 0.3), **options):
    """A thrown cube and three at rest, of different meshes so that slaves have a facet each."""
    starts, bodies = np.cumsum([0.0, *(1.0 + np.array(gaps))]), []
    for k, start in enumerate(starts):
        throw = {"velocity": (4.0 * metre, 0.1 * metre, 0.0)} if k == 0 else {}
        more = options if k == len(starts) - 1 else {}
        low = (start, -0.07 * k, -0.05 * k)
        bodies.append(cube(low, "abcd"[k], cells=2 + k % 2, metre=metre, **throw, **more))
    contacts = [
        pair(a, b, friction=mu) for a, b, mu in zip(bodies, bodies[1:], friction, strict=False)
    ]
    return nts.System(bodies, contacts=contacts)


def run(system, steps, *, sleep, integrator="energy-momentum", dt=DT, **newton):
    """Stepper after some steps, and of each which bodies were awake."""
    s = nts.Stepper(system, INTEGRATORS[integrator], newton=nts.Newton(**newton), sleep=sleep)
    awake = []
    for _ in range(steps):
        s.advance(dt)
        awake.append("".join(system.bodies[k].name for k in s.problem.awake))
    s.close()
    return s, awake


def both(make, steps, **options):
    """The same scene with and without sleep."""
    (a, awake), (b, _) = (run(make(), steps, sleep=on, **options) for on in (True, False))
    return a, b, awake


def assert_same(a, b, tolerance=1e-12):
    for name in ("u", "v"):
        one, two = (np.concatenate(getattr(s.state, name)) for s in (a, b))
        top = COMM.allreduce(np.abs(two).max(initial=0.0), op=MPI.MAX)
        assert COMM.allreduce(np.abs(one - two).max(initial=0.0), op=MPI.MAX) <= tolerance * top
    one, two = a.solution.balance, b.solution.balance
    for name in ("active", "stick", "slip", "newton_iterations"):
        assert np.array_equal(one[name], two[name]), name
    assert difference(one, two) < tolerance


# ---- a row of cubes
@pytest.mark.mpi
@pytest.mark.parametrize("newton", [{}, {"condense": True, "linear_solver": "krylov"}])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_cubes_sleep_until_they_are_reached(integrator, newton):
    a, b, awake = both(row, 30, integrator=integrator, **newton)
    print(awake)
    assert_same(a, b)
