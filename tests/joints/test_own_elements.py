"""A kind of elements from outside the package: a spring with a damper between material points.

It shows all that a joint of one's own needs: the scene's item, its elements, their work and losses.
"""

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from integrators import ACCELERATED, INTEGRATORS
from scenes import box

import dolfinx_nts as nts
from dolfinx_nts.interaction.elements import evaluate_together
from dolfinx_nts.output import BalanceCSV

COMM = MPI.COMM_WORLD


@dataclass(frozen=True, eq=False, kw_only=True)
class SpringElements(nts.PointElements):
    """One spring, on rank 0: V = k/2 (l - L)^2 and a damper c, by theory section 14.

    Forces are taken where the integrator takes them: with `taken_at` None, between both ends of the
    step as a discrete gradient. The damper resists the mean rate of the length.
    """

    stiffness: float
    damping: float
    length: float
    step: nts.Step
    x0: np.ndarray

    @property
    def time(self):
        """Length of the step [s]; load steps of equilibrium take none."""
        return self.step.dt if self.step.integrator.inertia else 0.0

    def evaluate(self, x, own):
        k, c, h = self.stiffness, self.damping, self.time
        weight, theta = self.weights[:, 0] - self.weights[:, 1], self.step.integrator.taken_at
        ends = (self.x0, x) if theta is None else (self.x0 + theta * (x - self.x0),) * 2
        r0, r1, r = (np.einsum("na,nai->ni", weight, y) for y in (*ends, x))
        l0, l1, length = (np.linalg.norm(v, axis=1)[:, None] for v in (r0, r1, r))
        middle, both = 0.5 * (r0 + r1), l0 + l1
        drag = 2.0 * c * (length - self.lengths(self.x0)[:, None]) / (h * both) if h else 0.0 * both
        force = k * (1.0 - 2.0 * self.length / both) + drag
        slope = (2.0 * k * self.length / both - drag) / both
        by_r = 0.5 * force[:, :, None] * np.eye(3) + middle[:, :, None] * (slope * r1 / l1)[:, None]
        by_r = by_r if theta is None else 2.0 * theta * by_r
        if h:
            by_r = by_r + middle[:, :, None] * (2.0 * c / (h * both) * r / length)[:, None]
        factor, n = self.step.factor, len(x)
        residual = factor * np.einsum("na,ni->nai", weight, force * middle)
        tangent = factor * np.einsum("na,nb,nij->naibj", weight, weight, by_r)
        size = self.num_coordinates
        return nts.PointPart(residual.reshape(n, size), tangent.reshape(n, size, size))

    def lengths(self, x):
        weight = self.weights[:, 0] - self.weights[:, 1]
        return np.linalg.norm(np.einsum("na,nai->ni", weight, x), axis=1)


class Spring(nts.Joint):
    """A spring with a damper between points of two bodies."""

    losses = ("damping_dissipation",)

    def __init__(self, a, b, points, *, stiffness, damping=0.0, length=None, name="spring"):
        self.name, self.bodies, self.stiffness, self.damping = name, (a, b), stiffness, damping
        here = slice(0 if a.comm.rank else 1)
        self._sides = tuple(
            body.points(x).select(here) for body, x in zip((a, b), points, strict=True)
        )
        rest = float(np.linalg.norm(np.subtract(*points)))
        self.length = rest if length is None else length

    @property
    def settings(self):
        return {"stiffness": self.stiffness, "damping": self.damping, "length": self.length}

    def _elements(self, step, x0=None):
        elements = _Kept if step else SpringElements
        return elements(
            name=self.name, sides=self._sides, stiffness=self.stiffness, damping=self.damping,
            length=self.length, step=step, x0=x0,
        )  # fmt: skip

    def potential(self, u, history):
        batch = self._elements(None)
        at = batch.reference() + self._gathered(u)
        return float((0.5 * self.stiffness * (batch.lengths(at) - self.length) ** 2).sum())

    def _gathered(self, u):
        """Displacements of the spring's nodes, from all ranks."""
        moved = [side.nodal(values) for side, values in zip(self._sides, u, strict=True)]
        return np.concatenate(moved, axis=1)

    def slopes(self, u, history, when=None):
        """For the warning of steps that do not resolve it."""
        x = self._elements(None).reference() + self._gathered(u)
        weight = self._elements(None).weights
        r = np.einsum("na,nai->ni", weight[:, 0] - weight[:, 1], x)
        r /= np.linalg.norm(r, axis=1)[:, None]
        signs = (1.0, -1.0)
        gradients = [
            side.gathered(sign * side.weights[:, :, None] * r[:, None])
            for sign, side in zip(signs, self._sides, strict=True)
        ]
        return nts.Slopes(gradients, self.stiffness, self.damping)

    def coupling(self, bodies):
        def make(step, history):
            u0 = [step.state.u[b] for b in bodies]
            return self._elements(step, self._elements(None).reference() + self._gathered(u0))

        return nts.EveryStep(bodies, make)


