"""Vectors, matrices and communicators of PETSc, where petsc4py 3.18 and 3.22 do not bind all."""

from __future__ import annotations

import atexit
import ctypes
import gc
import itertools
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI

import dolfinx.fem.petsc as fem_petsc
import numpy as np
import numpy.typing as npt
from dolfinx import cpp, fem
from petsc4py import PETSc

from dolfinx_nts.dolfinx_compat import OLD
from dolfinx_nts.types import FloatArray, IntArray

#: One for all meshes of the same ranks in the same order, see `petsc_communicator`.
_COMMUNICATORS: list[Any] = [MPI.COMM_SELF, MPI.COMM_WORLD]
#: See `close_at_exit`; in an order that all ranks have.
_OPEN: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()
_NUMBERS = itertools.count()

_REASONS: Any = PETSc.SNES.ConvergedReason
#: SNES's reason where numbers are not finite; PETSc 3.25 gave it another name.
DIVERGED_NOT_FINITE: int = (
    _REASONS.DIVERGED_FNORM_NAN
    if hasattr(_REASONS, "DIVERGED_FNORM_NAN")
    else _REASONS.DIVERGED_FUNCTION_NANORINF
)


def petsc_communicator(comm: MPI.Comm) -> MPI.Comm:
    """Communicator of the same ranks, one for all meshes, for PETSc's objects.

    In parallel PETSc frees what Python has dropped in `free_dropped` alone, by communicator. Each
    mesh has its own, which may be gone by then; and MPICH has only 2,048.
    """
    for known in _COMMUNICATORS:
        if MPI.Comm.Compare(known, comm) in (MPI.IDENT, MPI.CONGRUENT):
            return known
    _COMMUNICATORS.append(comm.Dup())
    return _COMMUNICATORS[-1]


def free_dropped(comm: MPI.Comm) -> None:
    """Free what PETSc made on a communicator and Python has dropped; all ranks call it."""
    if comm.size > 1:
        PETSc.garbage_cleanup(comm)


def close_at_exit(owner: Any) -> None:
    """Close what owns preconditioners of Python's before Python ends, if nobody does."""
    _OPEN[next(_NUMBERS)] = owner


@atexit.register
def _close() -> None:
    # What is left, PETSc would free after Python is gone, and ask Python for it.
    for _, owner in sorted(_OPEN.items()):
        owner.close()
    # Of an owner that is gone, its preconditioners may wait for Python's collector.
    gc.collect()
    for comm in _COMMUNICATORS:
        free_dropped(comm)


def create_vector(space: fem.FunctionSpace) -> PETSc.Vec:
    """New zero ghosted PETSc vector in the layout of the space."""
    blocks, size = space.dofmap.index_map, space.dofmap.index_map_bs
    b = PETSc.Vec().createGhost(
        np.asarray(blocks.ghosts, dtype=PETSc.IntType), (size * blocks.size_local, None),
        bsize=size, comm=petsc_communicator(space.mesh.comm),
    )  # fmt: skip
    b.set(0.0)
    return b


def add_vector(values: FloatArray, form: Any) -> None:
    """Add a compiled linear form to this rank's values, ghosts included."""
    form = getattr(form, "_cpp_object", form)
    packed = cpp.fem.pack_constants(form), cpp.fem.pack_coefficients(form)
    cpp.fem.assemble_vector(values, form, *packed)


def sum_ghosts(b: PETSc.Vec) -> None:
    """Add values at ghosts of a PETSc vector to their owners."""
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)


def create_matrix(form: Any) -> PETSc.Mat:
    """New PETSc matrix with the sparsity of a bilinear form."""
    pattern = fem.create_sparsity_pattern(form)
    if OLD:
        pattern.assemble()
    else:
        pattern.finalize()
    return cpp.la.petsc.create_matrix(petsc_communicator(form.mesh.comm), pattern)


