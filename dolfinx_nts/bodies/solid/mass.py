"""The mass of a body with a function space, also where slave nodes have none (theory section 16).

To the mass, each massless node moves with its nearest neighbour that has some. A smooth factor
close to 1 of each node's velocity, 1 + a polynomial of degree 2 in X, then sets mass, centre of
mass and inertia right: the kinetic energy of every motion as a rigid body, and of every uniform
deformation, is as before. What is left is positive definite on the nodes with mass.

A velocity that is extrapolated to the massless nodes would keep these moments by itself, but
contact forces oscillate three times as much with it: in a bar of 50 elements, Courant number 1, by
0.042 of 0.3 in place of 0.012.

The friction of an impact is made in a layer as thick as a shear wave comes while the pressure that
presses it on goes through the body. Cells that are thicker take too little of it where their nodes
have no mass, and too much where they have.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from dolfinx_nts import petsc_compat
from dolfinx_nts.interaction.points import of_nodes
from dolfinx_nts.parallel import anywhere, global_sum
from dolfinx_nts.types import Array, BoolArray, FloatArray, IntArray


class MassMatrix:
    """Mass matrix of a body.

    Attributes:
        matrix: PETSc matrix, the same scalar in each of the three directions.
        nodal: Its row sums [kg], shape (num_owned,).
        nodal_before: The same before nodes lost their mass.
    """

    def __init__(self, form: Any) -> None:
        self._form = form
        self.matrix: Any = None
        self._consistent: Any = None
        self._change: Any = None
        self._sum: Any = None
        self.assemble()

    def assemble(self) -> None:
        """Assemble it, anew where what the form is made of has changed. Collective."""
        full = petsc_compat.create_matrix(self._form)
        petsc_compat.assemble_matrix(full, self._form, (), 0.0)
        if self.matrix is None:
            self._in, self._out = full.createVecs()
        else:
            self.matrix.destroy()
        # Directions do not mix: two of three entries of the blocks are zero.
        self.matrix = petsc_compat.without_zeros(full)
        full.destroy()
        self._sum_up()
        self.nodal_before = self.nodal

    def _sum_up(self) -> None:
        self.nodal = self.times(np.ones(self._in.getLocalSize()))

    def times(self, v: FloatArray) -> FloatArray:
        """M v. Collective."""
        self._in.array_w[:] = v
        self.matrix.mult(self._in, self._out)
        return self._out.array_r.copy()

    # ---- nodes without mass
    def redistribute(self, massless: BoolArray, x: FloatArray, fixed: IntArray) -> str:
        """Take the mass of nodes and give it to others, see `massless`. Collective.

        Args:
            massless: This rank's nodes that shall have none, shape (n,).
            x: Reference positions of this rank's nodes [m], shape (n, 3).
            fixed: As of `Body`.

        Returns:
            What is wrong with what is left, for messages; if anything is, the mass stays.
        """
        first = self.matrix if self._consistent is None else self._consistent
        new, problem = redistributed(first, massless, x)
        if problem:
            return problem
        if self._consistent is not None:
            self.matrix.destroy()
            self._change.destroy()
        self._consistent, self.matrix = first, new
        self._sum_up()
        change = new.copy()
        change.axpy(-1.0, first, structure=PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        start, _ = change.getOwnershipRange()
        change.zeroRowsColumns((start + fixed).astype(PETSc.IntType), diag=0.0)
        self._change = change
        return ""

    def corrected(self, tangent: Any, mass: float) -> Any:
        """A tangent with `mass` times this mass in place of the form's. Collective.

        It is the same matrix in each call: a new one if mass is where the form has no entries.

        Args:
            tangent: PETSc matrix, the same in each call, with `mass` times the form's mass.
            mass: Factor.
        """
        if self._change is None:
            return tangent
        if self._sum is None:
            self._sum = tangent.copy()
            other = PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
            self._sum.axpy(mass, self._change, structure=other)
            return self._sum
        subset = PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN
        self._sum.zeroEntries()
        self._sum.axpy(1.0, tangent, structure=subset)
        self._sum.axpy(mass, self._change, structure=subset)
        return self._sum

    def destroy(self) -> None:
        """Free the PETSc objects."""
        for a in (self.matrix, self._consistent, self._change, self._sum, self._in, self._out):
            if a is not None:
                a.destroy()


#: Part by which neighbours that count as equally near may differ in their distance.
_AS_NEAR = 1e-6
#: Newton iterations for the factors, in which the moments are quadratic.
_ITERATIONS = 30
#: Moments over their sizes that count as kept.
_KEPT = 1e-14
#: Smallest and largest factor of a node's coordinates.
_FACTORS = (0.5, 2.0)
#: Singular values of the moments' derivative that count as zero.
_SINGULAR = 1e-10
_TOO_THIN = "has fewer than four cells or so behind them, too few to keep its inertia"


def redistributed(mass: Any, massless: BoolArray, x: FloatArray) -> tuple[Any, str]:
    """A mass matrix with zeros at some nodes that keeps a body's moments of mass. Collective.

    Args:
        mass: PETSc AIJ matrix with the same scalar in each of the three directions, kept as it is.
        massless: This rank's nodes without mass, shape (n,).
        x: Their reference positions [m], shape (n, 3).

    Returns:
        The new matrix, and what is wrong with it for messages: empty if nothing is.
    """
    comm, work = mass.getComm().tompi4py(), _Products(mass)
    shape = _polynomials(x, comm)
    affine = shape[:, :4]
    wanted = _moments(affine, [work.times(f) for f in affine.T], comm)
    level = _levels(work, massless, comm)
    work.destroy()
    if level is None:
        return None, "has a part without any other nodes"
    parent, new = _parents(mass, level, x), mass.copy()
    for _ in range(int(comm.allreduce(level.max(initial=0), op=MPI.MAX))):
        old, new = new, new.ptap(parent)
        old.destroy()
    parent.destroy()
    factor, problem = _factors(_Products(new), shape, wanted, ~massless, comm)
    scaling = new.createVecLeft()
    scaling.array_w[:] = np.repeat(factor, 3)
    new.diagonalScale(scaling, scaling)
    scaling.destroy()
    return new, problem


class _Products:
    """Products of a mass matrix with nodal scalars."""

    def __init__(self, matrix: Any) -> None:
        self._matrix, (self._in, self._out) = matrix, matrix.createVecs()

    def times(self, values: FloatArray) -> FloatArray:
        """M times nodal scalars, shape (n,). Collective."""
        self._in.array_w[:] = np.repeat(values, 3)
        self._matrix.mult(self._in, self._out)
        return self._out.array_r[::3].copy()

    def destroy(self) -> None:
        """Free the vectors."""
        self._in.destroy()
        self._out.destroy()


def _levels(mass: _Products, massless: BoolArray, comm: MPI.Comm) -> IntArray | None:
    """Cells from each node to one with mass, shape (n,); None if some node reaches none."""
    level, layer = np.where(massless, -1, 0), 0
    while anywhere(comm, bool((level < 0).any())):
        near = (level < 0) & (mass.times((level == layer).astype(float)) != 0.0)
        if not anywhere(comm, bool(near.any())):
            return None
        layer += 1
        level[near] = layer
    return level


def _parents(mass: Any, level: IntArray, x: FloatArray) -> Any:
    """PETSc matrix that gives each node its own velocity, but massless ones their neighbour's.

    That is the nearest of those neighbours that are one level nearer to nodes with mass; the mean
    of several that are as near.
    """
    first = mass.getOwnershipRange()[0] // 3
    rows = np.flatnonzero(level > 0)
    found = [mass.getRow(3 * (first + int(r)))[0] // 3 for r in rows]
    used = np.unique(np.concatenate([np.empty(0, int), *found])).astype(PETSc.IntType)
    known = _at_nodes(mass, used, np.column_stack([x, level]))
    parents = [np.array([first + k]) for k in range(len(x))]
    for r, nodes in zip(rows, found, strict=True):
        at = known[np.searchsorted(used, nodes)]
        distance = np.linalg.norm(at[:, :3] - x[r], axis=1)
        distance[at[:, 3] != level[r] - 1] = np.inf
        parents[r] = nodes[distance <= (1.0 + _AS_NEAR) * distance.min()]
    counts = np.repeat([len(nodes) for nodes in parents], 3)
    cols = [column for nodes in parents for column in of_nodes(nodes).T]
    start = np.concatenate([[0], np.cumsum(counts)])
    columns = np.concatenate([np.empty(0, int), *cols])
    return petsc_compat.with_entries(mass, start, columns, 1.0 / np.repeat(counts, counts))


def _at_nodes(mass: Any, nodes: Array, values: FloatArray) -> FloatArray:
    """Values (n, k) of this rank's nodes at any nodes, by global numbers. Collective."""
    vector = mass.createVecRight()
    target = PETSc.Vec().createSeq(len(nodes), comm=PETSc.COMM_SELF)
    source = PETSc.IS().createGeneral(3 * nodes, comm=PETSc.COMM_SELF)
    scatter = PETSc.Scatter().create(vector, source, target, None)
    found = np.empty((len(nodes), values.shape[1]))
    for k in range(values.shape[1]):
        vector.array_w[:] = np.repeat(values[:, k], 3)
        scatter.scatter(vector, target, mode=PETSc.ScatterMode.FORWARD)
        found[:, k] = target.array_r
    for a in (vector, target, source, scatter):
        a.destroy()
    return found


