"""Friction where some slip is prescribed, as in plane strain: what lambda_T is there."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box
from integrators import MID_STEP
from pairs import pairs
from scenes import RUBBER

import dolfinx_nts as nts
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.integrators import Static
from dolfinx_nts.interaction.elements import evaluate_together

COMM = MPI.COMM_WORLD
#: Twist, skew and smoothing of `held_across`.
SHAPES = [(0.0, 0.0, False), (0.2, 0.0, False), (0.0, 0.5, False), (0.2, 0.5, True)]


def held_across(friction, twist, skew, smoothing, drag, integration="nodes"):
    """A block pressed on a plate and dragged along it; no node moves across, along z.

    Args:
        friction: Coulomb's coefficient.
        twist: Turn of the surfaces about x per length of x, which tilts their normals.
        skew: Shear of the plate in its plane, which makes its facets parallelograms.
        smoothing: Of the plate.
        drag: Path of the block [m] from pseudo time 1 to 2.
        integration: As of `ContactPair`.
    """

    def box(low, high, n):
        kind, ghost = CellType.hexahedron, GhostMode.shared_facet
        mesh = create_box(COMM, [low, high], n, kind, ghost_mode=ghost)
        x = mesh.geometry.x
        x[:, 1] += twist * x[:, 0] * (x[:, 2] - 0.15)
        return mesh

    ground = box([-1, -0.5, 0], [2, 0, 0.3], [8, 2, 1])
    ground.geometry.x[:, 0] += skew * (ground.geometry.x[:, 2] - 0.15)
    upper = box([0.2, 0, 0], [0.8, 0.4, 0.3], [3, 2, 1])
    across = nts.Dirichlet(lambda x: np.full(x.shape[1], True), components=(2,))
    bottom = nts.Dirichlet(lambda x: x[1] < -0.4)
    top = nts.Dirichlet(
        lambda x: x[1] > 0.3,
        value=lambda t: (drag * max(0.0, t - 1.0), -0.02 * min(t, 1.0), 0.0),
    )
    plate = nts.Continuum(ground, RUBBER, density=1e3, bcs=[across, bottom], name="plate")
    block = nts.Continuum(upper, RUBBER, density=1e3, bcs=[across, top], name="block")
    pair = nts.ContactPair(
        slave=block.surface(lambda x: x[1] < 0.1),
        master=plate.surface(lambda x: x[1] > -0.1, smoothing=smoothing),
        friction=friction,
        integration=integration,
    )
    return nts.System([plate, block], contacts=[pair])


def dragged(friction, shape, drag, steps, integration="nodes"):
    times = [*np.arange(1, 5) / 4, *(1 + np.arange(1, steps + 1) / steps)]
    run = nts.equilibrium(held_across(friction, *shape, drag, integration), load_steps=times)
    assert run.status == "completed" and run.retries == 0
    return run


def forces(run):
    """p_N, and the length of the friction and its part across of this rank's slaves."""
    tangential = run.state.contacts[0].tangential
    return run.state.contacts[0].force, np.linalg.norm(tangential, axis=1), np.abs(tangential[:, 2])


@pytest.mark.mpi
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.fast("shape3")
@pytest.mark.fast_on_ranks()
def test_dragged_from_stick_to_slip(shape):
    """Over more than a facet; the force is along and what Coulomb says."""
    run = dragged(0.3, shape, 0.3, 8)
    assert run.balance["stick"].max() > 0
    normal, friction, across = forces(run)
    assert np.allclose(friction, 0.3 * normal, rtol=1e-9)
    # The deformed facets are not quite plane, so that "along" turns a little on the way.
    assert (across <= 3e-3 * friction).all()


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("integration", "friction", "rule"), pairs(["nodes", "surface"], [0.3, np.inf], MID_STEP)
)
@pytest.mark.fast("nodes-inf-energy-momentum")
@pytest.mark.fast_on_ranks()
def test_dynamics_on_a_twisted_plate(integration, rule, friction):
    """Dragged on from equilibrium the block slides or sticks; the ledger closes."""
    shape, drag = (0.2, 0.5, False), 0.3 if np.isfinite(friction) else 0.02
    start = dragged(friction, shape, drag, 8, integration)
    integrator = MID_STEP[rule]
    run = nts.simulate(start.system, integrator, dt=2e-3, t_end=2.02, start=start)
    assert run.status == "completed" and run.retries == 0
    table = run.balance
    assert table["active"][-1] >= 4
    if isinstance(integrator, nts.EnergyMomentum):
        top = np.abs(table["external_work"]).max()
        assert np.abs(table["ledger_residual"]).max() < 1e-10 * top