def dense_matrix(comm: MPI.Comm, size: int) -> PETSc.Mat:
    """New PETSc AIJ matrix of nodes, 3 x 3 blocks, with room for all entries of a rank's own.

    Args:
        comm: MPI communicator.
        size: Rows and columns on this rank.
    """
    return PETSc.Mat().createAIJ(((size, None), (size, None)), nnz=(size, 0), bsize=3, comm=comm)


def coo_matrix(comm: MPI.Comm, size: int, rows: npt.ArrayLike, cols: npt.ArrayLike) -> PETSc.Mat:
    """New PETSc AIJ matrix of nodes, 3 x 3 blocks, for `set_values_coo`.

    Args:
        comm: MPI communicator.
        size: Rows and columns on this rank.
        rows: Global numbers of the triplets that this rank sets, whoever owns them.
        cols: Likewise.
    """
    a = PETSc.Mat().create(comm)
    a.setSizes(((size, None), (size, None)))
    a.setBlockSize(3)
    a.setType("aij")
    set_preallocation_coo(a, rows, cols)
    return a


def without_zeros(a: PETSc.Mat) -> PETSc.Mat:
    """Copy of an assembled matrix without the zeros stored in it; MatFilter only since 3.20."""
    rows, cols, values = a.getValuesCSR()
    kept = values != 0.0
    start = np.concatenate([[0], np.cumsum(kept)])[rows]
    return with_entries(a, start, cols[kept], values[kept])


def with_entries(a: PETSc.Mat, start: IntArray, cols: IntArray, values: FloatArray) -> PETSc.Mat:
    """PETSc AIJ matrix of the sizes of another with other entries of this rank's rows.

    Args:
        a: The other one.
        start: Where each row starts among the entries, and their number, shape (rows + 1,).
        cols: Global columns.
        values: Values.
    """
    csr = (start.astype(PETSc.IntType), cols.astype(PETSc.IntType), values)
    return PETSc.Mat().createAIJ(a.getSizes(), csr=csr, comm=a.comm)


def assemble_matrix(
    a: PETSc.Mat, form: Any, bcs: Sequence[Any], diagonal: float, *more: Any
) -> None:
    """Assemble bilinear forms; rows and columns of bcs hold only the given diagonal."""
    a.zeroEntries()
    for each in (form, *more):
        fem_petsc.assemble_matrix(a, each, list(bcs), diagonal)
        a.assemble()  # else what is added next would take the place of what is there


_lib: Any = None
_INT: Any = np.ctypeslib.as_ctypes_type(PETSc.IntType)


def _petsc_library() -> Any:
    """The PETSc library this process already has loaded."""
    global _lib  # noqa: PLW0603
    if _lib is None:
        with open("/proc/self/maps", encoding="utf-8") as maps:
            names = (x.split()[-1] for x in maps if "libpetsc_" in x or "libpetsc." in x)
            path = next(names)
        _lib = ctypes.CDLL(path)
        count, pointer = ctypes.c_ssize_t, ctypes.c_void_p
        _lib.MatSetPreallocationCOO.argtypes = (pointer, count, pointer, pointer)
        _lib.MatSetValuesCOO.argtypes = (pointer, pointer, ctypes.c_int)
        _lib.PetscOptionsUsed.argtypes = (pointer, ctypes.c_char_p, pointer)
        _lib.MatMPIAIJGetSeqAIJ.argtypes = (pointer,) * 4
        _lib.MatSeqAIJGetCSRAndMemType.argtypes = (pointer,) * 5
    return _lib


def set_preallocation_coo(a: PETSc.Mat, rows: npt.ArrayLike, cols: npt.ArrayLike) -> None:
    """Declare the triplets of a matrix; negative indices are ignored, duplicates summed."""
    rows = np.array(rows, dtype=PETSc.IntType)  # copies: PETSc may permute them
    cols = np.array(cols, dtype=PETSc.IntType)
    if hasattr(a, "setPreallocationCOO"):
        a.setPreallocationCOO(rows, cols)
        return
    i, j = rows.ctypes.data, cols.ctypes.data
    if error := _petsc_library().MatSetPreallocationCOO(a.handle, rows.size, i, j):
        raise PETSc.Error(error)


