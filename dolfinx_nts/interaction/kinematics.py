"""How constraints of a joint change in time at a state, for starts that fit them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.interaction.combination import of_multipliers
from dolfinx_nts.state import State
from dolfinx_nts.types import FloatArray, OfTime

#: A run warns of a larger turn in a step [rad]: a steady one is short by a twelfth of its cube.
FAR_TURN = 1.0
#: Part of positions and velocities by which a start may violate a constraint.
OFF = 1e-9
#: Where in a step constraints are looked at, over its length.
_PLACES = np.array([0.25, 0.5, 0.75, 1.0])
#: Values there -> coefficients of the cubic, and of the parabola of all but the last.
_FINE, _COARSE = (
    np.linalg.inv(np.vander(_PLACES[:n], increasing=True)) for n in (len(_PLACES), 3)
)
_EPS = float(np.finfo(float).eps)
#: Part of positions by which differences of them are off.
ROUNDED = 8.0 * _EPS


class Kinematics(NamedTuple):
    """Constraints g at a state; axis 0 of the elements' arrays = element.

    Attributes:
        rows: g, and its first and second derivative in time, in the units of the elements' rows,
            shape (3, n, m).
        size: Largest |g| [m] and |dg/dt| [m/s] on this rank; of several joints those of each,
            shape (2, joints).
        limit: What both may be by rounding, or as prescribed values leave it open within the step,
            likewise.
        along: Largest velocity along a constraint [m/s] on this rank, of the bodies or prescribed,
            likewise: of both it is the same however the whole scene flies or turns.
        tangent: That of the elements without forces, shape (n, r, r).
    """

    rows: FloatArray
    size: FloatArray
    limit: FloatArray
    along: FloatArray | float
    tangent: FloatArray


def differenced(
    make: OfTime, bodies: Sequence[int], state: State, dt: float
) -> Kinematics | None:
    """Kinematics of elements between points, from residuals and tangents. Collective.

    Elements of a step of length s have the constraints g of the time s. With their derivative G,
    g' = G v + dg/dt and g'' = G a + (G v)' v + 2 d(G v)/dt + d^2 g/dt^2, in which derivatives in
    time are differences within dt, and those of G along v.

    Args:
        make: Makes the elements of a step of some length [s].
        bodies: Numbers of their bodies in the system.
        state: The state; without accelerations they count as zero.
        dt: Time in which they may change [s].

    Returns:
        None: they have no constraints that hold always.

    Raises:
        TypeError: They are no elements between points, or have augmented unknowns.
    """
    batch = make(dt)
    if not has_constraints(batch):
        return None
    if batch.widths["augmented"] or not hasattr(batch, "sides"):
        raise unknown(batch)
    y, v, a = (
        np.concatenate(
            [side.nodal(values[b]) for side, b in zip(batch.sides, bodies, strict=True)], axis=1
        )
        for values in (state.u, state.v, state.a or [0.0 * v for v in state.v])
    )
    y = y + batch.reference()
    n, m = batch.num_elements, batch.widths["constraints"]
    own = {"augmented": np.empty((n, 0)), "constraints": np.zeros((n, m))}
    # At one place at several times, then at the last of them ahead and behind.
    parts = [(at, at.evaluate(y, own)) for at in (make(float(s)) for s in dt * _PLACES)]
    rows = np.array([at.rows(part, "constraints") for at, part in parts])
    speeds = np.array([_along(part, v) for _, part in parts])
    ahead, behind = (batch.evaluate(y + s * v, own) for s in (dt, -dt))
    curved = (_along(ahead, v) - _along(behind, v)) / (2.0 * dt)
    tangent = parts[-1][1].tangent.copy()
    (g, rate, bend), (flow, turn, _) = (_at_start(_FINE, f, dt) for f in (rows, speeds))
    found = np.array([
        g, flow + rate,
        _along(parts[-1][1], a) + curved + 2.0 * turn + bend,
    ])  # fmt: skip
    coarse = _at_start(_COARSE, rows, dt)
    # Only the elements know what length a row of theirs is.
    unit = 1.0
    for at, part in (*parts, (batch, ahead), (batch, behind)):
        length = float(at.largest(part)[1])
        if length > 0.0:
            joined = of_multipliers(batch, at.rows(part, "constraints"))
            unit = float(np.abs(joined).max()) / length
    doubts = 2.0 * np.array([g - coarse[0], rate - coarse[1]])
    size, doubt = (
        np.array([np.abs(of_multipliers(batch, a)).max(initial=0.0) for a in values]) / unit
        for values in (found[:2], doubts)
    )
    extent, speed = (float(np.abs(values).max(initial=0.0)) for values in (y, v))
    rounding = ROUNDED * extent * np.abs(_FINE[:2]).sum(axis=1) * np.array([1.0, 1.0 / dt])
    along = max(float(np.abs(values).max(initial=0.0)) for values in (flow, rate)) / unit
    # Springs that the same elements may have are no mass.
    tangent[:, :-m, :-m] = 0.0
    limit = OFF * np.array([extent, speed]) + doubt + rounding
    return Kinematics(found, size, limit, along, tangent)


def _along(part: Any, v: FloatArray) -> FloatArray:
    """G v: change of the constraints' rows with the nodes' motion (n, k, 3), shape (n, m)."""
    n, width = len(v), 3 * v.shape[1]
    return np.einsum(
        "nma,na->nm", part.tangent[:, width:, :width], v.reshape(n, width)
    )


def _at_start(matrix: FloatArray, values: FloatArray, dt: float) -> FloatArray:
    """Value, first and second derivative in time at t_n, (3, n, m), from values at `_PLACES`."""
    found: FloatArray = np.tensordot(matrix[:3], values[: len(matrix)], axes=1)
    return found * np.array([1.0, 1.0 / dt, 2.0 / dt**2])[:, None, None]


def has_constraints(batch: Any) -> bool:
    """Return whether a batch of elements has constraints that hold always."""
    return bool(batch.bilateral and batch.widths["constraints"])


def unknown(batch: Any) -> TypeError:
    """Return what to raise where nobody knows how constraints change in time."""
    return TypeError(
        f"joint {batch.name!r}: its elements have constraints, but nothing says how these change "
        "in time, which a start has to fit; give its coupling kinematics(state, dt), with None "
        "for what the start need not fit"
    )
