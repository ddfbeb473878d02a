"""Mass, centre and principal moments of rigid bodies: of a mesh, or as a user gives them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import ufl
from dolfinx import fem

from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.solid.parameters import Parameter, is_number
from dolfinx_nts.forms import compile_forms
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import floats

#: Part of the largest moment by which given moments and axes may miss what they must satisfy.
ROUNDED = 1e-9
#: Part of the largest moment by which equal ones may differ by the rounding of a mesh.
_EQUAL = 1e-9
#: Part of the mass that matrices lend to directors without any.
_LENT = 1e-8


class Inertia(NamedTuple):
    """Mass of a rigid body and where it is in the reference.

    Attributes:
        mass: [kg].
        centre: Its centre [m], shape (3,).
        euler: Principal moments E_i of int rho x x^T dV about it [kg m^2], shape (3,).
        axes: Their directions d_i as columns, shape (3, 3).
    """

    mass: float
    centre: FloatArray
    euler: FloatArray
    axes: FloatArray

    @classmethod
    def of_moments(
        cls, mass: float, centre: FloatArray, moments: FloatArray, axes: FloatArray
    ) -> Inertia:
        """From principal moments of inertia [kg m^2], shape (3,)."""
        return cls(mass, centre, _not_rounding(0.5 * moments.sum() - moments), axes)

    @property
    def moments(self) -> FloatArray:
        """Principal moments of inertia [kg m^2], shape (3,)."""
        return self.euler.sum() - self.euler

    @property
    def length(self) -> float:
        """Radius of gyration l [m].

        A point has none, and nothing depends on what its directors are given.
        """
        return float(np.sqrt(self.euler.sum() / self.mass)) or 1.0

    @property
    def nodes(self) -> FloatArray:
        """The centre and l d_i [m], shape (4, 3)."""
        return np.vstack([self.centre, self.length * self.axes.T])

    @property
    def nodal_mass(self) -> FloatArray:
        """Of the centre m, of the directors E_i / l^2 [kg], shape (4,)."""
        return np.array([self.mass, *(self.euler / self.length**2)])

    @property
    def lent(self) -> FloatArray:
        """What matrices lend to directors without mass where a rotation has no inertia [kg], (4,).

        As about the axis of a rod: Newton's updates leave that rotation alone then.
        """
        masses = self.nodal_mass
        few = np.count_nonzero(masses[1:]) < 2
        return np.where((masses == 0.0) & few, _LENT * self.mass, 0.0)


def _not_rounding(euler: FloatArray) -> FloatArray:
    """Without the rounding of a disc's or a rod's moments, which is no mass."""
    return np.where(euler > ROUNDED * euler.max(), euler, 0.0)


def inertia_of(space: fem.FunctionSpace, density: Parameter, degree: int) -> Inertia:
    """That of a mesh with a function space of vectors on it, both of a degree. Collective."""
    mesh = space.mesh
    rho = fem.Constant(mesh, float(density)) if is_number(density) else density
    v, w = ufl.TrialFunction(space), ufl.TestFunction(space)
    dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 4 if degree == 1 else 7})
    (form,) = compile_forms([rho * ufl.inner(v, w) * dx])
    matrix = petsc_compat.create_matrix(form)
    petsc_compat.assemble_matrix(matrix, form, (), 0.0)
    owned = 3 * space.dofmap.index_map.size_local
    x = space.tabulate_dof_coordinates()[: owned // 3]
    right, left = matrix.createVecs()

    def weighted(values: FloatArray) -> FloatArray:
        right.array_w[:] = np.repeat(values, 3)
        matrix.mult(right, left)
        return left.array_r[::3].copy()

    total = mesh.comm.allreduce(np.concatenate([[weighted(np.ones(len(x))).sum()],
                                                x.T @ weighted(np.ones(len(x)))]))  # fmt: skip
    mass, centre = float(total[0]), total[1:] / total[0]
    # About the centre: far from the origin a difference of moments would lose digits.
    off = x - centre
    euler = mesh.comm.allreduce(np.array([off.T @ weighted(off[:, k]) for k in range(3)]))
    for a in (matrix, right, left):
        a.destroy()
    moments, axes = axes_of(0.5 * (euler + euler.T))
    return Inertia(mass, centre, _not_rounding(moments), axes)


def principal(inertia: Any, axes: Any) -> tuple[FloatArray, FloatArray]:
    """Principal moments [kg m^2] (3,) and axes (3, 3) of what a user gives."""
    given = floats(inertia)
    if given.shape not in ((3,), (3, 3)) or not np.isfinite(given).all():
        raise ValueError(
            f"inertia={inertia!r}: pass three principal moments or a tensor (3, 3) [kg m^2]"
        )
    columns = np.eye(3)
    if given.shape == (3, 3):
        if axes is not None:
            raise ValueError(f"axes={axes!r}: a tensor has axes of its own; leave axes out")
        if np.abs(given - given.T).max() > ROUNDED * np.abs(given).max():
            raise ValueError(f"inertia={inertia!r}: is not symmetric; pass a symmetric tensor")
        given, columns = axes_of(given)
    elif axes is not None:
        columns = floats(axes)
        problem = misfit_of_axes(columns)
        if problem:
            raise ValueError(f"axes={axes!r}: {problem}")
    size = np.abs(given).max()
    if (given < -ROUNDED * size).any():
        raise ValueError(f"inertia={inertia!r}: a principal moment is negative; pass moments >= 0")
    if (given.sum() - 2.0 * given < -ROUNDED * size).any():
        raise ValueError(
            f"inertia={inertia!r}: one principal moment exceeds the sum of the others, which no "
            "body has; check the moments"
        )
    return np.maximum(given, 0.0), columns


def misfit_of_axes(axes: FloatArray) -> str | None:
    """Say what keeps axes from being columns of a right-handed orthonormal matrix."""
    fits = axes.shape == (3, 3) and np.isfinite(axes).all()
    if not fits or np.abs(axes.T @ axes - np.eye(3)).max() > ROUNDED:
        return "pass a matrix (3, 3) with orthonormal columns"
    if np.linalg.det(axes) < 0.0:
        return "the columns are left-handed; turn the sign of one"
    return None


def axes_of(tensor: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues and right-handed axes (3, 3) of a symmetric tensor, whatever its rounding.

    Where eigenvalues are equal, the axes are those nearest to x, y and z; the largest component of
    the others is positive.
    """
    values, axes = np.linalg.eigh(0.5 * (tensor + tensor.T))
    size, start = np.abs(values).max(), 0
    while start < 3:
        same = np.abs(values - values[start]) <= _EQUAL * size
        space = axes[:, same]
        if space.shape[1] > 1:
            # Of the coordinate axes those that lie most in the space, made orthonormal in it.
            chosen = np.sort(np.argsort(-np.linalg.norm(space, axis=1))[: space.shape[1]])
            one, _, two = np.linalg.svd(space @ space[chosen].T, full_matrices=False)
            space = one @ two
        axes[:, same] = space * np.sign(space[np.abs(space).argmax(axis=0), range(space.shape[1])])
        start = int(np.flatnonzero(same).max()) + 1
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return values, axes
