"""Checks of arguments that name the argument, its value and a remedy, on every rank alike."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
import math
import numbers
import os
import traceback
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from mpi4py import MPI

import numpy as np

from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import Array, FloatArray, OfTime

T = TypeVar("T")
StrPath = str | os.PathLike[str]

#: Part of a function's value by which ranks may differ, as by sums in another order.
_ALIKE = 1e-9


class StepFailedError(RuntimeError):
    """A step was not solved; the message names the worst block, nodes and facets.

    Args:
        message: What failed.
        advises: Whether it says what to do, too.

    Attributes:
        part: Length of the step over that of the one asked for, where it was cut until it failed.
    """

    def __init__(self, message: str, *, advises: bool = False) -> None:
        super().__init__(message)
        self.advises, self.part = advises, 1.0


class UserFunctionError(StepFailedError, ValueError):
    """A function of the user's raised or returned what it must not; a smaller step mends nothing.

    The message says which and when, on all ranks alike; what it raised is `__cause__` on the rank
    where it did.
    """


class OutputError(RuntimeError):
    """A writer raised, which ended the run: a full disk, say.

    What it raised is `__cause__` on the rank where it did; the message is the same on all ranks.

    Attributes:
        solution: The `Solution` with everything computed until then; its status is the message.
    """

    def __init__(self, message: str, solution: Any) -> None:
        super().__init__(message)
        self.solution = solution


def known_options(target: T) -> T:
    """Decorate a function or class: what is passed by an unknown name or without one raises.

    It says which names are known, or that of the first option that is passed by its name only. To
    set an option of an object that has been made raises, too, as most of them are read only once.
    """
    wrapped: Any = target
    is_class = isinstance(target, type)
    function = wrapped.__init__ if is_class else wrapped
    parameters = inspect.signature(function).parameters
    known = [p for p in parameters if p not in ("self", "cls")]
    places = [n for n, p in parameters.items() if p.kind == p.POSITIONAL_OR_KEYWORD]
    named = [n for n, p in parameters.items() if p.kind == p.KEYWORD_ONLY]
    several = any(p.kind == p.VAR_POSITIONAL for p in parameters.values())

    @functools.wraps(function)
    def checked(*args: Any, **options: Any) -> Any:
        if len(args) > len(places) and named and not several:
            first = next((n for n in named if n not in options), named[0])
            without = ", ".join(n for n in places if n in known)
            raise TypeError(
                f"{first}={args[len(places)]!r}: {wrapped.__name__} takes no more than {without} "
                f"without names; pass other arguments by theirs, e.g. {first}=..."
            )
        for name in options:
            if name not in known:
                raise TypeError(
                    f"{name}={options[name]!r}: unknown option of {wrapped.__name__}; "
                    f"choose from {', '.join(known)}"
                )
        return function(*args, **options)

    if not is_class:
        decorated: Any = checked
        return decorated

    @functools.wraps(function)
    def made(self: Any, *args: Any, **options: Any) -> None:
        checked(self, *args, **options)
        # A user's class that derives from this one goes on.
        if type(self).__module__.partition(".")[0] == __name__.partition(".")[0]:
            object.__setattr__(self, "_made", True)

    def set_attribute(self: Any, name: str, value: Any) -> None:
        if name in known and name != "name" and getattr(self, "_made", False):
            label = f" {self.name!r}" if hasattr(self, "name") else ""
            raise AttributeError(
                f"{name}={value!r}: this {wrapped.__name__}{label} has been made with another "
                f"{name}; make a new one"
            )
        object.__setattr__(self, name, value)

    if dataclasses.is_dataclass(target):  # frozen, all of them
        wrapped.__init__ = checked
    else:
        wrapped.__init__, wrapped.__setattr__ = made, set_attribute
    return target


def is_finite(value: object) -> TypeGuard[float]:
    """Return whether the value is a finite real number; text and truth values are none."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)


