"""Stresses of a body as DOLFINx Functions, with which DOLFINx's own tools can go on."""

from __future__ import annotations

import math
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import ufl
from dolfinx import fem

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts import petsc_compat
from dolfinx_nts.bodies.solid.cell_means import CellMeans, EntriesOfCells
from dolfinx_nts.forms import compile_forms
from dolfinx_nts.kernels.strain_energy import green_strain
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import require_one_of


def cauchy_stress(body: Any, *, at: str = "nodes") -> Any:
    """Cauchy stress F S F^T / J at `body.u`; collective.

    DOLFINx writes it, as it writes `body.u`, e.g. from the `write` of a writer of one's own:

        with dolfinx.io.XDMFFile(body.comm, "stress.xdmf", "w") as file:
            file.write_mesh(body.mesh)
            file.write_function(nts.cauchy_stress(body), stepper.state.time)

    A file that is kept open takes a Function at each time. `VTXWriter` (DOLFINx 0.9 and later, in
    a file without functions of other degrees) keeps one Function: fill its array each time with
    that of a new one. The values belong to the undeformed mesh; ParaView warps it by `body.u`.

    Args:
        body: Continuum with any material.
        at: "nodes": at the corners of cells, the mean of the cells around each, of what follows in
            each cell from the stress at its Gauss points, where it is most exact; where materials
            meet, the mean of both. "cells": the mean over each cell's reference volume.

    Returns:
        Function of degree 1, or 0 in cells, a 3 x 3 tensor [Pa].

    Raises:
        TypeError: The body has no material.
        ValueError: `at` is out of range.
    """
    return _of(body, "cauchy_stress", at)


def von_mises(body: Any, *, at: str = "nodes") -> Any:
    """Von Mises measure of the Cauchy stress at `body.u`; collective.

    It is the mean of the measure in cells, or of that of the stress at the corners of the cells
    around a node, not the measure of the mean that `cauchy_stress` gives; DOLFINx writes it in the
    same way.

    Args:
        body: Continuum with any material.
        at: As of `cauchy_stress`.

    Returns:
        Function of degree 1, or 0 in cells [Pa].

    Raises:
        TypeError: The body has no material.
        ValueError: `at` is out of range.
    """
    return _of(body, "von_mises", at)


def _cauchy(body: Any) -> tuple[Any, CellMeans | None]:
    """Cauchy stress in UFL, and the cells' means that it holds."""
    h = body.gradient
    law, means = body.energy()
    f = ufl.Identity(3) + h
    stress = f * law.stress(green_strain(h)) * f.T / ufl.det(f)
    if means is not None:
        means.compile(body.u)
    return stress, means


def _measure(stress: FloatArray) -> FloatArray:
    """Von Mises measure of stresses, (..., 9) -> (..., 1)."""
    tensor = stress.reshape(*stress.shape[:-1], 3, 3)
    deviator = tensor - np.trace(tensor, axis1=-2, axis2=-1)[..., None, None] / 3 * np.eye(3)
    found: FloatArray = np.sqrt(1.5 * np.square(deviator).sum(axis=(-2, -1)))
    return found[..., None]


class _InCells:
    """The stress in the mean over each cell.

    Args:
        body: The body.
        name: `cauchy_stress` or `von_mises`.
    """

    def __init__(self, body: Any, name: str) -> None:
        value, self._means = _cauchy(body)
        if name == "von_mises":
            deviator = ufl.dev(value)
            value = ufl.sqrt(1.5 * ufl.inner(deviator, deviator))
        self._name = name
        self._space = compat.function_space(body.mesh, "DG", 0, value.ufl_shape)
        self._sums, q = EntriesOfCells(self._space), ufl.TestFunction(self._space)
        one = ufl.as_tensor([[1.0] * 3] * 3) if value.ufl_shape else ufl.as_ufl(1.0)
        dx = ufl.Measure("dx", body.mesh, metadata={"quadrature_degree": 2 * body.degree})
        self._form, weigh = compile_forms([ufl.inner(value, q) * dx, ufl.inner(one, q) * dx])
        self._volumes = self._sums(weigh)

    def __call__(self) -> Any:
        """At the displacement of now, as a Function. Collective."""
        if self._means is not None:
            self._means.evaluate()
        result = fem.Function(self._space, name=self._name)
        result.x.array[: self._volumes.size] = (self._sums(self._form) / self._volumes).ravel()
        result.x.scatter_forward()
        return result


class _AtNodes:
    """The stress at the corners of cells, from that at each cell's Gauss points.

    Args:
        body: The body.
        name: As of `_InCells`.
    """

    def __init__(self, body: Any, name: str) -> None:
        value, self._means = _cauchy(body)
        mesh, shape, self._name = body.mesh, () if name == "von_mises" else (3, 3), name
        self._space = compat.function_space(mesh, "Lagrange", 1, shape)
        broken, one = (compat.function_space(mesh, "DG", 1, of) for of in ((3, 3), ()))
        self._sums, column = EntriesOfCells(broken), EntriesOfCells(one)
        unit, dofs = fem.Function(one), compat.cell_dofs(one)
        # Two points in each direction, where the stress of either degree is most exact.
        dx = ufl.Measure("dx", mesh, metadata={"quadrature_degree": 3})
        self._form, weigh = compile_forms(
            [ufl.inner(value, ufl.TestFunction(broken)) * dx, unit * ufl.TestFunction(one) * dx]
        )
        columns = []
        for k in range(dofs.shape[1]):
            unit.x.array[:] = 0.0
            unit.x.array[dofs[:, k]] = 1.0
            columns.append(column(weigh))
        self._inverse = np.linalg.inv(np.stack(columns, axis=2))
        self._nodes = compat.cell_dofs(self._space)[: len(self._inverse)]
        self._width = math.prod(shape)
        self._counts = self._sum(np.ones((*self._nodes.shape, self._width)))

    def _sum(self, corners: FloatArray) -> FloatArray:
        """Sums over the cells around each node, from the cells' corners (cells, corners, width)."""
        vector = petsc_compat.create_vector(self._space)
        with vector.localForm() as here:
            np.add.at(here.array_w.reshape(-1, self._width), self._nodes, corners)
        petsc_compat.sum_ghosts(vector)
        sums: FloatArray = vector.array_r.copy()
        vector.destroy()
        return sums

    def __call__(self) -> Any:
        """As of `_InCells`."""
        if self._means is not None:
            self._means.evaluate()
        sums = self._sums(self._form).reshape(*self._nodes.shape, 9)
        corners = np.matmul(self._inverse, sums)
        # A measure has no sign: led on itself it would be too small where a section bends.
        corners = corners if self._width == 9 else _measure(corners)
        result = fem.Function(self._space, name=self._name)
        values = self._sum(corners) / self._counts
        result.x.array[: values.size] = values
        result.x.scatter_forward()
        return result


_PLACES = {"nodes": _AtNodes, "cells": _InCells}
#: Of each body what has been compiled.
_compiled: WeakKeyDictionary[Any, dict[tuple[str, str], Any]] = WeakKeyDictionary()


def _of(body: Any, name: str, at: str) -> Any:
    """Means of a body's stress as a Function. Collective."""
    require_one_of("at", at, _PLACES)
    if getattr(body, "law", None) is None:
        label = getattr(body, "name", body)
        raise TypeError(f"body={label!r}: has no material W(C), so no stress; pass a Continuum")
    known = _compiled.setdefault(body, {})
    if (name, at) not in known:
        known[name, at] = _PLACES[at](body, name)
    return known[name, at]()
