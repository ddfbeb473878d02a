"""`bodies.inversion.Determinants` in NumPy."""

import basix
import numpy as np

from dolfinx_nts import dolfinx_compat as compat


def determinants(space, degree, quadrature_degree, u):
    """det F at the corners and quadrature points of a body's cells, shape (cells, points)."""
    kind = getattr(basix.CellType, compat.cell_name(space.mesh))
    points = basix.make_quadrature(kind, quadrature_degree)[0]
    points = np.concatenate([basix.geometry(kind), points])
    variant = basix.LagrangeVariant.gll_warped
    element = basix.create_element(basix.ElementFamily.P, kind, degree, variant)
    nodes = space.tabulate_dof_coordinates()
    both = []
    for x in (nodes + u.reshape(-1, 3), nodes):
        slopes = element.tabulate(1, points)[1:, :, :, 0]
        a, b, c = np.einsum("dpi,nik->dnpk", slopes, x[compat.cell_dofs(space)])
        both.append((a * np.cross(b, c)).sum(axis=-1))
    return both[0] / both[1]