class _Kept(SpringElements):
    """With what the damper takes: c (l_1 - l_0)^2/h."""

    def evaluate(self, x, own):
        part = super().evaluate(x, own)
        return _Part(part.residual, part.tangent, self.lengths(x) - self.lengths(self.x0))

    def ledger(self, part, factor):
        lost = self.damping * float((part.way**2).sum()) / self.time if self.time else 0.0
        return {"damping_dissipation": lost}


class _Part:
    def __init__(self, residual, tangent, way):
        self.residual, self.tangent, self.way = residual, tangent, way
        self.status = np.empty((0, len(residual)), dtype=bool)


def cube(low, name, velocity=(0.0, 0.0, 0.0), **options):
    mesh = box(np.array(low), np.array(low) + 1.0, 2)
    return nts.Continuum(
        mesh, nts.NeoHookean(1e6, 0.3), density=1e3, velocity=velocity, name=name, **options
    )


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("damping", "newton"), [(0.0, {}), (500.0, {}), (500.0, {"linear_solver": "krylov"})]
)
@pytest.mark.fast("500.0-newton2")
@pytest.mark.fast_on_ranks()
def test_a_spring_between_cubes(damping, newton, mpi_tmp_path):
    """Both momenta and the ledger, with what the damper takes as a column of its own."""
    a, b = cube((0, 0, 0), "a"), cube((1.6, 0.2, 0.1), "b", velocity=(2.0, 1.0, 0.0))
    spring = Spring(a, b, [(0.9, 0.4, 0.3), (1.7, 0.5, 0.4)], stiffness=2e4, damping=damping)
    pair = nts.ContactPair(
        slave=a.surface(lambda x: x[0] > 1 - 1e-9), master=b.surface(lambda x: x[0] < 1.6 + 1e-9)
    )
    system = nts.System([a, b], contacts=[pair], joints=[spring])
    path = mpi_tmp_path / "balance.csv"
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=5e-3, t_end=0.2, newton=nts.Newton(**newton),
        output=[BalanceCSV(path)],
    )  # fmt: skip
    table = run.balance
    energy = table["energy"]
    assert run.status == "completed"
    assert np.abs(table["ledger_residual"]).max() < 1e-10 * energy[0]
    for name, size in (("linear_momentum", 2e3), ("angular_momentum", 2e3)):
        assert np.abs(table[name] - table[name][0]).max() < 1e-9 * size
    lost = table["damping_dissipation"]
    assert (np.diff(lost) >= 0).all() and (lost[-1] > 1.0) == bool(damping)
    assert np.allclose(energy[0] - energy - table["contact_defect"], lost, rtol=0, atol=1e-9)
    assert table["potential"].max() > 10.0
    if COMM.rank == 0:
        assert "damping_dissipation [J]" in path.read_text().splitlines()[0]


@pytest.mark.mpi
@pytest.mark.parametrize("rule", INTEGRATORS)
def test_it_is_its_built_in_twin_with_every_integrator(rule):
    """Two tumbling bodies, held at points beside their centres."""

    def energies(kind):
        a, b = (
            nts.RigidBody.from_inertia(
                mass,
                (0.1, 0.2, 0.25),
                centre=(x, 0, 0),
                velocity=(0, speed, 0),
                angular_velocity=(1, 2, speed),
                name=name,
                comm=COMM,
            )  # fmt: skip
            for mass, x, speed, name in ((2.0, 0.0, 0.3, "a"), (3.0, 1.0, -0.2, "b"))
        )
        spring = kind(a, b, [(0.1, 0.2, 0), (0.9, -0.1, 0.1)], stiffness=50.0, length=0.6)
        system = nts.System([a, b], joints=[spring])
        run = nts.simulate(system, INTEGRATORS[rule], dt=0.02, t_end=0.4, accuracy="exact")
        return np.array([run.balance["kinetic"], run.balance["potential"]])

    own, twin = energies(Spring), energies(nts.Spring)
    assert np.ptp(own[1]) > 0.5
    assert own == pytest.approx(twin, rel=0, abs=1e-10)


