"""What bodies with a DOLFINx function space and forms in UFL have in common."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.conditions import Dirichlet, Supports
from dolfinx_nts.bodies.mesh_body import MeshBody
from dolfinx_nts.bodies.meshes.mesh_check import pieces_of, places_of
from dolfinx_nts.bodies.nodal_values import motion_on, nodal_values, order_of_input
from dolfinx_nts.bodies.solid.arguments import check_surface
from dolfinx_nts.bodies.solid.cell_means import CellMeans
from dolfinx_nts.bodies.solid.inversion import Determinants
from dolfinx_nts.bodies.solid.mass import MassMatrix, waves
from dolfinx_nts.bodies.solid.materials import misfit
from dolfinx_nts.bodies.solid.parameters import (
    Parameter,
    WatchedParameters,
    in_expressions,
    is_number,
    require_positive_parameter,
    values_of,
)
from dolfinx_nts.bodies.solid.step_forms import StepForms, check_extra_form, fill
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.forms import compile_forms
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.interaction.points import Points, in_mesh
from dolfinx_nts.parallel import anywhere, global_sum
from dolfinx_nts.types import ExtraForm, FloatArray, IntArray, Places, Settings, Values
from dolfinx_nts.validation import UserFunctionError, require_bool, require_name, vectors


class UflBody(MeshBody):
    """A body whose coordinates are the nodes of a Lagrange space of 3-vectors.

    A kind of body calls `_stand`, then `_set_forms`, and has `_mass_form` and `_virtual_work`.

    Args:
        space: Function space of the displacements.
        degree: Its polynomial degree.
        name: Name in messages and files.
        extra_form: As of `Continuum`.
        quadrature_degree: That of the energy; cells of 3D meshes are watched at its points.
        allow_inversion: As of `Continuum`.
        viscous: Virtual work of a viscosity, as of `StepForms`.
        following: That of loads that follow the body, as `extra_form`.
    """

    _mass: MassMatrix

    def __init__(
        self, space: fem.FunctionSpace, degree: int, name: str, extra_form: ExtraForm | None,
        quadrature_degree: int, allow_inversion: bool, viscous: Any = None,
        following: ExtraForm | None = None,
    ) -> None:  # fmt: skip
        require_name("name", name)
        require_bool("allow_inversion", allow_inversion)
        if extra_form is not None and not callable(extra_form):
            raise TypeError(f"extra_form={extra_form!r}: pass a callable (u, v, w, t) -> UFL form")
        self.name, self.space, self.degree, self._extra_form = name, space, degree, extra_form
        self.mesh = space.mesh
        self.made_on = places_of(self.mesh)
        self.comm = petsc_compat.petsc_communicator(self.mesh.comm)
        self.u, self.v = motion_on(space, name)
        self.num_owned = 3 * space.dofmap.index_map.size_local
        self.reference = space.tabulate_dof_coordinates().ravel()[: self.num_owned].copy()
        self._stiffness: FloatArray | None = None
        self._meant: tuple[FloatArray, float] | None = None
        self._given_density: Parameter | None = None
        self.allow_inversion = allow_inversion
        # Cells of a surface or a line have no inside.
        solid = self.mesh.topology.dim == 3
        self._determinants = Determinants(space, degree, quadrature_degree) if solid else None
        self._forms = StepForms(
            space, self._virtual_work, self._mass_form, extra_form, viscous, self.check_alive,
            following,
        )  # fmt: skip

    # ---- what a kind of body has of its own
    def _mass_form(self, v: Any, w: Any) -> Any:
        """Kinetic energy's second derivative in UFL, linear in v and w."""
        raise NotImplementedError

    def _check_parameters(self) -> None:
        """Raise ValueError unless parameters are in their ranges. Collective."""
        if self._given_density is not None:
            require_positive_parameter("density", self._given_density, "kg/m^d")

    def _virtual_work(self, rule: Integrator, u0: Any, u1: Any, w: Any) -> Any:
        """Internal virtual work between two displacements, as of `StepForms`."""
        raise NotImplementedError

    @cached_property
    def pieces(self) -> int:  # type: ignore[override]
        """As of `Body`."""
        return pieces_of(self.mesh) if self.mesh.topology.dim == 3 else 1

    def _check_surface(self, mass: str) -> None:
        """As of `MeshBody`."""
        check_surface(self.mesh, int(self.degree or 1), self.name, mass)

    def _make_massless(self, surface: Surface) -> None:
        """As of `MeshBody`."""
        self.check_alive()
        what = f"mass='redistributed' of a surface of {self.name!r}"
        if self._forms.used:
            raise ValueError(f"{what}: the body has moved already; ask for it before the first run")
        massless = self.massless.copy()
        massless.reshape(-1, 3)[surface.rows] = True
        problem = self._mass.redistribute(
            massless[::3], self.reference.reshape(-1, 3), self.fixed
        )
        if problem:
            raise ValueError(
                f"{what}: beside its nodes without mass the body {problem}; use a finer mesh, a "
                "smaller surface, or mass='consistent'"
            )
        self.massless, self.has_massless = massless, True
        self.nodal_mass = self._mass.nodal

    def waves_in_layer(self) -> tuple[float, float]:
        """Massless layer's thickness over the body's, and wave speeds, see `waves`. Collective."""
        return waves(
            lambda u: self.potential(u.ravel()), self.reference.reshape(-1, 3),
            self._mass.nodal_before[::3], self.massless[::3], self.comm,
        )  # fmt: skip

    def points(self, x: Places) -> Points:
        """As of `Body`; ValueError for a point in no cell. Collective."""
        return in_mesh(self, vectors("x", x, "points [m]"), "x")

    def file_order(self) -> IntArray:
        """As of `Body`. Collective."""
        return order_of_input(self.space)

    # ---- set-up
    def _stand(self, bcs: Sequence[Dirichlet], velocity: Values, displacement: Values) -> None:
        """Set conditions, and displacement and velocity at the start."""
        self._supports = Supports(self.comm, self.space, bcs, self.name)
        self.fixed, self.driven = self._supports.fixed, self._supports.driven
        given = nodal_values(self.space, "velocity", self.name, velocity, "m/s")
        self.v.x.array[:] = given.ravel()
        self.v.x.array[self._supports.still] = 0.0
        self.v.x.scatter_forward()
        self.initial_velocity = self.v.x.array[: self.num_owned].copy()
        given = nodal_values(self.space, "displacement", self.name, displacement, "m")
        self.u.x.array[:] = given.ravel()
        self.starts_moved = anywhere(self.comm, bool(self.u.x.array.any()))
        self.u.x.array[self.fixed] = self.prescribed(0.0)
        self.u.x.scatter_forward()
        self.initial_displacement = self.u.x.array[: self.num_owned].copy()
        if self._determinants is not None and self.starts_moved and not self.allow_inversion:
            self._determinants.refuse_inverted(self.u.x.array, self.name)

    def _set_forms(
        self, energy: Any, *loads: Any, means: CellMeans | None = None, others: Sequence[Any] = ()
    ) -> list[Any]:
        """Compile mass and energy in UFL and any loads, which are returned.

        Args:
            energy: Of `self.u`.
            loads: Linear forms.
            means: Means in cells that the energy holds.
            others: Expressions whose parameters may change, too.
        """
        v, w = ufl.TrialFunction(self.space), ufl.TestFunction(self.space)
        mass, own = self._mass_form(v, w), [self.u]
        if means is not None:
            own += means.functions
            means.compile(self.u)
        self._means = means
        of_energy, of_mass = (
            in_expressions((part.integrand() for part in form.integrals()), own)
            for form in (energy, mass)
        )
        self._parameters = WatchedParameters(
            self.comm, self.name, of_mass, [*of_energy, *in_expressions(others)],
            self._check_parameters,
        )  # fmt: skip
        if self._extra_form is not None:
            check_extra_form(self, self._extra_form, w)
        self._energy_form, mass_form, *compiled = compile_forms([energy, mass, *loads])
        self._load = np.zeros(self.num_owned)
        self._mass = MassMatrix(mass_form)
        self.nodal_mass = self._mass.nodal
        return compiled

    def _density(self, density: Any) -> Any:
        """A density as the forms take it; it is checked again where it changes."""
        self._given_density = density
        return self._on_mesh("density", density)

    def _on_mesh(self, name: str, value: Any) -> Any:
        """A parameter as the forms take it; ValueError if it is on another mesh."""
        if is_number(value):
            # Bodies of any number share compiled forms.
            return fem.Constant(self.mesh, float(value))
        problem = misfit([value], self.mesh.ufl_domain())
        if problem:
            raise ValueError(f"{name}={value!s} of {self.name!r}: {problem}")
        return value

    # ---- as of Body
    def begin_step(self, rule: Integrator, moment: EvaluationPoint) -> None:
        """Set the state at t_n."""
        self._forms.begin(rule, moment)

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v [kg m/s for a velocity]."""
        self.check_alive()
        return self._mass.times(v)

    def internal(self, u1: FloatArray) -> FloatArray:
        """Internal forces of the step [N]."""
        return self._forms.internal(u1)

    def external(self, u1: FloatArray, gravity: FloatArray) -> FloatArray:
        """Loads and gravity, less the extra work [N]."""
        force = self._load.copy()
        if gravity.any():
            force += self.weight(gravity)
        return force - self._forms.extra(u1)

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> PETSc.Mat:
        """Return mass M + stiffness K, the same matrix in each call."""
        self.check_alive()
        diagonal = mass * self._mean(self.nodal_mass)
        if not mass:
            diagonal = stiffness * self._mean(self.nodal_stiffness())
        matrix = self._forms.tangent(u1, mass, stiffness, self._supports.masks, diagonal)
        return self._mass.corrected(matrix, mass)

    def _mean(self, values: FloatArray) -> float:
        """Over all coordinates, known as long as the array is the same object. Collective."""
        if self._meant is None or self._meant[0] is not values:
            total = global_sum(self.comm, np.array([values.sum(), self.num_owned]))
            self._meant = values, float(total[0] / total[1])
        return self._meant[1]

    def nodal_stiffness(self) -> FloatArray:
        """Mean diagonal of the tangent in equilibrium at each node, without deformation [N/m]."""
        self.check_alive()
        if self._stiffness is None:
            # The mean of a node's three entries does not depend on the directions of the axes.
            mean = self._forms.stiffness_at_rest().reshape(-1, 3).mean(axis=1)
            self._stiffness = np.repeat(mean, 3)
        return self._stiffness

    def reactions(self, residual: FloatArray, u1: FloatArray) -> FloatArray:
        """Resultants on the coordinates of each `Dirichlet` condition, this rank's part [N]."""
        return self._supports.reactions(residual)

    def prescribed(self, time: float) -> FloatArray:
        """Prescribed displacements at a time, in the order of `fixed` [m]. Collective."""
        return self._supports.prescribed(time)

    def potential(self, u: FloatArray) -> float:
        """Strain energy on this rank [J]."""
        kept = self.u.x.array.copy()
        fill(self.u, u)
        if self._means is not None:
            self._means.evaluate()
        value = self._energy_form.value()
        self.u.x.array[:] = kept
        return value

    def smallest_det(self, u: FloatArray) -> tuple[float, FloatArray]:
        """As of `Body`, at corners and quadrature points of cells in 3D."""
        if self._determinants is None:
            return np.inf, np.full(3, np.nan)
        return self._determinants.smallest(self._forms.with_ghosts(u))

    @property
    def settings(self) -> Settings:
        """What ranks must have in common, see `Body`."""
        constants = [t.value for t in self._parameters.all if isinstance(t, fem.Constant)]
        return {"bcs": self._supports.settings, "constants in the material": constants}

    def parameters(self) -> FloatArray:
        """Values of Constants and Functions in energy and mass, which a caller may change, (n,)."""
        return values_of(self._parameters.all)

    def take_parameters(self) -> None:
        """Assemble the mass anew if what it is made of has changed. Collective.

        Raises:
            UserFunctionError: A value is out of range, there is no mass left, or it has been moved
                between nodes.
        """
        changed, of_mass = self._parameters.changed()
        if changed:
            self._stiffness = None
        if of_mass:
            self._renew_mass()
        self._parameters.take()

    def _renew_mass(self) -> None:
        if self.has_massless:
            raise UserFunctionError(
                f"density of {self.name!r}: has changed after mass='redistributed' of a surface "
                "took it from its nodes; keep it, or use mass='consistent'"
            )
        self._mass.assemble()
        self.nodal_mass = self._mass.nodal
        total = self.comm.allreduce(float(self.nodal_mass.sum())) / 3.0
        if not total > 0.0:
            raise UserFunctionError(
                f"mass of {self.name!r}: its parameters now make {total:.3g}; it must be "
                "positive"
            )

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Write the accepted state into the dolfinx Functions u and v."""
        fill(self.u, u)
        fill(self.v, v)

    def last_accepted(self) -> tuple[FloatArray, FloatArray]:
        """Owned values of the Functions u [m] and v [m/s]."""
        return self.u.x.array[: self.num_owned], self.v.x.array[: self.num_owned]

    def destroy(self) -> None:
        """Free the PETSc objects, for those who make many bodies; the body is of no use then."""
        super().destroy()
        for a in (self._mass, self._forms):
            a.destroy()