# ---- one element
def at_rest(shape):
    """Step without motion, its contact and the positions, multipliers as in equilibrium."""
    run = dragged(0.6, shape, 0.002, 1)
    problem = StepProblem(run.system, Static(), rtol=1e-12, condense=False)
    problem.begin(run.state, 0.0)
    (contact,) = problem.elements
    (x,) = problem.laid.positions(problem.x, problem.elements)
    node = contact.candidates.node
    force, tangential = run.state.contacts[0].force[node], run.state.contacts[0].tangential[node]
    multiplier = contact.multipliers(force, tangential) / contact.law.scale[:, None]
    problem.destroy()
    return contact, x, multiplier


def evaluate(contact, x, multiplier):
    own = {"augmented": np.empty((contact.num_elements, 0)), "constraints": multiplier}
    return evaluate_together(COMM, [contact], [x], [own])[0]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.fast("shape0", "shape1", "shape2")
def test_rows_are_regular_at_the_edge_of_sticking(shape):
    """Nodes that have not slipped yet but are at Coulomb's bound, as at the start of a step."""
    contact, x, multiplier = at_rest(shape)
    tangents = contact.measure.tangents
    dual = np.linalg.solve(tangents @ tangents.transpose(0, 2, 1), tangents)
    length = np.linalg.norm(np.einsum("na,nai->ni", multiplier[:, -2:], dual), axis=1)
    edge = (1 + 1e-5) * 0.6 * -multiplier[:, 0] / length
    multiplier[:, -2:] *= np.where(multiplier[:, 0] < 0, edge, 1.0)[:, None]
    part = evaluate(contact, x, multiplier)
    touching = multiplier[:, 0] < 0
    assert touching.sum() >= 6 and not part.stick[touching].any()
    singular = np.linalg.svd(part.tangent[touching, -2:, -2:], compute_uv=False)
    assert (singular[:, 1] > 0.01 * singular[:, 0]).all()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sliding", [False, True])
@pytest.mark.fast("False-shape0")
def test_tangent_is_the_derivative_of_the_residual(shape, sliding):
    contact, x, multiplier = at_rest(shape)
    rng = np.random.default_rng(5)
    if sliding:
        x[:, 0, 0] += 0.02 * (1 + rng.random(len(x)))
        multiplier[:, -2:] *= 4.0
    x[..., :2] += 1e-4 * rng.normal(size=x[..., :2].shape)
    multiplier *= 1 + 0.1 * rng.random(multiplier.shape)
    part = evaluate(contact, x, multiplier)
    assert part.active.sum() >= 6
    assert part.stick[part.active].sum() >= 6 - 4 * sliding
    assert (part.active & ~part.stick).sum() >= 4 * sliding
    step, change = 1e-6, rng.normal(size=multiplier.shape)
    motion = rng.normal(size=x.shape) * [1, 1, 0]
    ends = [
        evaluate(contact, x + s * step * motion, multiplier + s * step * change) for s in (1, -1)
    ]
    found = (ends[0].residual - ends[1].residual) / (2 * step)
    direction = np.concatenate([motion.reshape(len(x), -1), change], axis=1)
    expected = np.einsum("nrz,nz->nr", part.tangent, direction)
    scale = np.einsum("nrz,nz->nr", np.abs(part.tangent), np.abs(direction)).max(axis=0)
    assert (np.abs(found - expected) <= 1e-6 * scale).all()


@pytest.mark.mpi
@pytest.mark.parametrize("integration", ["nodes", "surface"])
@pytest.mark.parametrize("drag", [1e-6, 1e-3, 1.0])
def test_nodes_that_are_made_to_slip_feel_friction_however_slow(drag, integration):
    """Prescribed motion along the floor: its supports carry mu times the pressure."""
    kind, ghost = CellType.hexahedron, GhostMode.shared_facet
    mesh = create_box(COMM, [[0, 0, 0], [1, 1, 0.5]], [2, 2, 1], kind, ghost_mode=ghost)
    faces = nts.Dirichlet(
        lambda x: np.full(x.shape[1], True),
        components=(0, 1),
        value=lambda t: (0.6 * drag * t, 0.8 * drag * t, 0),
    )
    top = nts.Dirichlet(
        lambda x: x[2] > 0.5 - 1e-9, components=(2,), value=lambda t: (0, 0, -0.02 * t)
    )
    block = nts.Continuum(mesh, RUBBER, density=1e3, bcs=[faces, top], name="block")
    face = block.surface(lambda x: x[2] < 1e-9)
    floor = nts.Plane((0, 0, 0), (0, 0, 1), name="floor")
    pair = nts.ContactPair(face, floor, friction=0.3, integration=integration)
    run = nts.equilibrium(nts.System([block], contacts=[pair]), load_steps=3)
    assert run.status == "completed"
    force, support = run.contact_forces[1:, 0], run.reactions["block"][1:].sum(axis=1)
    assert np.allclose(force[:, :2], -0.3 * force[:, 2:] * [0.6, 0.8], rtol=1e-9)
    assert np.allclose(force, -support, rtol=1e-9)
