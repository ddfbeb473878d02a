"""Bodies that a step evaluates together have the terms that each of them has alone."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from lines import interval_mesh
from shells import grid, plate_nodes, surface_mesh

import dolfinx_nts as nts
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.ledger import balance

COMM = MPI.COMM_WORLD
GRAVITY = np.array([1.0, -2.0, -9.0])
H = 0.02


def rigid(k, **options):
    """A rigid body of its own size, place and motion."""
    rng = np.random.default_rng(k)
    given = {"velocity": rng.normal(size=3), "angular_velocity": rng.normal(size=3)} | options
    return nts.RigidBody.from_inertia(
        1.0 + k, np.array([3.0, 4.0, 5.0]) * 10.0 ** (-k), centre=(2.0 * k, 0, 0), name=f"body {k}",
        **given,
    )  # fmt: skip


def scene():
    """Four plain bodies, one under a torque and one that is driven; joints of several kinds."""
    plain = [rigid(k) for k in range(4)]
    turned = rigid(4, torque=(0.1, 0.2, 0.3))
    driven = rigid(5, velocity=(0, 0, 0), motion=lambda t: (np.sin(t), 0, 0))
    a, b, c, d = plain
    joints = [
        nts.Spherical(a, None, point=(0, 1, 0), name="pivot"),
        nts.Revolute(b, a, point=(1, 0, 0), axis=(0, 1, 2), name="hinge 1"),
        nts.Revolute(c, b, point=(3, 0, 0), axis=(1, 1, 0), name="hinge 2"),
        nts.Spherical(d, c, point=(5, 0, 0), name="ball"),
        nts.Spherical(turned, d, point=(7, 0, 0), name="to the turned one"),
        nts.Spring(driven, turned, ((10, 0, 0), (8, 1, 0)), stiffness=3.0, name="spring"),
    ]
    # In an order in which those that are evaluated together are not next to each other.
    return nts.System([a, turned, b, driven, c, d], joints=joints, gravity=GRAVITY)


def moving(k):
    rng = np.random.default_rng(k)
    return {"velocity": rng.normal(size=3), "angular_velocity": rng.normal(size=3)}


def rope(k, cells, section, **options):
    """A rope of its own length, place and motion, a metre beside the one before it."""
    mesh = interval_mesh(np.linspace([0, k, 0], [1.0 + k, k, 0.1 * k], cells + 1))
    return nts.Beam(mesh, section, name=f"rope {k}", **moving(k) | options)


def plate(place, cells, name, side=1.0, **options):
    mesh = surface_mesh(plate_nodes(*cells, side, 1.0) + place, grid(*cells))
    given = {"young": 1e6, "poisson": 0.3, "thickness": 0.02, "density": 1e3} | options
    return nts.Shell(mesh, name=name, **given)


def thin_scene():
    """Ropes of one kind and one that is clamped, plates of two kinds; two ropes hang together."""
    rubber = {"young": 1e6, "poisson": 0.3, "density": 1e3}
    section = nts.Circle(0.02).section(**rubber)
    stiffer = nts.Circle(0.02).section(**rubber | {"young": 2e6})
    clamp = nts.Clamp(lambda x: x[0] < 1e-9)
    still = {"velocity": (0, 0, 0), "angular_velocity": (0, 0, 0)}
    a, b, c = rope(0, 3, section), rope(1, 4, section), rope(2, 2, stiffer)
    held = rope(3, 2, section, bcs=[clamp], **still)
    thick = plate((0, 9, 0), (2, 1), "thick", thickness=0.03)
    plates = [
        plate((0, 5 + 2 * k, 0), (2, 2 + k), f"plate {k}", 1.0 + k, **moving(k)) for k in range(2)
    ]
    joints = [
        nts.Spherical(a, None, point=(0, 0, 0), name="hook"),
        nts.Spherical(b, None, point=(0, 1, 0), name="other hook"),
        nts.Spring(a, b, ((1, 0, 0), (2, 1, 0.1)), stiffness=3.0, name="spring"),
    ]
    bodies = [a, plates[0], held, b, thick, c, plates[1]]
    return nts.System(bodies, joints=joints, gravity=GRAVITY)


@pytest.fixture
def alone(monkeypatch):
    """Makes systems whose bodies are evaluated one by one."""

    def make(make_scene=scene):
        with monkeypatch.context() as patch:
            for kind in (nts.RigidBody, nts.Beam, nts.Shell):
                patch.setattr(kind, "alike", None)
            system = make_scene()
            assert not system.batches.several
        return system

    return make


def gathered(values):
    """Arrays of a body on all ranks, in their order: a rigid body has all on one."""
    return np.concatenate(COMM.allgather(np.asarray(values)))


def begun(system, integrator, seed=3):
    """A step's problem of a state with any velocities, and its evaluation at any iterate."""
    problem = StepProblem(system, integrator, rtol=1e-10, condense=True)
    state, rng = system.initial_state(), np.random.default_rng(seed)

    def noise(size):
        # The same whatever rank a body lives on; systems that are compared divide alike.
        each = [size * rng.normal(size=max(12, b.num_owned)) for b in system.bodies]
        return tuple(a[: b.num_owned] for a, b in zip(each, system.bodies, strict=True))

    v = tuple(a + b for a, b in zip(state.v, noise(0.1), strict=True))
    a = noise(1.0) if integrator.accelerations else ()
    problem.begin(nts.State(state.time, state.u, v, a, state.contacts, state.joints), H)
    moved = noise(1e-2)
    with problem.x as x:
        for k, own in enumerate(moved):
            x[problem.laid.of_body(k)] += own
    return problem, problem.evaluate(problem.x)