@pytest.mark.mpi
@pytest.mark.parametrize("stabilization", [None, 0.1])
def test_a_mass_hangs_on_it_at_rest(stabilization):
    """It sags by m g/k; load steps and relaxations take no time, and its damper is at rest."""
    turn = {"rotation": (0, 0, 0)}
    held, mass = (
        nts.RigidBody.from_inertia(10.0, (1, 1, 1), centre=(0, 0, z), name=name, comm=COMM, **more)
        for z, name, more in ((1, "held", {"motion": (0, 0, 0), **turn}), (0, "mass", turn))
    )
    spring = Spring(held, mass, [(0, 0, 1), (0, 0, 0)], stiffness=1e3, damping=5.0)
    system = nts.System([held, mass], joints=[spring], gravity=(0, 0, -9.81))
    nts.equilibrium(system, stabilization=stabilization)
    assert mass.position[2] == pytest.approx(-10.0 * 9.81 / 1e3, rel=1e-9)


def masses(speed=0.0):
    """Two of 1 kg, 1 m apart, and a flexible cube beside them; one moves."""
    a, b = (
        nts.RigidBody.from_inertia(
            1.0, (1, 2, 2.5), centre=(x, 0, 0), velocity=(x * speed, 0, 0), name=name, comm=COMM
        )
        for x, name in ((0, "a"), (1, "b"))
    )
    return a, b, cube((1.5, -0.5, -0.5), "flexible")


def told(bodies, joints, dt=1e-2, steps=0):
    """How many times too fast a spring is said to be."""
    stepper = nts.Stepper(nts.System(bodies, joints=joints), nts.EnergyMomentum())
    stepper.start(dt)
    for _ in range(steps):
        stepper.advance(dt)
    found = stepper.solution.warnings.get("unresolved")
    stepper.close()
    return 0.0 if found is None else found.worst


@pytest.mark.mpi
def test_a_spring_of_ones_own_that_steps_do_not_resolve_is_told():
    """Omega h as of the built-in twin, and c h/(2 m) of its damper."""
    a, b, _ = masses()
    ends = [(0, 0, 0), (1, 0, 0)]
    omega = np.sqrt(2.0 * 1e6)
    assert told((a, b), [Spring(a, b, ends, stiffness=1e6)]) == pytest.approx(1e-2 * omega)
    assert told((a, b), [nts.Spring(a, b, ends, stiffness=1e6)]) == pytest.approx(1e-2 * omega)
    damper = Spring(a, b, ends, stiffness=1.0, damping=1e4)
    assert told((a, b), [damper], steps=2) == 0.0
    a, b, _ = masses(speed=1.0)
    damper = Spring(a, b, ends, stiffness=1.0, damping=1e4)
    assert told((a, b), [damper], steps=2) == pytest.approx(100.0)


@pytest.mark.mpi
@pytest.mark.parametrize("tells", [True, False])
def test_a_weak_spring_of_ones_own_holds_no_body(tells):
    """A fast spring beside it is told, whether the own one says its slopes or not."""
    a, b, block = masses()
    weak = Spring(b, block, [(1, 0, 0), (2, 0, 0)], stiffness=1e-3, name="weak")
    if not tells:
        weak = Silent(weak)
    fast = nts.Spring(a, b, [(0, 0, 0), (1, 0, 0)], stiffness=1e6)
    found = told((a, b, block), [fast, weak])
    assert found == pytest.approx(1e-2 * np.sqrt(2.0 * 1e6), rel=1e-9)


class Silent:
    """A spring that does not say its slopes; no `Joint`, but it has all that one has."""

    def __init__(self, joint):
        self._joint = joint

    def __getattr__(self, name):
        return getattr(self._joint, name)

    def slopes(self, u, history, when=None):
        return None


