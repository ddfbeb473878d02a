"""Stresses of a body as DOLFINx Functions, with which DOLFINx's own tools can go on."""

from __future__ import annotations

from typing import Any

import ufl
from dolfinx import fem

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.forms import assemble_vector, compile_forms
from dolfinx_nts.kernels.strain_energy import green_strain


def cauchy_stress(body: Any) -> Any:
    """Cauchy stress F S F^T / J at `body.u`, in the mean over each cell; collective.

    DOLFINx writes it, as it writes `body.u`, e.g. from the `write` of a writer of one's own:

        with dolfinx.io.XDMFFile(body.comm, "stress.xdmf", "w") as file:
            file.write_mesh(body.mesh)
            file.write_function(nts.cauchy_stress(body), stepper.state.time)

    A file that is kept open takes a Function at each time. `VTXWriter` (DOLFINx 0.9 and later, in
    a file without functions of other degrees) keeps one Function: fill its array each time with
    that of a new one. The values belong to the undeformed mesh; ParaView warps it by `body.u`.

    Args:
        body: Continuum with any material.

    Returns:
        Function of degree 0, a 3 x 3 tensor in each cell [Pa]. The mean is over the cell's
        reference volume.

    Raises:
        TypeError: The body has no material.
    """
    return _cell_means(body, _cauchy(body), "cauchy_stress")


def von_mises(body: Any) -> Any:
    """Von Mises measure of the Cauchy stress at `body.u`, in the mean over each cell; collective.

    It is the mean of the measure, not the measure of the mean that `cauchy_stress` gives; DOLFINx
    writes it in the same way.

    Args:
        body: Continuum with any material.

    Returns:
        Function of degree 0 [Pa].

    Raises:
        TypeError: The body has no material.
    """
    deviator = ufl.dev(_cauchy(body))
    return _cell_means(body, ufl.sqrt(1.5 * ufl.inner(deviator, deviator)), "von_mises")


def _cauchy(body: Any) -> Any:
    if getattr(body, "law", None) is None:
        name = getattr(body, "name", body)
        raise TypeError(f"body={name!r}: has no material W(C), so no stress; pass a Continuum")
    h = ufl.grad(body.u)
    law, means = body.energy()
    f, stress = ufl.Identity(3) + h, law.stress(green_strain(h))
    if means is not None:
        means.compile(body.u)
        means.evaluate()
    return f * stress * f.T / ufl.det(f)


def _cell_means(body: Any, value: Any, name: str) -> Any:
    """Means of a scalar or 3 x 3 tensor in UFL over each cell, as a Function. Collective."""
    space = compat.function_space(body.mesh, "DG", 0, value.ufl_shape)
    q, one = ufl.TestFunction(space), ufl.as_ufl(1.0)
    if value.ufl_shape:
        one = ufl.as_tensor([[1.0] * 3] * 3)
    dx = ufl.Measure("dx", body.mesh, metadata={"quadrature_degree": 2 * body.degree})
    forms = compile_forms([ufl.inner(value, q) * dx, ufl.inner(one, q) * dx])
    result, vector = fem.Function(space, name=name), petsc_compat.create_vector(space)
    sums = []
    for form in forms:
        assemble_vector(vector, form)
        sums.append(vector.array_r.copy())
    vector.destroy()
    result.x.array[: len(sums[0])] = sums[0] / sums[1]
    result.x.scatter_forward()
    return result