def compare(problem, e, other, expected):
    """Terms of each body and norms of rounding, of all bodies together and one by one."""
    assert len(problem.elements) < len(other.elements)
    for k, (one, two) in enumerate(zip(e.bodies, expected.bodies, strict=True)):
        for name in ("u1", "du", "internal", "external", "coupling", "residual"):
            found, right = (gathered(getattr(terms, name)) for terms in (one, two))
            size = max(np.abs(right).max(), 1e-12)
            assert found.shape == right.shape
            assert np.abs(found - right).max() <= 1e-13 * size, (k, name)
    for p in (problem, other):
        p.rounding.measure(p.awake)
    assert problem.rounding.forces == pytest.approx(other.rounding.forces, rel=1e-12)


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", [nts.EnergyMomentum(), nts.GeneralizedAlpha()])
def test_terms_are_those_of_members(integrator, alone):
    system, single = scene(), alone()
    assert system.batches.numbers == [[0, 2, 4, 5], [1], [3]]
    (problem, e), (other, expected) = (begun(s, integrator) for s in (system, single))
    # Hinges together, others by themselves; of what holds bodies together all in one but of two.
    assert [len(of) for _, of in problem.couplings.joints].count(2) == 1
    compare(problem, e, other, expected)
    # By hand: h^2/2 times the weight at the centre of mass, nothing on the directors.
    heavy = gathered(e.bodies[4].external)
    factor = integrator.factor(H)
    assert heavy[:3] == pytest.approx(factor * 3.0 * GRAVITY, rel=1e-14)
    assert not heavy[3:].any()
    for p in (problem, other):
        p.destroy()


@pytest.mark.mpi
@pytest.mark.parametrize("integrator", [nts.EnergyMomentum(), nts.Newmark()])
def test_terms_of_beams_and_shells_are_those_of_members(integrator, alone):
    system, single = thin_scene(), alone(thin_scene)
    assert system.batches.numbers == [[0, 3, 5], [1, 6], [2], [4]]
    (problem, e), (other, expected) = (begun(s, integrator) for s in (system, single))
    compare(problem, e, other, expected)
    for p in (problem, other):
        p.destroy()


