"""The problem of one step as PETSc SNES callbacks: residual, nested Jacobian, convergence per block, diagnosis.

The momentum equation is multiplied by h/2 and the multipliers are h^2/2 lambda (theory section 8),
which makes the condition number independent of h. Nothing here changes a State.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from dolfinx_nts.assembly import ElementBlocks, Layout, StepMatrix
from dolfinx_nts.contact import ContactStep, Contribution
from dolfinx_nts.system import State, System

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]

#: Direct solve of the converted AIJ; symmetric indefinite pivoting needs more workspace than
# MUMPS's own guess.
DEFAULT_PETSC_OPTIONS: Mapping[str, Any] = {
    "snes_linesearch_type": "basic",
    "ksp_type": "preonly",
    "pc_type": "lu",
    "pc_factor_mat_solver_type": "mumps",
    "mat_mumps_icntl_14": 80,
}
_EPS = float(np.finfo(float).eps)
_prefixes = itertools.count()


@dataclass(frozen=True, kw_only=True)
class Newton:
    """When a step counts as solved and how hard to try.

    Attributes:
        rtol: Largest residual of a block relative to the forces (or motions) of the step, > 0.
        max_iterations: Newton iterations before a step is dropped.
        max_retries: How often a dropped step may be halved before the run stops.
        condense: Eliminate (d, f) and their multipliers pair by pair, so that only the bodies and
            lambda_N reach the linear solver; the same solution with a smaller factorisation.

    Raises:
        ValueError: An argument is out of range.
    """

    rtol: float = 1e-12
    max_iterations: int = 25
    max_retries: int = 8
    condense: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.rtol < 1:
            raise ValueError(f"rtol={self.rtol!r}: must lie in (0, 1)")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations={self.max_iterations!r}: must be at least 1")
        if self.max_retries < 0:
            raise ValueError(f"max_retries={self.max_retries!r}: must not be negative")


class StepFailedError(RuntimeError):
    """A step was not solved; the message names the worst block, nodes and facets."""


@dataclass(frozen=True, eq=False)
class BodyTerms:
    """Parts of a body's equation at an iterate, owned coordinates, [kg m] except u1 and du [m].

    Attributes:
        u1: Displacement at t_{n+1}.
        du: u_1 - u_0.
        internal: h^2/2 internal forces.
        external: h^2/2 external forces.
        contact: h^2/2 contact forces G^T lambda.
        residual: Complete equation, also at prescribed coordinates, where it is h^2/2 times the
            reaction.
    """

    u1: FloatArray
    du: FloatArray
    internal: FloatArray
    external: FloatArray
    contact: FloatArray
    residual: FloatArray


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The step equations at an iterate.

    Attributes:
        x: Iterate it belongs to, this rank's part.
        bodies: Terms of each body.
        contacts: Contribution of each contact.
        multipliers: Multipliers of each contact [kg m], shape (n, multipliers).
        ratio: Residual of each block over what counts as converged; solved when all are <= 1.
        iterations: Newton iterations it took.
    """

    x: FloatArray
    bodies: tuple[BodyTerms, ...]
    contacts: tuple[Contribution, ...]
    multipliers: tuple[FloatArray, ...]
    ratio: dict[str, float]
    iterations: int = 0


@dataclass(eq=False)
class _Workspace:
    """PETSc objects of one layout, reused while the candidates stay the same."""

    layout: Layout
    numbers: tuple[Any, ...]
    elements: list[ElementBlocks]
    x: Any
    f: Any
    forces: Any
    local: Any
    scatter: Any
    snes: Any
    matrix: StepMatrix | None = None
    options: list[str] = field(default_factory=list)

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        database = PETSc.Options()
        for key in self.options:
            database.delValue(key)
        if self.matrix is not None:
            self.matrix.destroy()
        for a in (self.snes, self.scatter, self.local, self.forces, self.f, self.x):
            a.destroy()


