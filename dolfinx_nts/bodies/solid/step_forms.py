"""Forms in UFL of a body: those that users hand over, and internal forces of a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.solid.cell_means import WithinCells
from dolfinx_nts.bodies.solid.materials import misfit
from dolfinx_nts.forms import assemble_vector, compile_forms
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.integrators.static import EQUILIBRIUM
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import ExtraForm, FloatArray, MassForm


def checked_form(
    body: Any, what: str, make: Callable[[], Any], wanted: set[Any], else_: str, remedy: str
) -> Any:
    """A form of the user's; what is wrong with it raises on every rank.

    Args:
        body: Whose mesh it is of.
        what: Argument that it comes from, and its value.
        make: Makes it.
        wanted: Its test and trial functions.
        else_: What to say if it has others.
        remedy: What to do.

    Raises:
        TypeError: It is none, or cannot be compiled on this mesh.
    """
    problem, cause, form, domain = None, None, None, body.mesh.ufl_domain()
    try:
        with compat.without_floats():
            form = make()
        arguments = set(form.arguments()) if isinstance(form, ufl.Form) else set()
    except Exception as error:  # any: a rank that raises alone would leave the others waiting
        problem, cause = f"raised {error!r}; {remedy}", error
    else:
        if not isinstance(form, ufl.Form):
            problem = f"returned an object of type {type(form).__name__}; {remedy}"
        elif arguments != wanted:
            problem = f"{else_}; {remedy}"
        elif any(d != domain for d in form.ufl_domains()):
            problem = "has a measure of another mesh; use ufl.dx, or one of the body's mesh"
        else:
            problem = misfit([part.integrand() for part in form.integrals()], domain)
    text = f"{what} of {body.name!r}: {problem}"
    raise_together(body.comm, text if problem else None, TypeError, cause)
    return form


def check_extra_form(body: Any, extra_form: ExtraForm, w: Any) -> None:
    """Raise on every rank unless a form of the user's is linear in the test function w alone."""
    # Sums, as those that it will be given.
    given = body.u + body.v, body.u - body.v, w, fem.Constant(body.mesh, 0.0)
    checked_form(
        body, f"extra_form={extra_form!r}", lambda: extra_form(*given), {w},
        "is not linear in the test function w alone",
        "return a UFL form like 3.0 * ufl.inner(v, w) * ufl.dx",
    )  # fmt: skip


#: See `StepForms`.
VirtualWork = Callable[
    [Integrator, Any, Any, Any], tuple[Any, Callable[[Any, Any, Any], WithinCells] | None]
]


class _Compiled(NamedTuple):
    """Forms by a rule.

    Attributes:
        work: Internal virtual work, with that of a viscosity.
        tangent: Mass and stiffness.
        extra: Extra virtual work, if there is any.
        power: What a viscosity takes [W], if there is any.
        cells: What is within cells, if there is anything.
        following: Virtual work of loads that follow and its tangent, if there are such. One form
            takes tags of one set alone, and `extra` may have others.
    """

    work: Any
    tangent: Any
    extra: Any
    power: Any
    cells: WithinCells | None
    following: list[Any]


