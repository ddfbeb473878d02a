"""Forms in UFL that users hand to a body: checks before they are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import ufl

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.solid.materials import misfit
from dolfinx_nts.parallel import raise_together


def checked_form(
    body: Any, what: str, make: Callable[[], Any], wanted: set[Any], else_: str, remedy: str
) -> Any:
    """A form of the user's; what is wrong with it raises on every rank.

    Args:
        body: Whose mesh it is of.
        what: Argument that it comes from, and its value.
        make: Makes it.
        wanted: Its test and trial functions.
        else_: What to say if it has others.
        remedy: What to do.

    Raises:
        TypeError: It is none, or cannot be compiled on this mesh.
    """
    problem, cause, form, domain = None, None, None, body.mesh.ufl_domain()
    try:
        with compat.without_floats():
            form = make()
        arguments = set(form.arguments()) if isinstance(form, ufl.Form) else set()
    except Exception as error:  # any: a rank that raises alone would leave the others waiting
        problem, cause = f"raised {error!r}; {remedy}", error
    else:
        if not isinstance(form, ufl.Form):
            problem = f"returned an object of type {type(form).__name__}; {remedy}"
        elif arguments != wanted:
            problem = f"{else_}; {remedy}"
        elif any(d != domain for d in form.ufl_domains()):
            problem = "has a measure of another mesh; use ufl.dx, or one of the body's mesh"
        else:
            problem = misfit([part.integrand() for part in form.integrals()], domain)
    text = f"{what} of {body.name!r}: {problem}"
    raise_together(body.comm, text if problem else None, TypeError, cause)
    return form
