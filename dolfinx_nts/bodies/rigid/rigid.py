"""Rigid bodies: centre of mass and three directors, held orthonormal (theory section 12)."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from itertools import compress
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import Mesh
from petsc4py import PETSc

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.conditions import VectorInTime
from dolfinx_nts.bodies.directors import Directors
from dolfinx_nts.bodies.mesh_body import MeshBody
from dolfinx_nts.bodies.meshes.mesh_check import check_mesh, places_of
from dolfinx_nts.bodies.nodal_values import motion_on
from dolfinx_nts.bodies.rigid.inertia import Inertia, inertia_of, principal
from dolfinx_nts.bodies.rigid.rigid_loads import PrescribedMotion, RigidLoads
from dolfinx_nts.bodies.rigid.rigid_matrix import RigidMatrix
from dolfinx_nts.bodies.solid.parameters import (
    Parameter,
    is_number,
    require_positive_parameter,
    values_of,
)
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels.vectors import cross, range_of
from dolfinx_nts.parallel import gather_rows, raise_together, rank_of
from dolfinx_nts.types import FloatArray, IntArray, Places, Settings, Values
from dolfinx_nts.validation import (
    UserFunctionError,
    known_options,
    require_name,
    require_positive,
    require_same,
    vector,
    vectors,
)


@known_options
class RigidBody(MeshBody):
    """A rigid body on a DOLFINx mesh, with twelve coordinates and six constraints.

    Its coordinates are those of four nodes: the centre of mass phi and D_i = l d_i, l the radius of
    gyration and d_i the principal axes, so that all are lengths and the mass matrix is constant and
    diagonal: m, E_i / l^2 (theory section 12). They live on one rank; the mesh, which may be
    distributed, serves contact surfaces, fields and pictures.

    Args:
        mesh: 3D hexahedral or tetrahedral mesh.
        density: [kg/m^3], > 0: a number, or a Constant or Function on the mesh, which must keep
            its values.
        velocity: Of the centre of mass at the start [m/s]; not beside `motion`.
        angular_velocity: At the start [rad/s]; not beside `rotation`.
        force: Dead force on the centre of mass [N]: a vector, or a function of time.
        torque: Dead torque [N m]: a vector, or a function of time.
        motion: Displacement of the centre of mass from its reference [m], as a vector, or a
            function of time, where the body starts, too; its work is external work. None: the
            centre is free.
        rotation: Rotation from the reference, as a rotation vector [rad], a matrix (3, 3), or a
            function of time to one of them, likewise. None: the body is free to turn. A run warns
            of more than a radian in a step, whole turns included.
        name: Name in messages and files.

    Attributes:
        mass: [kg].
        moments: Principal moments of inertia [kg m^2], shape (3,).
        centre: Centre of mass in the reference [m], shape (3,).
        u: Displacement of the mesh [m], dolfinx Function of the last accepted state; v and space
            alike.

    Raises:
        TypeError: `mesh` is none, or an argument is of another kind.
        ValueError: An argument is out of range, or the mesh is not a valid 3D mesh.
    """

    rigid = oriented = bound = True
    _densities: Sequence[Any] = ()
    _made = False

    def __init__(
        self,
        mesh: Mesh,
        *,
        density: Parameter,
        velocity: Values = (0.0, 0.0, 0.0),
        angular_velocity: Values = (0.0, 0.0, 0.0),
        force: VectorInTime = (0.0, 0.0, 0.0),
        torque: VectorInTime = (0.0, 0.0, 0.0),
        motion: VectorInTime | None = None,
        rotation: Any = None,
        name: str = "rigid",
    ) -> None:
        require_name("name", name)
        degree = check_mesh(mesh, name)
        given = {
            "name": name, "velocity": velocity, "angular_velocity": angular_velocity,
            "force": force, "torque": torque, "motion": motion, "rotation": rotation,
        }  # fmt: skip
        require_same(mesh.comm, density=density if is_number(density) else None, **given)
        require_positive_parameter("density", density, "kg/m^3")
        self.mesh, self.density, self.degree = mesh, density, degree
        self.made_on = places_of(mesh)
        self.space = compat.vector_space(mesh, degree)
        self.u, self.v = motion_on(self.space, name)
        self._densities = [] if is_number(density) else [density]
        self._measured = self.parameters()
        self._set_up(mesh.comm, inertia_of(self.space, density, degree), **given)

    @classmethod
    @known_options
    def from_inertia(
        cls,
        mass: float,
        inertia: Any,
        centre: Any = (0.0, 0.0, 0.0),
        axes: Any = None,
        *,
        velocity: Values = (0.0, 0.0, 0.0),
        angular_velocity: Values = (0.0, 0.0, 0.0),
        force: VectorInTime = (0.0, 0.0, 0.0),
        torque: VectorInTime = (0.0, 0.0, 0.0),
        motion: VectorInTime | None = None,
        rotation: Any = None,
        name: str = "rigid",
        comm: MPI.Comm = MPI.COMM_WORLD,
    ) -> RigidBody:
        """A rigid body without a mesh.

        Args:
            mass: [kg], > 0.
            inertia: Principal moments of inertia about the centre of mass [kg m^2], shape (3,), or
                their tensor, shape (3, 3). Moments of 0 are legal: a rod, a point.
            centre: Centre of mass at the start [m].
            axes: Principal axes as the columns of a right-handed orthonormal matrix (3, 3);
                default: those of x, y, z, or of the tensor.
            velocity: As of the class, and so are the next ones.
            angular_velocity: [rad/s].
            force: [N].
            torque: [N m].
            motion: [m].
            rotation: [rad], or a matrix.
            name: Name in messages and files.
            comm: MPI communicator.

        Raises:
            TypeError: An argument is of another kind.
            ValueError: An argument is out of range: moments that no body has, axes that are not
                right-handed or not orthonormal.
        """
        if not isinstance(comm, MPI.Comm):
            raise TypeError(f"comm={comm!r}: pass an MPI communicator of mpi4py")
        given = {
            "name": name, "velocity": velocity, "angular_velocity": angular_velocity,
            "force": force, "torque": torque, "motion": motion, "rotation": rotation,
        }  # fmt: skip
        require_same(comm, mass=mass, inertia=inertia, centre=centre, axes=axes, **given)
        require_name("name", name)
        require_positive("mass", mass, "kg")
        where = vector("centre", centre, "m")
        moments, columns = principal(inertia, axes)
        body = cls.__new__(cls)
        body._set_up(comm, Inertia.of_moments(float(mass), where, moments, columns), **given)
        body._made = True
        return body

    def _set_up(
        self, comm: MPI.Comm, inertia: Inertia, *, name: str, velocity: Values,
        angular_velocity: Values, force: VectorInTime, torque: VectorInTime,
        motion: VectorInTime | None, rotation: Any,
    ) -> None:  # fmt: skip
        """Set up what both constructors share."""
        self.name, self._inertia = name, inertia
        self.comm = petsc_compat.petsc_communicator(comm)
        self.mass, self.centre, self.moments = inertia.mass, inertia.centre, inertia.moments
        self.length = inertia.length
        linear = vector("velocity", velocity, "m/s")
        turning = vector("angular_velocity", angular_velocity, "rad/s")
        self._drive = PrescribedMotion(comm, name, motion, rotation)
        self._drive.refuse_beside(linear, turning)
        self.driven = self._drive.in_time
        self._loads = RigidLoads(comm, name, force, torque, inertia.euler)
        self.loads_in_time = self._loads.in_time
        self._loads.begin(0.0, 1.0, inertia.axes)
        self._set_up_nodes(linear, turning)
        self.prescribed(0.0)
        held = self.points(self.centre).select(slice(0, int(comm.rank == self.owner)))
        self._directors_held = Directors(self, held, self.length, np.arange(len(held)))
        self.joints = () if self._drive.turns else (self._directors_held,)
        self._matrix = RigidMatrix(
            self.comm, self.nodal_mass + self.lent, self.fixed, self.mass
        )
        #: Of each node the largest weight in a point of the mesh, shape (4,).
        self.reach = np.ones(4)
        if self.mesh is not None:
            x = self.space.tabulate_dof_coordinates()
            self._mesh_weights = self._weights(x)
            local = np.abs(self._mesh_weights).max(axis=0, initial=0.0)
            comm.Allreduce(local, self.reach, op=MPI.MAX)
        self.accept(np.zeros(self.num_owned), self.initial_velocity)

    def _set_up_nodes(self, linear: FloatArray, turning: FloatArray) -> None:
        """Place, mass and velocity of the four nodes, all on one rank."""
        self.owner = rank_of(self.name, self.comm)
        self.num_owned = 12 if self.comm.rank == self.owner else 0
        self.places = np.array([True, False, False, False])[: self.num_owned // 3]
        y, masses = self._inertia.nodes, self._inertia.nodal_mass
        self.reference: FloatArray = y.ravel()[: self.num_owned]
        self.nodal_mass: FloatArray = np.repeat(masses, 3)[: self.num_owned]
        #: Mass that matrices have beside `nodal_mass` [kg], see `Inertia.lent`.
        self.lent: FloatArray = np.repeat(self._inertia.lent, 3)[: self.num_owned]
        speeds = np.vstack([linear, np.cross(turning, y[1:])])
        self.initial_velocity = speeds.ravel()[: self.num_owned]
        self._fixed = np.repeat([self._drive.moves] + 3 * [self._drive.turns], 3)
        self.fixed = np.flatnonzero(self._fixed[: self.num_owned])

    # ---- the last accepted state
    @property
    def position(self) -> FloatArray:
        """Centre of mass [m], shape (3,), the same on all ranks."""
        return self._y[0].copy()

    @property
    def velocity(self) -> FloatArray:
        """Velocity of the centre of mass [m/s], shape (3,), the same on all ranks."""
        return self._v[0].copy()

    @property
    def rotation(self) -> FloatArray:
        """Directors d_i as columns, shape (3, 3), the same on all ranks.

        They are the principal axes of inertia as they stand now, so this is not the identity at the
        start. The rotation from there is `body.rotation @ at_start.T`, with a copy of it made then.
        """
        return self._y[1:].T / self.length

    @property
    def angular_velocity(self) -> FloatArray:
        """1/2 sum d_i x v_i [rad/s], shape (3,), the same on all ranks."""
        return 0.5 * cross(self._y[1:], self._v[1:]).sum(axis=0) / self.length**2

    # ---- points
    def _weights(self, x: FloatArray) -> FloatArray:
        """Weights of the four nodes in points x (n, 3) of the reference, shape (n, 4)."""
        local = (x - self.centre) @ self._inertia.axes / self.length
        return np.column_stack([np.ones(len(x)), local])

    def _points(self, weights: FloatArray) -> Points:
        n, y = len(weights), self._inertia.nodes
        nodes = np.tile(np.arange(4), (n, 1))
        fixed = np.tile(self._fixed.reshape(4, 3), (n, 1, 1))
        places = np.tile([True, False, False, False], (n, 1))
        return Points(self, nodes, weights, np.tile(y, (n, 1, 1)), fixed, places)

    def points(self, x: Places) -> Points:
        """As of `Body`, inside the body or not."""
        return self._points(self._weights(vectors("x", x, "points [m]")))

    def directions(self, x: Places) -> Points:
        """As of `Body`."""
        local = vectors("x", x, "vectors") @ self._inertia.axes / self.length
        return self._points(np.column_stack([np.zeros(len(local)), local]))

    def directions_at(self, direction: FloatArray, x: Places) -> Points:
        """As of `Body`; it turns alike at all points."""
        return self.directions(direction)

    def at_nodes(self, nodes: IntArray, x: FloatArray) -> Points:
        """As of `Body`."""
        return self._points(self._weights(x))

    def at_mesh(self, values: FloatArray) -> FloatArray:
        """As of `Body`. Collective."""
        owned = self.space.dofmap.index_map.size_local
        return (self._mesh_weights[:owned] @ gather_rows(self.comm, values.reshape(-1, 3))).ravel()

    def _check_surface(self, mass: str) -> None:
        """As of `MeshBody`."""
        if mass != "consistent":
            raise ValueError(
                f"mass={mass!r} of a surface of {self.name!r}: a rigid body has no nodes that "
                "could do without mass; leave mass out, or let a Continuum be the slave"
            )
        if self.mesh is None:
            raise ValueError(
                f"body {self.name!r}: has no mesh, so no surface; make it by RigidBody(mesh, ...)"
            )

    def motion_range(self, du: FloatArray) -> FloatArray:
        """Bounds on the motion of the mesh's points on this rank, see `Body` [m]."""
        moved = du.reshape(-1, 4, 3)
        turned = np.einsum("k,nki->ni", self.reach[1:], np.abs(moved[:, 1:]))
        return range_of(moved[:, 0], turned)

    # ---- as of Body
    @property
    def alike(self) -> Hashable | None:
        """Not None if inertia and gravity are all there is to it: a step takes many as one."""
        held = self._drive.moves or self._drive.turns
        return () if self._loads.none and not held else None

    @property
    def settings(self) -> Settings:
        """What ranks must have in common, see `Body`."""
        return dict(self._loads.settings)

    def prescribed(self, time: float) -> FloatArray:
        """Displacements of the prescribed coordinates [m]. Collective."""
        return self._drive.coordinates(time, self._inertia)[self.fixed]

    def begin_step(self, rule: Integrator, moment: EvaluationPoint) -> None:
        """Set the state at t_n and the loads of the step."""
        self._u0, self._theta = moment.u0, rule.theta
        self._loads.begin(moment.time, moment.ramp, self.rotation)

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v [kg m/s for a velocity]."""
        return self.nodal_mass * v

    def internal(self, u1: FloatArray) -> FloatArray:
        """None [N]: what holds the directors are constraints."""
        return np.zeros(self.num_owned)

    def external(self, u1: FloatArray, gravity: FloatArray) -> FloatArray:
        """Gravity, force, and the torque's forces on the directors [N]."""
        f = self.weight(gravity).reshape(-1, 3)
        if self.num_owned:
            f[0] += self._loads.force
            if self._loads.turn:
                f[1:] = self._loads.on_directors(self._directors(u1))
        return f.ravel()

    def _directors(self, u1: FloatArray) -> FloatArray:
        """Return where the forces of the step act [m], shape (3, 3)."""
        u = self._u0 + self._theta * (u1 - self._u0)
        return (self.reference + u).reshape(4, 3)[1:]

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> PETSc.Mat:
        """Return mass M less stiffness times the derivative of the torque's forces."""
        self.check_alive()
        if not self._loads.turn:
            return self._matrix.at(mass, None)
        turning = np.zeros((9, 9))
        if self.num_owned:
            turning += stiffness * self._theta * self._loads.gradient(self._directors(u1))
        return self._matrix.at(mass, turning)

    def nodal_stiffness(self) -> FloatArray:
        """None [N/m]."""
        return np.zeros(self.num_owned)

    def parameters(self) -> FloatArray:
        """Values of a density that a caller may change, (n,)."""
        return values_of(self._densities)

    def take_parameters(self) -> None:
        """Refuse a density that has changed since mass and inertia were measured. Collective.

        Raises:
            UserFunctionError: It has.
        """
        if self._densities:
            same = np.array_equal(self.parameters(), self._measured)
            problem = (
                f"density of {self.name!r}: has changed, but the mass of a rigid body is measured "
                "when it is made; make a new body"
            )
            raise_together(self.comm, None if same else problem, UserFunctionError)

    def potential(self, u: FloatArray) -> float:
        """None [J]: loads do external work."""
        return 0.0

    def reactions(self, residual: FloatArray, u1: FloatArray) -> FloatArray:
        """Return what prescribed motion needs on this rank: force [N], then moment [N m].

        Shape (2, 3), (1, 3) if only one of them is prescribed, (0, 3) if none is.
        """
        rows = np.zeros((2, 3))
        if self.num_owned and self._fixed.any():
            force, *on_directors = residual.reshape(4, 3)
            rows[:] = force, cross(self._directors(u1), np.array(on_directors)).sum(axis=0)
        return rows[[self._drive.moves, self._drive.turns]]

    @property
    def reaction_labels(self) -> list[tuple[str, str]]:
        """Name and unit of each row of `reactions`."""
        both = ("force", "N"), ("moment", "N m")
        return list(compress(both, (self._drive.moves, self._drive.turns)))

    def turn(self, u0: FloatArray, u1: FloatArray) -> float:
        """Largest turn between two displacements on this rank [rad]."""
        return self._directors_held.largest_turn(self.reference + u0, self.reference + u1)

    def prescribed_turn(self, start: float, end: float) -> float:
        """Turn that `rotation` prescribes between two times [rad], at least. Collective."""
        return self._drive.turn(start, end)

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Make u and v the body's current state. Collective."""
        super().accept(u, v)
        local = np.reshape([self.reference + u, u, v], (3, -1, 3)).swapaxes(0, 1)
        self.show(*gather_rows(self.comm, local).swapaxes(0, 1))

    def show(self, place: FloatArray, moved: FloatArray, speed: FloatArray) -> None:
        """Take what others see of the body: of each node (4, 3).

        Args:
            place: Its vector [m].
            moved: Displacement [m].
            speed: Velocity [m/s].
        """
        self._y, self._v = place, speed
        if self.mesh is not None:
            for function, values in ((self.u, moved), (self.v, speed)):
                function.x.array[:] = (self._mesh_weights @ values).ravel()

    def destroy(self) -> None:
        """Free the PETSc objects; the body is of no use then."""
        super().destroy()
        self._matrix.destroy()