class StepProblem:
    """One step of a system with an integrator; `begin` fixes the step, `solve` solves it.

    Args:
        system: The scene.
        integrator: `Midpoint()` or `EnergyMomentum()`.
        newton: Tolerances.
        petsc_options: PETSc options of the SNES without prefix; they override the defaults.
    """

    def __init__(
        self,
        system: System,
        integrator: Any,
        newton: Newton,
        petsc_options: Mapping[str, Any] | None,
    ) -> None:
        self.system, self.integrator, self.newton = system, integrator, newton
        self._options = {**DEFAULT_PETSC_OPTIONS, **(petsc_options or {})}
        self._work: _Workspace | None = None

    # ---- set-up of a step
    def begin(self, state: State, dt: float) -> None:
        """Fix the state at t_n and the step: loads, candidates, layout, first guess.

        Args:
            state: State at t_n.
            dt: Step [s].
        """
        system = self.system
        self._state, self._dt, self._factor = state, dt, 0.5 * dt**2
        for body, u, v in zip(system.bodies, state.u, state.v, strict=True):
            body.begin_step(self.integrator, u, v, state.time, dt)
        self._inertia = [b.inertia(dt * v) for b, v in zip(system.bodies, state.v, strict=True)]
        self._first = [u + dt * v for u, v in zip(state.u, state.v, strict=True)]
        for body, u1 in zip(system.bodies, self._first, strict=True):
            u1[body.fixed] = body.prescribed(state.time + dt)
        local = np.array(
            [
                [np.abs(u1 - u).max(initial=0.0), np.abs(b.reference + u1).max(initial=0.0)]
                for b, u1, u in zip(system.bodies, self._first, state.u, strict=True)
            ]
        )
        self._motion, self._extent = _global_max(system.comm, local).T
        self._spread = np.zeros(len(system.bodies))
        self.contacts = [self._contact_step(k) for k in range(len(system.contacts))]
        self._prepare()
        self._last: Evaluation | None = None
        self._flips = [np.zeros(c.num_pairs, dtype=int) for c in self.contacts]

    def _contact_step(self, index: int) -> ContactStep:
        pair, state = self.system.contacts[index], self._state
        slave, master = (self.system.body_index(s.body) for s in (pair.slave, pair.master))
        reach = np.sqrt(3.0) * float(self._motion[slave] + self._motion[master])
        found = pair.find(state.u[slave], state.u[master], state.facets[index], reach)
        corners = pair.master.positions(state.u[master])[pair.master.facets[found.facet]]
        x = pair.slave.positions(state.u[slave])[pair.slave.owned[found.node]]
        mass = pair.slave.body.nodal_mass[pair.slave.rows[found.node, 0]]
        x0 = np.concatenate([x[:, None], corners], axis=1)
        return ContactStep(
            pair, found, self.integrator.contact_gradient, self.newton.condense, x0, mass
        )

    def _prepare(self) -> None:
        """Layout, scatter and solver of this step; kept from the last one if no rank's candidates changed."""
        system = self.system
        numbers = tuple(a for c in self.contacts for a in c.points())
        same = self._work is not None and _equal(numbers, self._work.numbers)
        if not system.comm.allreduce(same, op=MPI.LAND):
            self.destroy()
            self._work = self._new_workspace(numbers)
        self._start()

    def _new_workspace(self, numbers: tuple[Any, ...]) -> _Workspace:
        system, contacts, nb = self.system, self.contacts, len(self.system.bodies)
        sizes = [b.num_owned for b in system.bodies]
        augmented = sum(c.num_pairs * c.num_augmented for c in contacts)
        multipliers = sum(c.num_pairs * c.num_multipliers for c in contacts)
        any_contact = system.comm.allreduce(multipliers) > 0
        has_augmented = any_contact and any(c.num_augmented for c in contacts)
        self._fields = ([nb] if has_augmented else []) + (
            [nb + has_augmented] if any_contact else []
        )
        layout = Layout(
            system.comm, sizes + [augmented] * has_augmented + [multipliers] * any_contact
        )
        x = PETSc.Vec().createMPI((layout.num_owned, None), comm=system.comm)
        index = [np.empty((0,), np.int64)]
        for c in contacts:
            slave, master = (system.body_index(s.body) for s in (c.pair.slave, c.pair.master))
            s, m = c.points()
            index.append(
                np.concatenate(
                    [layout.to_system(slave, s), layout.to_system(master, m)], axis=1
                ).ravel()
            )
        needed = np.concatenate(index)
        local = PETSc.Vec().createSeq(len(needed), comm=PETSc.COMM_SELF)
        source = PETSc.IS().createGeneral(needed.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        scatter = PETSc.Scatter().create(x, source, local, None)
        source.destroy()
        work = _Workspace(
            layout, numbers, self._element_blocks(layout), x, x.duplicate(), x.duplicate(), local,
            scatter, PETSc.SNES().create(system.comm),
        )  # fmt: skip
        return work

    def _element_blocks(self, layout: Layout) -> list[ElementBlocks]:
        """Numbers of the contact elements' unknowns in their fields."""
        if not self._fields:
            return []
        blocks = []
        offset = [layout.start(f) for f in self._fields]
        for c in self.contacts:
            slave, master = (self.system.body_index(s.body) for s in (c.pair.slave, c.pair.master))
            widths = (
                [3, 3 * c.num_corners]
                + [c.num_augmented] * (len(self._fields) - 1)
                + [c.num_multipliers]
            )
            stops = np.cumsum(widths)
            numbers = list(c.dofs())
            for k, width in enumerate(widths[2:]):
                numbers.append(
                    offset[k] + np.arange(c.num_pairs * width).reshape(c.num_pairs, width)
                )
                offset[k] += c.num_pairs * width
            pattern = np.ones((stops[-1], stops[-1]), dtype=bool)
            pattern[stops[-2] :, stops[-2] :] = False
            pattern[stops[-2], stops[-2]] = True
            columns = tuple(slice(int(b - w), int(b)) for w, b in zip(widths, stops, strict=True))
            blocks.append(
                ElementBlocks((slave, master, *self._fields), columns, tuple(numbers), pattern)
            )
        return blocks

    # ---- iterates
    def _parts(self, x: FloatArray, width: str, which: int) -> list[FloatArray]:
        """This rank's augmented unknowns or multipliers of each contact, shape (n, width)."""
        widths = [getattr(c, width) for c in self.contacts]
        if not self._fields or not any(widths):
            return [np.zeros((c.num_pairs, w)) for c, w in zip(self.contacts, widths, strict=True)]
        assert self._work is not None
        values = x[self._work.layout.owned(self._fields[which])]
        stops = np.cumsum([c.num_pairs * w for c, w in zip(self.contacts, widths, strict=True)])
        parts = np.split(values, stops[:-1])
        return [
            p.reshape(c.num_pairs, w) for p, c, w in zip(parts, self.contacts, widths, strict=True)
        ]

    def _start(self) -> None:
        """First guess: free flight, no contact force, d and f that fit it."""
        work = self._work
        assert work is not None
        with work.x as x:
            x[:] = 0.0
            for k, u1 in enumerate(self._first):
                x[work.layout.owned(k)] = u1
        positions = self._positions(work.x)
        if len(self._fields) == 2:
            guess = [
                c.initial_guess(p).ravel() for c, p in zip(self.contacts, positions, strict=True)
            ]
            with work.x as x:
                x[work.layout.owned(self._fields[0])] = np.concatenate(guess)

    def _positions(self, x: Any) -> list[FloatArray]:
        """Slave and corner positions of each contact's pairs at an iterate, shape (n, nc + 1, 3)."""
        work = self._work
        assert work is not None
        work.scatter.scatter(x, work.local, mode=PETSc.ScatterMode.FORWARD)
        u = work.local.array_r
        out, start = [], 0
        for c in self.contacts:
            size = c.num_pairs * 3 * (c.num_corners + 1)
            s, m = c.pair.slave, c.pair.master
            reference = np.concatenate(
                [
                    s.reference[s.owned[c.candidates.node]][:, None],
                    m.reference[m.facets[c.candidates.facet]],
                ],
                axis=1,
            )
            out.append(reference + u[start : start + size].reshape(reference.shape))
            start += size
        return out

    def evaluate(self, x: Any) -> Evaluation:
        """The step equations at an iterate; pure. Every rank must call it.

        Args:
            x: PETSc vector of the unknowns.
        """
        work, system = self._work, self.system
        assert work is not None
        values = x.array_r.copy()
        positions = self._positions(x)
        multipliers = self._parts(values, "num_multipliers", -1)
        contacts = tuple(
            c.evaluate(p, a, m)
            for c, p, a, m in zip(
                self.contacts,
                positions,
                self._parts(values, "num_augmented", 0),
                multipliers,
                strict=True,
            )
        )
        forces = [
            k.residual[:, : 3 * (c.num_corners + 1)]
            for c, k in zip(self.contacts, contacts, strict=True)
        ]
        work.local.array_w[:] = np.concatenate([np.empty(0), *(f.ravel() for f in forces)])
        work.forces.set(0.0)
        work.scatter.scatter(
            work.local,
            work.forces,
            addv=PETSc.InsertMode.ADD_VALUES,
            mode=PETSc.ScatterMode.REVERSE,
        )
        force = work.forces.array_r
        bodies = []
        for k, (body, u0) in enumerate(zip(system.bodies, self._state.u, strict=True)):
            here = work.layout.owned(k)
            u1 = values[here]
            internal = self._factor * body.internal(u1)
            external = self._factor * body.external(u1, system.gravity)
            du, contact = u1 - u0, force[here].copy()
            residual = body.inertia(du) - self._inertia[k] + internal - external + contact
            bodies.append(BodyTerms(u1, du, internal, external, contact, residual))
        ratio = self._ratios(bodies, contacts, multipliers)
        return Evaluation(values, tuple(bodies), contacts, tuple(multipliers), ratio)

    def _residual(self, e: Evaluation) -> FloatArray:
        """This rank's part of the residual, zero at prescribed coordinates."""
        work = self._work
        assert work is not None
        out = np.zeros(work.layout.num_owned)
        for k, (body, terms) in enumerate(zip(self.system.bodies, e.bodies, strict=True)):
            r = terms.residual.copy()
            r[body.fixed] = 0.0
            out[work.layout.owned(k)] = r
        for which, name in enumerate(
            ("augmented", "multipliers")[-len(self._fields) :] if self._fields else ()
        ):
            rows = [
                _rows(c, k, name).ravel() for c, k in zip(self.contacts, e.contacts, strict=True)
            ]
            out[work.layout.owned(self._fields[which])] = np.concatenate(rows)
        return out

    def _ratios(
        self,
        bodies: list[BodyTerms],
        contacts: tuple[Contribution, ...],
        multipliers: list[FloatArray],
    ) -> dict[str, float]:
        """Residual of each block over what counts as converged there."""
        squares = []
        for k, (body, terms) in enumerate(zip(self.system.bodies, bodies, strict=True)):
            free = terms.residual.copy()
            free[body.fixed] = 0.0
            parts = (free, self._inertia[k], terms.internal, terms.external, terms.contact)
            squares.append([float(p @ p) for p in parts])
        comm, rtol = self.system.comm, self.newton.rtol
        norms = np.sqrt(comm.allreduce(np.array(squares)))
        ratio = {}
        for k, body in enumerate(self.system.bodies):
            limit = rtol * norms[k, 1:].max() + _EPS * self._spread[k]
            ratio[body.name] = _over(norms[k, 0], limit)
        if self._fields:
            ratio |= self._contact_ratios(bodies, contacts, multipliers)
        return ratio

    def _contact_ratios(
        self,
        bodies: list[BodyTerms],
        contacts: tuple[Contribution, ...],
        multipliers: list[FloatArray],
    ) -> dict[str, float]:
        moved = max(float(np.abs(b.du).max(initial=0.0)) for b in bodies)
        local = [moved, float(np.isnan([c.residual.sum() for c in contacts]).any())]
        for c, k, m in zip(self.contacts, contacts, multipliers, strict=True):
            rows = [
                np.abs(_rows(c, k, name)).max(initial=0.0) for name in ("augmented", "multipliers")
            ]
            local += [*rows, np.abs(m).max(initial=0.0), c.mass.max(initial=0.0)]
        top = _global_max(self.system.comm, np.array(local))
        if top[1]:
            return {c.pair.name: np.inf for c in self.contacts}
        motion = max(top[0], float(self._motion.max()))
        length = motion * self.newton.rtol + 8 * _EPS * float(self._extent.max())
        ratio = {}
        for c, (a, m, force, mass) in zip(self.contacts, top[2:].reshape(-1, 4), strict=True):
            if c.num_augmented:
                ratio[f"{c.pair.name} (d, f)"] = _over(
                    a, self.newton.rtol * max(force, mass * motion)
                )
            ratio[f"{c.pair.name} constraints"] = _over(m, length)
        return ratio

    # ---- SNES
    def solve(self) -> Evaluation:
        """Solve the step that `begin` fixed.

        Raises:
            StepFailedError: Not converged; names the worst block, its node or facet, and active-set
                flips.
        """
        work = self._work
        assert work is not None
        if work.matrix is None:
            self._jacobian_blocks(work)
            self._configure(work)
        work.snes.solve(None, work.x)
        reason, iterations = work.snes.getConvergedReason(), work.snes.getIterationNumber()
        last = self._at(work.x)
        if reason <= 0:
            raise StepFailedError(self._diagnosis(last, reason, iterations))
        return Evaluation(
            last.x, last.bodies, last.contacts, last.multipliers, last.ratio, iterations
        )

    def _at(self, x: Any) -> Evaluation:
        """Evaluation at an iterate, reused while SNES asks for the same one."""
        same = self._last is not None and np.array_equal(self._last.x, x.array_r)
        if not self.system.comm.allreduce(same, op=MPI.LAND):
            new = self.evaluate(x)
            if self._last is not None:
                for count, a, b in zip(self._flips, self._last.contacts, new.contacts, strict=True):
                    count += a.active != b.active
            self._last = new
        assert self._last is not None
        return self._last

    def _jacobian_blocks(self, work: _Workspace) -> None:
        bodies = [b.tangent(u1) for b, u1 in zip(self.system.bodies, self._first, strict=True)]
        work.matrix = StepMatrix(work.layout, bodies, work.elements)
        work.matrix.assemble(
            [self._zero_tangent(c) for c in self.contacts] if work.elements else []
        )

    @staticmethod
    def _zero_tangent(c: ContactStep) -> FloatArray:
        size = 3 * (c.num_corners + 1) + c.num_augmented + c.num_multipliers
        return np.zeros((c.num_pairs, size, size))

    def _configure(self, work: _Workspace) -> None:
        matrix, snes = work.matrix, work.snes
        assert matrix is not None
        prefix = f"nts_{next(_prefixes)}_"
        snes.setOptionsPrefix(prefix)
        snes.setFunction(self._snes_function, work.f)
        snes.setJacobian(self._snes_jacobian, matrix.aij, matrix.aij)
        snes.setConvergenceTest(self._snes_converged)
        snes.setTolerances(max_it=self.newton.max_iterations)
        database = PETSc.Options()
        for key, value in self._options.items():
            database[prefix + key] = value
            work.options.append(prefix + key)
        snes.setFromOptions()
        pc = snes.getKSP().getPC()
        if pc.getType() == "fieldsplit" and self._fields:
            pc.setFieldSplitIS(*matrix.field_sets(len(self.system.bodies)))

    def _snes_function(self, snes: Any, x: Any, f: Any) -> None:
        f.array_w[:] = self._residual(self._at(x))

    def _snes_jacobian(self, snes: Any, x: Any, j: Any, p: Any) -> None:
        e, work = self._at(x), self._work
        assert work is not None and work.matrix is not None
        for k, (body, terms) in enumerate(zip(self.system.bodies, e.bodies, strict=True)):
            a = body.tangent(terms.u1)
            if self._spread[k] == 0.0:
                diagonal = a.getDiagonal()
                self._spread[k] = diagonal.norm() * self._extent[k]
                diagonal.destroy()
        work.matrix.assemble([c.tangent for c in e.contacts] if work.elements else [])

    def _snes_converged(self, snes: Any, iteration: int, norms: tuple[float, float, float]) -> Any:
        assert self._last is not None
        worst = max(self._last.ratio.values())
        if np.isnan(norms[2]) or not np.isfinite(worst):
            return PETSc.SNES.ConvergedReason.DIVERGED_FNORM_NAN
        if worst <= 1.0:
            return PETSc.SNES.ConvergedReason.CONVERGED_FNORM_RELATIVE
        if iteration >= self.newton.max_iterations:
            return PETSc.SNES.ConvergedReason.DIVERGED_MAX_IT
        return PETSc.SNES.ConvergedReason.ITERATING

    def _diagnosis(self, e: Evaluation, reason: int, iterations: int) -> str:
        """One sentence that names what failed and where; every rank must call it."""
        worst = max(e.ratio, key=lambda name: np.nan_to_num(e.ratio[name], nan=np.inf))
        notes = [
            _contact_note(c, k, flips)
            for c, k, flips in zip(self.contacts, e.contacts, self._flips, strict=True)
            if c.num_pairs
        ]
        notes += [
            _body_note(body, terms)
            for body, terms in zip(self.system.bodies, e.bodies, strict=True)
            if body.num_owned
        ]
        gathered = [n for part in self.system.comm.allgather(notes) for n in part]
        top = [text for _, text in sorted(gathered, key=lambda n: -n[0])[:4]]
        return (
            f"step from t={self._state.time:.6g} with dt={self._dt:.3g} not solved after "
            f"{iterations} iterations (SNES reason {reason}); worst block {worst!r} at "
            f"{e.ratio[worst]:.3g} times its tolerance; {'; '.join(top)}"
        )

    def destroy(self) -> None:
        """Free the PETSc objects of the current layout."""
        if self._work is not None:
            self._work.destroy()
            self._work = None


def _contact_note(c: ContactStep, k: Contribution, flips: IntArray) -> tuple[float, str]:
    """The pair that flipped most or is worst solved, with its rank among all notes."""
    rows = np.abs(k.residual[:, 3 * (c.num_corners + 1) :]).max(axis=1)
    weight = np.nan_to_num(rows, nan=np.inf) * (1 + flips)
    i = int(np.argmax(weight))
    node = int(c.pair.slave.original[c.pair.slave.owned[c.candidates.node[i]]])
    facet, count = int(c.candidates.facet[i]), int(flips[i])
    text = f"contact {c.pair.name!r}: node {node} on facet {facet}, {count} active-set flips"
    return float(weight[i]), text


def _body_note(body: Any, terms: BodyTerms) -> tuple[float, str]:
    """Where the body's equation is worst solved; ranked below contact."""
    r = np.nan_to_num(np.abs(terms.residual), nan=np.inf)
    r[body.fixed] = 0.0
    x = ", ".join(f"{c:.4g}" for c in body.reference.reshape(-1, 3)[int(np.argmax(r)) // 3])
    return 0.0, f"body {body.name!r}: largest residual at X = ({x})"


def _global_max(comm: Any, values: FloatArray) -> FloatArray:
    out = np.array(values, dtype=np.float64)
    comm.Allreduce(MPI.IN_PLACE, out, op=MPI.MAX)
    return out


def _over(value: float, limit: float) -> float:
    if value == 0.0:
        return 0.0
    return float(value / limit) if limit > 0 else np.inf


def _rows(c: ContactStep, k: Contribution, name: str) -> FloatArray:
    start = 3 * (c.num_corners + 1)
    middle = start + c.num_augmented
    return k.residual[:, start:middle] if name == "augmented" else k.residual[:, middle:]


def _equal(a: tuple[Any, ...], b: tuple[Any, ...]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
