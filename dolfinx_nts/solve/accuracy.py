"""When a step counts as solved, and the levels of accuracy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dolfinx_nts.solve.linear_solver import SOLVERS, choose
from dolfinx_nts.system import System
from dolfinx_nts.types import Options
from dolfinx_nts.validation import (
    is_finite,
    is_whole,
    known_options,
    require_bool,
    require_one_of,
)

#: Coordinates of shells from which a Krylov solver is worth it where they are stiff and steps long.
_MANY = 2000
#: Tolerance that leaves rounding.
EXACT = 1e-12
#: Coordinates from which on the bodies' matrices take most of a step.
_LARGE = 600


@known_options
@dataclass(frozen=True, kw_only=True)
class Newton:
    """When a step counts as solved and how hard to try.

    Attributes:
        rtol: Largest residual of a block relative to the forces (or motions) of the step, > 0.
        max_iterations: Newton iterations before a step is dropped; those in which friction of
            joints is blurred do not count, up to as many again.
        max_retries: How often a dropped step may be cut (to less than half) before the run stops.
        condense: Eliminate (d, f) and their multipliers pair by pair, so that only the bodies,
            lambda_N and lambda_T reach the linear solver: the same solution in fewer iterations.
        linear_solver: "direct" (MUMPS), "krylov" (FGMRES with incomplete factors of the bodies
            and a Schur complement for contact) or "multigrid" (FGMRES with an algebraic multigrid
            of an augmented Lagrangian, for statics). At 50,000 coordinates an iteration costs a
            fifth. Incomplete factors weaken as dt grows beyond the time a wave needs through an
            element, multigrid near incompressibility.
            "auto" starts with "krylov", except below 600 coordinates (100 where no contact is
            declared), in statics with "multigrid", except below 10,000 (20,000 beside rigid bodies,
            beams or shells), and with MUMPS where `petsc_options` has others than those of SNES;
            after a solve that needed more iterations than MUMPS is worth it takes MUMPS for some
            steps. Where MUMPS fails, it leaves out equations that repeat others for some steps.
            Nothing takes over from "krylov" or "multigrid" where you ask for them.
        reuse: Keep the bodies' matrices, and what the linear solver made of them, over iterations
            and steps for as long as Newton contracts well; contact is always linearised anew. None:
            while "krylov" is in use in dynamics of 600 coordinates or more, not counting those of
            rigid bodies and beams, nor of shells below 2,000. There matrices take most of the time;
            MUMPS would factorise about twice as often.

    Raises:
        TypeError: An argument is of another type.
        ValueError: An argument is out of range.
    """

    rtol: float = EXACT
    max_iterations: int = 25
    max_retries: int = 8
    condense: bool = True
    linear_solver: str = "auto"
    reuse: bool | None = None

    def __post_init__(self) -> None:
        if not (is_finite(self.rtol) and 0 < self.rtol < 1):
            raise ValueError(f"rtol={self.rtol!r}: must lie in (0, 1)")
        for name in ("max_iterations", "max_retries"):
            value = getattr(self, name)
            if not is_whole(value):
                raise TypeError(f"{name}={value!r}: pass a whole number")
        require_bool("condense", self.condense)
        if self.reuse is not None:
            require_bool("reuse", self.reuse)
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations={self.max_iterations!r}: must be at least 1")
        if self.max_retries < 0:
            raise ValueError(f"max_retries={self.max_retries!r}: must not be negative")
        require_one_of("linear_solver", self.linear_solver, SOLVERS)

    def keeps(self, system: System, inertia: bool) -> bool:
        """Whether matrices are kept while an iterative solver is in use. Collective.

        Args:
            system: The scene.
            inertia: Whether the step equations have inertia.
        """
        if self.reuse is not None:
            return self.reuse
        return inertia and _sizes(system, inertia)[0] >= _LARGE

    def preset(self, system: System, inertia: bool, given: Options) -> str:
        """Preset of the linear solver to begin with; arguments as of `choose`."""
        if self.linear_solver != "auto":
            return self.linear_solver
        size, mixed = _sizes(system, inertia)
        couples = bool(system.contacts or system.joints)
        return choose(size, couples, inertia, given, mixed)


def _sizes(system: System, inertia: bool) -> tuple[int, bool]:
    """Coordinates of bodies that an iterative solver is for, and whether there are others.

    Collective.
    """
    continua = [b for b in system.bodies if not b.joints]
    loose = [b for b in system.bodies if b.joints and not b.bound]
    local = [sum(b.num_owned for b in bodies) for bodies in (continua, loose)]
    size, other = (int(n) for n in system.comm.allreduce(np.array(local)))
    # Multigrid knows nothing of constraints; incomplete factors take a few well.
    if inertia and other >= _MANY:
        size += other
    return size, len(continua) < len(system.bodies)


#: What `simulate(accuracy=...)` stands for; what each costs and loses is measured by `tradeoff`.
ACCURACY: Mapping[str, Newton] = {
    "exact": Newton(),
    "balanced": Newton(rtol=1e-9, reuse=True),
    "fast": Newton(rtol=1e-6, reuse=True),
}
