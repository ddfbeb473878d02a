"""The C files beside this, compiled once into a library, and how its kernels are called."""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import os
import platform
import shlex
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

_NAMES = (
    *("facets.h", "nts_element.h", "facets.c", "nts_element.c", "surface_points.c"),
    *("segments.c", "contact_law.h", "contact_law.c", "edges.c", "constraints.c", "node_sums.c"),
    "measures.c",
)
_SOURCES = [Path(__file__).with_name(name) for name in _NAMES]
_FLAGS = ["-std=c99", "-O2", "-ftree-vectorize", "-fno-math-errno", "-fno-trapping-math"]

#: What compiles, and where it comes from.
COMPILER = (
    "it takes a C compiler with the headers of C and Python, as in Debian's gcc, libc6-dev and "
    'python3-dev, or ziglang of PyPI with CC="python -m ziglang cc" in the environment'
)

_INT, _LONG, _REAL, _ARRAY = ctypes.c_int, ctypes.c_long, ctypes.c_double, ctypes.c_void_p
#: What begins where an array does.
_START: Any = ctypes.c_char * 0


class Facet(ctypes.Structure):
    """A kind of facet; see `facets.h`."""

    _fields_ = [  # noqa: RUF012
        *(("nc", _INT), ("degree", _INT), ("together", _INT)),
        ("coefficients", _ARRAY),
    ]


class Limits(ctypes.Structure):
    """Where projections end; see `facets.c`."""

    _fields_ = [("last_step", _REAL), ("far_step", _REAL), ("collinear", _REAL)]  # noqa: RUF012


class Law(ctypes.Structure):
    """Laws of contact and friction of pairs in a step; see `contact_law.c`."""

    _fields_ = [  # noqa: RUF012
        *((name, _ARRAY) for name in ("scale", "yielding", "none", "before")),
        *((name, _INT) for name in ("size", "row", "friction", "endless", "strong", "redundant")),
        *((name, _REAL) for name in ("coefficient", "pull", "uneven", "opening", "hardly")),
        *((name, _REAL) for name in ("width", "gap_width")),
        *((name, _ARRAY) for name in ("tangential_scale", "unmoved")),
        *((name, _ARRAY) for name in ("coefficients", "by_slip", "by_force")),
    ]


class Edges(ctypes.Structure):
    """Sharp edges of a boundary; see `edges.c`."""

    _fields_ = [  # noqa: RUF012
        ("nc", _INT),
        *((name, _ARRAY) for name in ("x", "way", "ends", "corners", "of_surface", "goes_on")),
    ]


class EdgeLimits(ctypes.Structure):
    """Which pairs of edges count; see `edges.c`."""

    _fields_ = [  # noqa: RUF012
        *((name, _REAL) for name in ("parallel", "end", "outside")),
        *((name, _REAL) for name in ("level", "steep", "flat", "by_node")),
    ]


class Cuts(ctypes.Structure):
    """Where pieces of facets end; see `segments.c`."""

    _fields_ = [(name, _REAL) for name in ("facing", "on", "nothing")]  # noqa: RUF012


class FieldTable(ctypes.Structure):
    """A Function in a form; see `cell_batches.c`."""

    _fields_ = [  # noqa: RUF012
        *(("values", _ARRAY), ("dofs", _ARRAY)),
        *(("blocks", _INT), ("size", _INT)),
    ]


#: Arguments of the loop in `cell_batches.c`.
ASSEMBLE = (_LONG, *(_ARRAY,) * 3, _INT, *(_ARRAY,) * 3)
_FACET, _LIMITS = ctypes.POINTER(Facet), ctypes.POINTER(Limits)
_EDGES = ctypes.POINTER(Edges)
#: Arguments of the kernels.
_KERNELS = {
    "project": (_FACET, _LIMITS, _LONG, *(_ARRAY,) * 4),
    "closest_point": (_FACET, _LIMITS, _LONG, *(_ARRAY,) * 4),
    "closest_facets": (
        *(_FACET, _LIMITS, _LONG, _ARRAY, _ARRAY),
        *(_LONG, _ARRAY, _ARRAY, _REAL, *(_ARRAY,) * 3),
    ),
    "closest_edges": (
        *(_EDGES, _EDGES, ctypes.POINTER(EdgeLimits)),
        *(_REAL, _REAL, _REAL, _LONG, *(_ARRAY,) * 7),
    ),
    "condensed": (_FACET, _INT, _ARRAY, _ARRAY, _INT, _LONG, *(_ARRAY,) * 13),
    "segments": (
        *(ctypes.POINTER(Cuts), _INT, _INT, _LONG, *(_ARRAY,) * 4),
        *(_LONG, _ARRAY, _ARRAY, _ARRAY),
    ),
    "points_of": (_INT, _INT, _LONG, *(_ARRAY,) * 4),
    "over_surface": (
        *(_FACET, _INT, _ARRAY, _ARRAY, _INT, _REAL, _INT, _LONG),
        *(_ARRAY,) * 21,
    ),
    "over_obstacle": (_INT, _INT, _LONG, *(_ARRAY,) * 17),
    "law_of_sums": (_INT, _INT, _INT, _LONG, *(_ARRAY,) * 5),
    "laws": (ctypes.POINTER(Law), _ARRAY, _LONG, *(_ARRAY,) * 17),
    "obstacle": (_INT, _REAL, _LONG, *(_ARRAY,) * 16),
    "to_nodes": (_INT, _INT, _INT, _LONG, *(_ARRAY,) * 6),
    "wrenches": (_INT, _LONG, *(_ARRAY,) * 5),
    "constraints": (_INT, _INT, _REAL, _LONG, *(_ARRAY,) * 12),
    "gradients": (_INT, _LONG, *(_ARRAY,) * 7),
    "forces_along": (*(_INT,) * 3, _REAL, _REAL, _LONG, *(_ARRAY,) * 14),
    "node_sums": (_INT, _INT, _LONG, *(_ARRAY,) * 5),
}


