"""Bodies of a user's own forms: any mesh, any stored energy of a vector unknown in UFL."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.conditions import Dirichlet
from dolfinx_nts.bodies.meshes.mesh_check import check_any_mesh
from dolfinx_nts.bodies.nodal_values import largest_side
from dolfinx_nts.bodies.solid.parameters import Parameter, require_positive_parameter
from dolfinx_nts.bodies.solid.step_forms import checked_form
from dolfinx_nts.bodies.solid.ufl_body import UflBody
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.kernels.potential import Potential
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import ExtraForm, MassForm, Values
from dolfinx_nts.validation import is_whole, known_options

#: Part of the mass that rounding may add where two directions, or two orders of nodes, differ.
_ROUNDING = 1e-12


@known_options
class FormBody(UflBody):
    """A body whose stored energy and mass are given in UFL: a membrane, a string, a bedded block.

    Its unknown is the displacement of a material point, a 3-vector on a mesh of any dimension, e.g.
    a flat membrane of normal n under a tension T [N/m], with a stiffness k [N/m]:

        P = ufl.Identity(3) - ufl.outer(n, n)  # grad is that of the surface: F = P + grad u

        def strain(u):
            h = ufl.grad(u)
            return 0.5 * (P * h + h.T * P + h.T * h)

        body = nts.FormBody(
            space, lambda e: (T * ufl.tr(e) + 0.5 * k * ufl.inner(e, e)) * ufl.dx,
            strain=strain, density=0.2, bcs=[...],
        )

    The energy-momentum scheme takes the mean of dPi/ds on the straight way between the strains s at
    both ends of a step, by the integrator's `quadrature_points` Gauss points. Where `strain` is of
    degree <= 2 in u, it keeps the energy up to that quadrature (three points: exactly for energies
    up to degree 6 in the strain), and the angular momentum where no rotation changes the strain.
    Without `strain` the way is that of u: the energy is kept in the same sense (degree 6 in u), not
    the angular momentum. The other integrators take dPi/du where they take all forces.

    Args:
        space: Continuous Lagrange space of 3-vectors.
        energy: Callable u -> stored energy Pi [J] as a UFL form, or of what `strain` returns.
        strain: Callable u -> what the energy depends on, a UFL expression or a tuple of them, each
            of which `energy` gets as an argument; best of degree <= 2 in u.
        density: Mass per reference volume, area or length [kg/m^d], > 0: a number, or a Constant or
            Function on the mesh, which may change between steps; or
        mass: callable (v, w) -> bilinear form [kg m/s . m/s], symmetric and positive definite, the
            same in all directions.
        velocity: Initial velocity [m/s], as of `Continuum`.
        displacement: Displacement [m] in which the body starts, as of `Continuum`.
        bcs: `Dirichlet` conditions, on parts of the mesh's boundary.
        name: Name in messages and files.
        quadrature_degree: Of all integrals of `energy` whose measures name none; default twice the
            degree of the space, which those of `density` and `mass` have at least.
        extra_form: Further virtual work such as damping and loads, as of `Continuum`.
        allow_inversion: On a 3D mesh, accept steps that turn a cell inside out, as of `Continuum`.

    Attributes:
        u: Displacement [m], dolfinx Function of the last accepted state.
        v: Velocity [m/s], dolfinx Function.
        space: As given.

    Raises:
        TypeError: `energy`, `strain`, `mass` or `extra_form` is not callable, or makes no form that
            can be compiled on this mesh; `name` or a condition is not of the right kind.
        ValueError: The space is of another kind, the mesh is not valid, a mass depends on the
            direction, is not symmetric or not positive, an argument is out of range, or
            `displacement` turns a cell of a 3D mesh inside out.
    """

    def __init__(
        self,
        space: fem.FunctionSpace,
        energy: Callable[..., Any],
        *,
        strain: Callable[[Any], Any] | None = None,
        density: Parameter | None = None,
        mass: MassForm | None = None,
        velocity: Values = (0.0, 0.0, 0.0),
        displacement: Values = (0.0, 0.0, 0.0),
        bcs: Sequence[Dirichlet] = (),
        name: str = "body",
        quadrature_degree: int | None = None,
        extra_form: ExtraForm | None = None,
        allow_inversion: bool = False,
    ) -> None:
        _check_callables(energy, strain, mass)
        if (density is None) == (mass is None):
            raise ValueError(f"density={density!r}, mass={mass!r}: pass one of the two")
        if density is not None:
            require_positive_parameter("density", density, "kg/m^d")
        if quadrature_degree is not None and not (
            is_whole(quadrature_degree) and quadrature_degree > 0
        ):
            raise ValueError(f"quadrature_degree={quadrature_degree!r}: must be a positive integer")
        degree = compat.lagrange_degree(space) if hasattr(space, "dofmap") else None
        if degree is None:
            raise ValueError(
                f"space={space!r}: pass a continuous Lagrange space of 3-vectors, e.g. of "
                '("Lagrange", 1, (3,))'
            )
        least = check_any_mesh(space.mesh, name)
        if degree < least:
            raise ValueError(
                f"space={space!r}: is of degree {degree}, and its mesh of degree {least}; pass one "
                f"of degree {least}, or of nts.linear(mesh)"
            )
        self._quadrature, self._given_mass = quadrature_degree or 2 * degree, mass
        # With one point a cell could turn for nothing.
        # A curved cell's volume is a polynomial, too.
        self._of_mass = max(self._quadrature, 2 * degree + 3 * (least - 1))
        super().__init__(space, degree, name, extra_form, self._quadrature, allow_inversion)
        self._rho = None if density is None else self._density(density)
        self.rounded = largest_side(self.comm, self.reference)
        self._potential = Potential(
            lambda *strains: self._integrated(energy(*strains), self._quadrature),
            _in_tuple(strain),
        )
        form = self._checked_energy(energy)
        if mass is not None:
            self._check_mass_form(mass)
        self._stand(bcs, velocity, displacement)
        self._set_forms(form)
        self._check_mass()

    # ---- set-up
    def _integrated(self, form: Any, degree: int) -> Any:
        """A form with a degree of quadrature, but where its measures name one.

        UFL's own choice differs between an energy and its derivative, which would then be that of
        another energy.
        """
        if not isinstance(form, ufl.Form):
            return form
        parts = [
            part
            if "quadrature_degree" in part.metadata()
            else part.reconstruct(
                metadata={**part.metadata(), "quadrature_degree": degree}
            )
            for part in form.integrals()
        ]
        return ufl.Form(parts)

    def _checked_energy(self, energy: Any) -> Any:
        """Pi of the displacement in UFL; what is wrong with it raises on every rank."""
        what, w = f"energy={energy!r}", ufl.TestFunction(self.space)
        remedy = "return a UFL form like 0.5 * k * ufl.inner(u, u) * ufl.dx"
        form = checked_form(
            self, what, lambda: self._potential(self.u), set(), "has test or trial functions",
            remedy,
        )  # fmt: skip
        checked_form(
            self, what, lambda: self._potential.virtual_work(self.u, w), {w},
            "does not depend on the displacement", remedy,
        )  # fmt: skip
        return form

    def _check_mass_form(self, mass: Any) -> None:
        v, w = ufl.TrialFunction(self.space), ufl.TestFunction(self.space)
        checked_form(
            self, f"mass={mass!r}", lambda: mass(v, w), {v, w}, "is not linear in each of v and w",
            "return a UFL form like 2.0 * ufl.inner(v, w) * ufl.dx",
        )  # fmt: skip

    def _check_mass(self) -> None:
        """Raise on every rank unless the mass is one number between two nodes, > 0 in all."""
        mass = self._mass.matrix
        start, cols, values = mass.getValuesCSR()
        rows = np.repeat(np.arange(len(start) - 1), np.diff(start))
        size, problem = mass.norm(), None
        mixed = values[rows % 3 != cols % 3]
        masses = self.nodal_mass.reshape(-1, 3)
        differ = masses - masses[:, :1]
        if max(np.abs(a).max(initial=0.0) for a in (mixed, differ)) > _ROUNDING * size:
            problem = "depends on the direction; make it of rho * ufl.inner(v, w) alone"
        total = self.comm.allreduce(float(self.nodal_mass.sum()))
        if not total > 0.0:
            problem = f"is {total / 3:.3g} in all; it must be positive"
        elif not mass.isSymmetric(_ROUNDING * size):
            problem = "is not symmetric in v and w"
        diagonal = mass.getDiagonal()
        if problem is None and not (diagonal.array_r > 0.0).all():
            k = int(diagonal.array_r.argmin())
            where = self.reference[3 * (k // 3) : 3 * (k // 3) + 3].tolist()
            problem = f"is {diagonal.array_r[k]:.3g} at the node x={where}; make it positive"
        diagonal.destroy()
        text = f"mass={self._given_mass!r} of {self.name!r}: {problem}"
        raise_together(self.comm, text if problem else None)

    def _make_massless(self, surface: Any) -> None:
        """Refuse it: what stands in the user's forms may need the mass where it is."""
        raise ValueError(
            f"mass='redistributed' of a surface of {self.name!r}: the mass of a FormBody is the "
            "user's own; use a Continuum, or mass='consistent'"
        )

    def _mass_form(self, v: Any, w: Any) -> Any:
        """Mass in UFL."""
        if self._given_mass is None:
            form = self._rho * ufl.inner(v, w) * ufl.Measure("dx", self.mesh)
        else:
            form = self._given_mass(v, w)
        return self._integrated(form, self._of_mass)

    def _virtual_work(self, rule: Integrator, u0: Any, u1: Any, w: Any) -> tuple[Any, None]:
        """Virtual work of the potential by the rule in UFL."""
        return rule.virtual_work(self._potential, u0, u1, w), None


def _check_callables(energy: Any, strain: Any, mass: Any) -> None:
    if not callable(energy):
        raise TypeError(f"energy={energy!r}: pass a callable u -> UFL form [J]")
    if strain is not None and not callable(strain):
        raise TypeError(f"strain={strain!r}: pass a callable u -> UFL expression")
    if mass is not None and not callable(mass):
        raise TypeError(f"mass={mass!r}: pass a callable (v, w) -> UFL form, or density=")


def _in_tuple(strain: Callable[[Any], Any] | None) -> Callable[[Any], tuple[Any, ...]]:
    """The strains as a tuple; without any the displacement itself."""

    def strains(u: Any) -> tuple[Any, ...]:
        found = u if strain is None else strain(u)
        return tuple(found) if isinstance(found, tuple | list) else (found,)

    return strains
