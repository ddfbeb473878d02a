"""What a System asks of a body."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from dolfinx.mesh import Mesh
from petsc4py import PETSc

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.solid.locking import Locking
from dolfinx_nts.contact.skins import boundary_of_mesh, skin_of_mesh
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.integrators import Integrator
from dolfinx_nts.interaction.evaluation import EvaluationPoint
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels.vectors import range_of
from dolfinx_nts.types import BoolArray, FloatArray, IntArray, Places, Settings


class Body:
    """A body with coordinates q = X + u and a constant mass matrix (39); what all bodies inherit.

    A body knows neither the step's length nor the name of its integrator, which is the `rule` that
    tells how forces follow from two states. A body of one's own sets the first six attributes and
    has the first seven methods. All else has a default here, which is that of a body whose
    coordinates are the places of material points, free of conditions, without a mesh.

    Attributes:
        name: Unique in a system.
        comm: MPI communicator.
        num_owned: Coordinates this rank owns; the global numbering is contiguous by rank.
        reference: X [m], shape (num_owned,).
        nodal_mass: BalanceRow sums of the mass matrix [kg], shape (num_owned,).
        fixed: Positions of the prescribed coordinates among the owned ones.
        mesh: DOLFINx mesh whose nodes move with the body; None: it has none, hence no surface, no
            fields and no pictures. With one come `u` and `v`, dolfinx Functions on it.
        space: Their function space.
        degree: Its polynomial degree; None without a mesh.
        joints: Constraints among its own coordinates, see `Joint`.
        driven: Whether prescribed coordinates follow functions of time.
        loads_in_time: Whether loads on it may change by themselves in time.
        rigid: Whether no motion changes distances in it, so that `directions` turn with it.
        oriented: Whether it has directors, and with them `length`, `directions_at` and `turn`.
        bound: Whether its own constraints are half as many as its coordinates, or about that.
        has_inner: Whether forces depend on more than its coordinates, see `inner`.
        length: What its directors are multiples of [m].
        rounded: Length [m], on all ranks, whose rounding enters forces beside u's; None: X's.
        allow_inversion: Whether steps are accepted that end with `smallest_det` <= 0.
        low_dets: `smallest_det` below which a run warns, and below which failed steps name it.
        has_massless: Whether coordinates on any rank have no mass.
        law: W as a function of Green's strain in UFL; None: it has no material.
        made_on: Places of its mesh's nodes when it was made, see `places_of`; None without a mesh.
        starts_moved: Whether the user has given it a displacement to start with.
        pieces: Number of parts of its mesh that share no node, of solid bodies. Collective.
        stressed: Stress of the undeformed body over its stiffness, once known and too large.
        locking: Whether its cells are too stiff; None: it is no solid of cells.
        losses: Columns of the balance table for energy that leaves through it, see `lost`.
        known: Arrays at owned coordinates and what all ranks know of each, shape (nodes, 3).
        destroyed: Whether `destroy` was called.
    """

    name: str
    comm: MPI.Comm
    num_owned: int
    reference: FloatArray
    nodal_mass: FloatArray
    fixed: IntArray

    mesh: Mesh = None
    space: fem.FunctionSpace = None
    degree: int | None = None
    joints: tuple[Any, ...] = ()
    driven: bool = False
    loads_in_time: bool = True
    rigid: bool = False
    oriented: bool = False
    bound: bool = False
    has_inner: bool = False
    length: float
    rounded: float | None = None
    allow_inversion: bool = False
    low_dets: tuple[float, float] = (0.05, 0.1)
    has_massless: bool = False
    law: Any = None
    made_on: Any = None
    starts_moved: bool = False
    pieces: int = 1
    stressed: float | None = None
    locking: Locking | None = None
    losses: tuple[str, ...] = ()
    known: tuple[tuple[FloatArray, FloatArray], ...] = ()
    destroyed: bool = False
    _accepted: tuple[FloatArray, FloatArray] | None = None
    _shown: tuple[FloatArray, ...] = ()
    _boundary: Surface | None = None

    def __repr__(self) -> str:
        # One of a class of the user's own may not have its name yet.
        return f"<{type(self).__name__} {getattr(self, 'name', '')!r}>"

    # ---- what each body has of its own
    def _missing(self, name: str) -> NotImplementedError:
        return NotImplementedError(
            f"{type(self).__name__} has no {name}(), which is asked for here; see nts.Body"
        )

    def begin_step(self, rule: Integrator, moment: EvaluationPoint) -> None:
        """Fix what the evaluations of a step have in common."""
        raise self._missing("begin_step")

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v."""
        raise self._missing("inertia")

    def internal(self, u1: FloatArray) -> FloatArray:
        """Internal forces between u_0 and u_1 by the rule [N]."""
        raise self._missing("internal")

    def external(self, u1: FloatArray, gravity: FloatArray) -> FloatArray:
        """External forces of the step [N]; their work is f . (u_1 - u_0). See `weight`."""
        raise self._missing("external")

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> PETSc.Mat:
        """PETSc matrix mass M + stiffness d(internal - external)/du_1.

        The same matrix in each call, with the same pattern. Rows and columns of `fixed` hold only a
        diagonal.
        """
        raise self._missing("tangent")

    def prescribed(self, time: float) -> FloatArray:
        """Displacement of the `fixed` coordinates [m]."""
        raise self._missing("prescribed")

    def potential(self, u: FloatArray) -> float:
        """Stored energy on this rank [J]."""
        raise self._missing("potential")

    # ---- what may be left as it is
    def lost(self, u1: FloatArray) -> dict[str, float]:
        """Power that leaves it where the step takes its forces, this rank's part [W], by `losses`.

        Internal forces do its work. Collective.

        Args:
            u1: Displacement at t_{n+1} [m].
        """
        return {}

    def inner_at_rest(self, u: FloatArray) -> FloatArray:
        """`inner` in equilibrium with a displacement [m]. Collective."""
        return np.empty(0)

    def inner(self, u1: FloatArray) -> FloatArray:
        """Values at t_{n+1} that the next step starts from beside u, such as vectors within cells.

        Of a body with `has_inner`: as many numbers of this rank at each time, the same number for
        each of `inner_numbers`. `begin_step` takes those of t_n. Collective.

        Args:
            u1: Displacement at t_{n+1} [m].
        """
        return np.empty(0)

    @property
    def inner_numbers(self) -> IntArray:
        """Numbers in files of the parts of `inner`, which do not depend on the ranks."""
        return np.empty(0, dtype=np.int64)

    def doubts(self, u: FloatArray) -> list[Any]:
        """What may be wrong with an accepted state, as `StepWarning`.

        Collective.

        Args:
            u: Owned displacements [m].
        """
        return []

    def take_inner(self, inner: FloatArray) -> FloatArray:
        """Take `inner` of the state that `potential` and `accept` are asked of next.

        Returns:
            What it was before.
        """
        return np.empty(0)

    @cached_property
    def initial_displacement(self) -> FloatArray:
        """Displacement u at the start [m], shape (num_owned,)."""
        return np.zeros(self.num_owned)

    @cached_property
    def initial_velocity(self) -> FloatArray:
        """Velocity v at the start [m/s], shape (num_owned,)."""
        return np.zeros(self.num_owned)

    @cached_property
    def places(self) -> BoolArray:
        """Which of this rank's nodes are places, t_a = 1, shape (num_owned / 3,).

        They move with a translation; the others are directors, which only turn (theory section 11).
        """
        return np.ones(self.num_owned // 3, dtype=bool)

    @cached_property
    def massless(self) -> BoolArray:
        """Which of the owned coordinates have no mass, shape (num_owned,)."""
        return np.zeros(self.num_owned, dtype=bool)

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Make u and v the body's current state."""
        self._accepted = u, v

    def last_accepted(self) -> tuple[FloatArray, FloatArray]:
        """Owned u [m] and v [m/s] of the last accepted state, or of the start."""
        return self._accepted or (self.initial_displacement, self.initial_velocity)

    def linear_momentum(self, momentum: FloatArray) -> FloatArray:
        """This rank's part of the sum of the places' momenta [kg m/s], shape (3,)."""
        return self.places @ momentum.reshape(-1, 3)

    def angular_momentum(self, u: FloatArray, momentum: FloatArray) -> FloatArray:
        """This rank's part of sum y_a x p_a about the origin [kg m^2/s], shape (3,)."""
        moment = (self.reference + u).reshape(-1, 3).T @ momentum.reshape(-1, 3)
        return np.array([moment[i, j] - moment[j, i] for i, j in ((1, 2), (2, 0), (0, 1))])

    def weight(self, gravity: FloatArray) -> FloatArray:
        """Forces of gravity (3,) [m/s^2], which accelerates places and no directors [N]."""
        return self.nodal_mass * (self.places[:, None] * gravity).ravel()

    def destroy(self) -> None:
        """Free the PETSc objects, for those who make many bodies; it cannot be used afterwards.

        An override must call super().destroy().
        """
        self.destroyed = True

    def check_alive(self) -> None:
        """Refuse a body that was destroyed.

        Raises:
            ValueError: It was.
        """
        if self.destroyed:
            raise ValueError(
                f"body {self.name!r} was destroyed, by body.destroy() or by that of its system; "
                "make it anew, or destroy it later"
            )

    def nodal_stiffness(self) -> FloatArray:
        """Stiffness of each node's neighbourhood at rest [N/m], shape (num_owned,).

        What the nodal mass is in dynamics, a scale, is this in statics, which alone asks for it.
        Where it is 0, as of rigid bodies, that of the other bodies counts.

        Raises:
            NotImplementedError: The body does not tell; `equilibrium` refuses it.
        """
        raise self._missing("nodal_stiffness")

    def reactions(self, residual: FloatArray, u1: FloatArray) -> FloatArray:
        """Resultant of a force [N] on the coordinates of each condition, this rank's part.

        Args:
            residual: Force of the step on all owned coordinates, shape (num_owned,).
            u1: Displacement at the end of the step, from which moments take their arms [m].

        Returns:
            Shape (conditions, 3).
        """
        return np.zeros((0, 3))

    @property
    def reaction_labels(self) -> list[tuple[str, str]]:
        """Name and unit of each row of `reactions`."""
        zero = np.zeros(self.num_owned)
        return [(str(k), "N") for k in range(len(self.reactions(zero, zero)))]

    def smallest_det(self, u: FloatArray) -> tuple[float, FloatArray]:
        """Smallest det F on this rank, inf without cells in 3D, and X of its cell [m], shape (3,).

        Of a body with directors at its nodes the smallest cosine of the turn between neighbours. A
        step that ends with one <= 0 is not accepted unless `allow_inversion` is True.
        """
        return np.inf, np.full(3, np.nan)

    def describe_det(self, det: float, place: FloatArray) -> tuple[str, str]:
        """What is so with a low `smallest_det` of all ranks, and what may prevent it."""
        x = ", ".join(f"{c:.4g}" for c in place)
        turns = "is nearly" if det > 0.0 else "turns"
        return (
            f"a cell of body {self.name!r} {turns} inside out, which W(C) cannot see: det F = "
            f"{det:.3g} near X = ({x})",
            "smaller loads or speeds may prevent it",
        )

    def turn(self, u0: FloatArray, u1: FloatArray) -> float:
        """Largest turn of its directors between two displacements on this rank [rad], if any."""
        return 0.0

    def prescribed_turn(self, start: float, end: float) -> float:
        """Turn of prescribed directors between two times [rad], any number of turns. Collective.

        What `turn` cannot tell from their places at both times.
        """
        return 0.0

    @property
    def settings(self) -> Settings:
        """Numbers and texts by the arguments that it was made of, which ranks have in common."""
        return {}

    def parameters(self) -> FloatArray:
        """Values of the material that a caller may change during a run, shape (n,)."""
        return np.empty(0)

    def take_parameters(self) -> None:
        """Take over changed `parameters` where not all that is made of them is asked for anew.

        Collective; a run calls it before its first step, and whenever `parameters` have changed.
        """

    def file_order(self) -> IntArray:
        """Numbers of the nodes, counted rank after rank, in the order of files; on rank 0.

        That order does not depend on the ranks. Collective.
        """
        return np.arange(self.comm.allreduce(self.num_owned // 3))

    # ---- points
    def points(self, x: Places) -> Points:
        """Material points, for joints and springs. Collective.

        Args:
            x: Reference positions [m], shape (3,) or (n, 3), the same on all ranks.

        Raises:
            TypeError: The body does not override this method.
        """
        raise TypeError(f"body {self.name!r} has no points(): joints and springs need it, see Body")

    def directions_at(self, direction: FloatArray, x: Places) -> Points:
        """A direction that turns with a point of an oriented body, for joints. Collective.

        Args:
            direction: At the start [-], shape (3,).
            x: Reference position of the point [m], as of `points`.
        """
        raise TypeError(f"body {self.name!r} is oriented but has no directions_at(), see Body")

    def directions(self, x: Places) -> Points:
        """Directions that turn with a rigid body as a whole, for joints and springs. Collective.

        Args:
            x: At the start [-], shape (3,) or (n, 3), the same on all ranks.
        """
        raise TypeError(f"body {self.name!r} is rigid but has no directions(), see Body")

    def motion_of_points(self, du: FloatArray) -> float:
        """Bound on the components of the motion of its material points on this rank [m].

        Args:
            du: Change of its owned coordinates [m].
        """
        return float(self.motion_range(du).max(initial=0.0))

    def motion_range(self, du: FloatArray) -> FloatArray:
        """Bounds on the motion of its material points on this rank along the axes, and against [m].

        Args:
            du: Change of its owned coordinates [m].

        Returns:
            Largest motion along x, y, z and along -x, -y, -z, shape (2, 3); -inf without points.
        """
        return range_of(du)

    def at_nodes(self, nodes: IntArray, x: FloatArray) -> Points:
        """Nodes of its mesh as its material points, for surfaces. Collective.

        Args:
            nodes: Global numbers in its `space`, sorted, shape (n,), the same on all ranks.
            x: Reference positions [m], shape (n, 3).
        """
        one = np.ones((len(nodes), 1))
        free = np.zeros((len(nodes), 1, 3), dtype=bool)
        points = Points(self, nodes[:, None], one, x[:, None], free, one.astype(bool))
        prescribed = np.zeros(self.num_owned, dtype=bool)
        prescribed[self.fixed] = True
        return replace(points, fixed=points.nodal(prescribed))

    def boundary(self) -> Surface:
        """The whole boundary of a body with a mesh, made once. Collective."""
        if self._boundary is None:
            self._boundary = Surface(self, skin_of_mesh(self, compat.exterior_facets(self.mesh)))
        return self._boundary

    def boundary_now(self, u: FloatArray) -> FloatArray:
        """This rank's part of the whole boundary, corners of facets [m], (m, nc, 3). Collective.

        Args:
            u: Owned displacements [m].
        """
        return boundary_of_mesh(self, u)

    def at_mesh(self, values: FloatArray) -> FloatArray:
        """Values at the nodes of its mesh on this rank, as of its `space`. Collective.

        Args:
            values: At its owned coordinates, shape (num_owned,).
        """
        return values


#: What an object has that is used as a body without being a `Body`.
_PROTOCOL = tuple(
    name for name in (*Body.__annotations__, *vars(Body)) if name[0] != "_" and name != "length"
)


def is_body(given: Any) -> bool:
    """Whether an object is a `Body` or has all that one has."""
    return isinstance(given, Body) or all(hasattr(given, name) for name in _PROTOCOL)
