"""What all ranks do together: gather, agree on a maximum or a problem, leave work to one."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Generator, Iterable
from functools import cache
from typing import Any, TypeVar

from mpi4py import MPI

import numpy as np

from dolfinx_nts.kernels import library
from dolfinx_nts.types import Array, FloatArray, IntArray

T = TypeVar("T")
#: Work that asks all ranks now and then, see `together`.
Asking = Generator[Any, Any, T]


def rank_of(name: str, comm: MPI.Comm) -> int:
    """Rank that holds an item that lives on one rank, the same in every run.

    Names that differ in their last number are dealt one by one, others by chance.
    """
    numbers = re.findall(r"\d+", name)
    stem = zlib.crc32(re.sub(r"\d+", "", name).encode())
    return (stem + int(numbers[-1] if numbers else 0)) % int(comm.size)


def gather_rows(comm: MPI.Comm, rows: Array, counts: IntArray | None = None) -> Array:
    """Rows of all ranks in rank order, on every rank.

    Args:
        comm: MPI communicator.
        rows: This rank's.
        counts: How many each rank has, if that is known: then ranks need not tell each other, and
            rows of one type and width travel in one call.
    """
    if comm.size == 1:  # pickling takes longer than the rows
        return rows.copy()
    if counts is None:
        return np.concatenate(comm.allgather(rows))
    out = np.empty((int(counts.sum()), *rows.shape[1:]), dtype=rows.dtype)
    width = int(np.prod(rows.shape[1:]))
    comm.Allgatherv(np.ascontiguousarray(rows), [out, (counts * width).tolist()])
    return out


def gather_on_root(comm: MPI.Comm, rows: Array) -> Array:
    """Rows of all ranks in rank order on rank 0, none elsewhere."""
    parts = comm.gather(rows)
    return rows[:0] if parts is None else np.concatenate([p for p in parts if len(p)] or parts)


def global_max(comm: MPI.Comm, values: FloatArray) -> FloatArray:
    """Largest of each value over all ranks, on every rank."""
    return _over_ranks(comm, values, MPI.MAX)


def global_sum(comm: MPI.Comm, values: FloatArray) -> FloatArray:
    """Sum of each value over all ranks, on every rank."""
    return _over_ranks(comm, values, MPI.SUM)


def _over_ranks(comm: MPI.Comm, values: FloatArray, op: Any) -> FloatArray:
    out = np.array(values, dtype=np.float64)
    if comm.size > 1:
        comm.Allreduce(MPI.IN_PLACE, out, op=op)
    return out


def sums_and_largest(
    comm: MPI.Comm, sums: FloatArray, sizes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Sums of some values (n,) and largest of others (m,) over all ranks, in one call. Collective.

    Unlike MPI's, this maximum is NaN if one is.
    """
    if comm.size == 1:
        return sums.copy(), sizes.copy()
    # One item of a type of its own: MPI may cut several up, and give an operation the parts.
    out = np.concatenate([[float(len(sums))], sums, sizes])
    item = MPI.DOUBLE.Create_contiguous(len(out)).Commit()
    comm.Allreduce(MPI.IN_PLACE, [out, 1, item], op=_sum_and_largest())
    item.Free()
    return out[1 : 1 + len(sums)], out[1 + len(sums) :]


@cache
def _sum_and_largest() -> MPI.Op:
    def reduce(given: Any, to: Any, _: MPI.Datatype) -> None:
        a, b = np.frombuffer(given), np.frombuffer(to)
        n = 1 + int(a[0])
        b[1:n] += a[1:n]
        np.maximum(a[n:], b[n:], out=b[n:])

    return MPI.Op.Create(reduce, commute=True)


def anywhere(comm: MPI.Comm, flag: bool) -> bool:
    """Whether it holds on any rank, on every rank."""
    # A number: mpi4py sends a flag pickled, in messages and two broadcasts.
    return bool(global_max(comm, np.array([float(flag)]))[0])


def everywhere(comm: MPI.Comm, flag: bool) -> bool:
    """Whether it holds on all ranks, on every rank."""
    return not anywhere(comm, not flag)