def is_whole(value: object) -> TypeGuard[int]:
    """Return whether the value is a whole number; a truth value is none."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def require_positive(name: str, value: object, unit: str) -> None:
    """Raise ValueError unless the value is a positive, finite number."""
    if not (is_finite(value) and value > 0):
        raise ValueError(f"{name}={value!r}: must be positive and finite [{unit}]")


def require_bool(name: str, value: object) -> None:
    """Raise TypeError unless the value is True or False."""
    if not isinstance(value, bool):
        raise TypeError(f"{name}={value!r}: pass True or False")


def require_name(argument: str, value: object) -> None:
    """Raise TypeError or ValueError unless the value is text with something to read."""
    if not isinstance(value, str):
        raise TypeError(f"{argument}={value!r}: pass text, e.g. {argument}='block'")
    if not value.strip():
        raise ValueError(f"{argument}={value!r}: is empty; pass e.g. {argument}='block'")


def require_one_of(name: str, value: object, known: Iterable[str]) -> None:
    """Raise ValueError unless the value is one of the known texts."""
    known = tuple(known)
    if not (isinstance(value, str) and value in known):
        raise ValueError(f"{name}={value!r}: choose one of {', '.join(map(repr, known))}")


def floats(value: object) -> FloatArray:
    """The value as floats; an empty array where it is no array of real numbers, text included."""
    if hasattr(value, "ufl_shape"):  # UFL would take being asked for an array for Einstein's sum
        return np.empty(0)
    try:
        array = np.asarray(value)
        if array.dtype.kind in "iufO":
            return array.astype(np.float64)
    except (TypeError, ValueError):
        pass
    return np.empty(0)


def vector(name: str, value: object, unit: str, *, or_else: str = "") -> FloatArray:
    """The value as three finite components, shape (3,)."""
    array = floats(value)
    if array.shape != (3,) or not np.isfinite(array).all():
        other = f", or {or_else}" if or_else else ""
        raise ValueError(f"{name}={value!r}: pass three finite components [{unit}]{other}")
    return array


def direction(name: str, value: object) -> FloatArray:
    """A unit vector (3,) along a given one of any length."""
    given = vector(name, value, "-")
    largest = np.abs(given).max()
    if largest == 0.0:
        raise ValueError(f"{name}={value!r}: has no direction; pass a vector that is not zero")
    given = given / largest  # squares of the smallest and largest numbers are none
    return given / np.linalg.norm(given)


def vectors(name: str, value: object, what: str) -> FloatArray:
    """The value as rows of three finite components, shape (n, 3); a single one may be (3,)."""
    array = np.atleast_2d(floats(value))
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise ValueError(f"{name}={value!r}: pass {what} of shape (3,) or (n, 3)")
    return array


def require_same(comm: MPI.Comm, **given: Any) -> None:
    """Raise a ValueError on all ranks unless arguments have the same values there. Collective.

    Of functions only that they are some is compared.
    """
    shown = {name: as_text(value) for name, value in given.items()}
    digest = hashlib.sha256(repr(sorted(shown.items())).encode()).digest()
    if len(set(comm.allgather(digest))) == 1:
        return
    first = comm.bcast(shown)
    problem = None
    for name in first | shown:
        here, there = (known.get(name, "missing") for known in (shown, first))
        if here != there and problem is None:
            problem = (
                f"{name}: is {here} on rank {comm.rank} and {there} on rank 0; pass the same on "
                "all ranks"
            )
    raise_together(comm, problem)


def as_text(value: object) -> str:
    """What a value is made of, numbers and texts, in words that do not depend on the rank."""
    array = floats(value)
    if array.size:
        return repr(array.tolist())
    if value is None or isinstance(value, str | bool):
        return repr(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{k}: {as_text(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(as_text, value)) + "]"
    if is_dataclass(value) and not isinstance(value, type):
        parts = (f"{f.name}={as_text(getattr(value, f.name))}" for f in fields(value))
        return f"{type(value).__name__}({', '.join(parts)})"
    return "a function" if callable(value) else type(value).__name__


def items(name: str, value: object, fits: Callable[[Any], bool], wanted: str) -> tuple[Any, ...]:
    """The items of a sequence argument, all of the wanted kind."""
    if not isinstance(value, Iterable):
        raise TypeError(f"{name}={value!r}: pass a sequence of {wanted}")
    found = tuple(value)
    for k, item in enumerate(found):
        if isinstance(item, type):
            raise TypeError(
                f"{name}[{k}]={item!r}: is a class; pass objects made from it, "
                f"{item.__name__}(...)"
            )
        if not fits(item):
            raise TypeError(f"{name}[{k}]={item!r}: pass a sequence of {wanted}")
    return found


def _line(error: Exception) -> str:
    """The line of the user's file that led to an error, if there is one."""
    own = Path(__file__).parent
    frames = [
        frame for frame in traceback.extract_tb(error.__traceback__)
        if own not in Path(frame.filename).parents
    ]  # fmt: skip
    lines = [frame.lineno for frame in frames if frame.filename == frames[0].filename]
    return f", line {lines[-1]} of {Path(frames[0].filename).name}" if lines else ""


def call_together(
    comm: MPI.Comm, name: str, function: Callable[..., Any], *arguments: Any, shown: Any = None
) -> Any:
    """Call the user's function; what it raises on one rank is raised on all.

    Args:
        comm: MPI communicator.
        name: Name of the argument, and when it is called.
        function: What every rank calls.
        *arguments: Its arguments.
        shown: What the user has given, where `function` is made from it.

    Raises:
        UserFunctionError: It raised on some rank.
    """
    problem, cause, value = None, None, None
    try:
        value = function(*arguments)
    except Exception as error:  # any: a rank that raises alone would leave the others waiting
        what = function if shown is None else shown
        cause, problem = error, f"{name}: {what!r} raised {error!r}{_line(error)}; correct it"
    raise_together(comm, problem, UserFunctionError, cause)
    return value


