"""What FFCx has written for one cell, run on several cells at once.

A form of a body is some hundred operations in each quadrature point of a cell, one after the other.
A processor does each of them on four or eight numbers in the time that it takes for one. So the C
code of FFCx is compiled once more, with a number of each of as many cells in place of each number
(cross-element vectorization: Sun, Mitchell, Kulkarni, Kloeckner, Ham and Kelly 2020). Operations
and their order stay, and so do results but for rounding.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.kernels import library
from dolfinx_nts.types import FloatArray, IntArray

_LOOP = Path(__file__).with_name("cell_batches.c")
#: The processor's own instructions. A fused product and sum rounds once where C rounds twice.
_FLAGS = ["-std=gnu11", "-O2", "-ftree-vectorize", "-march=native", "-g0"]
_FLAGS += ["-fno-math-errno", "-fno-trapping-math", "-Wno-psabi"]
_REAL = r"\1Real \2 EACH(\3);"
#: Cells on which a new kernel is compared with FFCx's, no multiple of what runs at once.
_COMPARED = 11
#: Parts of their size by which coordinates and values differ there: the second where an energy is
#: not defined for the first.
_WARPED = 0.05, 1e-3
#: Part of the largest entry by which they may differ: rounding where the code cancels digits.
_AGREE = 1e-8


class Shape(NamedTuple):
    """How many numbers a kernel has of one cell.

    Attributes:
        coordinates: Coordinates of the cell's nodes.
        coefficients: Of all Functions.
        entries: What it adds to.
        block: Entries of each of its nodes.
    """

    coordinates: int
    coefficients: int
    entries: int
    block: int


def _body(code: str) -> str:
    """The body of the only kernel in FFCx's C code, with `Real` variables for `cell_batches.c`.

    Raises:
        ValueError: There is another number of kernels.
    """
    (found,) = re.finditer(r"\bvoid tabulate_tensor_\w+\([^)]*\)\s*\{", code)
    begin = end = found.end()
    depth = 1
    while depth:
        depth += {"{": 1, "}": -1}.get(code[end], 0)
        end += 1
    parts = re.split(r"(static const double [^;]*;)", code[begin : end - 1])
    # Every other part is a table, which all cells share.
    parts[::2] = [_for_lanes(part) for part in parts[::2]]
    return "".join(parts)


def _for_lanes(code: str) -> str:
    """Statements with `Real` in place of numbers, and `Mask` in place of bool."""
    code = _with_select(code)
    # So that what is true of Constants is a mask, as what is true of fields.
    code = re.sub(r"\bc\[\d+\]", r"EACH(\g<0>)", code)
    for of_numbers, of_masks in (("&&", "&"), (r"\|\|", "|"), ("!(?!=)", "~")):
        code = re.sub(of_numbers, of_masks, code)
    code = re.sub(r"\bbool (\w+) = ", r"Mask \1 = ", code)
    code = re.sub(r"^( *)(?:const )?(?:double|int) (\w+ =) ([^;]*);", _REAL, code, flags=re.M)
    code = re.sub(r"\b(?:const )?double (\w+)\[", r"Real \1[", code)
    return re.sub(r"^( *\w+\[[^=;]*\] =) ([^;]*);", r"\1 EACH(\2);", code, flags=re.M)


def _with_select(code: str) -> str:
    """Conditional expressions as calls of SELECT."""
    while (mark := code.rfind("?")) >= 0:
        begin, colon = _border(code, mark, -1), _border(code, mark, 1)
        end = _border(code, colon, 1)
        parts = code[begin + 1 : mark], code[mark + 1 : colon], code[colon + 1 : end]
        code = f"{code[: begin + 1]} SELECT({','.join(parts)}){code[end:]}"
    return code


def _border(code: str, start: int, step: int) -> int:
    """Where an operand of a conditional expression ends, from one of its marks on."""
    depth, k = 0, start + step
    while True:
        depth += step * {"(": 1, "[": 1, ")": -1, "]": -1}.get(code[k], 0)
        assigns = code[k] == "=" and code[k - 1] not in "=<>!" and code[k + 1] != "="
        if depth < 0 or (depth == 0 and (code[k] in "?:;,{}" or assigns)):
            return k
        k += step


def load(code: str, shape: Shape, folder: Path, flags: Sequence[str]) -> Any:
    """The loop over cells with a kernel, in a library.

    Args:
        code: C code with one kernel as FFCx writes it.
        shape: Sizes of the kernel.
        folder: Where the library is kept.
        flags: More of the compiler's flags, which count more than ours.

    Raises:
        library.NotMadeError: It cannot be made.
    """
    sizes = [f"-D{name.upper()}={value}" for name, value in shape._asdict().items()]
    given = [*_FLAGS, *flags, *sizes]

    def command(empty: Path) -> list[str]:
        kernel = empty / "kernel.c"
        kernel.write_text(body)
        return [*given, f'-DKERNEL="{kernel}"', str(_LOOP)]

    try:
        body = _body(code)
    except (ValueError, LookupError) as error:
        raise library.NotMadeError("FFCx's code is not understood") from error
    key = library.key(body, _LOOP.read_text(), *given, _processor())
    loop = library.made(f"cells_{key}", command, folder).assemble
    loop.argtypes = library.ASSEMBLE
    return loop


@lru_cache
def _processor() -> str:
    """What the machine's processor can do, as a folder may be shared by different ones."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