@pytest.mark.mpi
def test_points_are_where_they_were_asked_for():
    body = cube((0, 0, 0), "a", bcs=[nts.Dirichlet(lambda x: x[2] < 1e-9)])
    x = np.array([[0.2, 0.3, 0.1], [1.0, 1.0, 1.0], [0.5, 0.5, 0.5]])
    found = body.points(x)
    assert np.allclose(np.einsum("na,nai->ni", found.weights, found.reference), x, atol=1e-14)
    assert np.allclose(found.weights.sum(axis=1), 1.0, atol=1e-14)
    assert np.array_equal(found.fixed, (found.reference[..., 2:] < 1e-9).repeat(3, axis=2))
    with pytest.raises(ValueError, match=r"x=\[0.0, 0.0, 1.5\]: lies in no cell of body 'a'"):
        body.points([[0.1, 0.1, 0.1], [0.0, 0.0, 1.5]])
    with pytest.raises(ValueError, match=r"x='here': pass points"):
        body.points("here")


@pytest.mark.mpi
@pytest.mark.parametrize("kind", [CellType.hexahedron, CellType.tetrahedron])
@pytest.mark.parametrize("size", [1e-9, 1e6])
def test_points_are_found_in_bodies_of_any_size(kind, size):
    """Also on faces, and where cells are not straight; those beside the body are none."""

    def bent(x):
        return np.column_stack([x[:, 0], x[:, 1] + 0.2 * x[:, 0] * x[:, 2], x[:, 2]])

    mesh = create_box(COMM, [(0, 0, 0), (1, 1, 1)], [3, 2, 2], kind)
    mesh.geometry.x[:] = size * bent(mesh.geometry.x)
    body = nts.Continuum(mesh, nts.NeoHookean(young=1.0, poisson=0.3), density=1.0, name="a")
    inner = np.random.default_rng(3).random((20, 3))
    x = size * bent(np.vstack([inner, np.eye(3), 0.5 * np.eye(3)]))
    found = body.points(x)
    assert np.abs(found.combine(found.reference) - x).max() < 1e-14 * size
    for beside in (1e-6, 0.1, 2.0):
        with pytest.raises(ValueError, match="lies in no cell of body 'a'"):
            body.points(size * np.array([0.4, 0.3, -beside]))


@pytest.mark.mpi
def test_a_joint_of_a_stranger_is_refused():
    a, b = cube((0, 0, 0), "a"), cube((2, 0, 0), "b")
    spring = Spring(a, b, [(0.5, 0.5, 0.5), (2.5, 0.5, 0.5)], stiffness=1.0)
    with pytest.raises(ValueError, match="joints: 'spring' holds body 'b', which is not among"):
        nts.System([a], joints=[spring])
    with pytest.raises(TypeError, match=r"joints\[0\]=3: pass a sequence of joints"):
        nts.System([a], joints=[3])


@dataclass(frozen=True, eq=False, kw_only=True)
class DriveElements(nts.PointElements):
    """A point that is drawn along x by a way: a constraint whose multiplier is its force."""

    way: float

    @property
    def widths(self):
        return {"augmented": 0, "constraints": 1}

    @property
    def pattern(self):
        return np.zeros((1, 1), dtype=bool)

    def evaluate(self, x, own):
        (side,) = self.sides
        n, k = side.weights.shape
        along = np.zeros((n, k, 3))
        along[..., 0] = side.weights
        along = along.reshape(n, 3 * k)
        place = np.einsum("nk,nk->n", along, x.reshape(n, -1)) if n else np.zeros(0)
        start = np.einsum("nk,nk->n", along, self.reference().reshape(n, 3 * k))
        residual, tangent = np.zeros((n, 3 * k + 1)), np.zeros((n, 3 * k + 1, 3 * k + 1))
        residual[:, :-1] = MASS * own["constraints"] * along
        residual[:, -1] = MASS * (place - start - self.way)
        tangent[:, :-1, -1], tangent[:, -1, :-1] = MASS * along, MASS * along
        return nts.PointPart(residual, tangent)

    def largest(self, part):
        rows = np.abs(part.residual[:, -1]) / MASS
        return [0.0, float(rows.max(initial=0.0)), 0.0, self.extent]


MASS = 1e3


class Drive(nts.Joint):
    """A joint with the ground whose constraint depends on time: a way at an acceleration."""

    driven = True

    def __init__(self, body, x, speed, acceleration=0.0, name="drive"):
        self.name, self.bodies = name, (body,)
        self.rates = (speed, acceleration)
        side = body.points(x)
        self.side = side if COMM.rank == 0 else side.select(slice(0))

    def coupling(self, bodies):
        def make(step, history):
            (speed, acceleration), t = self.rates, step.state.time + step.dt
            return DriveElements(
                name=self.name, sides=(self.side,), way=speed * t + 0.5 * acceleration * t**2
            )

        return nts.EveryStep(bodies, make)


