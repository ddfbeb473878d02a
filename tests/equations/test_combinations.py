"""A multiplier that stands in several elements: a cord over pins holds the sum of lengths."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from measures import STENCIL, dense
from point_mass import PointMass

import dolfinx_nts as nts
from dolfinx_nts.interaction.combination import Combination

COMM = MPI.COMM_WORLD
GRAVITY = 9.81
#: Masses [kg], and the pins that the cord hangs them from [m].
MASSES = (3.0, 2.0)
PINS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True, eq=False, kw_only=True)
class CordElements(nts.PointElements):
    """Length from a mass to its pin, element i that of mass i, less the element's part of the cord.

    With r = x - pin and l = |r|, (r_0 + r_1)/(l_0 + l_1) is its discrete gradient.
    """

    x0: Any
    part: float
    combination: Any

    @property
    def widths(self):
        return {"augmented": 0, "constraints": 1}

    @property
    def pattern(self):
        return np.zeros((1, 1), dtype=bool)

    def evaluate(self, x, own):
        n = len(x)
        residual, tangent = np.zeros((n, 7)), np.zeros((n, 7, 7))
        for i in range(n):
            r0, r1 = (y[i, i] - PINS[i] for y in (self.x0, x))
            l0, l1 = np.linalg.norm(r0), np.linalg.norm(r1)
            here, force = slice(3 * i, 3 * i + 3), own["constraints"][i, 0]
            along = (r0 + r1) / (l0 + l1)
            residual[i, here], residual[i, 6] = force * along, l1 - self.part
            bend = (np.eye(3) - np.outer(along, r1 / l1)) / (l0 + l1)
            tangent[i, here, here] = force * bend
            tangent[i, here, 6], tangent[i, 6, here] = along, r1 / l1
        return nts.PointPart(residual, tangent)


class Cord(nts.Joint):
    """Two masses at one cord: `ratio` times the first length and the second are its length."""

    def __init__(self, bodies, x, ratio):
        self.name, self.bodies, self.ratio = "cord", tuple(bodies), ratio
        # The masses are on the first rank, the elements on the last.
        here = slice(2 if COMM.rank == COMM.size - 1 else 0)
        node, one = np.zeros((2, 1), dtype=int), np.ones((2, 1))
        self.sides = tuple(
            nts.Points(body, node, one, np.tile(p, (2, 1, 1)), np.zeros((2, 1, 3), bool), one > 0)
            .select(here)
            for body, p in zip(bodies, x, strict=True)
        )
        lengths = np.linalg.norm(np.array(x) - PINS, axis=1)
        self.length = float(lengths @ [ratio, 1.0])

    @cached_property
    def combination(self):
        n = len(self.sides[0])
        weight = np.array([self.ratio, 1.0])[:n, None, None]
        return Combination(np.zeros((n, 1, 1), dtype=int), weight, min(n, 1))

    def coupling(self, bodies):
        def make(step, history):
            u = [side.nodal(step.state.u[b]) for side, b in zip(self.sides, bodies, strict=True)]
            return CordElements(
                name=self.name, sides=self.sides, combination=self.combination,
                part=self.length / (1.0 + self.ratio),
                x0=np.concatenate([s.reference + y for s, y in zip(self.sides, u, strict=True)], 1),
            )  # fmt: skip

        return nts.EveryStep(bodies, make)


def masses_at(x, ratio, v=((0, 0, 0), (0, 0, 0))):
    """Two masses at these places and velocities, and their cord."""
    each = zip(MASSES, x, v, "ab", strict=True)
    bodies = [PointMass(COMM, mass, place, speed, name) for mass, place, speed, name in each]
    return nts.System(bodies, joints=[Cord(bodies, x, ratio)], gravity=(0, 0, -GRAVITY))


@pytest.mark.mpi
@pytest.mark.parametrize("rule", [nts.Midpoint(), nts.EnergyMomentum()])
@pytest.mark.parametrize("ratio", [1.0, 0.5])
def test_masses_at_a_cord_fall_as_atwoods_do(ratio, rule):
    """The cord's force is one multiplier, `ratio` times it on the first mass."""
    system = masses_at([[0, 0, -1.0], [1.0, 0, -1.0]], ratio)
    run = nts.simulate(system, rule, dt=0.01, t_end=0.2)
    fall = GRAVITY * (MASSES[0] - ratio * MASSES[1]) / (MASSES[0] + ratio**2 * MASSES[1])
    for u, moved in zip(run.state.u, (-fall, ratio * fall), strict=True):
        expected = [0.0, 0.0, 0.5 * moved * 0.2**2]
        assert np.abs(u - expected[: len(u)]).max(initial=0.0) < 1e-12


SWINGS = {
    "x": [[0.6, 0.1, -0.8], [1.3, -0.4, -1.2]],
    "v": [(0.8, 0.0, 0.6), (0.4, 0.3, 0.0)],
}


@pytest.mark.mpi
@pytest.mark.parametrize("solver", ["direct", "krylov"])
def test_masses_that_swing_at_a_cord_keep_energy_and_its_length(solver):
    run = nts.simulate(
        masses_at(**SWINGS, ratio=1.0), nts.EnergyMomentum(), dt=0.01, t_end=0.5,
        project_start=True, newton=nts.Newton(linear_solver=solver),
    )  # fmt: skip
    # Gravity's potential is no part of this body's.
    moved = [COMM.bcast(u) for u in run.state.u]
    work = -GRAVITY * sum(mass * u[2] for mass, u in zip(MASSES, moved, strict=True))
    kinetic = run.balance["kinetic"]
    assert abs(work) > 1.0 and kinetic[-1] - kinetic[0] == pytest.approx(work, rel=1e-12)
    lengths = np.linalg.norm(np.array(SWINGS["x"]) + moved - PINS, axis=1).sum()
    start = np.linalg.norm(np.array(SWINGS["x"]) - PINS, axis=1).sum()
    assert lengths == pytest.approx(start, rel=1e-12)


@pytest.mark.skipif(COMM.size > 1, reason="reads the whole matrix")
def test_jacobian_is_the_derivative_of_the_residual():
    stepper = nts.Stepper(masses_at(**SWINGS, ratio=0.5), nts.EnergyMomentum())
    problem, solver = stepper.problem, stepper.solver
    problem.begin(stepper.state, 0.02)
    rng = np.random.default_rng(2)
    with problem.x as x:
        x[:] = 0.1 * rng.normal(size=len(x))
    assert len(x) == 7
    solver.assemble(problem.evaluate(problem.x))
    at, step = problem.x.array_r.copy(), 1e-4

    def residual(values):
        with problem.x as x:
            x[:] = values
        return problem.residual(problem.evaluate(problem.x))

    found = dense(solver.matrix.operator)
    expected = [
        sum(w / step * residual(at + k * step * e) for k, w in STENCIL) for e in np.eye(7)
    ]
    assert np.abs(found - np.transpose(expected)).max() < 1e-9
    stepper.close()
