"""Material points of a body, x = sum of w_a y_a with constant weights w_a (theory section 11)."""

from __future__ import annotations

from typing import Any, NamedTuple

import basix
import numpy as np
import numpy.typing as npt

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.parallel import raise_together

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]


class Points(NamedTuple):
    """Material points, the same on all ranks; axis 0 = point.

    Attributes:
        nodes: Global numbers of the nodes y_a that a point depends on, shape (n, k); their
            coordinates are 3 node, 3 node + 1, 3 node + 2.
        weights: w_a, shape (n, k).
        reference: Reference positions of the nodes [m], shape (n, k, 3).
        fixed: Which coordinates of the nodes are prescribed, shape (n, k, 3).
    """

    nodes: IntArray
    weights: FloatArray
    reference: FloatArray
    fixed: BoolArray

    @property
    def dofs(self) -> IntArray:
        """Global coordinates of the nodes, shape (n, k, 3)."""
        dofs: IntArray = 3 * self.nodes[:, :, None] + np.arange(3)
        return dofs


def in_mesh(body: Any, x: FloatArray, name: str) -> Points:
    """Points of a body with a Lagrange space on a mesh of degree 1. Collective.

    Args:
        body: The body; it has `mesh`, `space`, `degree` and `fixed`.
        x: Reference positions [m], shape (n, 3), the same on all ranks.
        name: Of the argument, for messages.

    Raises:
        ValueError: A point lies in no cell.
    """
    mesh, space, comm = body.mesh, body.space, body.comm
    cells = compat.cells_at(mesh, x)
    mine = np.flatnonzero(cells >= 0)
    dofs, index_map = compat.cell_dofs(space)[cells[mine]], space.dofmap.index_map
    corners = mesh.geometry.x[compat.geometry_dofmap(mesh)[cells[mine]]]
    kind = getattr(basix.CellType, compat.cell_name(mesh))
    variant = basix.LagrangeVariant.gll_warped
    element = basix.create_element(basix.ElementFamily.P, kind, body.degree, variant)
    weights = np.empty((len(mine), dofs.shape[1]))
    for k, i in enumerate(mine):
        inside = mesh.geometry.cmap.pull_back(x[i : i + 1], corners[k])
        weights[k] = element.tabulate(0, inside)[0, 0, :, 0]
    nodes = index_map.local_to_global(dofs.ravel().astype(np.int32)).reshape(dofs.shape)
    reference = space.tabulate_dof_coordinates()[dofs]
    fixed = compat.with_ghosts(space, body.fixed)[dofs]
    # Of several ranks that hold a point, the first one tells.
    found: dict[int, Any] = {}
    local = list(zip(mine.tolist(), nodes, weights, reference, fixed, strict=True))
    for part in comm.allgather(local):
        for i, *values in part:
            found.setdefault(i, values)
    outside = [i for i in range(len(x)) if i not in found]
    raise_together(
        comm,
        f"{name}={x[outside[0]].tolist()}: lies in no cell of body {body.name!r}; choose a point "
        "of its reference configuration"
        if outside
        else None,
    )
    columns = zip(*(found[i] for i in range(len(x))), strict=True)
    return Points(*(np.array(values) for values in columns))