class Field(NamedTuple):
    """A Function in a form.

    Attributes:
        values: Its values, which the form takes as they are at each evaluation, shape (n,).
        dofs: Blocks of the cells, shape (cells, blocks).
        size: Values of a block.
    """

    values: FloatArray
    dofs: IntArray
    size: int


class CellBatches:
    """Sums a form over cells, several at once.

    Args:
        loop: As of `load`.
        nodes: Numbers of each cell's nodes, shape (cells, nodes).
        x: Their coordinates [m], shape (n, 3).
        dofs: Blocks of the cells in what they are added to, shape (cells, blocks).
        fields: Of the form.
    """

    def __init__(
        self, loop: Any, nodes: IntArray, x: FloatArray, dofs: IntArray, fields: Sequence[Field]
    ) -> None:
        numbers = nodes, dofs, *(f.dofs for f in fields)
        whole = [np.ascontiguousarray(a, dtype=np.int32) for a in numbers]
        given = [
            library.FieldTable(f.values.ctypes.data, of.ctypes.data, of.shape[1], f.size)
            for f, of in zip(fields, whole[2:], strict=True)
        ]
        table = (library.FieldTable * len(given))(*given)
        self._held = whole, x, list(fields), table
        places = whole[0].ctypes.data, x.ctypes.data, whole[1].ctypes.data
        self._run = partial(loop, len(nodes), *places, len(given), table)

    def add(self, constants: FloatArray, out: FloatArray) -> None:
        """Add the form.

        Args:
            constants: As DOLFINx packs them, shape (constants,).
            out: What it is added to, contiguous, shape (blocks times their size,).
        """
        library.run(self._run, constants, out)


def difference(
    loop: Any,
    kernel: Any,
    shape: Shape,
    x: FloatArray,
    coefficients: FloatArray,
    constants: FloatArray,
) -> str:
    """What speaks against a kernel beside FFCx's, on cells and with values near given ones.

    Args:
        loop: As of `load`.
        kernel: FFCx's.
        shape: Sizes of both.
        x: Coordinates of one cell's nodes [m], shape (nodes, 3).
        coefficients: Values of this cell, shape (coefficients,); those that are zero are taken for
            displacements.
        constants: Of the form.

    Returns:
        In words; empty if nothing does.
    """
    rng = np.random.default_rng(0)
    edges = np.linalg.norm(x[:, None] - x, axis=2)
    size = float(edges[edges > 0.0].min())
    sizes = np.where(coefficients == 0.0, size, np.abs(coefficients))
    # Far from the origin rounding would differ.
    x = x - x[0]
    nodes = np.arange(_COMPARED * len(x)).reshape(_COMPARED, -1)
    dofs = np.arange(_COMPARED * shape.entries // shape.block).reshape(_COMPARED, -1)
    of_cells = np.arange(_COMPARED * shape.coefficients).reshape(_COMPARED, -1)
    for part in _WARPED:
        places = x + part * size * rng.uniform(-1.0, 1.0, (_COMPARED, *x.shape))
        w = coefficients + part * sizes * rng.uniform(-1.0, 1.0, (_COMPARED, shape.coefficients))
        found, expected = np.zeros((2, _COMPARED, shape.entries))
        for one, of_cell, place in zip(expected, w, places, strict=True):
            library.run(kernel, one, of_cell, constants, place, None, None, None)
        field = Field(w.ravel(), of_cells, 1)
        batches = CellBatches(loop, nodes, places.reshape(-1, 3), dofs, [field])
        batches.add(constants, found.reshape(-1))
        limit = _AGREE * np.abs(expected[np.isfinite(expected)]).max(initial=0.0)
        if not np.allclose(found, expected, rtol=0.0, atol=limit, equal_nan=True):
            return "it differs from FFCx's"
        if np.isfinite(expected).all(axis=1).any():
            return ""
    return "it is not finite where it would be compared with FFCx's"
