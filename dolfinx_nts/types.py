"""Names that annotations use: arrays by what they hold, and what users hand over."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]
BoolArray = npt.NDArray[np.bool_]
#: Of any of these.
Array = npt.NDArray[Any]

#: Three numbers, and several of these.
Vector: TypeAlias = Sequence[float] | FloatArray
Vectors: TypeAlias = Sequence[Vector] | FloatArray
#: Numbers, or a function of x (3, n) that returns them at n points.
Values: TypeAlias = float | Vector | Callable[..., Any]
#: A function of time [s].
OfTime: TypeAlias = Callable[[float], Any]
#: Where something holds: a function of x (3, n) that says so at n points, or meshtags.
Marker: TypeAlias = Callable[..., Any] | Any
#: One or several points or vectors [m].
Places: TypeAlias = Vector | Vectors
#: Further virtual work in UFL, of displacement, velocity, test function and time.
ExtraForm: TypeAlias = Callable[[Any, Any, Any, Any], Any]
#: Forms in UFL of a body: of its mass (v, w), of its energy (C or F, ...).
MassForm: TypeAlias = Callable[[Any, Any], Any]
Energy: TypeAlias = Callable[..., Any]
#: What is called before every attempt at a step, with its time [s] and length [s].
BeforeStep: TypeAlias = Callable[[float, float], Any]
#: What something was made of, by name, for restarts and files.
Settings: TypeAlias = dict[str, Any]
#: PETSc options of a user.
Options: TypeAlias = Mapping[str, Any]
#: One row of a balance table or of a study, by column.
BalanceRow: TypeAlias = Mapping[str, Any]
#: Rows of a study.
Rows: TypeAlias = list[dict[str, Any]]
