"""Contact beside equations that a user assembles and solves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.bodies.batches import Batches
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.contact.contact_search import ContactSearch
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.equations.assembly import StepMatrix
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.integrators.static import EQUILIBRIUM
from dolfinx_nts.interaction.elements import Step, evaluate_together
from dolfinx_nts.interaction.evaluation import BodyTerms, Evaluation
from dolfinx_nts.parallel import global_max
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import StepFailedError, is_finite


class ContactTerms:
    """Unknowns, forces and tangents of contact, for a Newton solver of the user's own.

    The gap of each node in contact is closed at the end of a step (theory section 5), with forces
    in [N]: a load step of equilibrium, or a step of a dissipative integrator of the user's own. In
    each step come `begin`; `residual` and `jacobian` as often as the solver asks; `accept`. See
    `demos/own_problem.py`.

    Args:
        bodies: Bodies of the user's own, `nts.Body`, with its first six attributes but for
            `nodal_mass`, with `prescribed` and `nodal_stiffness`.
        contacts: Contacts between them and with obstacles.

    Raises:
        ValueError: As of `System`.
    """

    def __init__(self, bodies: Sequence[Body], contacts: Sequence[ContactPair]) -> None:
        self._system = System(bodies, contacts=contacts)
        self._search = ContactSearch(
            self._system.pairs, self._system.pair_bodies, self._system.comm
        )
        self.state: State = self._system.initial_state()
        self._system.refuse_overlap(self.state)
        self._laid: Unknowns | None = None
        self._matrix: StepMatrix | None = None

    def begin(self, time: float, reach: float) -> Any:
        """Find what may touch in the step that ends at a time. Collective.

        Args:
            time: End of the step [s], or pseudo time.
            reach: How far points may move in the step [m]; with a larger one more nodes become
                candidates, and no result changes.

        Returns:
            PETSc vector of the unknowns that holds a first guess: the displacements of each body,
            then the multipliers.

        Raises:
            ValueError: `time` or `reach` makes no step.
        """
        if not (is_finite(time) and time > self.state.time):
            raise ValueError(f"time={time!r}: must be later than the last, {self.state.time:.6g}")
        if not (is_finite(reach) and reach > 0.0):
            raise ValueError(f"reach={reach!r}: must be positive [m]")
        self.destroy()
        u, system = self.state.u, self._system
        size = np.array([np.abs(a).max(initial=0.0) for a in u])
        first = [a.copy() for a in u]
        for body, there in zip(system.bodies, first, strict=True):
            there[body.fixed] = body.prescribed(time)
        step = Step(
            state=self.state,
            dt=time - self.state.time,
            factor=1.0,
            integrator=EQUILIBRIUM,
            condense=True,
            first=first,
            ahead=[np.zeros_like(a) for a in u],
            motion=np.full(len(u), float(reach)),
            length=global_max(system.comm, size),
            stiffness=lambda body, _=(): body.nodal_stiffness(),
            moments=[],
            force_rounding=lambda bodies: 0.0,
        )
        self._time, self._reach = float(time), float(reach)
        self._search.begin(step, self.state.contacts, None, search=True)
        elements = self._search.elements
        batches = Batches(system.bodies, together=False)
        self._laid = laid = Unknowns(batches, range(len(u)), elements, self._search.bodies)
        with laid.x as x:
            for k, a in enumerate(u):
                x[laid.of_body(k)] = a
        if laid.own:
            places = laid.positions(laid.x, elements)
            guess = [self._search.guess(k, place).ravel() for k, place in enumerate(places)]
            with laid.x as x:
                x[laid.of_elements("constraints")] = np.concatenate(guess)
        return laid.x

    def displacements(self, x: PETSc.Vec) -> list[FloatArray]:
        """Displacements of each body at an iterate [m], this rank's part."""
        return [x.array_r[self._layout.of_body(k)].copy() for k in range(len(self.state.u))]

    def forces(self, x: PETSc.Vec) -> list[FloatArray]:
        """Forces of contact on the coordinates of each body [N]. Collective.

        Args:
            x: PETSc vector of the unknowns.
        """
        return self._forces(self._parts(x))

    def _forces(self, parts: Sequence[Any]) -> list[FloatArray]:
        """`forces` of an iterate's parts. Collective."""
        laid = self._layout
        if not laid.blocks:
            return [np.zeros_like(u) for u in self.state.u]
        total = laid.forces(self._search.elements, parts)
        return [-total[laid.of_body(k)] for k in range(len(self.state.u))]

    def residual(self, x: PETSc.Vec, forces: Sequence[FloatArray]) -> FloatArray:
        """The residual with contact, this rank's part. Collective.

        Args:
            x: PETSc vector of the unknowns.
            forces: Residual of each body without contact [N]: internal less external forces.

        Returns:
            Zero at `fixed` coordinates; then the constraints.
        """
        laid, out, parts = self._layout, np.zeros(len(x.array_r)), self._parts(x)
        bodies = zip(self._system.bodies, forces, self._forces(parts), strict=True)
        for k, (body, own, contact) in enumerate(bodies):
            rest = own - contact
            rest[body.fixed] = 0.0
            out[laid.of_body(k)] = rest
        if laid.own:
            both = zip(self._search.elements, parts, strict=True)
            rows = [c.rows(part, "constraints") for c, part in both]
            found = laid.own_rows("constraints", self._search.elements, rows)
            out[laid.of_elements("constraints")] = found
        return out

    def jacobian(self, x: PETSc.Vec, matrices: Sequence[Any]) -> Any:
        """PETSc matrix of the derivatives of `residual`, the same in each call of a step.

        Collective.

        Args:
            x: PETSc vector of the unknowns.
            matrices: PETSc matrix of each body without contact [N/m], the same in each call, with
                nothing but a diagonal in the rows and columns of `fixed`.
        """
        laid = self._layout
        if self._matrix is None:
            self._matrix = StepMatrix(laid.layout, matrices, laid.blocks)
        tangents = [part.tangent for part in self._parts(x)] if laid.blocks else []
        self._matrix.assemble(tangents)
        return self._matrix.operator

    def accept(self, x: PETSc.Vec) -> None:
        """Take a solution for the end of the step. Collective.

        Args:
            x: PETSc vector of the unknowns.

        Raises:
            StepFailedError: Bodies have moved by more than `reach`, and contact may have been
                missed: begin the step again with a larger one.
        """
        both = zip(self.displacements(x), self.state.u, strict=True)
        terms = [BodyTerms(u1, u1 - u0, *4 * [np.zeros_like(u0)]) for u1, u0 in both]
        parts = self._parts(x)
        e = Evaluation(x.array_r.copy(), tuple(terms), tuple, parts)
        bodies = zip(self._system.bodies, terms, strict=True)
        local = np.array([body.motion_of_points(t.du) for body, t in bodies])
        motion = global_max(self._system.comm, local)
        if self._search.misses(e, parts, motion):
            raise StepFailedError(
                f"step to t={self._time:.6g}: points move by up to {motion.max():.3g} with "
                f"reach={self._reach:.3g}, and contact may have been missed; begin the step again "
                "with a larger reach, or take a shorter one"
            )
        u = tuple(t.u1 for t in terms)
        rest = tuple(np.zeros_like(a) for a in u)
        self.state = State(self._time, u, rest, (), self._search.history(parts), ())

    def destroy(self) -> None:
        """Free the PETSc objects of the step; its vectors and matrices are of no use then."""
        if self._matrix is not None:
            self._matrix.destroy()
        if self._laid is not None:
            self._laid.destroy()
        self._matrix = self._laid = None

    @property
    def _layout(self) -> Unknowns:
        assert self._laid is not None, "begin comes first"
        return self._laid

    def _parts(self, x: PETSc.Vec) -> tuple[Any, ...]:
        """Contribution of the elements at an iterate. Collective."""
        laid, elements = self._layout, self._search.elements
        own = laid.own_values(x.array_r, elements)
        self._search.held.tell(elements, own)
        places = laid.positions(x, elements)
        return evaluate_together(self._system.comm, elements, places, own)
