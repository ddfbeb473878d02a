"""What beams and shells share: nodes of a place and directors, an energy quadratic in strains."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.mesh import Mesh
from petsc4py import PETSc
from scipy.optimize import brentq
from scipy.spatial import cKDTree

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.conditions import Dirichlet
from dolfinx_nts.bodies.directors import Directors
from dolfinx_nts.bodies.meshes.mesh_check import places_of
from dolfinx_nts.bodies.slender.director_mesh import DirectorMesh, Hull
from dolfinx_nts.bodies.slender.node_conditions import Clamp, Load, NodeConditions
from dolfinx_nts.bodies.slender.pressure import Pressure, Pressures
from dolfinx_nts.contact.skins import Skin, in_order
from dolfinx_nts.contact.surfaces import Surface, Touching
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels import quadratic as kernel
from dolfinx_nts.kernels.vectors import range_of
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.types import BoolArray, FloatArray, IntArray, Marker, Settings, Values
from dolfinx_nts.validation import at_points, vector, vectors

#: Turn between neighbouring nodes [rad] from which on failed steps name it.
_NAMED = np.pi / 6.0
#: Moment of a bent element over the right one below which a run warns, that of a beam of two nodes
#: at 15 degrees, and what the elements have that a message asks for. Rounding must not tell an axis
#: that turns by just this.
_TOLD, _RESOLVED = 3.0 / np.pi - 1e-9, 0.97
#: Part of a body's size within which a point is a node.
_AT_NODE = 1e-9


class DirectorBody(Body):
    """A body whose nodes have a place phi and directors D_i = l d_i, held by constraints.

    A subclass says what its nodes, elements and masses are; see `_set_up`.

    Attributes:
        u: Displacement of the places [m], dolfinx Function of the last accepted state.
        v: Velocity of the places [m/s], dolfinx Function.
        space: Their function space.
    """

    oriented = True
    kind: ClassVar[str]

    # ---- what each kind has of its own
    def _elements_of(self, y: FloatArray) -> tuple[kernel.Elements, FloatArray]:
        """This rank's elements from their reference.

        Args:
            y: Nodal vectors [m], shape (n, k, 3).

        Returns:
            The elements, and int N_a N_b of their nodes [m or m^2], shape (n, nodes, nodes).
        """
        raise NotImplementedError

    def _make_hull(self) -> Hull:
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
        """Turn that the strains of an element feel, and its slope.

        Args:
            turn: Between neighbouring nodes [rad].
        """
        raise NotImplementedError

    # ---- set-up
    def _set_up_mesh(self, mesh: Mesh, name: str, degree: int = 1) -> None:
        """What fields live on."""
        self.name, self.mesh, self.degree = name, mesh, degree
        self.comm = petsc_compat.petsc_communicator(mesh.comm)
        self.made_on = places_of(mesh)
        self.low_dets = float(np.cos(self._turn_that_leaves(_TOLD))), float(np.cos(_NAMED))
        self.space = compat.vector_space(mesh, degree)
        stem = re.sub(r"\W", "_", name, flags=re.ASCII)
        self.u, self.v = (fem.Function(self.space, name=f"{stem}_{s}") for s in "uv")

    def _set_up(
        self,
        skeleton: DirectorMesh,
        length: float,
        masses: FloatArray,
        bcs: Sequence[Clamp | Dirichlet],
        forces: Sequence[Load | Pressure],
        velocity: Values,
        spin: FloatArray,
    ) -> None:
        """Set up all but the mesh.

        Args:
            skeleton: Nodes and cells.
            length: Of the directors [m].
            masses: Per length or area, of the place and of the directors, shape (vectors,).
            bcs: As of the subclass, and so are the next ones.
            forces: Loads.
            velocity: [m/s].
            spin: [rad/s].
        """
        self._skeleton, self.length, self._masses = skeleton, length, masses
        self._width = 3 * len(masses)
        self._set_up_nodes()
        self._set_up_elements()
        self._conditions = NodeConditions(
            self.comm, skeleton, self._here, bcs, forces, self.kind, self.name
        )
        self.fixed, self.driven = self._conditions.fixed, self._conditions.driven
        self.loads_in_time = self._conditions.loads_in_time
        self._pressures = Pressures(
            self.comm, skeleton, self._cells, self._conditions.pressures, self.name
        )
        self._set_up_velocity(velocity, spin)
        held = self._first + self._conditions.free_directors
        along = np.empty_like(skeleton.order)
        along[skeleton.order] = np.arange(len(along))
        self.joints = (Directors(self, self._points(held, self._place), length, along[held]),)
        self._matrix: Any = None
        self.accept(np.zeros(self.num_owned), self.initial_velocity)

    def _set_up_nodes(self) -> None:
        """Reference of this rank's nodes, and what exchanges values with other ranks."""
        index_map = self.space.dofmap.index_map
        self._first, stop = index_map.local_range
        self._here = slice(self._first, stop)
        self.num_owned = self._width * index_map.size_local
        self.reference: FloatArray = self._vectors_at(np.arange(self._first, stop)).ravel()
        self._place = np.eye(self._width // 3)[:1]
        self.places = np.tile(self._place[0] > 0.0, index_map.size_local)
        ghosts = np.asarray(index_map.ghosts, dtype=PETSc.IntType)
        self._shared = PETSc.Vec().createGhost(
            ghosts, (self.num_owned, None), bsize=self._width, comm=self.comm
        )
        self._numbers = np.concatenate([np.arange(self._first, stop), ghosts])

    def _vectors_at(self, nodes: IntArray) -> FloatArray:
        """Nodal vectors of nodes in the reference [m], shape (n, vectors, 3)."""
        x, directors = self._skeleton.x[nodes], self._skeleton.directors[nodes]
        found: FloatArray = np.concatenate([x[:, None], self.length * directors], axis=1)
        return found

    def _set_up_elements(self) -> None:
        """This rank's cells, with their nodes as the skeleton orders them."""
        owned = self.mesh.topology.index_map(self.mesh.topology.dim).size_local
        start = self.comm.exscan(owned) or 0
        self._cells = self._skeleton.cells[start : start + owned]
        order = np.argsort(self._numbers)
        self._nodes = order[np.searchsorted(self._numbers[order], self._cells)]
        corners = self._cells.shape[1]
        y = self._vectors_at(self._cells.ravel()).reshape(owned, self._corners, 3)
        self._elements, self._shares = self._elements_of(y)
        self._rest = y
        sums = self._shares.sum(axis=2)[:, :, None, None] * self._masses[:, None]
        of_nodes = np.broadcast_to(sums, (owned, corners, len(self._masses), 3))
        self.nodal_mass: FloatArray = self._gather(of_nodes)

    def _set_up_velocity(self, velocity: Values, spin: FloatArray) -> None:
        x, d = self._skeleton.x[self._here], self._skeleton.directors[self._here]
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
        order: IntArray = (k * self._skeleton.order[:, None] + np.arange(k)).ravel()
        return order

    # ---- values of this rank's elements
    def _scatter(self, owned: FloatArray) -> FloatArray:
        """Values at the nodes of this rank's elements, shape (n, k, 3). Collective."""
        self.check_alive()
        self._shared.array_w[:] = owned
        self._shared.ghostUpdate(PETSc.InsertMode.INSERT, PETSc.ScatterMode.FORWARD)
        with self._shared.localForm() as local:
            values = local.array_r.reshape(-1, self._width)[self._nodes]
        found: FloatArray = values.reshape(len(self._nodes), self._corners, 3)
        return found

    @property
    def _corners(self) -> int:
        """Nodal vectors of an element."""
        return self._nodes.shape[1] * self._width // 3

    @cached_property
    def _rows(self) -> IntArray:
        """Number on this rank of each coordinate, element after element."""
        rows: IntArray = (self._width * self._nodes[:, :, None] + np.arange(self._width)).ravel()
        return rows

    def _gather(self, values: FloatArray) -> FloatArray:
        """Sums at this rank's coordinates of what elements contribute, (n, 3 k). Collective."""
        with self._shared.localForm() as local:
            size = local.getLocalSize()
            local.array_w[:] = np.bincount(self._rows, values.ravel(), minlength=size)
        self._shared.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        owned: FloatArray = self._shared.array_r.copy()
        return owned

    def _vectors(self, u: FloatArray) -> FloatArray:
        """Nodal vectors of this rank's elements [m], shape (n, k, 3). Collective."""
        return self._rest + self._scatter(u)

    def _in_order(self) -> tuple[FloatArray, FloatArray]:
        """Places in the reference and now [m], shape (n, 3) each, in file order. Collective."""
        u = self.last_accepted()[0].reshape(-1, self._width)[:, :3]
        moved = gather_rows(self.comm, u)
        order = self._skeleton.order
        return self._skeleton.x[order], self._skeleton.x[order] + moved[order]

    def resultants(self) -> dict[str, Any]:
        """Force and moment in the middles of the cells, at the last accepted state. Collective.

        Returns:
            DOLFINx Functions of degree 0, "force" and "moment", as `force_and_moment` has them.
        """
        both = self.force_and_moment(self._vectors(self.last_accepted()[0]))
        stem = self.u.name[:-2]
        return {
            what: self._cell_function(f"{stem}_{what}", values)
            for what, values in zip(("force", "moment"), both, strict=True)
        }

    def force_and_moment(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Stress resultants in this rank's cells.

        Args:
            y: Nodal vectors of the cells [m], shape (n, vectors, 3).
        """
        raise NotImplementedError

    def _cell_function(self, name: str, values: FloatArray) -> Any:
        """DOLFINx Function of degree 0 from values (n, 3) or (n, 3, 3) in this rank's cells."""
        make = compat.cell_vector_space if values.ndim == 2 else compat.tensor_space
        function = fem.Function(make(self.mesh, "DG", 0), name=name)
        of_cells = compat.cell_dofs(function.function_space)[: len(values), 0]
        rows = values.reshape(len(values), 3 ** (values.ndim - 1))
        function.x.array.reshape(-1, rows.shape[1])[of_cells] = rows
        function.x.scatter_forward()
        return function

    # ---- points
    def points(self, x: Any) -> Points:
        """Nodes as material points, for joints and springs. Collective.

        Args:
            x: Reference positions of nodes [m], shape (3,) or (n, 3), the same on all ranks.

        Raises:
            ValueError: x is no array of points, or one of them is no node.
        """
        given, of = vectors("x", x, "points [m]"), self._skeleton.x
        distance, nodes = cKDTree(of).query(given)
        off = distance > _AT_NODE * np.ptp(of, axis=0).max()
        if off.any():
            near = of[nodes[off.argmax()]].tolist()
            raise ValueError(
                f"x={given[off.argmax()].tolist()}: is no node of {self.kind} {self.name!r}; the "
                f"nearest one is {near}"
            )
        return self._points(nodes, self._place)

    def at_nodes(self, nodes: IntArray, x: FloatArray) -> Points:
        """Nodes of the mesh as material points. Collective.

        Args:
            nodes: Global numbers in `space`, shape (n,), the same on all ranks.
            x: Their reference positions [m], shape (n, 3).
        """
        return self._points(np.asarray(nodes), self._place)

    def _points(self, nodes: IntArray, weights: FloatArray) -> Points:
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
    def _hull(self) -> Hull:
        return self._make_hull()

    @cached_property
    def _touching(self) -> Touching:
        return Touching(self._hull.node)

    def _surface(self, chosen: BoolArray, smoothing: bool = False) -> Surface:
        """Some of the facets of the skin, chosen by a mask. Collective."""
        hull = self._hull
        used, inverse = np.unique(hull.facets[chosen], return_inverse=True)
        facets, original = inverse.reshape(-1, 4), hull.original[used]
        roll, order = in_order(original[facets])
        facets = np.take_along_axis(facets, roll, axis=1)[order]
        node, columns = hull.node[used], np.flatnonzero(hull.weights.any(axis=0))
        points = self._points(node, hull.weights[used]).columns(columns)
        rows = node[(node >= self._here.start) & (node < self._here.stop)] - self._first
        skin = Skin(used, facets, original, points.combine(points.reference), rows, points)
        return Surface(self, skin, smoothing, self._touching)

    def _marked(self, marker: Marker, facets: BoolArray, x: FloatArray) -> BoolArray:
        """Which of some facets of the skin a user's marker selects, shape (m,). Collective.

        Args:
            marker: Function x (3, n) -> bool (n,), or None.
            facets: Mask of the facets to choose from.
            x: What it is asked for, of each point of the skin [m], shape (p, 3).
        """
        if marker is None:
            return facets
        what = f"marker of a surface of {self.name!r}"
        if not callable(marker):
            raise TypeError(f"{what}={marker!r}: pass a function of x with shape (3, n)")
        chosen = at_points(self.comm, what, marker, x.T, (), "b")
        found: BoolArray = facets & chosen[self._hull.facets].all(axis=1)
        if not found.any():
            raise ValueError(f"{what}={marker!r}: selects no facet; check its tolerance")
        return found

    @cached_property
    def _whole(self) -> Surface:
        """The whole skin. Collective."""
        return self._surface(np.ones(len(self._hull.facets), dtype=bool))

    @property
    def has_skin(self) -> bool:
        """Whether it has one; a beam whose section has no outline has none."""
        return bool(len(self._hull.facets))

    def boundary(self) -> Surface:
        """The whole skin. Collective."""
        return self._whole

    def boundary_now(self, u: FloatArray) -> FloatArray:
        """This rank's part of the whole skin, corners of facets [m], (m, 4, 3). Collective."""
        corners: FloatArray = self._whole.positions(u)[self._whole.facets]
        return corners[self.comm.rank :: self.comm.size]

    def motion_range(self, du: FloatArray) -> FloatArray:
        """Bounds on the motion of the skin's points on this rank, see `Body` [m]."""
        reach = np.abs(self._hull.weights).max(axis=0)
        moved = du.reshape(-1, len(reach), 3)
        turned = np.einsum("k,nki->ni", reach[1:], np.abs(moved[:, 1:]))
        return range_of(moved[:, 0], turned)

    def at_mesh(self, values: FloatArray) -> FloatArray:
        """Values of the places at the mesh's nodes on this rank, as of `space`."""
        return values.reshape(-1, self._width)[:, :3].ravel()

    # ---- as of Body
    def begin_step(self, rule: Integrator, moment: EvaluationPoint) -> None:
        """Set the state at t_n and the loads of the step."""
        self._u0, self._y0 = moment.u0, self._vectors(moment.u0)
        self._theta, self._held_at = rule.taken_at, rule.theta
        self._load, self._couple = self._conditions.loads(moment.time, moment.ramp)
        self._pressures.begin(moment.time, moment.ramp)

    @property
    def settings(self) -> Settings:
        """What ranks must have in common, see `Body`."""
        return self._conditions.settings

    def prescribed(self, time: float) -> FloatArray:
        """Displacements of the prescribed coordinates [m]. Collective."""
        return self._conditions.prescribed(time)

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v [kg m/s for a velocity]. Collective."""
        n, nodes = self._nodes.shape
        at = self._scatter(v).reshape(n, nodes, self._width)
        mass = np.repeat(self._masses, 3)
        return self._gather(np.matmul(self._shares, at) * mass)

    def internal(self, u1: FloatArray) -> FloatArray:
        """Internal forces of the step [N]. Collective."""
        y1 = self._vectors(u1)
        return self._gather(kernel.force(self._elements, self._y0, y1, self._theta))

    def external(self, u1: FloatArray, gravity: FloatArray) -> FloatArray:
        """Loads and gravity [N]; a moment acts on directors where the step takes its forces."""
        f = self.weight(gravity).reshape(-1, self._width)
        f[:, :3] += self._load
        turned = self._conditions.turned
        if turned.size:
            y = self.reference + self._u0 + self._held_at * (u1 - self._u0)
            pushed = np.matmul(self._of_turned(y), -self._turning)
            f[turned, 3:] += pushed.reshape(len(turned), self._width - 3)
        if self._pressures:
            on_cells = np.zeros((len(self._nodes), self._corners, 3))
            x0, x1 = self._y0[:, ::2], self._vectors(u1)[:, ::2]
            on_cells[:, ::2] = self._pressures.forces(x0, x1, self._theta)
            f += self._gather(on_cells).reshape(f.shape)
        return f.ravel()

    def _of_turned(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values at directors that moments turn, (n, directors, 3), from those of this rank."""
        turned, width = self._conditions.turned, self._width
        rows = values.reshape(-1, width)[turned, 3:]
        return rows.reshape(len(turned), width // 3 - 1, 3)

    @property
    def _turning(self) -> FloatArray:
        """Matrices whose product with a director is the moment's force on it [N/m], (n, 3, 3).

        The force tau x D_i / l^2 does the work of tau in turns about what is across d_i; of three
        directors each turn is across two.
        """
        tau = self._couple / (self.length**2 * (2.0 if self._width > 6 else 1.0))
        x, y, z = tau.T
        none = np.zeros(len(tau))
        return np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1).reshape(-1, 3, 3)

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> PETSc.Mat:
        """Return mass M + stiffness K, the same matrix in each call. Collective."""
        if self._matrix is None:
            self._set_up_matrix()
        n, size = len(self._nodes), 3 * self._corners
        values = np.zeros((n, size, size))
        if stiffness:
            y1 = self._vectors(u1)
            values += stiffness * kernel.tangent(self._elements, self._y0, y1, self._theta)
            if self._pressures:
                pushed = self._pressures.tangent(self._y0[:, ::2], y1[:, ::2], self._theta)
                of_places = values.reshape(n, self._corners, 3, self._corners, 3)
                of_places[:, ::2, :, ::2] -= stiffness * pushed
        if mass:
            inertia = mass * np.einsum("nab,k->nakb", self._shares, self._masses)
            k = self._width // 3
            whole = np.zeros((n, self._nodes.shape[1], k, self._nodes.shape[1], k))
            whole[:, :, range(k), :, range(k)] = inertia.transpose(2, 0, 1, 3)
            for i in range(3):
                values[:, i::3, i::3] += whole.reshape(n, size // 3, size // 3)
        values[self._held[:, :, None] | self._held[:, None]] = 0.0
        of_moments = np.zeros(self._held_directors.shape)
        if stiffness:
            of_moments -= stiffness * self._held_at * self._turning[:, None]
        of_moments[self._held_directors] = 0.0
        diagonal = np.zeros(self.num_owned)
        scale = mass * self.nodal_mass if mass else stiffness * self._diagonal
        places = np.repeat(self.places, 3)
        total = self.comm.allreduce(np.array([scale[places].sum(), places.sum()]))
        diagonal[self.fixed] = total[0] / total[1] or 1.0
        petsc_compat.set_values_coo(
            self._matrix, np.concatenate([values.ravel(), of_moments.ravel(), diagonal])
        )
        return self._matrix

    def _set_up_matrix(self) -> None:
        """Triplets of the elements, of moments' directors, of the diagonal."""
        width, size = self._width, 3 * self._corners
        fixed = np.zeros(self.num_owned)
        fixed[self.fixed] = 1.0
        self._held = self._scatter(fixed).reshape(-1, size) > 0.5
        numbers = (width * self._cells[:, :, None] + np.arange(width)).reshape(-1, size)
        own = width * self._first + np.arange(self.num_owned)
        directors, held = (self._of_turned(a) for a in (own, fixed > 0.5))
        self._held_directors = held[..., :, None] | held[..., None, :]
        rows, cols = zip(
            *(np.broadcast_arrays(a[..., :, None], a[..., None, :]) for a in (numbers, directors)),
            strict=True,
        )
        self._matrix = petsc_compat.coo_matrix(
            self.comm, self.num_owned,
            *(np.concatenate([*(a.ravel() for a in both), own]) for both in (rows, cols)),
        )  # fmt: skip

    @cached_property
    def _diagonal(self) -> FloatArray:
        """Return the diagonal of the stiffness in the reference [N/m]. Collective."""
        k = kernel.tangent(self._elements, self._rest, self._rest, 1.0)
        return self._gather(np.einsum("nii->ni", k))

    def nodal_stiffness(self) -> FloatArray:
        """Mean diagonal of the tangent at each node in the reference [N/m]. Collective."""
        mean = self._diagonal.reshape(-1, 3).mean(axis=1)
        return np.repeat(mean, 3)

    def potential(self, u: FloatArray) -> float:
        """Strain energy on this rank [J]. Collective."""
        return float(kernel.energy(self._elements, self._vectors(u)).sum())

    def reactions(self, residual: FloatArray, u1: FloatArray) -> FloatArray:
        """Resultants on the places of each condition, this rank's part [N], (conditions, 3)."""
        return self._conditions.reactions(residual)

    @np.errstate(over="ignore", invalid="ignore")  # an iterate may run off
    def smallest_det(self, u: FloatArray) -> tuple[float, FloatArray]:
        """Smallest cosine of the turn between neighbouring nodes, and X of their middle [m].

        An element bends with the sine of that angle: from 90 degrees on a larger one needs a
        smaller moment, and nothing in it can tell. Collective.
        """
        y, pairs = self._vectors(u), self._neighbours
        if not len(y):
            return np.inf, np.full(3, np.nan)
        nodes = self._nodes.shape[1]
        directors = y.reshape(len(y), nodes, self._width // 3, 3)[:, :, 1:]
        directors = directors.reshape(len(y), nodes, self._width - 3)
        size = np.linalg.norm(directors, axis=2)
        a, b = pairs.T
        cosine = np.einsum("npk,npk->np", directors[:, a], directors[:, b])
        cosine /= size[:, a] * size[:, b]
        i = int(cosine.argmin())  # the first NaN, if there is one
        least = float(cosine.flat[i])
        if self._width > 6:
            # Products of three directors are 1 + 2 cos of their turn, in terms of one.
            least = 1.5 * least - 0.5
        cell, pair = divmod(i, len(pairs))
        places = self._rest[cell, :: self._width // 3][pairs[pair]]
        return least if np.isfinite(least) else -np.inf, places.mean(axis=0)

    def describe_det(self, det: float, place: FloatArray) -> tuple[str, str]:
        """How far neighbouring nodes turn against each other, and what elements are needed."""
        turn = float(np.arccos(np.clip(det, -1.0, 1.0)))
        bent = min(turn, 0.5 * np.pi)
        straight, arc = (100.0 * (1.0 - part) for part in self._moments(bent))
        x = ", ".join(f"{c:.4g}" for c in place)
        text = (
            f"{self.kind} {self.name!r} turns by {np.degrees(turn):.3g} degrees between "
            f"neighbouring nodes near X = ({x}): too easy to bend by {straight:.0f} % if it was "
            f"straight, by {arc:.0f} % if it was an arc like this"
        )
        return text, self._finer(bent / self._turn_that_leaves(_RESOLVED))

    def _moments(self, turn: float) -> tuple[float, float]:
        """Moment of an element over the right one, bent by so much, and a little on from there."""
        felt, slope = self._felt(turn)
        return felt * slope / turn, slope**2

    def _turn_that_leaves(self, part: float) -> float:
        """Turn between neighbouring nodes that leaves this part of a straight one's moment."""
        found = brentq(lambda turn: self._moments(turn)[0] - part, 1e-3, 0.5 * np.pi)
        return float(found)

    def turn(self, u0: FloatArray, u1: FloatArray) -> float:
        """Largest turn between two displacements on this rank [rad]."""
        (directors,) = self.joints
        turned: float = directors.largest_turn(self.reference + u0, self.reference + u1)
        return turned

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Make u and v the body's current state. Collective."""
        super().accept(u, v)
        for function, values in ((self.u, u), (self.v, v)):
            here = self.at_mesh(values)
            function.x.array[: len(here)] = here
            function.x.scatter_forward()

    def destroy(self) -> None:
        """Free the PETSc objects; the body is of no use then."""
        super().destroy()
        for a in (self._shared, self._matrix):
            if a is not None:
                a.destroy()
