"""MPI calls of a run by the library that makes them: the package (mpi4py), PETSc, DOLFINx, MUMPS.

MPI's profiling interface: a library of wrappers, compiled here, stands before MPI's own functions
and tells each call's name, bytes and caller. Make `Calls` before anything imports mpi4py.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

#: Name -> parameters, how it is called, bytes that this rank gives.
_REDUCED = (
    "const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, MPI_Comm c", "a, b, n, t, o, c",
    "bytes(n, t)",
)  # fmt: skip
_GATHERED = (
    "const void *a, int n, MPI_Datatype t, void *b, const int *m, const int *d, MPI_Datatype u, "
    "MPI_Comm c",
    "a, n, t, b, m, d, u, c", "bytes(n, t)",
)  # fmt: skip
_EVEN = (
    "const void *a, int n, MPI_Datatype t, void *b, int m, MPI_Datatype u, MPI_Comm c",
    "a, n, t, b, m, u, c", "bytes(n, t)",
)  # fmt: skip
_SENT = (
    "const void *a, int n, MPI_Datatype t, int to, int tag, MPI_Comm c", "a, n, t, to, tag, c",
    "bytes(n, t)",
)  # fmt: skip
_LATER = (f"{_SENT[0]}, MPI_Request *r", f"{_SENT[1]}, r", "bytes(n, t)")
COLLECTIVE = {
    "MPI_Allreduce": _REDUCED,
    "MPI_Scan": _REDUCED,
    "MPI_Exscan": _REDUCED,
    "MPI_Allgather": _EVEN,
    "MPI_Allgatherv": _GATHERED,
    "MPI_Alltoall": (_EVEN[0], _EVEN[1], "bytes(n, t) * ranks(c)"),
    "MPI_Bcast": ("void *a, int n, MPI_Datatype t, int to, MPI_Comm c", "a, n, t, to, c",
                  "bytes(n, t)"),
    "MPI_Reduce": (
        "const void *a, void *b, int n, MPI_Datatype t, MPI_Op o, int to, MPI_Comm c",
        "a, b, n, t, o, to, c", "bytes(n, t)",
    ),
    "MPI_Barrier": ("MPI_Comm c", "c", "0"),
}  # fmt: skip
#: Messages; a persistent one (`MPI_Start`) of PETSc's scatters is counted by PETSc alone.
MESSAGES = {"MPI_Send": _SENT, "MPI_Isend": _LATER, "MPI_Issend": _LATER}
_HEAD = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <mpi.h>
typedef void (*hook_t)(const char *, const char *, long);
static hook_t hook;
void set_hook(hook_t to) { hook = to; }
static long bytes(int n, MPI_Datatype t) { int s = 0; PMPI_Type_size(t, &s); return (long)n * s; }
static long ranks(MPI_Comm c) { int n = 1; PMPI_Comm_size(c, &n); return n; }
static void tell(const char *name, void *from, long n)
{ Dl_info i; if (hook) hook(name, dladdr(from, &i) ? i.dli_fname : "", n); }
long (*unused)(MPI_Comm) = ranks;
"""
#: Part of a library's path -> whose calls it makes.
_OWNERS = {"mpi4py": "package", "petsc": "PETSc", "dolfinx": "DOLFINx", "mumps": "MUMPS"}


class Calls:
    """Counts calls, while it counts.

    Attributes:
        number: Calls by (owner, name).
        sent: Bytes that this rank gave to them, by the same.
        lines: Calls by (owner, name, file and line of Python).
    """

    def __init__(self) -> None:
        if "mpi4py.MPI" in sys.modules:
            raise RuntimeError("mpi4py is imported: make Calls before anything imports it")
        self.number, self.sent = Counter[Any](), Counter[Any]()
        self.lines = Counter[Any]()
        code = _HEAD + "".join(
            f'int {name}({given}) {{ tell("{name}", __builtin_return_address(0), {size}); '
            f"return P{name}({call}); }}\n"
            for name, (given, call, size) in (COLLECTIVE | MESSAGES).items()
        )
        with tempfile.TemporaryDirectory() as folder:
            source, made = Path(folder) / "calls.c", Path(folder) / "calls.so"
            source.write_text(code)
            subprocess.run(["mpicc", "-shared", "-fPIC", "-o", made, source, "-ldl"], check=True)
            # Global symbols that are there before mpi4py's libraries stand before MPI's own.
            self._library = ctypes.CDLL(str(made), mode=ctypes.RTLD_GLOBAL)
        self._kind = ctypes.CFUNCTYPE(None, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_long)
        self._hook = self._kind(self._count)

    def begin(self) -> None:
        """Count from now on, from zero."""
        for each in (self.number, self.sent, self.lines):
            each.clear()
        self._library.set_hook(self._hook)

    def end(self) -> None:
        """Count no longer."""
        self._library.set_hook(self._kind())

    def _count(self, name: bytes, library: bytes, size: int) -> None:
        path = library.decode().lower().rsplit("/lib/", 1)[-1]
        base = path.replace("petscdir", "")
        # The last that the path names: DOLFINx and mpi4py may lie in a folder of PETSc's.
        found = {k: base.rfind(k) for k in _OWNERS if k in base}
        owner = _OWNERS[max(found, key=found.__getitem__)] if found else "others"
        call = name.decode()
        self.number[owner, call] += 1
        self.sent[owner, call] += size
        frame = sys._getframe(1)
        while frame.f_code.co_filename.endswith("dolfinx_nts/parallel.py") and frame.f_back:
            frame = frame.f_back
        self.lines[owner, call, f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"] += 1
