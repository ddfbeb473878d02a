"""Flexible bodies: hexahedral or tetrahedral DOLFINx meshes with a strain energy in UFL."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from dolfinx import mesh as dolfinx_mesh
from mpi4py import MPI
from ufl.corealg.traversal import traverse_unique_terminals

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.body import Moment
from dolfinx_nts.bodies.inversion import Determinants
from dolfinx_nts.bodies.materials import misfit, with_constants
from dolfinx_nts.bodies.mesh_check import check_mesh
from dolfinx_nts.bodies.points import Points, in_mesh
from dolfinx_nts.contact.surfaces import Surface, locate_facets
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.kernels.strain_energy import Isotropic, green_strain, strain_energy
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.validation import (
    at_points,
    at_time,
    floats,
    is_whole,
    items,
    known_options,
    require_bool,
    require_name,
    require_positive,
    vector,
)

logger = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
Vector = Sequence[float] | FloatArray
VectorInTime = Vector | Callable[[float], Vector]

#: Stress of an undeformed body, over its stiffness, that counts as none.
_STRESS_FREE = 1e-6
#: Strain that tells the stiffness: of the size that leaves linear terms and rounding far apart.
_SMALL_STRAIN = 1e-4


@known_options
@dataclass(frozen=True)
class Dirichlet:
    """Prescribed displacement on a part of the boundary.

    Attributes:
        where: Function x (3, n) -> bool (n,), or a pair (facet meshtags, tag).
        value: Displacement [m]: a vector, or a function of time; its work is external work. The
            nodes start where and as fast as the value says at the start.
        components: Which of x, y, z are prescribed.

    Raises:
        ValueError: Unknown component.
    """

    where: Any
    value: VectorInTime = (0.0, 0.0, 0.0)
    components: tuple[int, ...] = (0, 1, 2)

    def __post_init__(self) -> None:
        given = self.components
        listed = isinstance(given, Sequence) and all(is_whole(c) and 0 <= c <= 2 for c in given)
        if not listed or not given:
            raise ValueError(f"components={given!r}: pass a tuple of some of 0, 1, 2")


@known_options
@dataclass(frozen=True)
class Traction:
    """Dead traction on a part of the boundary.

    Attributes:
        where: Function x (3, n) -> bool (n,), or a pair (facet meshtags, tag).
        value: Force per reference area [Pa]: a vector, or a function of time.
    """

    where: Any
    value: VectorInTime


def _facets(mesh: Any, where: Any, what: str) -> IntArray:
    if isinstance(where, tuple) and len(where) == 2:
        return locate_facets(mesh, *where, what)
    return locate_facets(mesh, where, None, what)


@known_options
class Continuum:
    """A flexible body on a DOLFINx mesh (theory section 2).

    Args:
        mesh: 3D hexahedral or tetrahedral mesh.
        material: Strain energy W(C) [J/m^3]: a material of this package, an `Isotropic` of one's
            own, or any callable C -> UFL scalar.
        density: Reference density [kg/m^3], > 0.
        velocity: Initial velocity [m/s]: a vector, or a callable x (3, n) -> (3, n) as in DOLFINx's
            interpolate.
        displacement: Displacement [m] from the stress-free mesh in which the body starts, as
            `velocity`; prescribed coordinates start where their condition says. `equilibrium` takes
            it as its first guess, so that its ledger misses the energy stored in the guess.
        bcs: `Dirichlet` conditions, fixed or moving in time.
        name: Name in messages and files.
        degree: Polynomial degree; contact surfaces need 1.
        body_force: Force per reference volume [N/m^3], a vector or a function of time.
        traction: `Traction` loads.
        quadrature_degree: For energy, stress and mass alike; default 2 x 2 x 2 Gauss points on
            trilinear hexahedra.
        extra_form: Further virtual work as UFL, a callable (u, v, w, t) -> form of displacement,
            velocity and time where the integrator takes forces (the middle of the step; in statics
            its end, at rest) and of the test function w; it is added to the internal virtual work
            and its work counts as external.
        allow_inversion: Accept steps that turn a cell inside out, det F <= 0 at a corner or
            quadrature point, with a warning in the Solution; else such a step is cut, and the
            run stops where that does not help. W(C) cannot see it.

    Attributes:
        u: Displacement [m], dolfinx Function of the last accepted state.
        v: Velocity [m/s], dolfinx Function.
        space: Their function space.

    Raises:
        TypeError: `material`, `extra_form`, `name` or a condition is not of the right kind, or what
            the first two make cannot be compiled on this mesh.
        ValueError: An argument is out of range, the mesh is not a valid 3D mesh, or `displacement`
            turns a cell inside out.
    """

    def __init__(
        self,
        mesh: Any,
        material: Callable[[Any], Any],
        *,
        density: float,
        velocity: Any = (0.0, 0.0, 0.0),
        displacement: Any = (0.0, 0.0, 0.0),
        bcs: Sequence[Dirichlet] = (),
        name: str = "body",
        degree: int = 1,
        body_force: VectorInTime = (0.0, 0.0, 0.0),
        traction: Sequence[Traction] = (),
        quadrature_degree: int | None = None,
        extra_form: Callable[[Any, Any, Any, Any], Any] | None = None,
        allow_inversion: bool = False,
    ) -> None:
        if not callable(material):
            raise TypeError(
                f"material={material!r}: pass a callable C -> W(C), "
                "e.g. NeoHookean(young=1e6, poisson=0.3)"
            )
        require_positive("density", density, "kg/m^3")
        for option, value in (("degree", degree), ("quadrature_degree", quadrature_degree)):
            default = option == "quadrature_degree" and value is None
            if not default and not (is_whole(value) and value > 0):
                raise ValueError(f"{option}={value!r}: must be a positive integer")
        require_name("name", name)
        if extra_form is not None and not callable(extra_form):
            raise TypeError(f"extra_form={extra_form!r}: pass a callable (u, v, w, t) -> UFL form")
        require_bool("allow_inversion", allow_inversion)
        self.allow_inversion = allow_inversion
        traction = items("traction", traction, lambda t: isinstance(t, Traction), "Traction")
        bcs = items("bcs", bcs, lambda b: isinstance(b, Dirichlet), "Dirichlet")
        check_mesh(mesh, name)
        self.name, self.mesh, self.comm, self.material, self.density = (
            name,
            mesh,
            mesh.comm,
            material,
            density,
        )
        self.degree = degree
        self.space = compat.vector_space(mesh, degree)
        # DOLFINx makes C identifiers of the names.
        stem = re.sub(r"\W", "_", name, flags=re.ASCII)
        self.u, self.v = (fem.Function(self.space, name=f"{stem}_{s}") for s in "uv")
        self.num_owned = 3 * self.space.dofmap.index_map.size_local
        self.reference = self.space.tabulate_dof_coordinates().ravel()[: self.num_owned].copy()
        # A W(C) is rounded at C = 1; a steep one at more than the size of a cell.
        self.rounded = 0.0 if isinstance(material, Isotropic) else self._size()
        self.body_force, self._traction, self._extra_form = body_force, traction, extra_form
        quadrature_degree = quadrature_degree or 2 * degree
        self._dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": quadrature_degree})
        self._ds = self._boundary_measure(quadrature_degree)
        self._determinants = Determinants(self.space, degree, quadrature_degree)
        self._loads_at(0.0)
        for k, condition in enumerate(bcs):
            self._at(f"Dirichlet.value of bcs[{k}]", condition.value, 0.0, "m")
        self._set_conditions(bcs)
        self._set_velocity(velocity)
        self._set_displacement(displacement)
        self._build_constant_forms()
        self._compiled: dict[Integrator, tuple[Any, Any, Any]] = {}
        self._stiffness: FloatArray | None = None
        self._seen_at_rest = False

    def surface(self, marker: Any, tag: int | None = None, *, smoothing: bool = False) -> Surface:
        """A part of the boundary for contact.

        With smoothing, a slave touches a smooth surface through the nodes instead of the flat or
        bilinear facets of a master: bicubic patches of Overhauser's cubics (Catmull and Rom 1974),
        which are linear in the nodes, so momentum and energy are kept as without. The normal no
        longer jumps from facet to facet, and the energy lost or gained by changes of facet
        (`contact_defect`) falls: more than 1e4 times on even facets, 20 to 100 times where they
        differ by up to a half in size. For smoothing in contact see Wriggers, Krstulovic-Opara and
        Korelc (2001) and Puso and Laursen (2002). Limits:

        - The surface must consist of quadrilaterals. Beyond its rim, at edges whose facets meet at
          more than 60 degrees, and where other than four facets meet, it is not smooth.
        - It bulges beyond the facets by what they cut off the curve, an eighth of the angle between
          neighbours times the size of a facet: gaps are measured from there.
        - Beyond its facet a patch goes on as a cubic, which is good for half a facet; let no slave
          slide over more than a third of a facet in a step.
        - A pair costs some twenty times as much. As a slave, a surface is not changed.

        Args:
            marker: Callable x (3, n) -> bool (n,) that holds at all corners of a facet, or facet
                meshtags.
            tag: Value in the meshtags.
            smoothing: Whether slaves touch a smooth surface when this one is the master.

        Raises:
            TypeError: smoothing is no bool.
            ValueError: Degree above 1, no facet, or interior facets; smoothing of triangles.
        """
        require_bool("smoothing", smoothing)
        if self.degree != 1:
            raise ValueError(
                f"degree={self.degree!r} of body {self.name!r}: contact surfaces need degree 1"
            )
        found = locate_facets(self.mesh, marker, tag, f"marker of a surface of {self.name!r}")
        return Surface(self, found, smoothing)

    def points(self, x: Any) -> Points:
        """Material points, for joints and springs. Collective.

        Args:
            x: Reference positions [m], shape (3,) or (n, 3), the same on all ranks.

        Raises:
            ValueError: x is no array of points, or one of them lies in no cell.
        """
        given = np.atleast_2d(floats(x))
        if given.ndim != 2 or given.shape[1] != 3 or not np.isfinite(given).all():
            raise ValueError(f"x={x!r}: pass points of shape (3,) or (n, 3) [m]")
        return in_mesh(self, given, "x")

    # ---- set-up
    def _size(self) -> float:
        """Largest side of the box around the body [m], the same on all ranks. Collective."""
        x = self.reference.reshape(-1, 3)
        ends = np.array([x.max(axis=0, initial=-np.inf), (-x).max(axis=0, initial=-np.inf)])
        self.comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
        return float(ends.sum(axis=0).max())

    def _boundary_measure(self, degree: int) -> Any:
        indices = [
            _facets(self.mesh, load.where, f"Traction.where of traction[{k}] of {self.name!r}")
            for k, load in enumerate(self._traction)
        ]
        tags = [np.full(len(i), k, np.int32) for k, i in enumerate(indices)]
        empty = np.empty(0, np.int32)
        index, tag = (
            np.concatenate([empty, *indices]).astype(np.int32),
            np.concatenate([empty, *tags]),
        )
        shared = len(index) - len(np.unique(index))
        text = (
            f"traction of {self.name!r}: {shared} facets carry two loads; add their values up in "
            "one Traction"
        )
        raise_together(self.comm, text if shared else None)
        order = np.argsort(index)
        data = dolfinx_mesh.meshtags(self.mesh, 2, index[order], tag[order])
        return ufl.Measure(
            "ds", self.mesh, subdomain_data=data, metadata={"quadrature_degree": degree}
        )

    def _set_conditions(self, bcs: Sequence[Dirichlet]) -> None:
        self._bcs: list[Any] = []
        self._conditions: list[tuple[VectorInTime, list[tuple[int, IntArray]]]] = []
        owner = np.full(self.num_owned, -1)
        for number, bc in enumerate(bcs):
            what = f"Dirichlet.where of bcs[{number}] of {self.name!r}"
            facets = _facets(self.mesh, bc.where, what)
            blocks = np.asarray(fem.locate_dofs_topological(self.space, 2, facets))
            self._conditions.append((bc.value, []))
            for component in bc.components:
                self._bcs.append(compat.subspace_component_bc(self.space, component, blocks))
                dofs = np.sort(blocks * 3 + component)
                dofs = dofs[dofs < self.num_owned]
                self._conditions[-1][1].append((component, dofs))
                owner[dofs] = number
        self.fixed = np.flatnonzero(owner >= 0)
        # Where two conditions meet, the later one's value holds, so it carries the force.
        self._condition = owner[self.fixed]

    def _set_velocity(self, velocity: Any) -> None:
        self._interpolate(self.v, "velocity", velocity, "m/s")
        values = self.v.x.array
        for value, parts in self._conditions:
            for _, dofs in parts if not callable(value) else ():
                values[dofs] = 0.0
        self.v.x.scatter_forward()
        self.initial_velocity = values[: self.num_owned].copy()

    def _set_displacement(self, displacement: Any) -> None:
        self._interpolate(self.u, "displacement", displacement, "m")
        moves = self.comm.allreduce(bool(self.u.x.array.any()), op=MPI.LOR)
        self.u.x.array[self.fixed] = self.prescribed(0.0)
        self.u.x.scatter_forward()
        self.initial_displacement = self.u.x.array[: self.num_owned].copy()
        if not moves or self.allow_inversion:
            return
        smallest = self._determinants.smallest(self.u.x.array)
        det, place = min(self.comm.allgather(smallest), key=lambda found: found[0])
        if det <= 0.0:
            where = ", ".join(f"{x:.4g}" for x in place)
            raise ValueError(
                f"displacement of {self.name!r}: with its Dirichlet values at t=0 it turns a cell "
                f"inside out, det F = {det:.3g} near X = ({where}); pass a smoother or smaller one"
            )

    def _interpolate(self, function: Any, name: str, given: Any, unit: str) -> None:
        """Fill a Function from a vector or a callable x (3, n) -> (3, n)."""
        values = function.x.array
        if callable(given):
            # The nodes of Lagrange elements are their interpolation points.
            x = self.space.tabulate_dof_coordinates().T
            found = at_points(self.comm, f"{name} of {self.name!r}", given, x, (3,))
            values[:] = found.T.ravel()
        else:
            constant = vector(name, given, unit, or_else="a callable x (3, n) -> (3, n)")
            values[:] = np.tile(constant, len(values) // 3)

    def _build_constant_forms(self) -> None:
        # Constants, not numbers: bodies of any density and stiffness share compiled forms.
        self._rho = fem.Constant(self.mesh, float(self.density))
        self._law = strain_energy(with_constants(self.material, self.mesh))
        v, w = ufl.TrialFunction(self.space), ufl.TestFunction(self.space)
        mesh = self.mesh
        self._loads = [fem.Constant(mesh, np.zeros(3)) for _ in range(1 + len(self._traction))]
        load = ufl.inner(self._loads[0], w) * self._dx
        for k, value in enumerate(self._loads[1:]):
            load += ufl.inner(value, w) * self._ds(k)
        energy = self._energy(green_strain(ufl.grad(self.u)))
        self._parameters = [
            t
            for t in traverse_unique_terminals(energy)
            if isinstance(t, fem.Constant | fem.Function) and t is not self.u
        ]
        if self._extra_form is not None:
            self._check_extra_form(self._extra_form, w)
        mass, self._load_form, self._energy_form = compat.compile_forms(
            [self._rho * ufl.inner(v, w) * self._dx, load, energy * self._dx]
        )
        full = compat.create_matrix(mass)
        compat.assemble_matrix(full, mass, (), 0.0)
        # Directions do not mix: two of three entries of the blocks are zero.
        self._mass = compat.without_zeros(full)
        full.destroy()
        self._load, self._assembled_loads = np.zeros(self.num_owned), np.zeros(3 * len(self._loads))
        self._in, self._out = compat.create_vector(self.space), compat.create_vector(self.space)
        self.nodal_mass = self.inertia(np.ones(self.num_owned))

    def _energy(self, e: Any) -> Any:
        """W at a strain in UFL; what is wrong with it raises on every rank."""
        problem, cause, energy = None, None, None
        try:
            energy = ufl.as_ufl(self._law(e))
        except Exception as error:  # any: a rank that raises alone would leave the others waiting
            problem, cause = f"raised {error!r}; return a UFL scalar", error
        else:
            if energy.ufl_shape != ():
                problem = f"has shape {energy.ufl_shape}; return a UFL scalar"
            else:
                problem = misfit([energy], self.mesh.ufl_domain())
        text = f"material={self.material!r} of {self.name!r}: W(C) {problem}"
        raise_together(self.comm, text if problem else None, TypeError, cause)
        return energy

    def _check_extra_form(self, extra_form: Any, w: Any) -> None:
        """Raise on every rank unless it makes a linear form of the test function w."""
        problem, cause = None, None
        wanted = "return a UFL form like 3.0 * ufl.inner(v, w) * ufl.dx"
        try:
            # Sums, as those that it will be given.
            form = extra_form(self.u + self.v, self.u - self.v, w, fem.Constant(self.mesh, 0.0))
            arguments = set(form.arguments()) if isinstance(form, ufl.Form) else set()
        except Exception as error:  # any: as above
            problem, cause = f"raised {error!r}; {wanted}", error
        else:
            if not isinstance(form, ufl.Form):
                problem = f"returned an object of type {type(form).__name__}; {wanted}"
            elif arguments != {w}:
                problem = f"is not linear in the test function w alone; {wanted}"
            elif any(d != self.mesh.ufl_domain() for d in form.ufl_domains()):
                problem = "has a measure of another mesh; use ufl.dx, or one of the body's mesh"
            else:
                integrands = [part.integrand() for part in form.integrals()]
                problem = misfit(integrands, self.mesh.ufl_domain())
        text = f"extra_form={extra_form!r} of {self.name!r}: {problem}"
        raise_together(self.comm, text if problem else None, TypeError, cause)

    def _compile(self, rule: Integrator) -> tuple[Any, Any, Any]:
        """Compiled internal virtual work, tangent and extra virtual work by a rule."""
        if rule not in self._compiled:
            if not self._compiled:
                self._u0, self._u1, self._drift = (fem.Function(self.space) for _ in range(3))
                # What multiplies mass and stiffness: in one Constant, as UFL sorts several by their
                # counts as text, and a form would be compiled again where 9 and 10 meet.
                self._factors = fem.Constant(self.mesh, np.zeros(2))
                # Change of the velocity with u_1; time.
                self._rate, self._time = (fem.Constant(self.mesh, 0.0) for _ in range(2))
            du, w = ufl.TrialFunction(self.space), ufl.TestFunction(self.space)
            h0, h1 = ufl.grad(self._u0), ufl.grad(self._u1)
            work = ufl.inner(rule.piola(self._law, h0, h1), ufl.grad(w)) * self._dx
            virtual, extra = work, None
            if self._extra_form is not None:
                moved = self._u1 - self._u0
                place, velocity = self._u0 + rule.theta * moved, self._rate * moved
                if rule.accelerations:
                    velocity += self._drift
                extra = self._extra_form(place, velocity, w, self._time)
                virtual = work + extra
            tangent = self._factors[1] * ufl.derivative(virtual, self._u1, du)
            if rule.inertia:
                tangent += self._factors[0] * self._rho * ufl.inner(du, w) * self._dx
            forms = compat.compile_forms([work, tangent] + ([] if extra is None else [extra]))
            self._compiled[rule] = forms[0], forms[1], forms[2] if extra is not None else None
            if not hasattr(self, "_matrix"):
                self._matrix = compat.create_matrix(forms[1])
        return self._compiled[rule]

    # ---- Body protocol
    def begin_step(self, rule: Integrator, moment: Moment) -> None:
        """Set the state at t_n and the loads of the step."""
        self._rule, self._forms = rule, self._compile(rule)
        if not self._seen_at_rest:
            self._warn_of_stress_at_rest(rule.theta)
        self._fill(self._u0, moment.u0)
        if self._extra_form is not None:
            self._rate.value, self._time.value = moment.rate, moment.time
            if moment.drift is not None:
                self._fill(self._drift, moment.drift)
        for constant, (value, now) in zip(self._loads, self._loads_at(moment.time), strict=True):
            constant.value[:] = now if callable(value) else moment.ramp * now
        loads = np.concatenate([constant.value for constant in self._loads])
        if not np.array_equal(loads, self._assembled_loads):
            self._load, self._assembled_loads = self._assemble(self._load_form), loads

    def _warn_of_stress_at_rest(self, theta: float) -> None:
        """Tell whether forces of its own move the undeformed body, as where dW/dC(1) is not 0.

        Beside them stand those of a small shear x, -y. Costs two evaluations of internal forces.
        """
        self._seen_at_rest = True
        shear = _SMALL_STRAIN * np.resize([1.0, -1.0, 0.0], self.num_owned) * self.reference
        for u in (self._u0, self._u1):
            self._fill(u, 0.0 * shear)
        at_rest = self._assemble(self._forms[0])
        self._fill(self._u1, shear)
        change = (self._assemble(self._forms[0]) - at_rest) / (theta * _SMALL_STRAIN)
        at_rest[self.fixed] = 0.0
        squares = np.array([at_rest @ at_rest, change @ change])
        stress, stiffness = np.sqrt(self.comm.allreduce(squares)).tolist()
        if not stress <= _STRESS_FREE * stiffness and self.comm.rank == 0:
            logger.warning(
                "body %r is under a stress of about %.2g of its stiffness while undeformed, and "
                "will move by itself; unless that is meant, let W(C) have dW/dC = 0 at C = 1",
                self.name, stress / stiffness if stiffness else math.inf,
            )  # fmt: skip

    def _loads_at(self, time: float) -> list[tuple[VectorInTime, FloatArray]]:
        """Body force and tractions as they were given, and their values at a time."""
        given = [("body_force", self.body_force, "N/m^3")]
        for k, traction in enumerate(self._traction):
            given.append((f"Traction.value of traction[{k}]", traction.value, "Pa"))
        return [(value, self._at(name, value, time, unit)) for name, value, unit in given]

    def _at(self, name: str, value: VectorInTime, time: float, unit: str) -> FloatArray:
        """A vector, or a function of time at a time, for which every rank must call this."""
        name = f"{name} of {self.name!r}"
        if callable(value):
            return at_time(self.comm, name, value, time, unit)
        return vector(name, value, unit)

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v [kg m/s for a velocity]."""
        self._in.array_w[:] = v
        self._mass.mult(self._in, self._out)
        return self._out.array_r.copy()

    def internal(self, u1: FloatArray) -> FloatArray:
        """Internal forces of the step [N]."""
        self._fill(self._u1, u1)
        return self._assemble(self._forms[0])

    def external(self, u1: FloatArray, gravity: FloatArray) -> FloatArray:
        """Body force, traction and gravity, less the extra work [N]."""
        force = self._load.copy()
        if gravity.any():
            force += self.nodal_mass * np.tile(gravity, self.num_owned // 3)
        if self._forms[2] is not None:
            self._fill(self._u1, u1)
            force -= self._assemble(self._forms[2])
        return force

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> Any:
        """Return mass M + stiffness K; contact may add to it before the next call."""
        diagonal = mass * self._mean(self.nodal_mass)
        if not mass:
            diagonal = stiffness * self._mean(self.nodal_stiffness(self._rule))
        self._fill(self._u1, u1)
        self._factors.value = mass, stiffness
        compat.assemble_matrix(self._matrix, self._forms[1], self._bcs, diagonal)
        return self._matrix

    def _mean(self, values: FloatArray) -> float:
        """Over all coordinates. Collective."""
        total = self.comm.allreduce(np.array([values.sum(), self.num_owned]))
        return float(total[0] / total[1])

    def nodal_stiffness(self, rule: Integrator) -> FloatArray:
        """Mean diagonal of a rule's tangent at each node of the undeformed body [N/m]."""
        if self._stiffness is None:
            tangent = self._compile(rule)[1]
            kept = [f.x.array.copy() for f in (self._u0, self._u1)]
            for u in (self._u0, self._u1):
                self._fill(u, np.zeros(self.num_owned))
            self._factors.value, self._rate.value = (0.0, 1.0), 0.0
            compat.assemble_matrix(self._matrix, tangent, (), 0.0)
            diagonal = self._matrix.getDiagonal()
            # The mean of a node's three entries does not depend on the directions of the axes.
            self._stiffness = np.repeat(diagonal.array_r.reshape(-1, 3).mean(axis=1), 3)
            diagonal.destroy()
            for u, values in zip((self._u0, self._u1), kept, strict=True):
                u.x.array[:] = values
        return self._stiffness

    def reactions(self, residual: FloatArray) -> FloatArray:
        """Resultants on the coordinates of each `Dirichlet` condition, this rank's part [N]."""
        total = np.zeros((len(self._conditions), 3))
        np.add.at(total, (self._condition, self.fixed % 3), residual[self.fixed])
        return total

    def prescribed(self, time: float) -> FloatArray:
        """Prescribed displacements at a time, in the order of `fixed` [m]. Collective."""
        values = np.zeros(self.num_owned)
        for k, (value, parts) in enumerate(self._conditions):
            now = self._at(f"Dirichlet.value of bcs[{k}]", value, time, "m")
            for component, dofs in parts:
                values[dofs] = now[component]
        return values[self.fixed]

    def potential(self, u: FloatArray) -> float:
        """Strain energy on this rank [J]."""
        kept = self.u.x.array.copy()
        self._fill(self.u, u)
        value = float(fem.assemble_scalar(self._energy_form))
        self.u.x.array[:] = kept
        return value

    def parameters(self) -> FloatArray:
        """Values of the Constants and Functions in W(C), which a caller may change, shape (n,)."""
        values = [
            t.value if isinstance(t, fem.Constant) else t.x.array for t in self._parameters
        ]
        return np.concatenate([np.empty(0), *map(np.ravel, values)])

    def smallest_det(self, u: FloatArray) -> tuple[float, FloatArray]:
        """Smallest det F at corners and quadrature points on this rank, and X of its cell [m]."""
        self._in.array_w[:] = u
        self._in.ghostUpdate()
        with self._in.localForm() as here:
            return self._determinants.smallest(here.array_r)

    def linear_momentum(self, momentum: FloatArray) -> FloatArray:
        """This rank's part of sum p [kg m/s]."""
        total: FloatArray = momentum.reshape(-1, 3).sum(axis=0)
        return total

    def angular_momentum(self, u: FloatArray, momentum: FloatArray) -> FloatArray:
        """This rank's part of sum x cross p about the origin [kg m^2/s]."""
        moment = (self.reference + u).reshape(-1, 3).T @ momentum.reshape(-1, 3)
        return np.array([moment[i, j] - moment[j, i] for i, j in ((1, 2), (2, 0), (0, 1))])

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Write the accepted state into the dolfinx Functions u and v."""
        self._fill(self.u, u)
        self._fill(self.v, v)

    def destroy(self) -> None:
        """Free the PETSc objects, for those who make many bodies; the body is of no use then."""
        for a in (self._mass, self._in, self._out, getattr(self, "_matrix", None)):
            if a is not None:
                a.destroy()

    def _fill(self, function: Any, owned: FloatArray) -> None:
        function.x.array[: self.num_owned] = owned
        function.x.scatter_forward()

    def _assemble(self, form: Any) -> FloatArray:
        compat.assemble_vector(self._out, form)
        return self._out.array_r.copy()
