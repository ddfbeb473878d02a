"""What a System asks of a body, and what a body knows of a step."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from dolfinx_nts.integrators import Integrator

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]


class Moment(NamedTuple):
    """Where a step evaluates the forces of a body.

    Attributes:
        u0: Displacement at t_n [m], owned coordinates.
        time: Of the loads [s].
        ramp: Part of constant loads that acts.
        rate: Change of the velocity there with u_1 [1/s]; 0 in statics.
        drift: Velocity there for u_1 = u_0 [m/s]; None: zero.
    """

    u0: FloatArray
    time: float
    ramp: float = 1.0
    rate: float = 0.0
    drift: FloatArray | None = None


def places_of(body: Any) -> BoolArray:
    """Whether each of this rank's nodes is a place, t_a = 1, or a director (theory section 11)."""
    given = getattr(body, "places", None)
    return np.ones(body.num_owned // 3, dtype=bool) if given is None else given


def motion_of_points(body: Any, du: FloatArray) -> float:
    """Bound on the components of the motion of a body's material points on this rank [m].

    It is that of the coordinates unless the body has a method of this name, of `du` alone.

    Args:
        body: The body.
        du: Change of its owned coordinates [m].
    """
    if hasattr(body, "motion_of_points"):
        return float(body.motion_of_points(du))
    return float(np.abs(du).max(initial=0.0))


class Body(Protocol):
    """What a System asks of a body with coordinates q = X + u and a constant mass matrix (39).

    A body knows neither the step's length nor the name of its integrator, which is the `rule` that
    tells how forces follow from two states.

    Attributes:
        name: Unique in a system.
        comm: MPI communicator.
        num_owned: Coordinates this rank owns; the global numbering is contiguous by rank.
        reference: X [m], shape (num_owned,).
        initial_velocity: v at the start [m/s], shape (num_owned,).
        initial_displacement: u at the start [m], shape (num_owned,); may be missing, and is 0 then.
        nodal_mass: Row sums of the mass matrix [kg], shape (num_owned,).
        fixed: Positions of the prescribed coordinates among the owned ones.
        places: Which of this rank's nodes are places that move with a translation, t_a = 1, shape
            (num_owned / 3,); the others are directors, which only turn. May be missing: all are.
        joints: Constraints among its own coordinates, see `Joint`; may be missing.
        file_order: Callable without arguments, collective: on rank 0, which of the nodes of all
            ranks, rank after rank, comes first in files, which second: an order that does not
            depend on the ranks. May be missing: rank after rank.
        driven: Whether prescribed coordinates follow functions of time; may be missing: no.
        turn: Callable (u0, u1): largest turn of its directors between two displacements [rad], on
            this rank, of which a run warns if it is far in a step. May be missing.
        rounded: Length [m], the same on all ranks, whose rounding the forces hold beside that of u;
            may be missing, and is that of the positions then.
    """

    name: str
    comm: Any
    num_owned: int
    reference: FloatArray
    initial_velocity: FloatArray
    nodal_mass: FloatArray
    fixed: IntArray

    def begin_step(self, rule: Integrator, moment: Moment) -> None:
        """Fix what the evaluations of a step have in common."""

    def inertia(self, v: FloatArray) -> FloatArray:
        """M v."""

    def internal(self, u1: FloatArray) -> FloatArray:
        """Internal forces between u_0 and u_1 by the rule [N]."""

    def external(self, u1: FloatArray, gravity: FloatArray) -> FloatArray:
        """External forces of the step [N]; their work is f . (u_1 - u_0)."""

    def tangent(self, u1: FloatArray, mass: float, stiffness: float) -> Any:
        """PETSc matrix mass M + stiffness d(internal - external)/du_1.

        The same matrix in each call, with the same pattern. Rows and columns of `fixed` hold only a
        diagonal.
        """

    def nodal_stiffness(self, rule: Integrator) -> FloatArray:
        """Stiffness of each node's neighbourhood at rest [N/m], shape (num_owned,).

        What the nodal mass is in dynamics, a scale, is this in statics, which alone asks for it.
        Where it is 0, as of rigid bodies, that of the other bodies counts.
        """

    def prescribed(self, time: float) -> FloatArray:
        """Displacement of the `fixed` coordinates [m]."""

    def reactions(self, residual: FloatArray) -> FloatArray:
        """Resultant of a force [N] on the coordinates of each condition, this rank's part.

        Args:
            residual: Force on all owned coordinates, shape (num_owned,).

        Returns:
            Shape (conditions, 3).
        """

    def potential(self, u: FloatArray) -> float:
        """Stored energy on this rank [J]."""

    def smallest_det(self, u: FloatArray) -> tuple[float, FloatArray]:
        """Smallest det F on this rank, inf without cells in 3D, and X of its cell [m], shape (3,).

        A body may leave it out; else a step that ends with det F <= 0 is not accepted unless the
        body's `allow_inversion` is True.
        """

    def angular_momentum(self, u: FloatArray, momentum: FloatArray) -> FloatArray:
        """This rank's part of sum x cross p about the origin [kg m^2/s], shape (3,)."""

    def linear_momentum(self, momentum: FloatArray) -> FloatArray:
        """This rank's part of the linear momentum [kg m/s], shape (3,)."""

    def accept(self, u: FloatArray, v: FloatArray) -> None:
        """Make u and v the body's current state."""