class StepForms:
    """What a body's energy does in a step, compiled once for each integrator.

    Arrays are the owned values of nodal vectors, shape (n,).

    Args:
        space: Function space of the displacements.
        virtual_work: The internal virtual work in UFL by an integrator, between two displacements:
            (rule, u0, u1, w) -> form, and None or what makes of (form, w, u1) the form with all
            that it holds within cells.
        mass: Kinetic energy's second derivative in UFL, (v, w) -> form.
        extra: As `extra_form` of `Continuum`.
        viscous: Virtual work of a viscosity in UFL, linear in v and w: (u, v, w) -> form of the
            place and the velocity where forces are taken; None: there is none.
        check_alive: Raises an error once the body was destroyed.
        following: Virtual work of loads that follow the body, as `extra`.
    """

    def __init__(
        self, space: fem.FunctionSpace, virtual_work: VirtualWork, mass: MassForm,
        extra: ExtraForm | None, viscous: Callable[[Any, Any, Any], Any] | None,
        check_alive: Callable[[], None], following: ExtraForm | None = None,
    ) -> None:  # fmt: skip
        self._check_alive, self._loads = check_alive, following
        self._space, self._virtual_work, self._mass, self._extra = space, virtual_work, mass, extra
        self._viscous = viscous
        self._forms: dict[Integrator, _Compiled] = {}
        self._u0, self._u1, self._drift = (fem.Function(space) for _ in range(3))
        # What multiplies mass and stiffness: in one Constant, as UFL sorts several by their counts
        # as text, and a form would be compiled again where 9 and 10 meet.
        self._factors = fem.Constant(space.mesh, np.zeros(2))
        # Change of the velocity with u_1; time.
        self._rate, self._time = (fem.Constant(space.mesh, 0.0) for _ in range(2))
        self._vector = petsc_compat.create_vector(space)
        self._size, self._alone = self._vector.getLocalSize(), space.mesh.comm.size == 1
        self._matrix: Any = None

    @property
    def used(self) -> bool:
        """Whether a step was made with them."""
        return bool(self._forms)

    def begin(self, rule: Integrator, moment: EvaluationPoint) -> None:
        """Set the state at t_n."""
        forms = self._compiled(rule)
        self._work, self._tangent, self._extra_work, self._power, self._cells, following = forms
        self._following, self._turning = following[:1], following[1:]
        if self._matrix is None:
            self._matrix = petsc_compat.create_matrix(self._tangent)
        fill(self._u0, moment.u0)
        if self._cells is not None:
            self._cells.begin(moment.inner)
        self._rate.value, self._time.value = moment.rate, moment.time
        rates = self._extra is not None or self._viscous is not None
        if rates and moment.drift is not None:
            fill(self._drift, moment.drift)

    def internal(self, u1: FloatArray) -> FloatArray:
        """Internal forces of the step [N]."""
        self._move_to(u1)
        return self.assemble(self._work)

    def extra(self, u1: FloatArray) -> FloatArray | float:
        """Forces of the extra virtual work and of loads that follow [N]."""
        own = [] if self._extra_work is None else [self._extra_work]
        if not (own or self._following):
            return 0.0
        fill(self._u1, u1)
        return np.sum([self.assemble(form) for form in own + self._following], axis=0)

    def power(self, u1: FloatArray) -> float:
        """What a viscosity takes where the step takes its forces, this rank's part [W]."""
        if self._power is None:
            return 0.0
        fill(self._u1, u1)
        return float(self._power.value())

    def tangent(
        self, u1: FloatArray, mass: float, stiffness: float, masks: Any, diagonal: float
    ) -> PETSc.Mat:
        """Return mass M + stiffness K, the same matrix in each call.

        Args:
            u1: Displacement at t_{n+1} [m].
            mass: Factor of M.
            stiffness: Factor of K.
            masks: Of prescribed coordinates, whose rows and columns are left out.
            diagonal: What stands on the diagonal there.
        """
        self._move_to(u1)
        self._factors.value = mass, stiffness
        petsc_compat.assemble_matrix(
            self._matrix, self._tangent, masks, diagonal, *self._turning
        )
        if self._cells is not None:
            self._cells.add_to(self._matrix, stiffness, masks)
        return self._matrix

    def _move_to(self, u1: FloatArray) -> None:
        """Set the displacement at t_{n+1}, and what follows from it within cells."""
        fill(self._u1, u1)
        if self._cells is not None:
            self._cells.move()

    def inner(self, u1: FloatArray) -> FloatArray:
        """What the next step goes on from within cells, see `Body.inner`."""
        if self._cells is None:
            return np.empty(0)
        self._move_to(u1)
        return self._cells.inner

    def inner_at_rest(self, u: FloatArray) -> FloatArray:
        """What is within cells in equilibrium at a displacement, as of `inner`."""
        cells = self._compiled(EQUILIBRIUM).cells
        if cells is None:
            return np.empty(0)
        for function in (self._u0, self._u1):
            fill(function, u)
        cells.begin(None)
        cells.move()
        return cells.inner

    def forces(self, rule: Integrator, u0: FloatArray, u1: FloatArray) -> FloatArray:
        """Internal forces by a rule between two places of rest [N]; set the state anew after it."""
        work, *_, cells, _ = self._compiled(rule)
        self._rate.value = 0.0
        fill(self._u0, u0)
        fill(self._u1, u1)
        if cells is not None:
            cells.begin(None)
            cells.move()
        return self.assemble(work)

    def stiffness_at_rest(self) -> FloatArray:
        """Diagonal of the tangent in equilibrium, without deformation [N/m]."""
        _, tangent, *_, cells, _ = self._compiled(EQUILIBRIUM)
        kept, rate = [f.x.array.copy() for f in (self._u0, self._u1)], self._rate.value.copy()
        for u in (self._u0, self._u1):
            u.x.array[:] = 0.0
        self._factors.value, self._rate.value = (0.0, 1.0), 0.0
        # The matrix of the step may be kept from an earlier one.
        matrix = petsc_compat.create_matrix(tangent)
        if cells is not None:
            cells.begin(None)
            cells.move()
        petsc_compat.assemble_matrix(matrix, tangent, (), 0.0)
        if cells is not None:
            cells.add_to(matrix, 1.0, ())
        diagonal = matrix.getDiagonal()
        found: FloatArray = diagonal.array_r.copy()
        for petsc_object in (diagonal, matrix):
            petsc_object.destroy()
        self._rate.value = rate
        for u, values in zip((self._u0, self._u1), kept, strict=True):
            u.x.array[:] = values
        return found

    def assemble(self, form: Any) -> FloatArray:
        """Owned entries of a compiled linear form."""
        self._check_alive()
        if self._alone:
            values = np.zeros(self._size)
            form.add(values)
            return values
        assemble_vector(self._vector, form)
        return self._vector.array_r.copy()

    def with_ghosts(self, u: FloatArray) -> FloatArray:
        """Values at all nodes of this rank, on one rank u itself. Collective."""
        self._check_alive()
        if self._alone:
            return u
        self._vector.array_w[:] = u
        self._vector.ghostUpdate()
        with self._vector.localForm() as here:
            return here.array_r.copy()

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for a in (self._vector, self._matrix):
            if a is not None:
                a.destroy()

    def _compiled(self, rule: Integrator) -> _Compiled:
        """Forms by a rule, compiled when they are asked for first."""
        if rule not in self._forms:
            du, w = ufl.TrialFunction(self._space), ufl.TestFunction(self._space)
            work, with_cells = self._virtual_work(rule, self._u0, self._u1, w)
            extra, power, moved = None, None, self._u1 - self._u0
            place, velocity = self._u0 + rule.theta * moved, self._rate * moved
            if rule.accelerations:
                velocity += self._drift
            if self._viscous is not None and rule.inertia:
                work += self._viscous(place, velocity, w)
                power = self._viscous(place, velocity, velocity)
            virtual = work
            if self._extra is not None:
                extra = self._extra(place, velocity, w, self._time)
                if self._u1 in extra.coefficients():  # else the tangent is that without it
                    virtual = work + extra
            tangent = self._factors[1] * ufl.derivative(virtual, self._u1, du)
            if rule.inertia:
                tangent += self._factors[0] * self._mass(du, w)
            cells = None if with_cells is None else with_cells(work, w, self._u1)
            own = [work] if cells is None else []
            *own, made = compile_forms([*own, tangent])
            of_extra, of_power = (
                None if form is None else compile_forms([form])[0] for form in (extra, power)
            )
            following = []
            if self._loads is not None:
                load = self._loads(place, velocity, w, self._time)
                turning = self._factors[1] * ufl.derivative(load, self._u1, du)
                following = compile_forms([load, turning])
            self._forms[rule] = _Compiled(
                (own or [cells])[0], made, of_extra, of_power, cells, following
            )
        return self._forms[rule]


def fill(function: Any, owned: FloatArray) -> None:
    """Give a dolfinx Function its owned values. Collective."""
    function.x.array[: len(owned)] = owned
    function.x.scatter_forward()