def set_values_coo(a: PETSc.Mat, values: npt.ArrayLike) -> None:
    """Replace the values of a matrix whose triplets were declared."""
    values = np.ascontiguousarray(values, dtype=PETSc.ScalarType)
    if hasattr(a, "setValuesCOO"):
        a.setValuesCOO(values, PETSc.InsertMode.INSERT_VALUES)
        return
    mode = int(PETSc.InsertMode.INSERT_VALUES)
    if error := _petsc_library().MatSetValuesCOO(a.handle, values.ctypes.data, mode):
        raise PETSc.Error(error)


def csr_parts(a: PETSc.Mat) -> list[tuple[IntArray, IntArray, IntArray, FloatArray]]:
    """This rank's rows of an assembled AIJ matrix; unlike `getValuesCSR` nothing is copied.

    Args:
        a: The matrix; the arrays are its own and are valid while it lives with this pattern.

    Returns:
        Of the part in the rank's own columns and, if there are several ranks, of that in the
        others': row pointer, column within the part, number of each such column, value.
    """
    (rows, width), lib = a.getLocalSize(), _petsc_library()
    numbers: list[IntArray] = [np.arange(width) + a.getOwnershipRangeColumn()[0]]
    parts = [ctypes.c_void_p(a.handle)]
    if a.getType() == "mpiaij":
        parts = [ctypes.c_void_p(), ctypes.c_void_p()]
        away = ctypes.POINTER(_INT)()
        if error := lib.MatMPIAIJGetSeqAIJ(a.handle, *map(ctypes.byref, (*parts, away))):
            raise PETSc.Error(error)
    result: list[tuple[IntArray, IntArray, IntArray, FloatArray]] = []
    for part in parts:
        pointer, column = ctypes.POINTER(_INT)(), ctypes.POINTER(_INT)()
        value = ctypes.POINTER(ctypes.c_double)()
        arrays = map(ctypes.byref, (pointer, column, value))
        if error := lib.MatSeqAIJGetCSRAndMemType(part, *arrays, None):
            raise PETSc.Error(error)
        start = np.ctypeslib.as_array(pointer, (rows + 1,))
        count = start[-1]
        columns = _view(column, count)
        if result:
            numbers.append(_view(away, columns.max(initial=-1) + 1))
        result.append((start, columns, numbers[-1], _view(value, count)))
    return result


def _view(pointer: Any, count: int) -> Any:
    """Array of a C array, whose pointer may be NULL if it is empty."""
    return np.ctypeslib.as_array(pointer, (int(count),)) if count else np.empty(0, pointer._type_)


def option_used(name: str) -> bool:
    """Return whether PETSc has asked for an option of its global database."""
    used = ctypes.c_int(0)  # PetscBool is an enum, since 3.24 a C99 bool; zero is false in both
    if error := _petsc_library().PetscOptionsUsed(None, name.encode(), ctypes.byref(used)):
        raise PETSc.Error(error)
    return bool(used.value)


#: KLU's ordering, for any pivots, and how large a pivot is beside its column.
_KLU = {"mat_klu_ordering": "COLAMD", "mat_klu_pivot_tol": 0.1}


@contextmanager
def klu_options() -> Iterator[None]:
    """Let factors of KLU that are made within take any entry of a column for its pivot.

    Rows of joints have no diagonal to pivot on: an ordering for pivots on the diagonal fills in a
    hundred times as much, and small pivots cost digits of the momenta. PETSc asks for these options
    when it makes the factors alone, and without a prefix.
    """
    options = PETSc.Options()
    ours = {name: value for name, value in _KLU.items() if not options.hasName(name)}
    for name, value in ours.items():
        options[name] = value
    try:
        yield
    finally:
        for name in ours:
            options.delValue(name)
