"""Equilibrium by an algebraic multigrid of the augmented Lagrangian, against MUMPS."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box

import dolfinx_nts as nts
from dolfinx_nts.solve.augmented import augmented

COMM = MPI.COMM_WORLD
RUBBER = nts.NeoHookean(young=1e6, poisson=0.3)


def block(name, low, high, cells, **options):
    mesh = create_box(COMM, [low, high], cells, CellType.hexahedron)
    return nts.Continuum(mesh, RUBBER, density=1e3, name=name, **options)


def face(body, z):
    return body.surface(lambda x: np.abs(x[2] - z) < 1e-9)


def scene(between):
    """A block on another, with friction, the upper one sheared; None, or a rigid lid, lies between.

    Nothing but contact holds up what lies on the lower one.
    """
    foot = nts.Dirichlet(lambda x: x[2] < 1e-9)
    lower = block("lower", [0, 0, 0], [1, 1, 1], [5, 5, 5], bcs=[foot])
    bodies, thick = [lower], 0.1 if between == "lid" else 0.0
    if between == "lid":
        lid = create_box(COMM, [[0.1, 0.1, 1], [0.9, 0.9, 1.1]], [3, 3, 1], CellType.hexahedron)
        bodies.append(nts.RigidBody(lid, density=2e4, name="lid"))
    top = 1.6 + thick
    sheared = nts.Dirichlet(
        lambda x: x[2] > top - 1e-9, value=lambda t: (2e-3 * t, 0, 0), components=(0, 1)
    )
    bodies.append(block("upper", [0.2, 0.2, 1 + thick], [0.8, 0.8, top], [4, 4, 4], bcs=[sheared]))
    if between == "lid":
        faces = [(bodies[1], lower, 1.0), (bodies[2], bodies[1], 1.1)]
    else:
        faces = [(bodies[1], lower, 1.0)]
    pairs = [nts.ContactPair(face(a, z), face(b, z), friction=0.4) for a, b, z in faces]
    return nts.System(bodies, contacts=pairs, gravity=(0, 0, -9.81))


def by_place(body):
    """Displacements of all nodes in the order of their places: which rank has one is by chance."""
    both = body.reference.round(9), body.u.x.array[: body.num_owned]
    x, u = (np.concatenate(COMM.allgather(a.reshape(-1, 3))) for a in both)
    return u[np.lexsort(x.T)]


@pytest.mark.mpi
@pytest.mark.parametrize("between", [None, "lid"])
@pytest.mark.parametrize("options", [{}, {"reuse": True, "rtol": 1e-11}], ids=["exact", "reuse"])
@pytest.mark.fast("exact-lid", "reuse-None")
@pytest.mark.fast_on_ranks()
def test_same_equilibrium_as_with_mumps(between, options):
    """To 1e-9 of the largest displacement; supports to the bit, which a coarse grid would move."""
    found = []
    for solver in ("direct", "multigrid"):
        system = scene(between)
        newton = nts.Newton(linear_solver=solver, max_retries=0, **options)
        run = nts.equilibrium(system, newton=newton)
        assert run.status == "completed" and run.rows[-1]["active"] >= 25
        found.append([*(by_place(b) for b in system.bodies if not b.joints), run.rows[-1]])
        upper = system.bodies[-1]
        assert set(run.state.u[-1][upper.fixed].tolist()) <= {0.0, 2e-3}
    *displacements, (one, other) = zip(*found, strict=True)
    for a, b in displacements:
        assert np.abs(a - b).max() <= 1e-9 * COMM.allreduce(np.abs(a).max(), op=MPI.MAX)
    assert one["energy"] == pytest.approx(other["energy"], rel=1e-9)


def test_a_body_alone():
    """Without contact the multigrid takes the whole matrix; a failure names the preset."""
    found = []
    for solver, limit in (("direct", {}), ("multigrid", {}), ("multigrid", {"ksp_max_it": 1})):
        foot = nts.Dirichlet(lambda x: x[2] < 1e-9)
        body = block("body", [0, 0, 0], [1, 1, 2], [5, 5, 10], bcs=[foot])
        run = nts.equilibrium(
            nts.System([body], gravity=(0, 0, -9.81)), petsc_options=limit,
            newton=nts.Newton(linear_solver=solver, max_retries=0),
        )  # fmt: skip
        found.append(body.u.x.array.copy())
        assert (run.status == "completed") == (not limit)
    assert "'multigrid' failed, KSP reason -3" in run.status
    assert np.abs(found[1] - found[0]).max() <= 1e-9 * np.abs(found[0]).max()


def inverse_times(tangent, changed, k):
    """Matrix of the system after the preconditioner, dense."""
    y = np.linalg.solve(changed[k:, k:], tangent[k:])
    x = np.linalg.solve(changed[:k, :k], tangent[:k] - changed[:k, k:] @ y)
    return np.concatenate([x, y])


def test_eigenvalues_after_the_augmented_preconditioner():
    """In (0, 1] where the constraints hold, and all 1 where nothing but them resists."""
    rng = np.random.default_rng(0)
    k, m = 9, 3
    b = rng.normal(size=(k, m))
    root = rng.normal(size=(k, k))
    full = root @ root.T
    tangent = np.block([[full, b], [b.T, np.zeros((m, m))]])
    (changed,) = augmented(tangent[None], np.diag(full)[None])
    values = np.linalg.eigvals(inverse_times(tangent, changed, k))
    assert np.abs(values.imag).max() < 1e-6 and 0 < values.real.min()
    assert values.real.max() < 1 + 1e-6
    c = rng.normal(size=(m, m))
    rigid = np.block([[np.zeros((m, m)), c], [c.T, np.zeros((m, m))]])
    (changed,) = augmented(rigid[None], np.ones((1, m)))
    # Double eigenvalues show half the digits.
    assert np.abs(np.linalg.eigvals(inverse_times(rigid, changed, m)) - 1).max() < 1e-6


def test_what_does_not_act_is_left_as_it_is():
    """Rows of open contacts D y = g have no part in the bodies' matrix."""
    tangent = np.diag([1.0, 2.0, 3.0, 5.0])[None]
    assert np.array_equal(augmented(tangent, np.ones((1, 3))), tangent)
    assert augmented(tangent, np.ones((1, 4))) is tangent