@pytest.mark.mpi
@pytest.mark.parametrize("newton", [{"linear_solver": "direct"}, {"linear_solver": "krylov"}])
def test_a_drive_moves_what_it_holds(newton):
    """Constraints of a joint count for convergence, also where nothing else moves."""
    body, x = cube((0, 0, 0), "a"), np.array([0.3, 0.4, 0.6])
    system = nts.System([body], joints=[Drive(body, x, 0.1)])
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=5e-3, t_end=0.05, newton=nts.Newton(**newton),
        project_start=True,
    )  # fmt: skip
    found = body.points(x)
    u = np.concatenate(COMM.allgather(run.state.u[0])).reshape(-1, 3)
    moved = found.weights[0] @ u[found.nodes[0]]
    assert abs(moved[0] - 5e-3) < 1e-14
    assert run.balance["newton_iterations"][1:].min() >= 1


@pytest.mark.mpi
def test_impacts_give_nothing_back_where_a_joint_of_ones_own_drives():
    body = cube((0, 0, 0), "a")
    system = nts.System([body], joints=[Drive(body, (0.3, 0.4, 0.6), 0.1)])
    with pytest.raises(ValueError, match="impact='restored': joint 'drive' is driven"):
        nts.Stepper(system, nts.EnergyMomentum(), impact="restored")


class FailingElements(SpringElements):
    """A spring that fails on one rank, but not at once."""

    def evaluate(self, x, own):
        if COMM.rank == COMM.size - 1 and self.step.state.time > 3e-3:
            raise RuntimeError("no table")
        return super().evaluate(x, own)


class TooLongElements(FailingElements):
    """A spring that fails on one rank where steps are long."""

    def evaluate(self, x, own):
        if COMM.rank == COMM.size - 1 and self.step.dt > 1e-3:
            raise nts.StepFailedError("steps are too long for a spring; use a smaller dt")
        return SpringElements.evaluate(self, x, own)


class Failing(Spring):
    """A spring whose elements raise on one rank alone."""

    kind = FailingElements

    def coupling(self, bodies):
        def make(step, history):
            x0 = self._elements(None).reference()
            x0 = x0 + self._gathered([step.state.u[b] for b in bodies])
            return self.kind(
                name=self.name, sides=self._sides, stiffness=self.stiffness, damping=0.0,
                length=self.length, step=step, x0=x0,
            )  # fmt: skip

        return nts.EveryStep(bodies, make)


@pytest.mark.mpi
def test_what_elements_raise_on_one_rank_ends_the_run_on_all():
    a, b = cube((0, 0, 0), "a"), cube((2, 0, 0), "b", velocity=(3.0, 1.0, 0))
    spring = Failing(a, b, [(0.5, 0.5, 0.5), (2.5, 0.5, 0.5)], stiffness=1e4)
    stepper = nts.Stepper(nts.System([a, b], joints=[spring]), nts.EnergyMomentum())
    words = r"'spring': its elements raised .*no table.*; correct it"
    with pytest.raises(nts.UserFunctionError, match=words):
        for _ in range(9):
            stepper.advance(2e-3)
    stepper.close()


@pytest.mark.mpi
def test_a_step_is_cut_where_elements_refuse_it_on_one_rank():
    a, b = cube((0, 0, 0), "a"), cube((2, 0, 0), "b", velocity=(3.0, 1.0, 0))
    spring = Failing(a, b, [(0.5, 0.5, 0.5), (2.5, 0.5, 0.5)], stiffness=1e4)
    spring.kind = TooLongElements
    stepper = nts.Stepper(nts.System([a, b], joints=[spring]), nts.EnergyMomentum())
    stepper.advance(2e-3)
    assert stepper.solution.retries == 1 and len(stepper.solution.rows) == 4
    stepper.close()


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("error", "kind", "text", "advises"),
    [
        (nts.StepFailedError("long; halve dt", advises=True), nts.StepFailedError, "long", True),
        (nts.StepFailedError("long"), nts.StepFailedError, "long", False),
        (nts.UserFunctionError("no table"), nts.UserFunctionError, "no table", False),
        (KeyError("no table"), nts.UserFunctionError, r"'bad': its .*no table.*; correct it", True),
    ],
)  # fmt: skip
def test_what_elements_raise_keeps_its_kind_and_its_advice(error, kind, text, advises):
    class Bad:
        name, alike = "bad", None

        def evaluate(self, x, own):
            if COMM.rank == COMM.size - 1:
                raise error

    with pytest.raises(kind, match=text) as caught:
        evaluate_together(COMM, [Bad()], [np.empty(0)], [{}])
    assert caught.type is kind and caught.value.advises == advises