def _polynomials(x: FloatArray, comm: MPI.Comm) -> FloatArray:
    """1, x, y, z and their products about the middle of the nodes, over their size, (n, 10)."""
    ends = np.array([x.max(axis=0, initial=-np.inf), (-x).max(axis=0, initial=-np.inf)])
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
    size = 0.5 * float((ends[0] + ends[1]).max())
    one = np.column_stack([np.ones(len(x)), (x - 0.5 * (ends[0] - ends[1])) / size])
    pairs = [one[:, i] * one[:, j] for i in range(4) for j in range(i, 4)]
    return np.column_stack(pairs)


def _moments(affine: FloatArray, products: list[FloatArray], comm: MPI.Comm) -> FloatArray:
    """Return the moments of mass in the order of `_polynomials`, shape (10,). Collective."""
    local = [float(affine[:, i] @ products[j]) for i in range(4) for j in range(i, 4)]
    return comm.allreduce(np.array(local))


def _factors(
    mass: _Products, shape: FloatArray, wanted: FloatArray, kept: BoolArray, comm: MPI.Comm
) -> tuple[FloatArray, str]:
    """Factors of the nodal masses, (n,), that give the wanted moments, and why none do."""
    affine, unknown = shape[:, :4], np.zeros(shape.shape[1])
    pairs = [(i, j) for i in range(4) for j in range(i, 4)]
    problem = _TOO_THIN
    for _ in range(_ITERATIONS):
        factor = 1.0 + shape @ unknown
        scaled = affine * factor[:, None]
        products = [mass.times(f) for f in scaled.T]
        missing = _moments(scaled, products, comm) - wanted
        if np.abs(missing).max() <= _KEPT * wanted[0]:
            problem = ""
            break
        slope = np.array([
            shape.T @ (affine[:, i] * products[j] + affine[:, j] * products[i]) for i, j in pairs
        ])  # fmt: skip
        slope = comm.allreduce(slope)
        unknown -= np.linalg.lstsq(slope, missing, rcond=_SINGULAR)[0]
    mass.destroy()
    ends = np.array([-factor[kept].min(initial=np.inf), factor[kept].max(initial=-np.inf)])
    comm.Allreduce(MPI.IN_PLACE, ends, op=MPI.MAX)
    if not (-ends[0] > _FACTORS[0] and ends[1] < _FACTORS[1]):
        problem = _TOO_THIN
    return factor, problem


