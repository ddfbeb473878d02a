"""Bending of hexahedra beside that of their nodes: three vectors within each cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import Mesh
from petsc4py import PETSc

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.solid.cell_means import EntriesOfCells, NodesOfCells
from dolfinx_nts.forms import CellForm, compile_forms
from dolfinx_nts.interaction.coupling import StepWarning
from dolfinx_nts.parallel import global_max
from dolfinx_nts.types import FloatArray

#: Numbers of a cell: a vector for each of its directions.
_WIDTH = 9
#: Rounds in which the modes of all cells are solved for.
_ROUNDS = 40
#: Distortion of cells from which on modes do not let them bend freely.
_DISTORTED = 0.2
#: Least eigenvalue of C, the square of a stretch, below which cells may fold: 0.39 at nu = 0.3,
#: 0.48 at 0.4999, with a margin.
_FOLDS = 0.56
#: A change of the modes that is rounding, over the modes, and of F = 1.
_ROUNDED = 2.0 * float(np.finfo(float).eps)
#: Largest change in a round.
_FARTHEST = 0.25
#: One that is rounding if the next round makes it no smaller, over the displacement gradient.
_STALLED = 1e-9
#: A change by more than this part of the one before asks for derivatives at the modes of now.
_SLOW = 0.1


class BendingModes:
    """Displacement gradients that let a hexahedron bend without shear (theory 19.4).

    Modes w_i in each cell add w_i x G_i to the displacement gradient, G_i of the direction xi_i of
    the cell: the gradient of (1 - xi_i^2)/2 but for its size, with the metric of the cell's centre,
    so that a uniform strain needs none. They are numbers without a unit and turn with the cell.

    Args:
        mesh: DOLFINx mesh of hexahedra of degree 1.

    Attributes:
        space: Function space of the modes, w_i in row i.
        cells: Entries of forms with test functions in it.

    Source: Wilson et al. (1973), Taylor, Beresford and Wilson (1976) for the centre's metric.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.space = compat.function_space(mesh, "DG", 0, (3, 3))
        self.cells = EntriesOfCells(self.space)
        # Corners of a cell in the order of its nodes, and of the values of a Function of degree 1.
        corners = np.array([[2.0 * (k >> i & 1) - 1.0 for i in range(3)] for k in range(8)])
        of_corners = compat.function_space(mesh, "DG", 1, (3,))
        self._place, self._directions = fem.Function(of_corners), fem.Function(self.space)
        self._place.x.array.reshape(-1, 3)[compat.cell_dofs(of_corners)] = corners
        x = mesh.geometry.x[compat.geometry_dofmap(mesh)]
        jacobian = np.einsum("cki,kj->cij", x, corners) / 8.0
        rows = np.linalg.inv(jacobian)
        own = slice(self.cells.cells)
        #: Derivatives of the corners' shape functions in the centre [1/m], shape (cells, 8, 3).
        self._slopes = np.einsum("kj,cji->cki", corners / 8.0, rows)[own]
        self._shortest = np.linalg.norm(jacobian, axis=1).min(axis=1)[own]
        sides = 2.0 * np.linalg.norm(jacobian[own], axis=1)
        off = x[own] - x[own].mean(axis=1, keepdims=True)
        off = np.linalg.norm(off - np.einsum("kj,cij->cki", corners, jacobian[own]), axis=2)
        thin = sides.min(axis=1)
        #: How far corners are from a parallelepiped, over the thickness and times the slenderness.
        self._distortion = float((off.max(axis=1) * sides.max(axis=1) / thin**2).max(initial=0.0))
        size = np.linalg.norm(rows, axis=2)
        # DOLFINx's cells are one wide.
        factor = -8.0 * np.linalg.det(jacobian)[:, None] / size
        values = self._directions.x.array.reshape(-1, _WIDTH)
        values[compat.cell_dofs(self.space)[:, 0]] = (rows * factor[:, :, None]).reshape(-1, _WIDTH)
        self._volume = ufl.JacobianDeterminant(mesh)

    def strain(self, corners: FloatArray) -> float:
        """How much displacements (cells, 24) [m] differ within a cell, over its size, the most."""
        spread = np.ptp(corners.reshape(len(corners), -1, 3), axis=1).max(axis=1)
        return float((spread / self._shortest).max(initial=0.0))

    def doubts(self, name: str, corners: FloatArray) -> list[StepWarning]:
        """What is wrong with the cells of a body of that name, as of `Body.doubts`. Collective.

        Args:
            name: Of the body.
            corners: Displacements of the cells' corners [m], shape (cells, 24).
        """
        h = np.einsum("cki,ckj->cij", corners.reshape(len(corners), 8, 3), self._slopes)
        f = h + np.eye(3)
        c = np.einsum("cki,ckj->cij", f, f)
        least = float(np.linalg.eigvalsh(c).min(initial=np.inf))
        top = global_max(self.space.mesh.comm, np.array([self._distortion, -least]))
        distortion, least, found = float(top[0]), -float(top[1]), []
        if distortion > _DISTORTED:
            text = (
                f"cells of body {name!r} are too far from parallelepipeds for bending=True, by "
                f"{distortion:.2g}: {_DISTORTED} makes them several per cent too stiff, and 1 "
                "undoes most of it; use more cells along curves, regular ones, or degree=2"
            )
            found.append(StepWarning("distorted cells", distortion, text, (name,)))
        if least < _FOLDS:
            text = (
                f"a cell of body {name!r} is compressed to {max(least, 0.0) ** 0.5:.2g} of a "
                "length, where bending=True lets it fold without a force; leave bending out, or "
                "pass degree=2"
            )
            found.append(StepWarning("folding cells", _FOLDS - least, text, (name,)))
        return found

    def gradient(self, modes: Any) -> Any:
        """What modes add to the displacement gradient (UFL), shape (3, 3)."""
        along = ufl.as_tensor(
            [[self._place[i] * self._directions[i, j] for j in range(3)] for i in range(3)]
        )
        return modes.T * along / self._volume