@pytest.mark.mpi
def test_the_stiffness_of_springs_is_a_norm_on_all_ranks():
    """Of two equal springs between the same bodies it is sqrt(2) times that of one."""
    a, b = (
        nts.RigidBody.from_inertia(1.0, (1, 1, 1), centre=(x, 0, 0), name=name)
        for x, name in ((0, "a"), (1, "b"))
    )
    norms = []
    for count in (1, 2):
        springs = [
            nts.Spring(a, b, [(0, 0, 0), (1, 0, 0)], stiffness=7.0, name=f"spring {k}")
            for k in range(count)
        ]
        stepper = nts.Stepper(nts.System([a, b], joints=springs), nts.EnergyMomentum())
        stepper.start(1e-2)
        stepper.problem.begin(stepper.state, 1e-2)
        norms.append(stepper.problem.stiffness_between())
        stepper.close()
    assert norms[0].all()
    np.testing.assert_allclose(norms[1], np.sqrt(2) * norms[0], rtol=1e-13)


@pytest.mark.mpi
def test_springs_that_fail_on_one_rank_alone_fail_on_all_when_measured():
    a, b = cube((0, 0, 0), "a"), cube((2, 0, 0), "b")
    spring = Failing(a, b, [(0.5, 0.5, 0.5), (2.5, 0.5, 0.5)], stiffness=1e4)
    spring.kind = TooLongElements
    stepper = nts.Stepper(nts.System([a, b], joints=[spring]), nts.EnergyMomentum())
    stepper.start(1e-3)
    stepper.problem.begin(stepper.state, 2e-3)
    with pytest.raises(nts.StepFailedError, match="steps are too long for a spring"):
        stepper.problem.stiffness_between()
    stepper.close()


# ---- starts
def at_point(body, x, values):
    """Nodal values at a material point, from all ranks."""
    found = body.points(x)
    return found.weights[0] @ np.concatenate(COMM.allgather(values)).reshape(-1, 3)[found.nodes[0]]


@pytest.mark.mpi
def test_a_start_that_violates_a_joint_of_ones_own_is_refused():
    """As that of the built-in twin, and projected alike."""
    x, twin = np.array([0.3, 0.4, 0.6]), {}
    body = cube((0, 0, 0), "a")
    system = nts.System([body], joints=[Drive(body, x, 0.1)])
    with pytest.raises(ValueError, match=r"joint 'drive' is violated at .* 0\.1;.*project_start"):
        nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=0.05)
    ball = nts.Spherical(body, None, point=x, displacement=lambda t: (0.1 * t, 0, 0))
    for name, joint in (("own", Drive(body, x, 0.1)), ("built-in", ball)):
        stepper = nts.Stepper(
            nts.System([body], joints=[joint]), nts.EnergyMomentum(), project_start=True
        )
        stepper.start(5e-3)
        twin[name] = stepper.state.v[0]
        assert at_point(body, x, twin[name])[0] == pytest.approx(0.1, abs=1e-12)
        stepper.close()
    # An impulse along x at the same point; the twin's others do little to the mass's coupling.
    assert twin["own"].reshape(-1, 3)[:, 0] == pytest.approx(
        twin["built-in"].reshape(-1, 3)[:, 0], abs=1e-12
    )
    off = cube((0, 0, 0), "b", displacement=(0.02, 0, 0), velocity=(0.1, 0, 0))
    with pytest.raises(ValueError, match=r"at the start 'drive' is off by 0\.02;"):
        nts.simulate(
            nts.System([off], joints=[Drive(off, x, 0.1)]), nts.EnergyMomentum(), dt=5e-3,
            t_end=0.05,
        )  # fmt: skip


@pytest.mark.mpi
@pytest.mark.parametrize("rule", ACCELERATED.values(), ids=ACCELERATED)
@pytest.mark.fast("generalized-alpha")
def test_first_accelerations_keep_a_joint_of_ones_own(rule):
    """A point that is drawn at 0.1 m/s and 3 m/s^2 out of a cube that flies at 0.1 m/s."""
    x = np.array([0.3, 0.4, 0.6])
    body = cube((0, 0, 0), "a", velocity=(0.1, 0.0, 0.0))
    stepper = nts.Stepper(nts.System([body], joints=[Drive(body, x, 0.1, 3.0)]), rule)
    stepper.start(5e-3)
    assert at_point(body, x, stepper.state.a[0]) == pytest.approx([3.0, 0, 0], abs=1e-9)
    stepper.close()


