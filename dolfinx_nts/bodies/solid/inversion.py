"""Cells that turn inside out: det F <= 0, which an energy W(C) cannot see."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from mpi4py import MPI

import basix
import numpy as np
from dolfinx import fem

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.kernels import library
from dolfinx_nts.kernels.cell_batches import CellBatches, Field, Shape, load
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import FloatArray

#: det(dx/dxi) at the points of a cell, from its nodes' positions, as FFCx would write it.
_KERNEL = """
void tabulate_tensor_det(double* restrict A, const double* restrict w)
{{
  static const double table[3][{points}][{nodes}] = {table};
  for (int p = 0; p < {points}; ++p)
  {{
    double x[3][3];
    for (int k = 0; k < 3; ++k)
    {{
      for (int d = 0; d < 3; ++d)
      {{
        double sum = 0.0;
        for (int i = 0; i < {nodes}; ++i)
          sum += w[3 * i + k] * table[d][p][i];
        x[k][d] = sum;
      }}
    }}
    double minors = x[0][0] * (x[1][1] * x[2][2] - x[1][2] * x[2][1]);
    minors += x[0][1] * (x[1][2] * x[2][0] - x[1][0] * x[2][2]);
    minors += x[0][2] * (x[1][0] * x[2][1] - x[1][1] * x[2][0]);
    A[p] += minors;
  }}
}}
"""


class Determinants:
    """det F at the corners and quadrature points of a body's cells.

    As det(dx/dxi) / det(dX/dxi) it needs the nodes' positions alone.

    Args:
        space: Continuous Lagrange space of the displacements.
        degree: Its polynomial degree.
        quadrature_degree: That of the strain energy.
    """

    def __init__(self, space: fem.FunctionSpace, degree: int, quadrature_degree: int) -> None:
        name = compat.cell_name(space.mesh)
        kind = getattr(basix.CellType, name)
        points = basix.make_quadrature(kind, quadrature_degree)[0]
        constant = name == "tetrahedron" and degree == 1
        points = points[:1] if constant else np.concatenate([basix.geometry(kind), points])
        variant = basix.LagrangeVariant.gll_warped
        element = basix.create_element(basix.ElementFamily.P, kind, degree, variant)
        derivatives = element.tabulate(1, points)[1:, :, :, 0]
        nodes = space.tabulate_dof_coordinates()
        # About a node of their own: differences of far positions would lose digits.
        self._origin = nodes[:1].sum(axis=0)
        self._reference = (nodes - self._origin).ravel()
        self._cells = compat.cell_dofs(space)[: space.mesh.topology.index_map(3).size_local]
        _, count, of_cell = derivatives.shape
        table = str(derivatives.tolist()).translate(str.maketrans("[]", "{}"))
        code = _KERNEL.format(points=count, nodes=of_cell, table=table)
        self._comm, self._shape = space.mesh.comm, Shape(3, 3 * of_cell, count, count)
        self._loop = library.Beside(
            load, code, self._shape, compat.cache_folder(), compat.chosen_flags()
        )

    @cached_property
    def _batches(self) -> CellBatches:
        """What takes several cells at once. Collective.

        Raises:
            RuntimeError: On all ranks, if one of them cannot compile it.
        """
        loop = None
        try:
            loop, problem = self._loop.result(), None
        except library.NotMadeError as error:
            problem = f"the kernel of det F cannot be compiled ({error})"
        raise_together(self._comm, problem, RuntimeError)
        self._x = np.empty_like(self._reference)
        number, x = np.arange(len(self._cells))[:, None], Field(self._x, self._cells, 3)
        return CellBatches(loop, np.zeros_like(number), np.zeros((1, 3)), number, [x])

    @cached_property
    def _inverse(self) -> FloatArray:
        """One over det(dX/dxi) [1/m^3], shape (cells, points)."""
        return 1.0 / self._dets(self._reference)

    def _dets(self, x: FloatArray) -> FloatArray:
        """det(dx/dxi) of nodes' positions x [m^3], shape (cells, points)."""
        out = np.zeros((len(self._cells), self._shape.entries))
        batches, self._x[:] = self._batches, x
        batches.add(np.empty(0), out.reshape(-1))
        return out

    def refuse_inverted(self, u: FloatArray, name: str) -> None:
        """Raise on every rank if a start, as of `smallest`, turns a cell of a body inside out."""
        det, place = min(self._comm.allgather(self.smallest(u)), key=lambda found: found[0])
        if det <= 0.0:
            where = ", ".join(f"{x:.4g}" for x in place)
            raise ValueError(
                f"displacement of {name!r}: with its Dirichlet values at t=0 it turns a cell "
                f"inside out, det F = {det:.3g} near X = ({where}); pass a smoother or smaller one"
            )

    @np.errstate(over="ignore", invalid="ignore")  # an iterate may run off
    def smallest(self, u: FloatArray) -> tuple[float, FloatArray]:
        """The smallest det F on this rank and the middle X of its cell [m], shape (3,). Collective.

        Args:
            u: Displacements of this rank's nodes and its ghosts [m], shape (coordinates,).

        Returns:
            A det that is not finite is -inf; without cells it is inf.
        """
        det = self._dets(self._reference + u) * self._inverse
        if not len(det):
            return np.inf, np.full(3, np.nan)
        i = int(det.argmin())  # the first NaN, if there is one
        least, nodes = float(det.flat[i]), self._cells[i // det.shape[1]]
        middle = self._origin + self._reference.reshape(-1, 3)[nodes].mean(axis=0)
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
        if body.rigid:
            local[k] = np.inf
            continue
        if k not in known or known[k][0] is not values:
            known[k] = values, body.smallest_det(values)[0]
        local[k] = known[k][1]
    system.comm.Allreduce(MPI.IN_PLACE, local, op=MPI.MIN)
    return local


def forbidden(system: Any, dets: FloatArray) -> FloatArray:
    """`smallest_dets` with inf at bodies that may turn inside out."""
    allowed = [body.allow_inversion for body in system.bodies]
    return np.where(allowed, np.inf, dets)


def describe(body: Body, u: FloatArray) -> tuple[str, str]:
    """Where a body's smallest det F is, and what may prevent it, see `Body`. Collective."""
    found = body.comm.allgather(body.smallest_det(u))
    return body.describe_det(*min(found, key=lambda one: one[0]))