@pytest.mark.mpi
def test_energies_and_momenta_are_those_of_members(alone):
    system, single = scene(), alone()
    one, two = (balance.measure(s, s.initial_state()) for s in (system, single))
    for name, value in two.items():
        assert one[name] == pytest.approx(value, rel=1e-13, abs=1e-13), name
    linear = sum((1.0 + k) * np.random.default_rng(k).normal(size=3) for k in range(5))
    assert one["linear_momentum"] == pytest.approx(linear, rel=1e-13)


@pytest.mark.mpi
@pytest.mark.parametrize("make", [scene, thin_scene])
def test_matrix_is_the_derivative_of_the_residual(make):
    integrator = nts.EnergyMomentum()
    stepper = nts.Stepper(make(), integrator, project_start=True)
    stepper.advance(H)
    problem = stepper.problem
    matrix = stepper.solver.assemble(problem.evaluate(problem.x)).operator
    way, there = problem.x.duplicate(), problem.x.duplicate()
    here = slice(0, problem.laid.of_elements("constraints").start)
    values = np.zeros(len(problem.x.array_r))
    values[here] = np.random.default_rng(COMM.rank).normal(size=here.stop)
    values[problem.laid.held] = 0.0
    way.array_w[:] = values
    matrix.mult(way, there)
    found, ends = there.array_r.copy(), []
    for step in (1e-5, -1e-5):
        problem.x.copy(there)
        there.axpy(step, way)
        ends.append(problem.residual(problem.evaluate(there)))
    expected = (ends[0] - ends[1]) / 2e-5
    size = COMM.allreduce(float(np.abs(expected).max(initial=0.0)), op=MPI.MAX)
    assert np.abs(found - expected).max(initial=0.0) < 1e-8 * size
    for vector in (way, there):
        vector.destroy()
    stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize("make", [scene, thin_scene])
@pytest.mark.parametrize("integrator", [nts.EnergyMomentum(), nts.Newmark()])
@pytest.mark.fast("integrator0-scene")
@pytest.mark.fast_on_ranks()
def test_runs_are_the_same(integrator, make, alone):
    """Reactions, ledger and what joints remember, too."""
    runs = [
        nts.simulate(system, integrator, dt=H, t_end=5 * H, project_start=True)
        for system in (make(), alone(make))
    ]
    one, two = (run.balance for run in runs)
    assert one.keys() == two.keys()
    for name in one.keys() - {"newton_iterations", "ledger_residual"}:
        a, b = np.asarray(one[name], dtype=float), np.asarray(two[name], dtype=float)
        size = np.abs(b[np.isfinite(b)]).max(initial=0.0)
        assert np.array_equal(np.isfinite(a), np.isfinite(b)), name
        both = np.isfinite(b)
        assert np.abs(a[both] - b[both]).max(initial=0.0) <= 1e-8 * max(size, 1e-3), name
    for a, b in zip(runs[0].state.joints, runs[1].state.joints, strict=True):
        if a is not None:
            size = COMM.allreduce(float(np.abs(b).max(initial=0.0)), op=MPI.MAX)
            assert a.shape == b.shape
            assert np.abs(a - b).max(initial=0.0) <= 1e-7 * max(size, 1e-3)


def blocks():
    """A row of cubes without gravity, the first of which flies at the others."""

    def cube(k, velocity=(0, 0, 0)):
        ends = [[1.2 * k, 0, 0], [1.2 * k + 1, 1, 1]]
        mesh = create_box(COMM, ends, [1, 1, 1], CellType.hexahedron)
        return nts.RigidBody(mesh, density=1.0, velocity=velocity, name=f"cube {k}")

    cubes = [cube(0, (4, 0, 0)), cube(1), cube(2), cube(3)]
    contacts = [
        nts.ContactPair(
            slave=b.surface(lambda x, at=1.2 * k: x[0] < at + 1e-9),
            master=a.surface(lambda x, at=1.2 * k - 0.2: x[0] > at - 1e-9),
        )
        for k, (a, b) in enumerate(zip(cubes, cubes[1:], strict=False), start=1)
    ]
    return nts.System(cubes, contacts=contacts)