#: Strain in which energies are taken as quadratic.
_STRAIN = 1e-4


def waves(
    potential: Callable[[FloatArray], float], x: FloatArray, mass: FloatArray, massless: BoolArray,
    comm: MPI.Comm,
) -> tuple[float, float]:  # fmt: skip
    """Thickness of the layer over the body's, and speed of pressure waves over shear ones.

    From energies of uniform strains of the body, summed over the axes, and of translations of the
    massless nodes; both as if the body was a block of one material. Collective.

    Args:
        potential: Strain energy on this rank [J] by displacements of its nodes (n, 3) [m].
        x: Reference positions [m], shape (n, 3).
        mass: BalanceRow sums of the consistent mass [kg], shape (n,).
        massless: Nodes that have lost theirs, shape (n,).
        comm: Communicator.
    """
    total = float(global_sum(comm, np.array([mass.sum()]))[0])
    arm = x - global_sum(comm, mass @ x) / total
    moments = np.linalg.eigvalsh(global_sum(comm, (arm * mass[:, None]).T @ arm))
    # The thinnest way through a block; a node of the layer has the mass of half a cell.
    size = np.sqrt(12.0 * moments[0] / total)
    taken = float(global_sum(comm, np.array([mass[massless].sum()]))[0])
    axes, on = np.eye(3), massless[:, None]
    pressed = sum(stiffness_along(potential, np.outer(arm[:, k], axes[k])) for k in range(3))
    sheared = sum(stiffness_along(potential, np.outer(arm[:, k], axes[k - 1])) for k in range(3))
    moved = sum(stiffness_along(potential, size * on * axes[k]) for k in range(3)) / size**2
    of_all = global_sum(comm, np.array([pressed, sheared, moved]))
    pressed, sheared, moved = of_all / [3.0, 3.0, 1.0]
    # NaN of a body that resists no shear, or whose energy has no value at rest: nothing is told.
    with np.errstate(divide="ignore", invalid="ignore"):
        thickness = np.sqrt(2.0 * taken / moved * (pressed + 2.0 * sheared) / total)
        speeds = np.sqrt(pressed / sheared)
    return float(thickness / size), float(speeds)


def stiffness_along(potential: Callable[[FloatArray], float], u: FloatArray) -> float:
    """Twice the quadratic part of the energy of a displacement on this rank."""
    u = _STRAIN * u
    rest = potential(np.zeros_like(u))
    return (potential(u) + potential(-u) - 2.0 * rest) / _STRAIN**2