@dataclass(frozen=True, eq=False, kw_only=True)
class RodElements(nts.PointElements):
    """A rod of fixed length from a point to the origin: (x . x - L^2)/2 = 0, in units of its own.

    Its `largest` says lengths, as the rows are those of an area.
    """

    square: float

    @property
    def widths(self):
        return {"augmented": 0, "constraints": 1}

    def evaluate(self, x, own):
        (side,) = self.sides
        n, k = side.weights.shape
        place = np.einsum("na,nai->ni", side.weights, x)
        along = (side.weights[:, :, None] * place[:, None]).reshape(n, 3 * k)
        residual, tangent = np.zeros((n, 3 * k + 1)), np.zeros((n, 3 * k + 1, 3 * k + 1))
        multiplier = MASS * own["constraints"]
        residual[:, :-1] = multiplier * along
        residual[:, -1] = 0.5 * MASS * (np.einsum("ni,ni->n", place, place) - self.square)
        both = np.einsum("na,nb,ij->naibj", side.weights, side.weights, np.eye(3))
        tangent[:, :-1, :-1] = multiplier[:, :, None] * both.reshape(n, 3 * k, 3 * k)
        tangent[:, :-1, -1] = tangent[:, -1, :-1] = MASS * along
        return nts.PointPart(residual, tangent)

    def largest(self, part):
        rows = np.abs(part.residual[:, -1]) / (MASS * np.sqrt(self.square))
        return [0.0, float(rows.max(initial=0.0)), 0.0, self.extent]


class Rod(Drive):
    """A joint with the ground."""

    def __init__(self, body, x):
        super().__init__(body, x, 0.0, name="rod")
        self.x = np.array(x)

    def coupling(self, bodies):
        def make(step, history):
            return RodElements(name=self.name, sides=(self.side,), square=float(self.x @ self.x))

        return nts.EveryStep(bodies, make)


@pytest.mark.mpi
def test_a_rod_of_ones_own_turns_as_the_built_in_one():
    """Its centripetal acceleration v^2/L, by the second derivative of a curved constraint."""
    length, speed, g = 0.7, 1.3, 9.81
    body = nts.RigidBody.from_inertia(
        2.0, (0.2, 0.5, 0.4), centre=(length, 0, 0), velocity=(0, 0, speed), name="bob", comm=COMM
    )
    system = nts.System([body], joints=[Rod(body, (length, 0, 0))], gravity=(0, 0, -g))
    stepper = nts.Stepper(system, nts.GeneralizedAlpha())
    stepper.start(1e-3)
    a = np.concatenate(COMM.allgather(stepper.state.a[0]))[:3]
    assert a == pytest.approx([-(speed**2) / length, 0.0, -g], abs=1e-8)
    stepper.close()
    body = nts.RigidBody.from_inertia(
        2.0, (0.2, 0.5, 0.4), centre=(length, 0, 0), velocity=(0.3, 0, 1), name="bob", comm=COMM
    )
    system = nts.System([body], joints=[Rod(body, (length, 0, 0))])
    with pytest.raises(ValueError, match=r"joint 'rod' is violated at a speed of 0\.3;"):
        nts.simulate(system, nts.EnergyMomentum(), dt=0.01, t_end=0.1)


@pytest.mark.mpi
def test_constraints_that_nobody_can_follow_are_refused():
    """The coupling of a user says None where a start need not fit."""
    body, x = cube((0, 0, 0), "a"), np.array([0.3, 0.4, 0.6])

    class Own(nts.EveryStep):
        def begin(self, step, history, again, search):
            self.elements = [self.make(step, history)]

    class Loose(Own):
        def kinematics(self, state, dt):
            return [None]

    class Other(Drive):
        def coupling(self, bodies):
            return self.kind(bodies, super().coupling(bodies).make)

    drive = Other(body, x, 0.1)
    drive.kind = Own
    system = nts.System([body], joints=[drive])
    with pytest.raises(TypeError, match="joint 'drive': its elements have constraints, but"):
        nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=5e-3)
    drive.kind = Loose
    run = nts.simulate(system, nts.EnergyMomentum(), dt=5e-3, t_end=5e-3)
    assert run.status.startswith("completed") and len(run.rows) == 2


