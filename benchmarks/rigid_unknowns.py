"""What six unknowns a rigid body could save, in place of twelve coordinates with six multipliers.

A Newton step of a chain of rigid bodies is solved twice: as the package does, with all coordinates
and multipliers, and in the null space of the directors' constraints (theory section 12): changes
P(y_1) s of the coordinates and equations P(y_m)^T r, where P(y) = [I 0; 0 -D_i^] gives twelve
changes of a body for six of place and angle, so that the directors' multipliers vanish from both.
Printed are how far both solutions differ, and CPU times over that of a whole step: of the linear
solves (MUMPS, analysis kept), of the projection, which the reduced form needs in addition, of the
matrices' assembly, and of the directors' elements, which it could leave out.

Measured for 100 bodies (three runs, beside other jobs): same motion to 2e-16; of a step of 70 ms
the linear solves take 15 %, 6 to 7 % reduced; the projection 5 to 6 %; the directors' elements 4 %,
and a part of the assembly's 2 % is theirs. So six unknowns would save less than a tenth of a step:
most of it is Python around bodies and elements one by one, which rotations would need alike. They
would cost a second kind of body, whose points are not linear in its unknowns. They are not built.

    python benchmarks/rigid_unknowns.py [--bodies 10 100 400]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

from mpi4py import MPI  # noqa: F401 - before PETSc

import numpy as np
from petsc4py import PETSc
from rigid_chain import chain
from scipy.sparse import bmat, bsr_matrix, csr_matrix
from scipy.sparse.linalg import spsolve

import dolfinx_nts as nts
from dolfinx_nts.interaction.elements import evaluate_together

STEP = 5e-3


def cost(work: Callable[[], Any], times: int = 20) -> float:
    """CPU time of a call [s], the fastest of some."""
    taken = []
    for _ in range(times):
        start = time.process_time()
        work()
        taken.append(time.process_time() - start)
    return min(taken)


def spins(y: np.ndarray) -> bsr_matrix:
    """P of all bodies, from their coordinates (12 n,) [m]: shape (12 n, 6 n)."""
    directors = y.reshape(-1, 4, 3)[:, 1:]
    n = len(directors)
    blocks = np.zeros((n, 4, 3, 6))
    blocks[:, 0, :, :3] = np.eye(3)
    blocks[:, 1:, :, 3:] = np.cross(np.eye(3), directors[:, :, None]).swapaxes(2, 3)
    return bsr_matrix((blocks.reshape(n, 12, 6), np.arange(n), np.arange(n + 1)))


class Factors:
    """MUMPS on a matrix, with the package's options for joints, its analysis kept."""

    def __init__(self, matrix: Any) -> None:
        self.matrix, self.ksp = matrix, PETSc.KSP().create(matrix.getComm())
        self.ksp.setType("richardson")
        self.ksp.setNormType(PETSc.KSP.NormType.NONE)
        self.ksp.setTolerances(max_it=2)
        self.ksp.setOperators(matrix)
        pc = self.ksp.getPC()
        pc.setType("lu")
        pc.setFactorSolverType("mumps")
        pc.setFactorSetUpSolverType()
        factors = pc.getFactorMatrix()
        for option, value in ((14, 80), (24, 1)):
            factors.setMumpsIcntl(option, value)
        factors.setMumpsCntl(1, 1e-9)
        self.x, self.b = matrix.createVecs()

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Factorise and solve."""
        self.matrix.stateIncrease()
        self.b.array_w[:] = right
        self.ksp.solve(self.b, self.x)
        assert self.ksp.getConvergedReason() > 0
        return self.x.array_r.copy()


def as_petsc(a: csr_matrix) -> Any:
    """The same as a PETSc matrix."""
    index = PETSc.IntType
    csr = (a.indptr.astype(index), a.indices.astype(index), a.data)
    return PETSc.Mat().createAIJ(a.shape, csr=csr)


def measure(bodies: int) -> None:
    """Print one line of each kind for a chain of this many bodies."""
    stepper = nts.Stepper(chain(bodies), nts.EnergyMomentum())
    step = cost(lambda: stepper.advance(STEP))
    iterations = float(np.mean(stepper.solution.balance["newton_iterations"][-15:]))
    problem, solver = stepper.problem, stepper.solver
    problem.begin(stepper.state, STEP)
    e = problem.evaluate(problem.x)
    right, operator = -problem.residual(e), solver.assemble(e).operator

    # The bodies come first, then the multipliers of each joint and triad in turn.
    n = 12 * bodies
    counts = [c.num_elements * c.widths["constraints"] for c in problem.elements]
    held = np.repeat(["directors" in c.name for c in problem.elements], counts)
    triads, joints = n + np.flatnonzero(held), n + np.flatnonzero(~held)
    a = csr_matrix(operator.getValuesCSR()[::-1], shape=operator.getSize())
    reference = np.concatenate([b.reference for b in problem.system.bodies])
    u0, u1 = (np.concatenate(u) for u in (stepper.state.u, [t.u1 for t in e.bodies]))

    full = Factors(operator)
    known = full.solve(right)
    # Off the constraints: the shortest way back to them, body by body.
    rows = a[triads, :n]
    off = rows.T @ spsolve((rows @ rows.T).tocsc(), right[triads])

    motion, pushes = a[:n, :n], a[:n][:, joints]
    slopes, own = a[joints, :n], a[joints][:, joints]
    ends, middle = spins(reference + u1), spins(reference + 0.5 * (u0 + u1))

    def project() -> csr_matrix:
        left = middle.T.tocsr()
        return bmat([[left @ motion @ ends, left @ pushes], [slopes @ ends, own]]).tocsr()

    small = project()
    less = Factors(as_petsc(small))
    right_small = np.concatenate(
        [middle.T @ (right[:n] - motion @ off), right[joints] - slopes @ off]
    )
    found = ends @ less.solve(right_small)[: 6 * bodies] + off
    differ = np.abs(found - known[:n]).max() / np.abs(known[:n]).max()

    elements = [c for c in problem.elements if "directors" in c.name]
    places = [c.reference() for c in elements]
    unknowns = [{"constraints": np.zeros((c.num_elements, 6))} for c in elements]
    parts = {
        "linear solves": iterations * cost(lambda: full.solve(right)),
        "reduced": iterations * cost(lambda: less.solve(right_small)),
        "projection": iterations * cost(project),
        "assembly of all matrices": iterations * cost(lambda: solver.assemble(e)),
        "directors' elements": (iterations + 1)
        * cost(lambda: evaluate_together(problem.system.comm, elements, places, unknowns)),
    }
    print(
        f"{bodies} bodies: {a.shape[0]} unknowns and {a.nnz} entries, {small.shape[0]} and "
        f"{small.nnz} reduced; same motion to {differ:.1e}; {1e3 * step:.1f} ms a step of "
        f"{iterations:.1f} iterations, of which"
    )
    print("    " + ", ".join(f"{name} {value / step:.1%}" for name, value in parts.items()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bodies", type=int, nargs="+", default=[10, 100])
    for number in parser.parse_args().bodies:
        measure(number)
