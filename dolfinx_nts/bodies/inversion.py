"""Cells that turn inside out: det F <= 0, which an energy W(C) cannot see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import basix
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.points import of_nodes

FloatArray = npt.NDArray[np.float64]

#: Cells that are evaluated at once, few enough for their derivatives to stay in the cache.
_CELLS = 1024


class Determinants:
    """det F at the corners and quadrature points of a body's cells.

    As det(dx/dxi) / det(dX/dxi) it needs the nodes' positions alone.

    Args:
        space: Continuous Lagrange space of the displacements on a mesh of degree 1.
        degree: Its polynomial degree.
        quadrature_degree: That of the strain energy.
    """

    def __init__(self, space: Any, degree: int, quadrature_degree: int) -> None:
        name = compat.cell_name(space.mesh)
        kind = getattr(basix.CellType, name)
        points = basix.make_quadrature(kind, quadrature_degree)[0]
        constant = name == "tetrahedron" and degree == 1
        points = points[:1] if constant else np.concatenate([basix.geometry(kind), points])
        variant = basix.LagrangeVariant.gll_warped
        element = basix.create_element(basix.ElementFamily.P, kind, degree, variant)
        gradients = element.tabulate(1, points)[1:, :, :, 0]
        self._table = np.ascontiguousarray(gradients.reshape(-1, gradients.shape[2]))
        nodes = space.tabulate_dof_coordinates()
        # About a node of their own: differences of far positions would lose digits.
        self._origin = nodes[:1].sum(axis=0)
        self._reference = (nodes - self._origin).ravel()
        cells = compat.cell_dofs(space)[: space.mesh.topology.index_map(3).size_local]
        self._parts = []
        for first in range(0, len(cells), _CELLS):
            of_cell = of_nodes(cells[first : first + _CELLS].T)
            numbers = of_cell.swapaxes(1, 2).reshape(len(of_cell), -1)
            self._parts.append((numbers, 1.0 / self._det(self._reference, numbers)))

    def _det(self, x: FloatArray, numbers: npt.NDArray[Any]) -> FloatArray:
        """det(dx/dxi) [m^3], shape (points, cells)."""
        rows = (self._table @ x.take(numbers)).reshape(3, -1, 3, numbers.shape[1] // 3)
        (a, b, c), (d, e, f), (g, h, i) = rows.transpose(0, 2, 1, 3)
        # In place: as long as the work is, new arrays take longer.
        det, minor, product = e * i, f * g, f * h
        det -= product
        det *= a
        minor -= np.multiply(d, i, out=product)
        minor *= b
        det += minor
        np.multiply(d, h, out=minor)
        minor -= np.multiply(e, g, out=product)
        minor *= c
        det += minor
        return det

    @np.errstate(over="ignore", invalid="ignore")  # an iterate may run off
    def smallest(self, u: FloatArray) -> tuple[float, FloatArray]:
        """The smallest det F on this rank and the middle X of its cell [m], shape (3,).

        Args:
            u: Displacements of this rank's nodes and its ghosts [m], shape (coordinates,).

        Returns:
            A det that is not finite is -inf; without cells it is inf.
        """
        x, least, nodes = self._reference + u, np.inf, None
        for numbers, inverse in self._parts:
            det = self._det(x, numbers)
            det *= inverse
            i = int(det.argmin())  # the first NaN, if there is one
            if not det.flat[i] >= least:
                least, nodes = float(det.flat[i]), numbers[:, i % det.shape[1] :: det.shape[1]]
        if nodes is None:
            return np.inf, np.full(3, np.nan)
        middle = self._origin + self._reference[nodes].mean(axis=0)
        return least if np.isfinite(least) else -np.inf, middle


def smallest_dets(
    system: Any, u: Sequence[FloatArray], known: dict[int, tuple[FloatArray, float]] | None = None
) -> FloatArray:
    """The smallest det F of each body, inf where it has none; the same on all ranks. Collective.

    Args:
        system: Its bodies.
        u: Displacements of each body [m].
        known: Of each body's number what was found last, which holds while its array is the same
            object; brought up to date.

    Returns:
        Shape (bodies,).
    """
    local, known = np.empty(len(system.bodies)), {} if known is None else known
    for k, (body, values) in enumerate(zip(system.bodies, u, strict=True)):
        if k not in known or known[k][0] is not values:
            known[k] = values, body.smallest_det(values)[0]
        local[k] = known[k][1]
    system.comm.Allreduce(MPI.IN_PLACE, local, op=MPI.MIN)
    return local


def forbidden(system: Any, dets: FloatArray) -> FloatArray:
    """`smallest_dets` with inf at bodies that may turn inside out."""
    allowed = [body.allow_inversion for body in system.bodies]
    return np.where(allowed, np.inf, dets)


def describe(system: Any, u: Sequence[FloatArray], dets: FloatArray) -> str:
    """Return which body turns inside out most, and where; the same on all ranks. Collective.

    Args:
        system: Its bodies.
        u: Displacements of each body [m].
        dets: As of `smallest_dets` or `forbidden`.
    """
    worst = int(dets.argmin())
    body = system.bodies[worst]
    found = system.comm.allgather(body.smallest_det(u[worst]))
    det, place = min(found, key=lambda one: one[0])
    x = ", ".join(f"{c:.4g}" for c in place)
    turns = "is nearly" if det > 0.0 else "turns"
    return (
        f"a cell of body {body.name!r} {turns} inside out, which W(C) cannot see: det F = "
        f"{det:.3g} near X = ({x})"
    )
