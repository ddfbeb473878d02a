"""Parameters of materials: numbers, or Constants and Functions that may change between steps."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from ufl.corealg.traversal import traverse_unique_terminals

from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import UserFunctionError, is_finite

#: What a parameter may be; the latter two of a scalar, a Function e.g. of degree 0.
Parameter = float | fem.Constant | fem.Function


def is_number(value: Any) -> bool:
    """Return whether a parameter is a number, which stays what it is."""
    return not isinstance(value, fem.Constant | fem.Function)


def require_parameter(name: str, value: Any, fits: Callable[[Any], bool], wanted: str) -> None:
    """Raise ValueError unless all values of a parameter fit; of a Function on all ranks.

    Args:
        name: Of the parameter.
        value: A number, or a scalar Constant or Function.
        fits: Tells of a value whether it lies in an interval.
        wanted: What to say else, e.g. "must be positive and finite [Pa]".
    """
    if is_number(value):
        if not fits(value):
            raise ValueError(f"{name}={value!r}: {wanted}")
        return
    is_field, problem = isinstance(value, fem.Function), None
    if value.ufl_shape != ():
        problem = f"{name}={value!s}: has shape {value.ufl_shape}; pass a scalar"
    else:
        values = np.ravel(value.x.array if is_field else value.value)
        unfit = [v for v in (values.min(), values.max()) if not fits(v)] if len(values) else []
        if unfit:
            problem = f"{name} with a value of {float(unfit[0])!r}: {wanted}"
    if is_field:
        raise_together(value.function_space.mesh.comm, problem)
    elif problem is not None:
        raise ValueError(problem)


def require_positive_parameter(name: str, value: Any, unit: str) -> None:
    """Raise ValueError unless all values of a parameter are positive and finite."""
    wanted = f"must be positive and finite [{unit}]"
    require_parameter(name, value, lambda v: is_finite(v) and v > 0, wanted)


def require_finite_parameter(name: str, value: Any, unit: str) -> None:
    """Raise ValueError unless all values of a parameter are finite."""
    require_parameter(name, value, is_finite, f"pass a finite number [{unit}]")


def in_expressions(expressions: Iterable[Any], unknowns: Iterable[Any] = ()) -> list[Any]:
    """Constants and Functions in UFL expressions, but for the body's own unknowns."""
    found = dict.fromkeys(t for e in expressions for t in traverse_unique_terminals(e))
    own = list(unknowns)
    return [
        t
        for t in found
        if isinstance(t, fem.Constant | fem.Function) and not any(t is u for u in own)
    ]


def values_of(parameters: Iterable[Any]) -> FloatArray:
    """Values of Constants and Functions one after another, shape (n,)."""
    values = [p.value if isinstance(p, fem.Constant) else p.x.array for p in parameters]
    return np.concatenate([np.empty(0), *map(np.ravel, values)])


class Taken:
    """Values of Constants and Functions as something was made of them."""

    def __init__(self, parameters: Iterable[Any]) -> None:
        self._parameters = list(parameters)
        self.take()

    def take(self) -> None:
        """Take the values of now."""
        self._values = values_of(self._parameters)

    @property
    def changed(self) -> bool:
        """Whether they are others now, on this rank."""
        return not np.array_equal(values_of(self._parameters), self._values)


class WatchedParameters:
    """Constants and Functions in a body's energy and mass, which a caller may change.

    Args:
        comm: MPI communicator.
        name: Of the body, for messages.
        of_mass: Those in the mass.
        others: Those elsewhere.
        check: Raises ValueError where one is out of its range. Collective.

    Attributes:
        all: They.
    """

    def __init__(
        self, comm: MPI.Comm, name: str, of_mass: list[Any], others: list[Any],
        check: Callable[[], None],
    ) -> None:  # fmt: skip
        self._comm, self._name, self._check = comm, name, check
        self.all = [*others, *of_mass]
        self._taken = Taken(self.all), Taken(of_mass)

    def take(self) -> None:
        """Note the values of now, of which something was made."""
        for taken in self._taken:
            taken.take()

    def changed(self) -> tuple[bool, bool]:
        """Whether any, and any in the mass, has changed since on any rank. Collective.

        Raises:
            UserFunctionError: One is out of its range, on all ranks.
        """
        if not self.all:
            return False, False
        flags = np.array([taken.changed for taken in self._taken])
        self._comm.Allreduce(MPI.IN_PLACE, flags, op=MPI.LOR)
        problem, cause = None, None
        try:
            if flags[0]:
                self._check()
        except ValueError as error:
            problem, cause = f"a parameter of {self._name!r} has changed: {error}", error
        raise_together(self._comm, problem, UserFunctionError, cause)
        return bool(flags[0]), bool(flags[1])