class StepModes:
    """Forces of a step with modes, which each evaluation solves for, as of `WithinCells`.

    Args:
        modes: Of the body.

    Attributes:
        old: At t_n, a Function.
        new: At t_{n+1}.
    """

    def __init__(self, modes: BendingModes) -> None:
        self._modes = modes
        self.old, self.new = (fem.Function(modes.space) for _ in range(2))

    @property
    def inner(self) -> FloatArray:
        """Modes of this rank's cells at t_{n+1}, shape (9 cells,)."""
        return self.new.x.array[: _WIDTH * self._modes.cells.cells].copy()

    def compiled(self, stress: Any, dx: Any, form: Any, w: Any, unknown: Any) -> StepModes:
        """Compile the forces of a step, and return this.

        Args:
            stress: First Piola-Kirchhoff stress in UFL, of the modes and displacements at both
                ends.
            dx: Measure.
            form: Virtual work of it.
            w: Its test function.
            unknown: Displacement at t_{n+1}.
        """
        modes, self._nodes = self._modes, NodesOfCells(w.ufl_function_space())
        self._unknown = unknown
        apart, test = ufl.TestFunction(self._nodes.space), ufl.TestFunction(modes.space)
        self._one = fem.Function(modes.space)
        self._entries = self._one.x.array.reshape(-1, _WIDTH)
        of_modes = ufl.inner(stress, modes.gradient(test)) * dx
        of_one = ufl.inner(stress, modes.gradient(self._one)) * dx
        self._form, self._residual, self._stiff, self._push, self._pull = compile_forms(
            [
                form,
                of_modes,
                ufl.derivative(of_modes, self.new, self._one),
                ufl.derivative(ufl.replace(form, {w: apart}), self.new, self._one),
                ufl.derivative(of_one, unknown, apart),
            ]
        )
        self._inverse: FloatArray | None = None
        return self

    def begin(self, inner: FloatArray | None) -> None:
        """Set the modes at t_n, shape (9 cells,); None: there are none yet."""
        values = 0.0 if inner is None else inner
        for function in (self.old, self.new):
            function.x.array[: _WIDTH * self._modes.cells.cells] = values

    def move(self) -> None:
        """Solve for the modes at the displacement of now.

        Where they do not settle they are not a number, and so are the forces.
        """
        values, before, largest = self.new.x.array, np.inf, 0.0
        strain = self._modes.strain(self._unknown.x.array[self._nodes.dofs])
        if not np.isfinite(values).all():
            values[:] = self.old.x.array
        inverse = self._renewed() if self._inverse is None else self._inverse
        for _ in range(_ROUNDS):
            residual = self._modes.cells(self._residual)
            change = -np.einsum("cij,cj->ci", inverse, residual)
            far = np.abs(change).max(axis=1, keepdims=True, initial=_FARTHEST)
            change *= _FARTHEST / far
            values[: change.size] += change.ravel()
            now, size = np.abs(change).max(initial=0.0), np.abs(values).max(initial=0.0)
            stalled = before <= 2.0 * now and now <= _STALLED * (strain + size) + self._rounded
            # Modes that vanish come ever nearer to zero.
            largest = max(largest, size)
            if stalled or now <= _ROUNDED * max(size, _ROUNDED * largest):
                return
            if not np.isfinite(now):
                break
            if now > _SLOW * before:
                inverse = self._renewed()
            before = now
        values[:], self._inverse = np.nan, None

    def add(self, values: FloatArray) -> None:
        """Add the virtual work to this rank's values, ghosts included."""
        self._form.add(values)

    def add_to(self, matrix: PETSc.Mat, factor: float, masks: Sequence[Any]) -> None:
        """As of `WithinCells`."""
        of_nodes, inverse = self._nodes.entries, self._renewed()
        push, pull = (self._columns(of_nodes, form) for form in (self._push, self._pull))
        blocks = np.matmul(push, np.matmul(inverse, -factor * pull.transpose(0, 2, 1)))
        self._nodes.add(matrix, blocks, masks)

    def _renewed(self) -> FloatArray:
        """Inverse of the modes' stiffness in each cell at the state of now."""
        stiff = self._columns(self._modes.cells, self._stiff)
        self._inverse = np.linalg.inv(stiff) if np.isfinite(stiff).all() else np.nan * stiff
        # What rounding of F = 1 leaves open.
        norms = (np.linalg.norm(a, axis=(1, 2)) for a in (stiff, self._inverse))
        self._rounded = _ROUNDED * float(np.prod([*norms], axis=0).max(initial=1.0))
        return self._inverse

    def _columns(self, entries: EntriesOfCells, form: CellForm) -> FloatArray:
        """Entries of a form with one of each cell's modes at a time, which is the last axis."""
        columns = []
        for k in range(_WIDTH):
            self._entries[:] = np.eye(_WIDTH)[k]
            columns.append(entries(form))
        return np.stack(columns, axis=2)