def together(comm: MPI.Comm, works: Iterable[Asking[T]]) -> list[T]:
    """Results of works that ask all ranks, those of one round in the same calls. Collective.

    A work yields a flag and is sent whether any rank has it, or two arrays and is sent sums of the
    first one and the largest of the second one, without axes, or rows and is sent those of all
    ranks, in rank order. Works and what each asks, in order, are the same on all ranks.
    """
    of = list(works)
    results: list[Any] = [None] * len(of)
    answers: dict[int, Any] = dict.fromkeys(range(len(of)))
    while answers:
        flags, rows = dict[int, bool](), dict[int, Array]()
        pairs = dict[int, tuple[FloatArray, FloatArray]]()
        for k, answer in answers.items():
            try:
                asked = of[k].send(answer)
            except StopIteration as end:
                results[k] = end.value
            else:
                kind: dict[int, Any] = rows if isinstance(asked, np.ndarray) else flags
                if isinstance(asked, tuple):
                    kind = pairs
                kind[k] = asked
        answers = {}
        if flags or pairs:
            answers.update(_reduced(comm, flags, pairs))
        if rows:
            own = list(rows.values())
            ranks = comm.allgather(own) if comm.size > 1 else [own]
            answers.update(zip(rows, map(np.concatenate, zip(*ranks, strict=True)), strict=True))
    return results


def _reduced(
    comm: MPI.Comm, flags: dict[int, bool], pairs: dict[int, tuple[FloatArray, FloatArray]]
) -> dict[int, Any]:
    """Answers to those who ask for flags, and to those who ask for sums and maxima, in one call."""
    given = [np.empty(0)], [np.array(list(flags.values()), dtype=np.float64)]
    for pair in pairs.values():
        for each, own in zip(given, pair, strict=True):
            each.append(own.ravel())
    found = sums_and_largest(comm, *map(np.concatenate, given))
    (_, *sums), (held, *sizes) = (
        np.split(all_of, np.cumsum([len(own) for own in each])[:-1])
        for all_of, each in zip(found, given, strict=True)
    )
    answers: dict[int, Any] = dict(zip(flags, (held > 0.0).tolist(), strict=True))
    return answers | dict(zip(pairs, zip(sums, sizes, strict=True), strict=True))


def first_problem(comm: MPI.Comm, problem: str | None) -> str | None:
    """The first rank's problem, on every rank."""
    # Mostly there is none, and a flag is one call where texts are two.
    if not anywhere(comm, problem is not None):
        return None
    return next(p for p in comm.allgather(problem) if p is not None)


def raise_together(
    comm: MPI.Comm, problem: str | None, kind: Callable[[str], Exception] = ValueError,
    cause: Exception | None = None,
) -> None:  # fmt: skip
    """Raise with the first rank's problem on every rank, if any rank has one."""
    found = first_problem(comm, problem)
    if found is not None:
        raise kind(found) from cause


def on_root(comm: MPI.Comm, work: Callable[[], T]) -> T | None:
    """Run `work` on rank 0 and return its result there; what it raises is raised on every rank."""
    result, error = None, None
    if comm.rank == 0:
        try:
            result = work()
        except Exception as caught:  # Gmsh raises nothing more special; the other ranks wait
            error = caught
    error = comm.bcast(error)
    if error is not None:
        raise error
    return result


def write_on_root(comm: MPI.Comm, what: str, action: Callable[[], Any]) -> Any:
    """Let rank 0 write; its result there. If it fails, every rank raises.

    Args:
        comm: MPI communicator.
        what: Argument that names the file, and its value.
        action: What rank 0 does.

    Raises:
        OSError: The file cannot be written; the message says what to do.
        RuntimeError: Rank 0 failed otherwise.
    """
    result, cause, problem = None, None, None
    if comm.rank == 0:
        try:
            result = action()
        except Exception as error:  # any: a rank left alone in a collective call would hang
            cause, problem = error, (isinstance(error, OSError), f"{error or repr(error)}")
    problem = comm.bcast(problem)
    if problem is None:
        return result
    if not problem[0]:
        raise RuntimeError(f"{what}: rank 0 failed: {problem[1]}") from cause
    raise OSError(
        f"{what}: cannot be written ({problem[1]}); pass a place that exists or can be made, with "
        "space and write permission"
    ) from cause


def need_kernels(comm: MPI.Comm) -> None:
    """Compile the kernels of contact and joints where they are not there. Collective.

    Raises:
        RuntimeError: On all ranks, if one of them cannot.
    """
    problem = None
    try:
        library.load()
    except library.NotMadeError as error:
        problem = str(error)
    raise_together(comm, problem, RuntimeError)