def at_time(
    comm: MPI.Comm, name: str, function: OfTime, time: float, unit: str
) -> FloatArray:
    """The user's vector at a time, shape (3,); what fails on one rank raises on all.

    So does one that differs between ranks by more than rounding.

    Args:
        comm: MPI communicator.
        name: Name of the argument.
        function: Callable time [s] -> three components.
        time: [s].
        unit: Of the components.

    Raises:
        UserFunctionError: It raised, or returned anything but the same three finite numbers on all
            ranks.
    """
    label = f"{name} at t={float(time)!r}"
    value = floats(given := call_together(comm, label, function, time))
    problem = None
    if value.shape != (3,) or not np.isfinite(value).all():
        shown = given.item() if isinstance(given, np.generic) else given  # NumPy 2 adds a type
        problem = f"{label}: returned {shown!r}; pass three finite components [{unit}]"
        value = np.zeros(3)
    agree(comm, label, value, problem)
    return value


def agree(comm: MPI.Comm, label: str, value: FloatArray, problem: str | None) -> None:
    """Raise on all ranks what is wrong with a function's value on one, or if values differ.

    Args:
        comm: MPI communicator.
        label: What the function is for, and when it was called.
        value: What it returned here, of the same shape on all ranks.
        problem: What is wrong with it.

    Raises:
        UserFunctionError: As above; the largest numbers may differ by rounding.
    """
    gathered = comm.allgather((problem, value.tolist()))
    problem = next((p for p, _ in gathered if p is not None), None)
    first = np.array(gathered[0][1])
    for rank, (_, other) in enumerate(gathered):
        size = max(np.abs(first).max(), np.abs(other).max())
        if problem is None and np.abs(first - other).max() > _ALIKE * size:
            problem = (
                f"{label}: is {other} on rank {rank} and {first.tolist()} on rank 0; return the "
                "same on all ranks"
            )
    if problem is not None:
        raise UserFunctionError(problem)


def vector_in_time(comm: MPI.Comm, name: str, value: Any, time: float, unit: str) -> FloatArray:
    """A vector, or a function of time at a time, for which every rank must call this."""
    is_function = callable(value) and not hasattr(value, "ufl_shape")  # UFL's can be called, too
    return at_time(comm, name, value, time, unit) if is_function else vector(name, value, unit)


def number_at(
    comm: MPI.Comm, name: str, function: OfTime, t: float, unit: str
) -> float:
    """The user's number at a time; what fails on one rank raises on all.

    Raises:
        UserFunctionError: It raised, or returned anything but the same finite number on all ranks.
    """
    name = f"{name} at t={float(t)!r}"
    value = floats(given := call_together(comm, name, function, t))
    fits = value.size == 1 and is_finite(value.item())
    problem = None if fits else f"{name}: returned {given!r}; return a finite number [{unit}]"
    number = float(value.item()) if fits else 0.0
    agree(comm, name, np.array([number]), problem)
    return number


def at_points(
    comm: MPI.Comm, name: str, function: Callable[[Any], Any], x: FloatArray, rows: tuple[int, ...],
    kinds: str = "iuf", error: type[Exception] = ValueError,
) -> Array:  # fmt: skip
    """The user's function at this rank's points; what fails on one rank raises on all.

    Args:
        comm: MPI communicator.
        name: Name of the argument.
        function: Callable x (3, n) -> (*rows, n).
        x: Points [m], shape (3, n).
        rows: Leading shape of the result.
        kinds: NumPy's kinds that the result may be of, "b" for truth values.
        error: What to raise.
    """
    problem, cause, shape, values = None, None, (*rows, x.shape[1]), np.empty(0)
    try:
        values = np.asarray(function(x))
    except Exception as caught:  # any: a rank that raises alone would leave the others waiting
        problem = f"{name}={function!r}: raised {caught!r} for x of shape {x.shape}; correct it"
        cause = caught
    else:
        if values.shape != shape:
            problem = (
                f"{name}={function!r}: returned shape {values.shape} for x of shape {x.shape}; "
                f"return shape {shape}"
            )
        elif values.size and values.dtype.kind not in kinds:
            wanted = "truth values, e.g. x[0] < 1e-9" if kinds == "b" else "real numbers"
            problem = f"{name}={function!r}: returned {values.dtype} values; return {wanted}"
        elif values.size and not np.isfinite(values).all():
            bad = x[:, np.flatnonzero(~np.isfinite(values.reshape(-1, x.shape[1])).all(axis=0))[0]]
            problem = f"{name}={function!r}: not finite at x={bad.tolist()}; check it for NaN"
    raise_together(comm, problem, error, cause)
    return values


def as_path(name: str, value: object) -> Path:
    """The path that an argument is.

    Raises:
        TypeError: It is none.
    """
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name}={value!r}: pass a path, e.g. {name}='out/run'")
    return Path(value)