def plates():
    """A stack of small plates without gravity, the first of which flies at the others."""

    stack = [
        plate(
            (0, 0, 0.1 * k), (2, 2), f"plate {k}", thickness=0.05, density=20.0,
            velocity=(0, 0, 4.0 * (k == 0)),
        )
        for k in range(4)
    ]  # fmt: skip
    contacts = [
        nts.ContactPair(slave=b.surface(side="bottom"), master=a.surface(side="top"))
        for a, b in zip(stack, stack[1:], strict=False)
    ]
    return nts.System(stack, contacts=contacts)


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_plates_sleep_one_by_one(alone):
    seen = []
    for system in (plates(), alone(plates)):
        stepper = nts.Stepper(system, nts.EnergyMomentum(), sleep=True)
        awake = []
        for _ in range(12):
            stepper.advance(0.002)
            awake.append(stepper.problem.awake)
        seen.append((awake, [gathered(u) for u in stepper.state.u], stepper.solution.balance))
        stepper.close()
    (awake, u, table), (expected, right, _) = seen
    assert awake == expected and awake[0] == (0,) and 1 in awake[-1]
    assert all((a.any() == b.any()) for a, b in zip(u, right, strict=True))
    top = max(np.abs(b).max() for b in right)
    assert max(np.abs(a - b).max() for a, b in zip(u, right, strict=True)) < 1e-9 * top
    assert np.abs(table["ledger_residual"]).max() < 1e-10 * table["energy"][0]


@pytest.mark.mpi
@pytest.mark.fast_on_ranks()
def test_bodies_sleep_one_by_one(alone):
    """A blow runs along a row of cubes, which wake up one after the other."""
    seen = []
    for system in (blocks(), alone(blocks)):
        stepper = nts.Stepper(system, nts.EnergyMomentum(), sleep=True)
        awake = []
        for _ in range(12):
            stepper.advance(0.01)
            awake.append(stepper.problem.awake)
        still = [k for k in range(4) if k not in stepper.problem.awake]
        assert all(not gathered(stepper.state.u[k]).any() for k in still)
        speeds = [body.velocity for body in system.bodies]
        seen.append((awake, np.array(speeds), stepper.solution.balance["energy"]))
        stepper.close()
    (awake, speeds, energy), (expected, right, whole) = seen
    assert awake == expected and awake[0] == (0,) and 1 in awake[-1]
    assert np.abs(speeds - right).max() < 1e-9 * 4.0
    assert speeds[:, 0].sum() == pytest.approx(4.0, rel=1e-12)
    assert energy == pytest.approx(whole, rel=1e-10)


@pytest.mark.mpi
def test_a_message_names_the_joint():
    """One of two hinges that are evaluated together is turned over in a step."""
    a, b, c, d = (rigid(k, velocity=(0, 0, 0), angular_velocity=(0, 0, 0)) for k in range(4))
    spun = rigid(6, velocity=(0, 0, 0), angular_velocity=(0, 0, 30.0))
    joints = [
        nts.Revolute(b, a, point=(1, 0, 0), axis=(0, 0, 1), name="still"),
        nts.Cylindrical(spun, None, point=(12, 0, 0), axis=(0, 0, 1), name="spun"),
        nts.Cylindrical(c, None, point=(4, 0, 0), axis=(0, 0, 1), name="calm"),
    ]
    run = nts.simulate(
        nts.System([a, b, c, d, spun], joints=joints), nts.EnergyMomentum(), dt=0.05, t_end=0.1
    )
    assert "body 6" in run.warnings["turns"].text
