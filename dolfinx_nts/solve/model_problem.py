"""A small linear system, with which options of PETSc are tried out."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

from petsc4py import PETSc


def model_problem(
    comm: MPI.Comm, *, constraint: bool
) -> tuple[Any, tuple[tuple[str, Any], tuple[str, Any]]]:
    """A chain of masses and springs, small but large enough for an algebraic multigrid.

    Args:
        comm: MPI communicator.
        constraint: Whether a multiplier holds the first mass of each rank.

    Returns:
        Its matrix, and the index sets "bodies" and "constraints" of its unknowns.
    """
    count, extra = 300, int(constraint)
    a = PETSc.Mat().createAIJ(((count + extra, None), (count + extra, None)), nnz=4, comm=comm)
    start, _ = a.getOwnershipRange()
    for i in range(start, start + count):
        a.setValue(i, i, 3.0)
        if i > start:
            a.setValue(i, i - 1, -1.0)
            a.setValue(i - 1, i, -1.0)
    if constraint:
        a.setValue(start, start + count, 1.0)
        a.setValue(start + count, start, 1.0)
        a.setValue(start + count, start + count, 0.0)
    a.assemble()
    bodies = PETSc.IS().createStride(count, start, 1, comm=comm)
    constraints = PETSc.IS().createStride(extra, start + count, 1, comm=comm)
    return a, (("bodies", bodies), ("constraints", constraints))