class NotMadeError(Exception):
    """A library cannot be made; says why and what to do in a line."""


class Beside:
    """A call in a thread beside what else there is to do; in a forked process it is made again.

    What it raises is raised by `result`.
    """

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call, self._process = partial(function, *arguments), os.getpid()
        self._found: list[Any] = []
        self._thread = Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._found = [self._call(), None]
        except Exception as error:  # any: it is raised where it is asked for
            self._found = [None, error]

    def result(self) -> Any:
        """What the function returns, once it does."""
        if os.getpid() == self._process:
            self._thread.join()
        if not self._found:
            self._run()
        value, error = self._found
        if error is not None:
            raise error
        return value


@contextmanager
def _alone(target: Path) -> Iterator[None]:
    """Let one thread of one process at a time make a file, if its file system has locks."""
    opened = os.open(target.with_suffix(".lock"), os.O_CREAT | os.O_RDWR)
    try:
        with suppress(OSError):
            fcntl.flock(opened, fcntl.LOCK_EX)
        yield
    finally:
        # A process that was forked meanwhile has it open, too.
        with suppress(OSError):
            fcntl.flock(opened, fcntl.LOCK_UN)
        os.close(opened)


def key(*parts: str) -> str:
    """What a library is made of, in 16 characters."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def made(name: str, command: Callable[[Path], list[str]], folder: Path | None = None) -> Any:
    """A library, made where it is not there.

    Ranks and processes that share the folder wait for the one that makes it.

    Args:
        name: Its file's, with the `key` of all that it is made of.
        command: An empty folder -> the compiler's flags and files.
        folder: Where it is kept; None: where DOLFINx keeps what it compiles, unless it is told
            another folder.

    Raises:
        NotMadeError: It can be neither made nor loaded.
    """
    if folder is None:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "fenics")
    try:
        target = folder.expanduser().resolve() / f"dolfinx_nts_{platform.machine()}_{name}.so"
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            with _alone(target):
                if not target.exists():
                    _make(target, command)
        try:
            return ctypes.CDLL(str(target))
        except OSError:  # what a full disk has left is of no use
            _make(target, command)
            return ctypes.CDLL(str(target))
    except subprocess.CalledProcessError as error:
        lines = (line.partition("error: ")[2] for line in error.stderr.splitlines())
        why = next(filter(None, lines), f"{error.cmd[0]} ends with status {error.returncode}")
        raise NotMadeError(f"{why}; {COMPILER}") from error
    except (OSError, RuntimeError) as error:  # pathlib's, without a home
        where = "set XDG_CACHE_HOME to a folder that can be written"
        raise NotMadeError(f"{error}; {where}") from error


def _make(target: Path, command: Callable[[Path], list[str]]) -> None:
    compiler = shlex.split(os.environ.get("CC", "cc"))
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        new = Path(folder, target.name)
        given = [*command(Path(folder)), "-shared", "-fPIC", "-o", str(new), "-lm"]
        try:
            subprocess.run([*compiler, *given], check=True, capture_output=True, text=True)
        except FileNotFoundError as error:
            raise NotMadeError(f"{error}; {COMPILER}") from error
        new.replace(target)


@lru_cache
def load() -> Any:
    """The library.

    Raises:
        NotMadeError: It can be neither found nor made.
    """
    of = key(" ".join(_FLAGS), *(source.read_text() for source in _SOURCES))
    try:
        compiled = [str(source) for source in _SOURCES if source.suffix == ".c"]
        library = made(of, lambda _: [*_FLAGS, *compiled])
    except NotMadeError as error:
        what = "the kernels of contact and joints cannot be compiled"
        raise NotMadeError(f"{what} ({error})") from error
    for name, arguments in _KERNELS.items():
        kernel = getattr(library, name)
        kernel.argtypes = arguments
    library.segments.restype = _LONG
    return library


def plain(value: Any) -> Any:
    """An array as kernels read it; anything else as it is."""
    return np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value


def pointer(value: Any) -> Any:
    """Where an array begins; anything else as it is."""
    return value.ctypes.data if isinstance(value, np.ndarray) else value


def _passed(value: Any) -> Any:
    """An array for a call, in an eighth of the time that its address takes; anything else as it is.

    The kernel may write into it if it is contiguous and may be written.
    """
    if not isinstance(value, np.ndarray):
        return value
    value = np.ascontiguousarray(value)
    return _START.from_buffer(value if value.flags.writeable else value.copy())


def run(function: Any, *arguments: Any) -> Any:
    """Call a kernel with arrays as pointers; those that it writes are contiguous."""
    return function(*[_passed(a) for a in arguments])
