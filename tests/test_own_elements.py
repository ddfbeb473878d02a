"""A kind of elements from outside the package: a spring with a damper between material points.

It shows all that a joint of one's own needs: the scene's item, its elements, their work and losses.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from dolfinx.mesh import CellType, GhostMode, create_box
from mpi4py import MPI

import dolfinx_nts as nts
from dolfinx_nts.output import BalanceCSV

COMM = MPI.COMM_WORLD


@dataclass(frozen=True, eq=False, kw_only=True)
class SpringElements(nts.PointElements):
    """One spring, on rank 0: V = k/2 (l - L)^2 and a damper c, by theory section 14."""

    stiffness: float
    damping: float
    length: float
    step: nts.Step
    x0: np.ndarray

    def evaluate(self, x, own):
        k, c, h = self.stiffness, self.damping, self.step.dt
        weight = self.weights[:, 0] - self.weights[:, 1]
        r0, r1 = (np.einsum("na,nai->ni", weight, y) for y in (self.x0, x))
        l0, l1 = (np.linalg.norm(r, axis=1)[:, None] for r in (r0, r1))
        middle, both = 0.5 * (r0 + r1), l0 + l1
        force = k * (1.0 - 2.0 * self.length / both) + 2.0 * c * (l1 - l0) / (h * both)
        slope = 2.0 * k * self.length / both**2 + 4.0 * c * l0 / (h * both**2)
        by_r = 0.5 * force[:, :, None] * np.eye(3)
        by_r = by_r + middle[:, :, None] * (slope * r1 / l1)[:, None]
        factor, n = self.step.factor, len(x)
        residual = factor * np.einsum("na,ni->nai", weight, force * middle)
        tangent = factor * np.einsum("na,nb,nij->naibj", weight, weight, by_r)
        size = self.num_coordinates
        return nts.PointPart(residual.reshape(n, size), tangent.reshape(n, size, size))

    def lengths(self, x):
        weight = self.weights[:, 0] - self.weights[:, 1]
        return np.linalg.norm(np.einsum("na,nai->ni", weight, x), axis=1)


class Spring:
    """A spring with a damper between points of two bodies."""

    losses = ("damping_dissipation",)

    def __init__(self, a, b, points, *, stiffness, damping=0.0, length=None, name="spring"):
        self.name, self.bodies, self.stiffness, self.damping = name, (a, b), stiffness, damping
        self._sides = tuple(body.points(x) for body, x in zip((a, b), points, strict=True))
        if COMM.rank:
            self._sides = tuple(side.part(slice(0)) for side in self._sides)
        rest = self._elements(None).lengths(self._elements(None).reference())
        self.length = length if length is not None else float(COMM.bcast(rest)[0])

    def _elements(self, step, x0=None):
        elements = _Kept if step else SpringElements
        return elements(
            name=self.name, sides=self._sides, stiffness=self.stiffness, damping=self.damping,
            length=getattr(self, "length", 1.0), step=step, x0=x0,
        )  # fmt: skip

    def start(self):
        return None

    def potential(self, u, history):
        batch = self._elements(None)
        at = batch.reference() + self._gathered(u)
        return float((0.5 * self.stiffness * (batch.lengths(at) - self.length) ** 2).sum())

    def _gathered(self, u):
        """Displacements of the spring's nodes, from all ranks."""
        parts = []
        for values, side in zip(u, self._sides, strict=True):
            everywhere = np.concatenate(COMM.allgather(values)).reshape(-1, 3)
            parts.append(everywhere[side.nodes])
        return np.concatenate(parts, axis=1)

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
        return {"damping_dissipation": self.damping * float((part.way**2).sum()) / self.step.dt}


class _Part:
    def __init__(self, residual, tangent, way):
        self.residual, self.tangent, self.way = residual, tangent, way
        self.status = np.empty((0, len(residual)), dtype=bool)


