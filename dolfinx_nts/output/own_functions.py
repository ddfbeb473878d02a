"""Functions of a user's own beside the fields of a body: stress, damage, temperature."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from dolfinx import fem

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import items

#: A Function, or what makes one of a body, as `von_mises` does.
Own: TypeAlias = fem.Function | Callable[[Any], fem.Function]


class OwnField(NamedTuple):
    """Values of a Function on this rank.

    Attributes:
        name: Its name.
        on_cells: Whether there is one of each owned cell, else of each local node of the mesh.
        values: Shape (cells or nodes,), (..., 3) or (..., 3, 3).
    """

    name: str
    on_cells: bool
    values: FloatArray


def checked(functions: Iterable[Any]) -> tuple[Own, ...]:
    """The argument `functions` of a writer."""
    wanted = "Functions, or callables body -> Function such as dolfinx_nts.von_mises"
    return items("functions", functions, _fits, wanted)


def _fits(given: Any) -> bool:
    """Whether it may be one of them; other expressions of UFL can be called, but of points."""
    return isinstance(given, fem.Function) or (callable(given) and not hasattr(given, "ufl_shape"))


def require_meshes(functions: Sequence[Own], bodies: Iterable[Body]) -> None:
    """Raise ValueError if a Function is on the mesh of none of the bodies."""
    known = [body.mesh.ufl_domain() for body in bodies]
    for k, given in enumerate(functions):
        if isinstance(given, fem.Function) and given.function_space.mesh.ufl_domain() not in known:
            raise ValueError(
                f"functions[{k}]={given!s}: is on none of the bodies' meshes; make it on body.mesh"
            )


def of_body(functions: Sequence[Own], body: Body, taken: Iterable[str]) -> list[OwnField]:
    """What is to be written of a body. Collective.

    Args:
        functions: A Function is written with the body on whose mesh it is; a callable is called of
            each body with a material.
        body: A body with a mesh.
        taken: Names of its other fields.

    Raises:
        TypeError: A callable returns no Function.
        ValueError: A Function has no value at each node or in each cell, or the name of another
            field.
    """
    found, domain, names = [], body.mesh.ufl_domain(), set(taken)
    for k, given in enumerate(functions):
        what = f"functions[{k}] of body {body.name!r}"
        function: Any = given
        if not isinstance(given, fem.Function):
            if body.law is None:
                continue
            function = made(what, given, body)
        if function.function_space.mesh.ufl_domain() == domain:
            found.append(_field(f"functions[{k}]", function, body))
            if function.name in names:
                raise ValueError(
                    f"{what}: there is another field {function.name!r} in its file; give this one "
                    "a name of its own, e.g. function.name = 'damage'"
                )
            names.add(function.name)
    return found


def made(what: str, make: Callable[[Any], fem.Function], body: Body) -> Any:
    """The Function that a callable makes of a body. Collective."""
    function: Any = make(body)
    wrong = not isinstance(function, fem.Function)
    text = f"{what}: {make!r} returned {function!r}; return a dolfinx Function"
    raise_together(body.comm, text if wrong else None, TypeError)
    return function


def _field(what: str, function: Any, body: Body) -> OwnField:
    space, shape = function.function_space, function.ufl_shape
    function.x.scatter_forward()
    values = function.x.array.reshape(-1, int(np.prod(shape, dtype=int)))
    dofs, owned = compat.cell_dofs(space), body.mesh.topology.index_map(body.mesh.topology.dim)
    on_cells = dofs.shape[1] == 1
    problem = None
    if shape not in ((), (3,), (3, 3)) or space.dofmap.index_map_bs != values.shape[1]:
        problem = f"has shape {shape}; pass scalars, 3-vectors or 3 x 3 tensors"
    elif on_cells:
        values = values[dofs[: owned.size_local, 0]]
    elif compat.is_nodal(space, body.mesh):
        values = values[compat.node_blocks(body.mesh, space)]
    else:
        problem = (
            "has other values than one at each node or in each cell; interpolate it into a "
            "Lagrange space of degree 1, or a DG space of degree 0"
        )
    text = f"{what}={function!s} of body {body.name!r}: {problem}"
    raise_together(body.comm, text if problem else None)
    return OwnField(function.name, on_cells, values.reshape(-1, *shape))
