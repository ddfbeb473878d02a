"""Geometrically exact beams: places and three directors at the nodes of intervals (section 15)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc
from scipy.spatial import cKDTree

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.axis import axis_of, check_line
from dolfinx_nts.bodies.body import Body, Moment
from dolfinx_nts.bodies.conditions import Dirichlet, Meetings
from dolfinx_nts.bodies.mesh_check import places_of
from dolfinx_nts.bodies.points import Points
from dolfinx_nts.bodies.section import Clamp, LineForce, PointForce, Section
from dolfinx_nts.bodies.triad import Triads, largest_turn
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.kernels import beam as kernel
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.validation import (
    at_points,
    items,
    known_options,
    require_name,
    vector,
    vector_in_time,
    vectors,
)

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]
Vector = Sequence[float] | FloatArray

#: Part of a beam's size within which a point is a node.
_AT_NODE = 1e-9
#: Weights of a node's four vectors in its place.
_PLACE = np.array([[1.0, 0.0, 0.0, 0.0]])


@known_options
class Beam(Body):
    """A beam on a mesh of its axis, straight or curved, with shear, stretch, bending and twist.

    A node has twelve coordinates: its place phi and D_i = l d_i, l the section's radius of gyration
    and d_i orthonormal by constraints, d_3 along the axis in the reference, which is free of
    stress. A material point is phi + x_1 d_1 + x_2 d_2. The energy is quadratic in strains that are
    quadratic in the coordinates (theory section 15), so that the energy-momentum scheme keeps it to
    rounding.

    Limits: each mesh is one line or ring, or several, without branches, and without corners of more
    than 60 degrees (`Fixed` joins beams there); no contact surface, no end moment; `Dirichlet`
    prescribes places alone; joints and springs hold nodes.

    Args:
        mesh: Intervals of degree 1 whose points have three coordinates.
        section: Stiffness and mass of the cross-section.
        direction: d_1 before it is set at right angles to the axis: a vector, or a function
            x (3, n) -> (3, n); None: of the axes y, z, x the one that is farthest from the beam's.
        velocity: At the start [m/s], a vector, or a function x (3, n) -> (3, n).
        angular_velocity: At the start, about the centre of mass [rad/s].
        bcs: `Clamp` and `Dirichlet` conditions, whose functions `where` select nodes.
        forces: `PointForce` and `LineForce` loads.
        name: Name in messages and files.

    Attributes:
        u: Displacement of the axis [m], dolfinx Function of the last accepted state.
        v: Velocity of the axis [m/s], dolfinx Function.
        space: Their function space.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or the mesh is not one of intervals in space, or
            has a cell without length, a branch or a corner.
    """

    oriented = True

    def __init__(
        self,
        mesh: Any,
        section: Section,
        *,
        direction: Any = None,
        velocity: Any = (0.0, 0.0, 0.0),
        angular_velocity: Vector = (0.0, 0.0, 0.0),
        bcs: Sequence[Clamp | Dirichlet] = (),
        forces: Sequence[PointForce | LineForce] = (),
        name: str = "beam",
    ) -> None:
        require_name("name", name)
        if not isinstance(section, Section):
            raise TypeError(f"section={section!r}: pass Section(EA=..., GA=(.., ..), ...)")
        check_line(mesh, name)
        spin = vector("angular_velocity", angular_velocity, "rad/s")
        self.name, self.mesh, self.comm, self.degree = name, mesh, mesh.comm, 1
        self.section, self.length = section, section.radius
        self.made_on = places_of(mesh)
        self.space = compat.vector_space(mesh, 1)
        stem = re.sub(r"\W", "_", name, flags=re.ASCII)
        self.u, self.v = (fem.Function(self.space, name=f"{stem}_{s}") for s in "uv")
        self._axis = axis_of(self.space, direction, name)
        self._set_up_nodes()
        self._set_up_elements()
        self._set_up_conditions(bcs, forces)
        self._set_up_velocity(velocity, spin)
        held = self._free_directors()
        along = np.empty_like(self._axis.order)
        along[self._axis.order] = np.arange(len(along))
        triads = Triads(self, self._points(held, _PLACE), self.length, along[held])
        self.joints = (triads,)
        self._matrix: Any = None
        self.accept(np.zeros(self.num_owned), self.initial_velocity)

    # ---- set-up
    def _set_up_nodes(self) -> None:
        """Reference of this rank's nodes, and what exchanges values with other ranks."""
        index_map = self.space.dofmap.index_map
        self._first, stop = index_map.local_range
        here = slice(self._first, stop)
        self.num_owned = 12 * index_map.size_local
        scaled = self.length * self._axis.directors[here]
        y = np.concatenate([self._axis.x[here, None], scaled], axis=1)
        self.reference: FloatArray = y.ravel()
        self.places = np.tile([True, False, False, False], index_map.size_local)
        self._shared = PETSc.Vec().createGhost(
            np.asarray(index_map.ghosts, dtype=PETSc.IntType),
            (self.num_owned, None), bsize=12, comm=self.comm,
        )  # fmt: skip

    def _set_up_elements(self) -> None:
        """This rank's cells, with their nodes in the axis' direction."""
        owned = self.mesh.topology.index_map(1).size_local
        start = self.comm.exscan(owned) or 0
        self._cells = self._axis.cells[start : start + owned]
        dofs = compat.cell_dofs(self.space)[:owned]
        index_map = self.space.dofmap.index_map
        numbers = index_map.local_to_global(dofs.ravel().astype(np.int32)).reshape(-1, 2)
        turned = numbers[:, 0] != self._cells[:, 0]
        self._nodes = np.where(turned[:, None], dofs[:, ::-1], dofs)
        x = self._axis.x[self._cells]
        length = np.linalg.norm(x[:, 1] - x[:, 0], axis=1)
        y = np.concatenate(
            [x[:, :, None], self.length * self._axis.directors[self._cells]], axis=2
        ).reshape(owned, 8, 3)
        self._beams = kernel.beams(y, length, self.length, self.section.stiffness)
        self._rest = y
        sums = 0.5 * length[:, None, None] * self.section.masses[:, None]
        of_nodes = np.broadcast_to(sums[:, None], (owned, 2, 4, 1)) * np.ones(3)
        self.nodal_mass: FloatArray = self._gather(of_nodes.reshape(owned, 24))

    def _set_up_conditions(
        self, bcs: Sequence[Clamp | Dirichlet], forces: Sequence[PointForce | LineForce]
    ) -> None:
        conditions = items(
            "bcs", bcs, lambda b: isinstance(b, Clamp | Dirichlet), "Clamp or Dirichlet"
        )
        loads = items(
            "forces", forces, lambda f: isinstance(f, PointForce | LineForce),
            "PointForce or LineForce",
        )  # fmt: skip
        owner = np.full((self.num_owned // 12, 12), -1)
        self._values: list[Any] = []
        dofs = []
        for k, bc in enumerate(conditions):
            chosen = self._chosen(f"{type(bc).__name__}.where of bcs[{k}] of {self.name!r}", bc)
            clamped = isinstance(bc, Clamp)
            columns = np.arange(12) if clamped else np.array(bc.components)
            owner[np.ix_(chosen, columns)] = k
            dofs.append((12 * chosen[:, None] + columns).ravel())
            self._values.append((0.0, 0.0, 0.0) if clamped else bc.value)
        self.driven = any(callable(value) for value in self._values)
        self.fixed: IntArray = np.flatnonzero(owner >= 0)
        self._condition = owner.ravel()[self.fixed]
        self._loads = []
        for k, load in enumerate(loads):
            what = f"{type(load).__name__}.where of forces[{k}] of {self.name!r}"
            if isinstance(load, LineForce):
                unit = "N/m"
                weights = self._lengths(None if load.where is None else self._chosen(what, load))
                if not self.comm.allreduce(weights.sum()):
                    raise ValueError(
                        f"{what}={load.where!r}: selects no two neighbours; select both ends of "
                        "the elements it acts on"
                    )
            else:
                unit, chosen = "N", self._chosen(what, load)
                weights = np.zeros(self.num_owned // 12)
                weights[chosen] = 1.0
                count = self.comm.allreduce(len(chosen))
                if count != 1:
                    raise ValueError(f"{what}={load.where!r}: selects {count} nodes; select one")
            self._loads.append((type(load).__name__, weights, load.value, unit))
        x = self._axis.x[self._first : self._first + len(owner)]
        self._meetings = Meetings(self.comm, self.name, self._values, dofs, x, 12)
        self._meetings.check(self._prescribed(0.0), 0.0, anew=False)
        self._loads_at(0.0, 1.0)

    def _lengths(self, chosen: IntArray | None) -> FloatArray:
        """Half of the lengths of the elements at each node [m]. Collective.

        Args:
            chosen: This rank's nodes at both ends of those that count; None: all.
        """
        ends = np.ones(self.num_owned)
        if chosen is not None:
            ends.reshape(-1, 12)[:] = np.isin(np.arange(len(ends) // 12), chosen)[:, None]
        both = self._scatter(ends).reshape(-1, 2, 12)[:, :, 0].min(axis=1)
        halves = np.repeat(0.5 * self._beams.length * both, 24).reshape(-1, 24)
        return self._gather(halves)[::12]

    def _chosen(self, what: str, given: Any) -> IntArray:
        """This rank's nodes where a condition holds; it must hold somewhere. Collective."""
        if not callable(given.where):
            raise TypeError(f"{what}={given.where!r}: pass a function x (3, n) -> bool (n,)")
        x = self._axis.x
        chosen = np.flatnonzero(at_points(self.comm, what, given.where, x.T, (), "b"))
        if not chosen.size:
            low, high = x.min(axis=0).tolist(), x.max(axis=0).tolist()
            raise ValueError(f"{what}={given.where!r}: selects no node between {low} and {high}")
        mine = (chosen >= self._first) & (chosen < self._first + self.num_owned // 12)
        return np.asarray(chosen[mine] - self._first)

    def _set_up_velocity(self, velocity: Any, spin: FloatArray) -> None:
        x, d = (
            a[self._first : self._first + self.num_owned // 12]
            for a in (self._axis.x, self._axis.directors)
        )
        if callable(velocity):
            speed = at_points(self.comm, f"velocity of {self.name!r}", velocity, x.T, (3,)).T
        else:
            speed = np.tile(vector("velocity", velocity, "m/s"), (len(x), 1))
        mass = self.nodal_mass[::12]
        total = self.comm.allreduce(np.array([*(mass @ x), mass.sum()]))
        v = np.zeros((len(x), 4, 3))
        v[:, 0] = speed + np.cross(spin, x - total[:3] / total[3])
        v[:, 1:] = self.length * np.cross(spin, d)
        still = [k for k, value in enumerate(self._values) if not callable(value)]
        self.initial_velocity: FloatArray = v.ravel()
        self.initial_velocity[self.fixed[np.isin(self._condition, still)]] = 0.0

    def _free_directors(self) -> IntArray:
        """Global numbers of this rank's nodes whose directors are not prescribed."""
        fixed = np.zeros(self.num_owned, dtype=bool)
        fixed[self.fixed] = True
        free = ~fixed.reshape(-1, 12)[:, 3:].all(axis=1)
        return np.asarray(self._first + np.flatnonzero(free))

    def file_order(self) -> IntArray:
        """Nodal vectors of all ranks in the order along the axis, see `Body`."""
        order: IntArray = (4 * self._axis.order[:, None] + np.arange(4)).ravel()
        return order

    # ---- values of this rank's elements
    def _scatter(self, owned: FloatArray) -> FloatArray:
        """Values at the nodes of this rank's elements, shape (n, 8, 3). Collective."""
        self.check_alive()
        self._shared.array_w[:] = owned
        self._shared.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        with self._shared.localForm() as local:
            values = local.array_r.reshape(-1, 12)[self._nodes]
        found: FloatArray = values.reshape(len(self._nodes), 8, 3)
        return found

    def _gather(self, values: FloatArray) -> FloatArray:
        """Sums at this rank's coordinates of what elements contribute, (n, 24). Collective."""
        with self._shared.localForm() as local:
            sums = np.zeros((local.getLocalSize() // 12, 12))
            np.add.at(sums, self._nodes, values.reshape(-1, 2, 12))
            local.array_w[:] = sums.ravel()
        self._shared.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        owned: FloatArray = self._shared.array_r.copy()
        return owned

    def _vectors(self, u: FloatArray) -> FloatArray:
        """Nodal vectors of this rank's elements [m], shape (n, 8, 3). Collective."""
        return self._rest + self._scatter(u)

    # ---- the last accepted state
    def centreline(self) -> tuple[FloatArray, FloatArray]:
        """Nodes of the axis as they follow each other, the same on all ranks. Collective.

        Returns:
            In the reference X and now x [m], shape (n, 3) each.
        """
        moved = gather_rows(self.comm, self.last_accepted()[0].reshape(-1, 4, 3)[:, 0])
        order = self._axis.order
        return self._axis.x[order], self._axis.x[order] + moved[order]

    # ---- points
    def points(self, x: Any) -> Points:
        """Nodes as material points, for joints and springs. Collective.

        Args:
            x: Reference positions of nodes [m], shape (3,) or (n, 3), the same on all ranks.

        Raises:
            ValueError: x is no array of points, or one of them is no node.
        """
        given = vectors("x", x, "points [m]")
        distance, nodes = cKDTree(self._axis.x).query(given)
        off = distance > _AT_NODE * np.ptp(self._axis.x, axis=0).max()
        if off.any():
            near = self._axis.x[nodes[off.argmax()]].tolist()
            raise ValueError(
                f"x={given[off.argmax()].tolist()}: is no node of beam {self.name!r}; the nearest "
                f"one is {near}"
            )
        return self._points(nodes, _PLACE)

    def directions_at(self, direction: FloatArray, x: Any) -> Points:
        """A direction that turns with a node, for joints. Collective.

        Args:
            direction: At the start [-], shape (3,).
            x: Reference position of the node [m], as of `points`.
        """
        nodes = self.points(x).nodes[:, 0] // 4
        local = self._axis.directors[nodes] @ direction / self.length
        return self._points(nodes, np.column_stack([np.zeros(len(local)), local]))

    def at_nodes(self, nodes: IntArray, x: FloatArray) -> Points:
        """Nodes of the mesh as material points. Collective.

        Args:
            nodes: Global numbers in `space`, shape (n,), the same on all ranks.
            x: Their reference positions [m], shape (n, 3).
        """
        return self._points(np.asarray(nodes), _PLACE)

    def _points(self, nodes: IntArray, weights: FloatArray) -> Points:
        """Points of the nodes' four vectors, weights of shape (n or 1, 4). Collective."""
        n = len(nodes)
        fixed = np.zeros(self.num_owned, dtype=bool)
        fixed[self.fixed] = True
        y = np.concatenate(
            [self._axis.x[nodes, None], self.length * self._axis.directors[nodes]], axis=1
        )
        return Points(
            self,
            4 * nodes[:, None] + np.arange(4),
            np.broadcast_to(weights, (n, 4)),
            y,
            gather_rows(self.comm, fixed.reshape(-1, 4, 3))[nodes],
            np.tile([True, False, False, False], (n, 1)),
        )

    def at_mesh(self, values: FloatArray) -> FloatArray:
        """Values of the axis at the mesh's nodes on this rank, as of `space`."""
        return values.reshape(-1, 4, 3)[:, 0].ravel()

    # ---- as of Body
    def begin_step(self, rule: Integrator, moment: Moment) -> None:
        """Set the state at t_n and the loads of the step."""
        self._y0 = self._vectors(moment.u0)
        self._theta = rule.taken_at
        self._load = self._loads_at(moment.time, moment.ramp)

    def _loads_at(self, time: float, ramp: float) -> FloatArray:
        """Loads [N]. Collective."""
        load = np.zeros((self.num_owned // 12, 12))
        for k, (kind, weights, value, unit) in enumerate(self._loads):
            what = f"{kind}.value of forces[{k}] of {self.name!r}"
            part = 1.0 if callable(value) else ramp
            force = vector_in_time(self.comm, what, value, time, unit)
            load[:, :3] += part * weights[:, None] * force
        return load.ravel()

    @property
    def settings(self) -> dict[str, Any]:
        """What ranks must have in common, see `Body`."""
        loads = [value for _, _, value, _ in self._loads]
        return {"section": self.section, "bcs": self._values, "forces": loads}

    def prescribed(self, time: float) -> FloatArray:
        """Displacements of the prescribed coordinates [m]. Collective."""
        now = self._prescribed(time)
        self._meetings.check(now, time)
        found: FloatArray = now[self._condition, self.fixed % 12]
        return found

    def _prescribed(self, time: float) -> FloatArray:
        """What each condition prescribes [m], shape (conditions, 12). Collective."""
        now = np.zeros((len(self._values), 12))
        for k, value in enumerate(self._values):
            what = f"Dirichlet.value of bcs[{k}] of {self.name!r}"
            now[k, :3] = vector_in_time(self.comm, what, value, time, "m")
        return now

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v [kg m/s for a velocity]. Collective."""
        both = self._scatter(v).reshape(-1, 2, 4, 3)
        mass = self._beams.length[:, None, None, None] / 6.0 * self.section.masses[:, None]
        return self._gather((mass * (both + both.sum(axis=1, keepdims=True))).reshape(-1, 24))

    def internal(self, u1: FloatArray) -> FloatArray:
        """Internal forces of the step [N]. Collective."""
        y1 = self._vectors(u1)
        return self._gather(kernel.force(self._beams, self._y0, y1, self._theta))

    def external(self, u1: FloatArray, gravity: FloatArray) -> FloatArray:
        """Point forces and gravity [N]."""
        return self._load + self.weight(gravity)

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> Any:
        """Return mass M + stiffness K, the same matrix in each call. Collective."""
        if self._matrix is None:
            self._set_up_matrix()
        values = np.zeros((len(self._nodes), 24, 24))
        if stiffness:
            y1 = self._vectors(u1)
            values += stiffness * kernel.tangent(self._beams, self._y0, y1, self._theta)
        if mass:
            values += mass * self._element_masses()
        values[self._held[:, :, None] | self._held[:, None]] = 0.0
        diagonal = np.zeros(self.num_owned)
        scale = mass * self.nodal_mass if mass else stiffness * self._diagonal
        places = np.repeat(self.places, 3)
        total = self.comm.allreduce(np.array([scale[places].sum(), places.sum()]))
        diagonal[self.fixed] = total[0] / total[1] or 1.0
        compat.set_values_coo(self._matrix, np.concatenate([values.ravel(), diagonal]))
        return self._matrix

    def _element_masses(self) -> FloatArray:
        """Consistent mass matrices [kg], shape (n, 24, 24)."""
        per_length = np.diag(np.repeat(self.section.masses, 3))
        of_unit = np.kron((np.ones((2, 2)) + np.eye(2)) / 6.0, per_length)
        found: FloatArray = self._beams.length[:, None, None] * of_unit
        return found

    def _set_up_matrix(self) -> None:
        fixed = np.zeros(self.num_owned)
        fixed[self.fixed] = 1.0
        self._held = self._scatter(fixed).reshape(-1, 24) > 0.5
        numbers = (12 * self._cells[:, :, None] + np.arange(12)).reshape(-1, 24)
        rows, cols = (
            np.broadcast_to(n, (len(numbers), 24, 24)).ravel()
            for n in (numbers[:, :, None], numbers[:, None])
        )
        own = 12 * self._first + np.arange(self.num_owned)
        self._matrix = compat.coo_matrix(
            self.comm, self.num_owned, np.append(rows, own), np.append(cols, own)
        )

    @cached_property
    def _diagonal(self) -> FloatArray:
        """Return the diagonal of the stiffness in the reference [N/m]. Collective."""
        k = kernel.tangent(self._beams, self._rest, self._rest, 1.0)
        return self._gather(np.einsum("nii->ni", k))

    def nodal_stiffness(self, rule: Integrator) -> FloatArray:
        """Mean diagonal of the tangent at each node in the reference [N/m]. Collective."""
        mean = self._diagonal.reshape(-1, 3).mean(axis=1)
        return np.repeat(mean, 3)

    def potential(self, u: FloatArray) -> float:
        """Strain energy on this rank [J]. Collective."""
        return float(kernel.energy(self._beams, self._vectors(u)).sum())

    def reactions(self, residual: FloatArray) -> FloatArray:
        """Resultants on the places of each condition, this rank's part [N], (conditions, 3)."""
        total = np.zeros((len(self._values), 3))
        place = self.fixed % 12 < 3
        dofs = self.fixed[place]
        np.add.at(total, (self._condition[place], dofs % 3), residual[dofs])
        return total

    def turn(self, u0: FloatArray, u1: FloatArray) -> float:
        """Largest turn between two displacements on this rank [rad]."""
        return largest_turn(self.reference + u0, self.reference + u1)

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Make u and v the body's current state. Collective."""
        super().accept(u, v)
        for function, values in ((self.u, u), (self.v, v)):
            function.x.array[: self.num_owned // 4] = self.at_mesh(values)
            function.x.scatter_forward()

    def destroy(self) -> None:
        """Free the PETSc objects; the body is of no use then."""
        super().destroy()
        for a in (self._shared, self._matrix):
            if a is not None:
                a.destroy()
