"""What beams and shells share: nodes of a place and directors, an energy quadratic in strains."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from dolfinx.mesh import Mesh
from petsc4py import PETSc
from scipy.spatial import cKDTree

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.conditions import Dirichlet
from dolfinx_nts.bodies.directors import Directors
from dolfinx_nts.bodies.loads import Pressure
from dolfinx_nts.bodies.meshes.mesh_check import places_of
from dolfinx_nts.bodies.nodal_values import cell_function, motion_on
from dolfinx_nts.bodies.slender import turns
from dolfinx_nts.bodies.slender.director_elements import DirectorElements
from dolfinx_nts.bodies.slender.director_loads import DirectorLoads, Load
from dolfinx_nts.bodies.slender.director_matrix import DirectorMatrix
from dolfinx_nts.bodies.slender.director_mesh import DirectorMesh, WholeSkin
from dolfinx_nts.bodies.slender.director_skin import DirectorSkin
from dolfinx_nts.bodies.slender.element_forces import ElementForces
from dolfinx_nts.bodies.slender.element_values import ElementValues
from dolfinx_nts.bodies.slender.node_conditions import Clamp, NodeConditions
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels import quadratic as kernel
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.types import FloatArray, IntArray, Places, Settings, Values
from dolfinx_nts.validation import at_points, vector, vectors

#: Part of a body's size within which a point is a node.
_AT_NODE = 1e-9


class DirectorBody(ElementForces):
    """A body whose nodes have a place phi and directors D_i = l d_i, held by constraints.

    A subclass says what its nodes, elements and masses are; see `_set_up`. The Functions `u` and
    `v` are of the places.
    """

    oriented = True
    kind: ClassVar[str]

    # ---- what each kind has of its own
    def _elements_of(self, y: FloatArray) -> tuple[kernel.Elements, FloatArray]:
        """This rank's elements from their reference y [m], shape (n, k, 3).

        And int N_a N_b of their nodes [m or m^2], shape (n, nodes, nodes).
        """
        raise NotImplementedError

    def _make_skin(self) -> WholeSkin:
        """Its whole skin."""
        raise NotImplementedError

    @property
    def _neighbours(self) -> IntArray:
        """Nodes of a cell that are neighbours, shape (pairs, 2)."""
        raise NotImplementedError

    def _finer(self, times: float) -> str:
        """Which elements are needed, so many times as many along an axis as there are."""
        raise NotImplementedError

    def _felt(self, turn: float) -> tuple[float, float]:
        """Turn that strains feel where neighbouring nodes turn by so much [rad], and its slope."""
        raise NotImplementedError

    # ---- set-up
    def _set_up_mesh(self, mesh: Mesh, name: str, degree: int = 1) -> None:
        """What fields live on."""
        self.name, self.mesh, self.degree = name, mesh, degree
        self.comm = petsc_compat.petsc_communicator(mesh.comm)
        self.made_on = places_of(mesh)
        told = turns.that_leaves(self._felt, turns.TOLD)
        self.low_dets = float(np.cos(told)), float(np.cos(turns.NAMED))
        self.space = compat.vector_space(mesh, degree)
        self.u, self.v = motion_on(self.space, name)

    def _set_up(
        self, director_mesh: DirectorMesh, length: float, masses: FloatArray,
        bcs: Sequence[Clamp | Dirichlet], forces: Sequence[Load | Pressure], velocity: Values,
        spin: FloatArray,
    ) -> None:  # fmt: skip
        """Set up all but the mesh.

        Args:
            director_mesh: Nodes and cells.
            length: Of the directors [m].
            masses: Per length or area, of the place and of the directors, shape (vectors,).
            bcs: As of the subclass, and so are the next ones.
            forces: Loads.
            velocity: [m/s].
            spin: [rad/s].
        """
        self._director_mesh, self.length, self._masses = director_mesh, length, masses
        self._width = 3 * len(masses)
        self._set_up_nodes()
        self._conditions = NodeConditions(
            self.comm, director_mesh, self._here, bcs, self.kind, self.name
        )
        self.fixed, self.driven = self._conditions.fixed, self._conditions.driven
        self._loads = DirectorLoads(
            self.comm, director_mesh, self.elements, length, forces, self.kind, self.name
        )
        self.loads_in_time = any(map(callable, self._loads.settings))
        self._set_up_velocity(velocity, spin)
        held = self._here.start + self._conditions.free_directors
        along = np.empty_like(director_mesh.order)
        along[director_mesh.order] = np.arange(len(along))
        self.joints = (Directors(self, self.points_of(held, self._place), length, along[held]),)
        self.accept(np.zeros(self.num_owned), self.initial_velocity)

    def _set_up_nodes(self) -> None:
        """This rank's nodes and elements, and what exchanges values with other ranks."""
        topology, index_map = self.mesh.topology, self.space.dofmap.index_map
        owned = topology.index_map(topology.dim).size_local
        start = self.comm.exscan(owned) or 0
        self._cells = self._director_mesh.cells[start : start + owned]
        ghosts = np.asarray(index_map.ghosts, dtype=np.int64)
        self._values = ElementValues(
            self.comm, index_map.size_local, ghosts, self._cells, self._width
        )
        self._here, self.num_owned = self._values.here, self._values.num_owned
        here = np.arange(self._here.start, self._here.stop)
        self.reference: FloatArray = self._vectors_at(here).ravel()
        self._place = np.eye(self._width // 3)[:1]
        self.places = np.tile(self._place[0] > 0.0, len(here))

        y = self._vectors_at(self._cells.ravel())
        y = y.reshape(len(self._cells), self._values.num_vectors, 3)
        strained, shares = self._elements_of(y)
        self.elements = DirectorElements(self._values, strained, y, shares, self._masses)
        self.nodal_mass: FloatArray = self.elements.nodal_mass

    def _vectors_at(self, nodes: IntArray) -> FloatArray:
        """Nodal vectors of nodes in the reference [m], shape (n, vectors, 3)."""
        x, directors = self._director_mesh.x[nodes], self._director_mesh.directors[nodes]
        return np.concatenate([x[:, None], self.length * directors], axis=1)

    def _set_up_velocity(self, velocity: Values, spin: FloatArray) -> None:
        x, d = self._director_mesh.x[self._here], self._director_mesh.directors[self._here]
        if callable(velocity):
            speed = at_points(self.comm, f"velocity of {self.name!r}", velocity, x.T, (3,)).T
        else:
            speed = np.tile(vector("velocity", velocity, "m/s"), (len(x), 1))
        mass = self.nodal_mass[:: self._width]
        total = self.comm.allreduce(np.array([*(mass @ x), mass.sum()]))
        v = np.zeros((len(x), 1 + d.shape[1], 3))
        v[:, 0] = speed + np.cross(spin, x - total[:3] / total[3])
        v[:, 1:] = self.length * np.cross(spin, d)
        self.initial_velocity: FloatArray = v.ravel()
        self.initial_velocity[self._conditions.still] = 0.0

    def file_order(self) -> IntArray:
        """Nodal vectors of all ranks in an order that does not depend on the ranks, see `Body`."""
        k = self._width // 3
        return (k * self._director_mesh.order[:, None] + np.arange(k)).ravel()

    # ---- values of this rank's elements
    def _vectors(self, u: FloatArray) -> FloatArray:
        """Nodal vectors of this rank's elements [m], shape (n, k, 3). Collective."""
        self.check_alive()
        return self.elements.vectors(u)

    def _in_order(self) -> tuple[FloatArray, FloatArray]:
        """Places in the reference and now [m], shape (n, 3) each, in file order. Collective."""
        u = self.last_accepted()[0].reshape(-1, self._width)[:, :3]
        moved = gather_rows(self.comm, u)
        order = self._director_mesh.order
        return self._director_mesh.x[order], self._director_mesh.x[order] + moved[order]

    def resultants(self) -> dict[str, Any]:
        """Force and moment in the middles of the cells, at the last accepted state. Collective.

        Returns:
            DOLFINx Functions of degree 0, "force" and "moment", as `force_and_moment` has them.
        """
        both = self.force_and_moment(self._vectors(self.last_accepted()[0]))
        stem = self.u.name[:-2]
        return {
            what: cell_function(self.mesh, f"{stem}_{what}", values)
            for what, values in zip(("force", "moment"), both, strict=True)
        }

    def force_and_moment(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Stress resultants in this rank's cells, of nodal vectors [m], shape (n, vectors, 3)."""
        raise NotImplementedError

    # ---- points
    def points(self, x: Places) -> Points:
        """As of `Body`, of nodes alone: ValueError for a point that is none. Collective."""
        given, of = vectors("x", x, "points [m]"), self._director_mesh.x
        distance, nodes = cKDTree(of).query(given)
        off = distance > _AT_NODE * np.ptp(of, axis=0).max()
        if off.any():
            near = of[nodes[off.argmax()]].tolist()
            raise ValueError(
                f"x={given[off.argmax()].tolist()}: is no node of {self.kind} {self.name!r}; the "
                f"nearest one is {near}"
            )
        return self.points_of(nodes, self._place)

    def at_nodes(self, nodes: IntArray, x: FloatArray) -> Points:
        """As of `Body`. Collective."""
        return self.points_of(np.asarray(nodes), self._place)

    def points_of(self, nodes: IntArray, weights: FloatArray) -> Points:
        """Points of the nodes' vectors, weights of shape (n or 1, vectors). Collective."""
        n, k = len(nodes), self._width // 3
        fixed = np.zeros(self.num_owned, dtype=bool)
        fixed[self.fixed] = True
        return Points(
            self,
            k * nodes[:, None] + np.arange(k),
            np.broadcast_to(weights, (n, k)),
            self._vectors_at(nodes),
            gather_rows(self.comm, fixed.reshape(-1, k, 3))[nodes],
            np.tile(self._place > 0.0, (n, 1)),
        )

    # ---- skin
    @cached_property
    def _skin(self) -> DirectorSkin:
        """Its whole skin and surfaces of it."""
        return DirectorSkin(self, self._make_skin(), self._here)

    @property
    def has_skin(self) -> bool:
        """Whether it has one; a beam whose section has no outline has none."""
        return bool(len(self._skin.whole_skin.facets))

    def boundary(self) -> Surface:
        """The whole skin. Collective."""
        return self._skin.whole

    def boundary_now(self, u: FloatArray) -> FloatArray:
        """This rank's part of the whole skin, corners of facets [m], (m, 4, 3). Collective."""
        whole = self._skin.whole
        corners: FloatArray = whole.positions(u)[whole.facets]
        return corners[self.comm.rank :: self.comm.size]

    def motion_range(self, du: FloatArray) -> FloatArray:
        """Bounds on the motion of the skin's points on this rank, see `Body` [m]."""
        return self._skin.range_of(du.reshape(-1, self._width // 3, 3))

    def at_mesh(self, values: FloatArray) -> FloatArray:
        """Values of the places at the mesh's nodes on this rank, as of `space`."""
        return values.reshape(-1, self._width)[:, :3].ravel()

    # ---- as of Body
    def begin_step(self, rule: Integrator, moment: EvaluationPoint) -> None:
        """Set the state at t_n and the loads of the step."""
        self.check_alive()
        self.elements.begin(moment.u0, rule.taken_at)
        self._u0, self._held_at = moment.u0, rule.theta
        self._loads.begin(moment.time, moment.ramp)

    @property
    def alike(self) -> Hashable | None:
        """What those have in common that a step evaluates together; None: it does so alone."""
        if self._conditions.values or self._loads.settings:
            return None
        return self._cells.shape[1], self.length, *self._masses.tolist()

    @property
    def settings(self) -> Settings:
        """What ranks must have in common, see `Body`."""
        return {"bcs": self._conditions.values, "forces": self._loads.settings}

    def prescribed(self, time: float) -> FloatArray:
        """Displacements of the prescribed coordinates [m]. Collective."""
        return self._conditions.prescribed(time)

    def external(self, u1: FloatArray, gravity: FloatArray) -> FloatArray:
        """Loads and gravity [N]; a moment acts on directors where the step takes its forces."""
        f = self.weight(gravity).reshape(-1, self._width)
        self._loads.add_to(f, u1)
        moments = self._loads.moments
        if moments.turned.size:
            y = self.reference + self._u0 + self._held_at * (u1 - self._u0)
            f[moments.turned, 3:] += moments.push(y)
        return f.ravel()

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> PETSc.Mat:
        """Return mass M + stiffness K, the same matrix in each call. Collective."""
        if self._matrix is None:
            self._matrix = DirectorMatrix(self._values, self._loads.moments, self.fixed)
        self.check_alive()
        values = self.elements.tangent(u1, mass, stiffness)
        self._loads.subtract_slopes(values, u1, stiffness)
        slopes = stiffness * self._held_at * self._loads.moments.slopes()
        of_moments = np.repeat(slopes, self._width // 3 - 1, axis=1)
        scale = mass * self.nodal_mass if mass else stiffness * self.elements.diagonal
        places = np.repeat(self.places, 3)
        total = self.comm.allreduce(np.array([scale[places].sum(), places.sum()]))
        return self._matrix.assemble(values, of_moments, total[0] / total[1] or 1.0)

    def reactions(self, residual: FloatArray, u1: FloatArray) -> FloatArray:
        """Resultants on the places of each condition, this rank's part [N], (conditions, 3)."""
        return self._conditions.reactions(residual)

    @np.errstate(over="ignore", invalid="ignore")  # an iterate may run off
    def smallest_det(self, u: FloatArray) -> tuple[float, FloatArray]:
        """Smallest cosine of the turn between neighbouring nodes, and X of their middle [m].

        An element bends with the sine of that angle: from 90 degrees on a larger one needs a
        smaller moment, and nothing in it can tell. Collective.
        """
        y = self._vectors(u)
        if not len(y):
            return np.inf, np.full(3, np.nan)
        count = self._width // 3
        nodes = (len(y), self._cells.shape[1], count, 3)
        least, cell, pair = turns.least_cosine(y.reshape(nodes)[:, :, 1:], self._neighbours)
        return least, self.elements.rest.reshape(nodes)[cell, pair, 0].mean(axis=0)

    def describe_det(self, det: float, place: FloatArray) -> tuple[str, str]:
        """How far neighbouring nodes turn against each other, and what elements are needed."""
        what = f"{self.kind} {self.name!r}"
        text, times = turns.described(self._felt, what, det, place)
        return text, self._finer(times)

    def turn(self, u0: FloatArray, u1: FloatArray) -> float:
        """Largest turn between two displacements on this rank [rad]."""
        (directors,) = self.joints
        return directors.largest_turn(self.reference + u0, self.reference + u1)

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Make u and v the body's current state. Collective."""
        super().accept(u, v)
        for function, values in ((self.u, u), (self.v, v)):
            here = self.at_mesh(values)
            function.x.array[: len(here)] = here
            function.x.scatter_forward()
