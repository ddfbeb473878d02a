"""The kernels of `contact_law.c`: the laws of contact and friction, and what is around them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.kernels import library
from dolfinx_nts.types import BoolArray, FloatArray


class Law(NamedTuple):
    """Laws of contact and friction of the pairs in a step, see `ContactLaw`.

    Attributes:
        scale: As of `ContactLaw`, shape (n,).
        yielding: The part of it that slave and foot move against each other, shape (n,).
        none: Contact force that counts as none [kg m], shape (n,).
        before: As of `ContactLaw`.
        size: Unknowns of a pair.
        row: That of its gap.
        friction: Whether there is any.
        endless: Whether it has no bound.
        strong: Whether it may hold a node that free motion lets go.
        redundant: As of `ContactPair`.
        coefficient: Of friction [-].
        pull: Pull over friction up to which a node that sticks is not let go.
        uneven: Largest ratio of normal forces by which friction is divided.
        opening: Part of `yielding` by which a gap that is open counts against a force.
        hardly: Stiffness against sliding of pairs that hardly rub, over `yielding`; 0: they do as
            Coulomb's law says.
        width: As of `ContactLaw`.
        gap_width: As of `ContactLaw`.
        tangential_scale: Algorithmic scale of the return map, shape (n,).
        unmoved: Projector on what of lambda_T acts on prescribed coordinates only, shape
            (n, 2, 2); None: nothing is prescribed.
        coefficients: Of friction, of each pair in place of `coefficient`, shape (n,); or None.
        by_slip: Their derivatives by the distance of the slip [1/m].
        by_force: By the force that presses [1/(kg m)].
    """

    scale: FloatArray
    yielding: FloatArray
    none: FloatArray
    before: FloatArray | None
    size: int
    row: int
    friction: bool = False
    endless: bool = False
    strong: bool = False
    redundant: bool = False
    coefficient: float = 0.0
    pull: float = 0.0
    uneven: float = 1.0
    opening: float = 1.0
    hardly: float = 0.0
    width: float = 0.0
    gap_width: float = 0.0
    tangential_scale: FloatArray | None = None
    unmoved: FloatArray | None = None
    coefficients: FloatArray | None = None
    by_slip: FloatArray | None = None
    by_force: FloatArray | None = None

    def structure(self) -> tuple[Any, list[Any]]:
        """What the kernel takes, and the arrays that it points to."""
        held = [library.plain(value) for value in self]
        return library.Law(*map(library.pointer, held)), held


class Obeyed(NamedTuple):
    """Step equations of pairs with the laws in them, and what follows; see `Contribution`.

    All rows and columns of constraints are [kg m] for unknowns in [m].
    """

    residual: FloatArray
    tangent: FloatArray
    end: FloatArray
    active: BoolArray
    stick: BoolArray
    distance: FloatArray
    force: FloatArray
    tangential: FloatArray


def laws(
    law: tuple[Any, list[Any]],
    together: tuple[FloatArray | float, FloatArray | float, FloatArray | float],
    residual: FloatArray,
    tangent: FloatArray,
    gap: FloatArray,
    slip: tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None,
    multiplier: FloatArray,
    held: FloatArray | None,
    normal: FloatArray | None,
    let_go: BoolArray | None,
) -> Obeyed:
    """Write the laws of contact and friction into the rows of pairs.

    Args:
        law: `Law.structure` of the pairs.
        together: As of `Together`.
        residual: Of the element, shape (n, r); may be overwritten.
        tangent: Shape (n, r, r); may be overwritten.
        gap: g_N at t_{n+1} [m], shape (n,).
        slip: As of `Slip`; None without friction.
        multiplier: h^2/2 lambda of the constraints [kg m], shape (n, constraints).
        held: Part of `Law.unmoved` where nothing is said of lambda_T, shape (n, 2, 2), or None.
        normal: Where the contact force acts, shape (n, 3), or None without friction.
        let_go: As of `Measured`.

    Returns:
        The rows, and what follows.
    """
    n = len(residual)
    out = Obeyed(
        np.ascontiguousarray(residual), np.ascontiguousarray(tangent), np.empty(multiplier.shape),
        np.empty(n, dtype=bool), np.empty(n, dtype=bool), np.empty(n), np.empty((n, 3)),
        np.zeros((n, 3)),
    )  # fmt: skip
    of_each = np.empty((n, 3))
    for k, value in enumerate(together):
        of_each[:, k] = value
    both = slip or (None,) * 4
    given = gap, *both, multiplier, held, normal, let_go
    library.run(library.load().laws, law[0], of_each, n, *given, *out)
    return out


def obstacle(
    theta: float,
    rule: tuple[FloatArray, FloatArray],
    end: tuple[FloatArray, FloatArray],
    middle: tuple[FloatArray, FloatArray],
    normal0: FloatArray,
    tangents: FloatArray,
    motion: FloatArray,
    multiplier: FloatArray,
) -> Any:
    """The element of slaves and an obstacle.

    Args:
        theta: Where between t_n and t_{n+1} friction acts.
        rule: Gradient of the gap that the contact force has and its derivative by the slave at
            t_{n+1}, shapes (n, 3) and (n, 3, 3).
        end: Gap at t_{n+1} [m], shape (n,), and its gradient, shape (n, 3).
        middle: Gradient and curvature of the gap where friction acts, (n, 3) and (n, 3, 3).
        normal0: Normal at t_n, shape (n, 3).
        tangents: Directions along the surface at t_n, shape (n, 2, 3).
        motion: Of the slaves in the step [m], shape (n, 3).
        multiplier: lambda_N, or lambda_N and lambda_T, [kg m], shape (n, 1) or (n, 3).

    Returns:
        Residual (n, r) and tangent (n, r, r), and value, gradient, metric and its gradient of the
        slip as of `Slip`, of no use without friction.
    """
    n, constraints = multiplier.shape
    size = 3 + constraints
    shapes = (size,), (size, size), (2,), (2, size), (2, 2), (2, 2, size)
    out = [np.zeros((n, *shape)) for shape in shapes[: 2 if constraints == 1 else 6]]
    slip: list[Any] = out[2:] or [None] * 4
    vectors, matrices = (n, 3), (n, 3, 3)
    given = zip(
        (*rule, *end, *middle), (vectors, matrices, (n,), vectors, vectors, matrices), strict=True
    )
    # An obstacle of a user's may have numbers of any kind, and arrays of a wrong shape.
    read = [np.ascontiguousarray(_shaped(a, shape), dtype=float) for a, shape in given]
    pairs = normal0, tangents, motion, multiplier
    library.run(library.load().obstacle, constraints, theta, n, *read, *pairs, *out[:2], *slip)
    return out


def _shaped(a: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    return a if a.shape == shape else np.broadcast_to(a, shape)


def to_nodes(
    weights: FloatArray, residual: FloatArray, tangent: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residual and tangent by points as those by the nodes that these are made of.

    Args:
        weights: Of the nodes in the points, shape (n, points, nodes).
        residual: Rows of the points first, shape (n, 3 points + rest).
        tangent: Its derivative.

    Returns:
        Rows of the nodes first, shape (n, 3 nodes + rest), and the derivative.
    """
    n, points, nodes = weights.shape
    rest = residual.shape[1] - 3 * points
    width = 3 * nodes + rest
    out = np.empty((n, width)), np.empty((n, width, width))
    given = weights, residual, tangent, np.empty((residual.shape[1], width))
    library.run(library.load().to_nodes, points, nodes, rest, n, *given, *out)
    return out


def wrenches(
    y: FloatArray, push: FloatArray, places: BoolArray, fixed: BoolArray
) -> FloatArray:
    """Force and moment about the middle of their places of forces on nodes, shape (n, 6).

    Args:
        y: The nodes [m], shape (n, k, 3).
        push: Forces on them, shape (n, k, 3).
        places: Whether they are places, shape (n, k).
        fixed: Where forces do not count, shape (n, k, 3).
    """
    n, nodes, _ = y.shape
    out = np.empty((n, 6))
    library.run(library.load().wrenches, nodes, n, y, push, places, fixed, out)
    return out