class Telling(nts.EveryStep):
    """Warns of bodies that have moved by 12.5 mm when a step begins."""

    def warnings(self, parts):
        x = self.step.state.u
        way = COMM.allreduce(max(float(np.abs(u).max(initial=0.0)) for u in x), op=MPI.MAX)
        told = nts.StepWarning("way", way, f"a body has moved by {way:.3g} m", ("a",))
        return [told] if way > 0.0125 else []


@pytest.mark.mpi
def test_a_coupling_of_ones_own_warns():
    body, x = cube((0, 0, 0), "a", velocity=(1.0, 0.0, 0.0)), np.array([0.3, 0.4, 0.6])

    class Told(Drive):
        def coupling(self, bodies):
            return Telling(bodies, super().coupling(bodies).make)

    stepper = nts.Stepper(nts.System([body], joints=[Told(body, x, 1.0)]), nts.EnergyMomentum())
    for _ in range(5):
        stepper.advance(5e-3)
    # The steps start 0, 5, 10, 15 and 20 mm from the start.
    (found,) = stepper.solution.warnings.values()
    assert (found.kind, found.count, found.about) == ("way", 2, ("a",))
    assert found.worst == pytest.approx(0.02, abs=1e-9)
    stepper.close()


# ---- resultants
@dataclass(frozen=True, eq=False, kw_only=True)
class PushElements(nts.PointElements):
    """Points that are pushed by constant forces, shape (n, 3)."""

    push: np.ndarray
    factor: float

    def evaluate(self, x, own):
        (side,) = self.sides
        n, size = len(x), self.num_coordinates
        residual = -self.factor * side.weights[:, :, None] * self.push[:, None]
        return nts.PointPart(residual.reshape(n, size), np.zeros((n, size, size)))


class Unspoken:
    """Elements that are no PointElements and do not know their resultant."""

    def __init__(self, batch):
        self._batch = batch

    def __getattr__(self, name):
        if name == "sides":
            raise AttributeError(name)
        return getattr(self._batch, name)

    def resultant(self, part, k, u):
        return np.full((4, 3), np.nan)


class TwoBatches(nts.EveryStep):
    def begin(self, step, history, again, search):
        self.elements = list(self.make(step, history))
        self.bodies = [self.bodies[0]] * len(self.elements)


class Pushes(nts.Joint):
    """A joint whose coupling has two batches of elements, each of two points."""

    def __init__(self, body, x, push, name="pushes", wrap=lambda batch: batch):
        self.name, self.bodies, self.push, self._wrap = name, (body,), push, wrap
        self._here = slice(None) if COMM.rank == 0 else slice(0)
        self._sides = [body.points(both).select(self._here) for both in x]

    def coupling(self, bodies):
        def make(step, history):
            for side, push in zip(self._sides, self.push, strict=True):
                yield self._wrap(PushElements(
                    name=self.name, sides=(side,), push=push[self._here], factor=step.factor
                ))  # fmt: skip

        return TwoBatches(bodies, make)


@pytest.mark.mpi
def test_reactions_of_ones_own_joint():
    """Of all its batches, about the middle of its points; NaN where elements do not say them."""
    body = cube((0, 0, 0), "a", bcs=[nts.Dirichlet(lambda x: np.isfinite(x[0]))])
    x = np.array([[[0.2, 0.3, 0.0], [1.0, 1.0, 1.0]], [[0.0, 1.0, 0.5], [0.7, 0.0, 0.9]]])
    push = np.array([[[1.0, 2.0, 3.0], [0.5, 0.0, -4.0]], [[0.0, 7.0, 0.0], [-1.0, 1.0, 6.0]]])
    joints = [Pushes(body, x, push), Pushes(body, x, push, "unspoken", Unspoken)]
    system = nts.System([body], joints=joints)
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=2e-3)
    middle = x.reshape(-1, 3).mean(axis=0)
    moment = np.cross(x - middle, push).sum(axis=(0, 1))
    wanted = np.array([push.sum(axis=(0, 1)), moment])
    assert run.reactions["pushes"][1:] == pytest.approx(np.array([wanted] * 2), abs=1e-9)
    assert np.isnan(run.reactions["unspoken"][1:]).all()
    # What holds the body bears both joints.
    assert run.reactions["a"][1:, 0] == pytest.approx(np.array([-2 * wanted[0]] * 2), abs=1e-9)
