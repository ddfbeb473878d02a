"""Flexible bodies: hexahedral or tetrahedral DOLFINx meshes with a strain energy in UFL."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.conditions import Dirichlet, VectorInTime
from dolfinx_nts.bodies.loads import Pressure, SolidLoads, Traction
from dolfinx_nts.bodies.meshes.mesh_check import check_mesh
from dolfinx_nts.bodies.nodal_values import largest_side
from dolfinx_nts.bodies.solid.arguments import check_cells, check_material
from dolfinx_nts.bodies.solid.bending_modes import BendingModes, StepModes
from dolfinx_nts.bodies.solid.cell_means import CellMeans, FormWithMeans, NodesOfCells
from dolfinx_nts.bodies.solid.locking import Locking
from dolfinx_nts.bodies.solid.materials import misfit, with_constants
from dolfinx_nts.bodies.solid.parameters import Parameter
from dolfinx_nts.bodies.solid.stress_jumps import StressJumps
from dolfinx_nts.bodies.solid.ufl_body import UflBody
from dolfinx_nts.bodies.solid.viscosity import check_viscosity, is_viscous, viscous_work
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.coupling import StepWarning
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.kernels.projected_volume import ProjectedVolume, shear_modulus
from dolfinx_nts.kernels.strain_energy import Isotropic, green_strain, strain_energy
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import ExtraForm, FloatArray, IntArray, Settings, Values
from dolfinx_nts.validation import is_whole, known_options, require_name

#: Stress of an undeformed body, over its stiffness, that counts as none.
_STRESS_FREE = 1e-6
#: Strain that tells the stiffness: of the size that leaves linear terms and rounding far apart.
_SMALL_STRAIN = 1e-4


@known_options
class Continuum(UflBody):
    """A flexible body on a DOLFINx mesh (theory section 2).

    Args:
        mesh: 3D hexahedral or tetrahedral mesh.
        material: Strain energy W(C) [J/m^3]: a material of this package, an `Isotropic` of one's
            own, or any callable C -> UFL scalar.
        density: Reference density [kg/m^3], > 0: a number, or a Constant or Function on the mesh.
            What it or a parameter of the material is changed to between steps, e.g. by
            `before_step`, holds in the next one; what that does to the energy is
            `material_change` in the balance.
        velocity: Initial velocity [m/s]: a vector, a callable x (3, n) -> (3, n) as in DOLFINx's
            interpolate, or a Function of vectors on the mesh.
        displacement: Displacement [m] from the stress-free mesh in which the body starts, as
            `velocity`; prescribed coordinates start where their condition says. `equilibrium` takes
            it as its first guess, so that its ledger misses the energy stored in the guess.
        bcs: `Dirichlet` conditions, fixed or moving in time.
        name: Name in messages and files.
        degree: Polynomial degree; contact surfaces need 1 or 2. Default: 2 for tetrahedra, which
            are wrong by tens of per cent with 1; else that of the mesh. Cells of a mesh of degree 2
            are curved.
        body_force: Force per reference volume [N/m^3], a vector or a function of time.
        traction: `Traction` and `Pressure` loads.
        quadrature_degree: For energy, stress and loads; default 2 x 2 x 2 Gauss points on trilinear
            hexahedra. Mass has never less than that: with one point a cell could turn without
            inertia.
        extra_form: Further virtual work as UFL, a callable (u, v, w, t) -> form of displacement,
            velocity and time where the integrator takes forces (the middle of the step; in statics
            its end, at rest) and of the test function w; it is added to the internal virtual work
            and its work counts as external.
        allow_inversion: Accept steps that turn a cell inside out, det F <= 0 at a corner or
            quadrature point, with a warning in the Solution; else such a step is cut, and the
            run stops where that does not help. W(C) cannot see it. F is that of the displacement,
            without what `bending` adds within cells.
        bending: Let hexahedra of degree 1 bend as thin parts do, without the shear that makes them
            too stiff: by three vectors within each cell, which follow from the displacement and
            from the step before (theory 19.4). For thin and stiff parts whose cells are nearly
            parallelepipeds; a run warns of others. Where a cell is compressed to 0.62 of a length
            (nu = 0.3) to 0.69 it may fold; a run warns from 0.75 on.
        volume: "projected": W takes the change of volume of each cell in the mean, so that cells do
            not lock where the material hardly changes its volume (nu near 0.5), and bend more
            easily; for hexahedra of degree 1. "full": W at each point, as it is.
        viscosity: eta [Pa s], >= 0, as `density`: adds the stress 2 eta dE/dt to that of W, with E
            of Green (theory section 2). What it takes is `viscous_dissipation` in the balance,
            which never decreases. In equilibrium it does nothing.

    Attributes:
        u: Displacement [m], dolfinx Function of the last accepted state.
        v: Velocity [m/s], dolfinx Function.
        space: Their function space.
        law: W as a function of Green's strain in UFL, with Constants for numbers of the package's
            materials.
        stressed: Stress of the undeformed body over its stiffness; None: it has none, or no step
            was made yet.

    Raises:
        TypeError: `material`, `extra_form`, `name` or a condition is not of the right kind, or what
            the first two make cannot be compiled on this mesh.
        ValueError: An argument is out of range, the mesh is not a valid 3D mesh, or `displacement`
            turns a cell inside out.
    """

    def __init__(
        self,
        mesh: Mesh,
        material: Callable[[Any], Any],
        *,
        density: Parameter,
        velocity: Values = (0.0, 0.0, 0.0),
        displacement: Values = (0.0, 0.0, 0.0),
        bcs: Sequence[Dirichlet] = (),
        name: str = "body",
        degree: int | None = None,
        body_force: VectorInTime = (0.0, 0.0, 0.0),
        traction: Sequence[Traction | Pressure] = (),
        quadrature_degree: int | None = None,
        extra_form: ExtraForm | None = None,
        allow_inversion: bool = False,
        volume: str = "full",
        bending: bool = False,
        viscosity: Parameter = 0.0,
    ) -> None:
        check_material(material, density, viscosity)
        for option, value in (("degree", degree), ("quadrature_degree", quadrature_degree)):
            if value is not None and not (is_whole(value) and value > 0):
                raise ValueError(f"{option}={value!r}: must be a positive integer")
        require_name("name", name)
        least = check_mesh(mesh, name)
        degree = degree or (2 if compat.cell_name(mesh) == "tetrahedron" else least)
        viscous = is_viscous(viscosity)
        check_cells(mesh, degree, least, name, volume, bending, viscous)
        quadrature_degree = quadrature_degree or 2 * degree
        space = compat.vector_space(mesh, degree)
        self._dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": quadrature_degree})
        self._loads = loads = SolidLoads(space, name, body_force, traction, self._dx)
        super().__init__(
            space, degree, name, extra_form, quadrature_degree, allow_inversion,
            self._viscous if viscous else None, loads.following if loads.follows else None,
        )  # fmt: skip
        self.material, self.density, self.viscosity = material, density, viscosity
        self.losses = ("viscous_dissipation",) if viscous else ()
        # A W(C) is rounded at C = 1; a steep one at more than the size of a cell.
        isotropic = isinstance(material, Isotropic)
        self.rounded = 0.0 if isotropic else largest_side(self.comm, self.reference)
        self.body_force = body_force
        self.loads_in_time = loads.in_time or extra_form is not None or loads.follows
        # A curved cell's volume is a polynomial, too.
        self._of_mass = max(quadrature_degree, 2 * degree + 3 * (least - 1))
        self._stand(bcs, velocity, displacement)
        self._rho, self._eta = self._density(density), self._on_mesh("viscosity", viscosity)
        self.law = strain_energy(with_constants(material, self.mesh))
        self._volume = volume
        self._modes = BendingModes(mesh) if bending else None
        self.has_inner = bending
        #: Modes of the state that `u` and `v` are of.
        self._bent = None if self._modes is None else fem.Function(self._modes.space)
        self._check_energy()
        law, means = self.energy()
        energy = law(green_strain(self.gradient)) * self._dx
        (self._load_form,) = self._set_forms(energy, loads.work, means=means, others=[self._eta])
        self._seen_at_rest = False
        self.stressed = None
        self.locking = Locking(
            self.space, self.reference, degree, material, volume=volume, bending=bending,
            jumps=self._stress_jumps,
        )  # fmt: skip

    # ---- set-up
    def energy(self) -> tuple[Any, CellMeans | None]:
        """W as a function of Green's strain in UFL that forces are made of, and means it makes."""
        if self._volume == "full":
            return self.law, None
        means = CellMeans(self.mesh, self._dx)
        shear = means.mean(shear_modulus(self.law), given=True)
        return ProjectedVolume(self.law, shear, means.mean), means

    @property
    def gradient(self) -> Any:
        """Displacement gradient in UFL that W takes at the state of `u`."""
        h = ufl.grad(self.u)
        return h if self._modes is None else h + self._modes.gradient(self._bent)

    def _check_energy(self) -> None:
        """Raise on every rank if something is wrong with W."""
        problem, cause = None, None
        try:
            with compat.without_floats():
                energy = ufl.as_ufl(self.law(green_strain(ufl.grad(self.u))))
        except Exception as error:  # any: a rank that raises alone would leave the others waiting
            remedy = "return a UFL scalar, made of functions of ufl as ufl.ln"
            problem, cause = f"raised {error!r}; {remedy}", error
        else:
            if energy.ufl_shape != ():
                problem = f"has shape {energy.ufl_shape}; return a UFL scalar"
            else:
                problem = misfit([energy], self.mesh.ufl_domain())
        text = f"material={self.material!r} of {self.name!r}: W(C) {problem}"
        raise_together(self.comm, text if problem else None, TypeError, cause)

    def _mass_form(self, v: Any, w: Any) -> Any:
        """Mass in UFL."""
        dx = ufl.Measure("dx", self.mesh, metadata={"quadrature_degree": self._of_mass})
        return self._rho * ufl.inner(v, w) * dx

    def _check_parameters(self) -> None:
        """Raise ValueError unless density and moduli are in their ranges."""
        super()._check_parameters()
        check_viscosity(self.viscosity)
        if isinstance(self.material, Isotropic):
            self.material.check()

    def _virtual_work(self, rule: Integrator, u0: Any, u1: Any, w: Any) -> Any:
        """Virtual work of the rule's stress in UFL."""
        (law, means), h0, h1 = self.energy(), ufl.grad(u0), ufl.grad(u1)
        if self._modes is not None:
            step = StepModes(self._modes)
            h0, h1 = (h + self._modes.gradient(w) for h, w in ((h0, step.old), (h1, step.new)))
            stress = rule.piola(law, h0, h1)
            return ufl.inner(stress, ufl.grad(w)) * self._dx, partial(
                step.compiled, stress, self._dx
            )
        work = ufl.inner(rule.piola(law, h0, h1), ufl.grad(w)) * self._dx
        return work, None if means is None else partial(FormWithMeans, means)

    def _viscous(self, u: Any, v: Any, w: Any) -> Any:
        """Virtual work of the viscosity in UFL."""
        return viscous_work(self._eta, u, v, w) * self._dx

    def _stress_jumps(self) -> StressJumps:
        """Of the stress at the state of `u`."""
        law, means = self.energy()
        stress = law.at_point(green_strain(self.gradient))
        if means is not None:
            means.compile(self.u)
        return StressJumps(
            stress, self.mesh, self._dx, means, lambda: self.potential(self.last_accepted()[0])
        )

    # ---- as of Body
    def lost(self, u1: FloatArray) -> dict[str, float]:
        """As of `Body`."""
        return {name: self._forms.power(u1) for name in self.losses}

    @property
    def settings(self) -> Settings:
        """What ranks must have in common, see `Body`."""
        loads = {"body_force": self.body_force, "traction": self._loads.settings}
        own = {"material": self.material, "density": self.density, "degree": self.degree}
        own["viscosity"] = self.viscosity
        own |= {"volume": self._volume, "bending": self._modes is not None}
        return own | loads | super().settings

    def inner(self, u1: FloatArray) -> FloatArray:
        """As of `Body`: the modes of the cells, shape (9 cells,)."""
        return self._forms.inner(u1)

    def take_inner(self, inner: FloatArray) -> FloatArray:
        """As of `Body`."""
        if self._bent is None:
            return np.empty(0)
        values = self._bent.x.array[: len(inner)]
        before: FloatArray = values.copy()
        values[:] = inner
        return before

    def inner_at_rest(self, u: FloatArray) -> FloatArray:
        """As of `Body`."""
        return np.empty(0) if self._modes is None else self._forms.inner_at_rest(u)

    def doubts(self, u: FloatArray) -> list[StepWarning]:
        """As of `Body`."""
        if self._modes is None:
            return []
        corners = self._forms.with_ghosts(u)[self._nodes_of_cells.dofs]
        return self._modes.doubts(self.name, corners)

    @cached_property
    def _nodes_of_cells(self) -> NodesOfCells:
        return NodesOfCells(self.space)

    @property
    def inner_numbers(self) -> IntArray:
        """As of `Body`: those of the cells in the input."""
        topology = self.mesh.topology
        owned = topology.index_map(topology.dim).size_local
        return np.asarray(topology.original_cell_index[:owned], dtype=np.int64)

    def destroy(self) -> None:
        """As of `Body`."""
        super().destroy()
        if self.locking is not None:
            self.locking.destroy()

    def begin_step(self, rule: Integrator, moment: EvaluationPoint) -> None:
        """Set the state at t_n and the loads of the step."""
        if not self._seen_at_rest:
            self._seek_stress_at_rest(rule)
        super().begin_step(rule, moment)
        if self._loads.begin(moment.time, moment.ramp):
            self._load = self._forms.assemble(self._load_form)

    def _seek_stress_at_rest(self, rule: Integrator) -> None:
        """Note whether forces of its own move the undeformed body, as where dW/dC(1) is not 0.

        Beside them stand those of a small shear x, -y. Costs two evaluations of internal forces.
        """
        self._seen_at_rest = True
        shear = _SMALL_STRAIN * np.resize([1.0, -1.0, 0.0], self.num_owned) * self.reference
        still = np.zeros_like(shear)
        at_rest = self._forms.forces(rule, still, still)
        change = self._forms.forces(rule, still, shear) - at_rest
        change /= rule.theta * _SMALL_STRAIN
        at_rest[self.fixed] = 0.0
        squares = np.array([at_rest @ at_rest, change @ change])
        stress, stiffness = np.sqrt(self.comm.allreduce(squares)).tolist()
        if not stress <= _STRESS_FREE * stiffness:
            self.stressed = stress / stiffness if stiffness else math.inf
