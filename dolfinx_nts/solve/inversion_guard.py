"""Bodies that iterations must not turn inside out."""

from __future__ import annotations

from itertools import compress

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.bodies.solid.inversion import describe, forbidden, smallest_dets
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.parallel import global_max
from dolfinx_nts.types import FloatArray

#: An update that would leave less than this part of the smallest det F of a body is halved, ...
_KEPT_DET = 0.1
#: ... so often at most, ...
_HALVINGS = 10
#: ... and in so many iterations in a row before the step is dropped.
_SHORTENED = 5


class InversionGuard:
    """Watches the cells of a step's iterates and shortens updates that would invert them."""

    def __init__(self, problem: StepProblem) -> None:
        self._problem = problem
        self._known: dict[int, tuple[FloatArray, float]] = {}
        self._deform = not all(body.rigid for body in problem.system.bodies)
        self._careful, self._shortened = False, 0
        self._unshortened = np.empty(0)

    def begin(self, *, careful: bool) -> None:
        """Begin an attempt.

        Args:
            careful: Shorten updates. Where Newton's method ends well without that, as it does in
                most steps, what its iterates were does not matter.
        """
        self._careful, self._shortened = careful, 0

    @property
    def gives_up(self) -> bool:
        """Whether too many updates in a row were shortened."""
        return self._shortened >= _SHORTENED

    def smallest(self, x: FloatArray) -> FloatArray:
        """Smallest det F of each body at an iterate, shape (bodies,). Collective."""
        if not self._deform:
            return np.full(len(self._problem.system.bodies), np.inf)
        return smallest_dets(self._problem.system, self._displacements(x), self._known)

    def accepts(self, dets: FloatArray) -> bool:
        """Whether no body with these smallest det F is inside out that must not be."""
        return not self._deform or bool((forbidden(self._problem.system, dets) > 0.0).all())

    def is_sound(self, x: FloatArray) -> bool:
        """Whether no cell is inside out or nearly so at an iterate. Collective."""
        bodies = self._problem.system.bodies
        low = np.array([body.low_dets[1] for body in bodies])
        return bool((forbidden(self._problem.system, self.smallest(x)) > low).all())

    def shorten(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Scale an update y that SNES subtracts from x; tells whether it did. Collective."""
        if not self._careful:
            return False
        system, start, update = self._problem.system, x.array_r, y.array_r
        dets = forbidden(system, self.smallest(start))
        least = np.where(dets > 0.0, _KEPT_DET * dets, -np.inf)
        part = 1.0
        for _ in range(_HALVINGS):
            if (forbidden(system, self.smallest(start - part * update)) >= least).all():
                break
            part *= 0.5
        if part == 1.0:
            self._shortened = 0
            return False
        self._shortened += 1
        self._unshortened = start - update
        y.scale(part)
        return True

    def describe_inverted(self, x: FloatArray) -> tuple[int, str]:
        """The body whose cell is inside out or nearly so, the cell and a remedy. Collective."""
        system = self._problem.system
        worst = int(forbidden(system, self.smallest(x)).argmin())
        body = system.bodies[worst]
        text = "; ".join(describe(body, self._displacements(x)[worst]))
        if body.oriented:
            return worst, text
        return worst, f"{text}, {type(body).__name__}(..., allow_inversion=True) accepts it"

    def describe_shortened(self) -> str:
        """Why it gives up, and what the last update would have done in full. Collective."""
        x = self._unshortened
        worst = int(forbidden(self._problem.system, self.smallest(x)).argmin())
        text, _ = describe(self._problem.system.bodies[worst], self._displacements(x)[worst])
        return f"{_SHORTENED} updates in a row were shortened; in full, {text}"

    def describe_flat(self, x: FloatArray) -> tuple[int, str, bool] | None:
        """The cell that is nearly inside out at t_n or an iterate, if one is. Collective.

        Returns:
            The body's number, a sentence, and whether that may be all there is to say.
        """
        system = self._problem.system
        low = [body.low_dets[1] for body in system.bodies]
        # Iterates that run off tell less than where they began.
        for u in (list(self._problem.state.u), self._displacements(x)):
            over = forbidden(system, smallest_dets(system, u)) - low
            worst = int(over.argmin())
            if over[worst] <= 0.0:
                body = system.bodies[worst]
                sure = body.oriented or bool(over[worst] + low[worst] <= _KEPT_DET)
                return worst, "; ".join(describe(body, u[worst])), sure
        return None

    def _displacements(self, x: FloatArray) -> list[FloatArray]:
        """Displacement of each body at an iterate [m]; the array of t_n if it stays. Collective."""
        problem, u = self._problem, list(self._problem.state.u)
        places = problem.displacements(x)
        moves = problem.laid.moves(places, dict(enumerate(problem.batches.join(u))))
        now = problem.batches.split(places)
        for j in compress(problem.laid.awake, global_max(problem.system.comm, np.array(moves))):
            for k in problem.batches.numbers[j]:
                u[k] = now[k]
        return u