def cube(low, name, velocity=(0.0, 0.0, 0.0), **options):
    mesh = create_box(
        COMM, [np.array(low), np.array(low) + 1.0], [2, 2, 2], CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    return nts.Continuum(
        mesh, nts.NeoHookean(1e6, 0.3), density=1e3, velocity=velocity, name=name, **options
    )


@pytest.mark.mpi
@pytest.mark.parametrize("newton", [{}, {"linear_solver": "direct"}, {"linear_solver": "krylov"}])
@pytest.mark.parametrize("damping", [0.0, 500.0])
@pytest.mark.fast("0.0-newton0", "500.0-newton1", "500.0-newton2")
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
def test_two_stiff_cubes_vibrate_as_two_masses():
    """omega^2 = k (1/m + 1/m); the springs' axis goes through both centres."""
    a, b = cube((0, 0, 0), "a", velocity=(0.1, 0, 0)), cube((2, 0, 0), "b", velocity=(-0.1, 0, 0))
    k = 1e3
    spring = Spring(a, b, [(0.5, 0.5, 0.5), (2.5, 0.5, 0.5)], stiffness=k)
    stepper = nts.Stepper(nts.System([a, b], joints=[spring]), nts.EnergyMomentum())
    omega, h = np.sqrt(2 * k / 1e3), 0.02
    # The midpoint rule's own frequency, tan(w h/2) = omega h/2.
    phase = 2 * np.arctan(omega * h / 2)
    for n in range(1, 60):
        state = stepper.advance(h)
        way = COMM.allreduce(state.u[0].reshape(-1, 3)[:, 0].sum()) / 27
        assert abs(way - 0.1 / omega * np.sin(n * phase)) < 2e-3 * 0.1 / omega
    stepper.close()


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
def test_a_joint_of_a_stranger_is_refused():
    a, b = cube((0, 0, 0), "a"), cube((2, 0, 0), "b")
    spring = Spring(a, b, [(0.5, 0.5, 0.5), (2.5, 0.5, 0.5)], stiffness=1.0)
    with pytest.raises(ValueError, match="joints: 'spring' holds body 'b', which is not among"):
        nts.System([a], joints=[spring])
    with pytest.raises(TypeError, match=r"joints\[0\]=3: pass a sequence of joints"):
        nts.System([a], joints=[3])


@dataclass(frozen=True, eq=False, kw_only=True)
class DriveElements(nts.PointElements):
    """A point that is drawn along x with a speed: a constraint whose multiplier is its force."""

    speed: float
    end: float

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
        residual[:, -1] = MASS * (place - start - self.speed * self.end)
        tangent[:, :-1, -1], tangent[:, -1, :-1] = MASS * along, MASS * along
        return nts.PointPart(residual, tangent)

    def largest(self, part):
        rows = np.abs(part.residual[:, -1]) / MASS
        return [0.0, float(rows.max(initial=0.0)), 0.0, self.extent]


MASS = 1e3


class Drive:
    """A joint with the ground whose constraint depends on time."""

    losses = ()

    def __init__(self, body, x, speed, name="drive"):
        self.name, self.bodies, self.speed = name, (body,), speed
        side = body.points(x)
        self.side = side if COMM.rank == 0 else side.part(slice(0))

    def start(self):
        return None

    def potential(self, u, history):
        return 0.0

    def coupling(self, bodies):
        def make(step, history):
            return DriveElements(
                name=self.name, sides=(self.side,), speed=self.speed,
                end=step.state.time + step.dt,
            )  # fmt: skip

        return nts.EveryStep(bodies, make)


@pytest.mark.mpi
@pytest.mark.parametrize("newton", [{"linear_solver": "direct"}, {"linear_solver": "krylov"}])
def test_a_drive_moves_what_it_holds(newton):
    """Constraints of a joint count for convergence, also where nothing else moves."""
    body, x = cube((0, 0, 0), "a"), np.array([0.3, 0.4, 0.6])
    system = nts.System([body], joints=[Drive(body, x, 0.1)])
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=5e-3, t_end=0.05, newton=nts.Newton(**newton)
    )
    found = body.points(x)
    u = np.concatenate(COMM.allgather(run.state.u[0])).reshape(-1, 3)
    moved = found.weights[0] @ u[found.nodes[0]]
    assert abs(moved[0] - 5e-3) < 1e-14
    assert run.balance["newton_iterations"][1:].min() >= 1


@pytest.mark.mpi
def test_a_step_with_a_joint_that_fails_is_cut():
    a, b = cube((0, 0, 0), "a"), cube((2, 0, 0), "b", velocity=(30.0, 0, 0))
    spring = Spring(a, b, [(0.5, 0.5, 0.5), (2.5, 0.5, 0.5)], stiffness=1e7)
    run = nts.simulate(
        nts.System([a, b], joints=[spring]), nts.EnergyMomentum(), dt=5e-2, t_end=0.1,
        newton=nts.Newton(max_iterations=1, max_retries=2),
    )  # fmt: skip
    assert run.retries == 2 and "not solved after" in run.status
