"""What bodies are coloured by in pictures and films, and the scale of the colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from dolfinx import fem

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.solid.stress import von_mises
from dolfinx_nts.contact.nodal_pressure import pressures
from dolfinx_nts.ledger import contact_fields
from dolfinx_nts.output.own_functions import made
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import FloatArray, IntArray
from dolfinx_nts.validation import require_one_of

#: A name, or what makes a scalar Function of a body with a material, as `Fields(functions=)` takes.
Colour: TypeAlias = str | Callable[[Any], fem.Function]

#: Percentiles of the values at which the scale of colours ends, and part of the largest value that
#: counts as none.
_ENDS, _NONE = (2.0, 98.0), 1e-9
#: Colour map and text of what has a name.
_NAMED = {
    "speed": ("viridis", "speed [{0}/s]"),
    "stress": ("plasma", "von Mises stress [{1}]"),
    "pressure": ("plasma", "contact pressure [{1}]"),
    "body": ("Set2", ""),
}
#: Colours of the map that bodies have one each of.
_BODIES = 8
#: Units of stress by those of length.
UNITS = {"m": "Pa", "mm": "MPa"}


def check_colour(colour: Any, bodies: Sequence[Any], run: Any) -> None:
    """Raise unless a colour is known, and a body has it."""
    if not callable(colour):
        require_one_of("colour", colour, _NAMED)
    if colour in ("speed", "body"):
        return
    solids = [b for b in bodies if b.mesh.topology.dim == 3]
    what, has = "a material", [b for b in solids if b.law is not None]
    if colour == "pressure":
        if run is None:
            raise ValueError(
                "colour='pressure': a scene has no contact forces; pass what simulate(...) or "
                "equilibrium(...) returns, with hide=[...] for what is not to be seen"
            )
        slaves = {id(pair.slave.body) for pair in run.system.contacts}
        what, has = "a slave surface of a solid", [b for b in solids if id(b) in slaves]
    if not has:
        names = [b.name for b in bodies]
        raise ValueError(f"colour={colour!r}: none of {names} has {what}; colour by 'speed'")


def number(k: int) -> float:
    """Value of body k where each has a colour of its own."""
    return float(k % _BODIES)


def at_corners(
    body: Any, colour: Colour, run: Any, corners: IntArray, cells: IntArray
) -> FloatArray:
    """Values of a solid's colour at the corners of its facets, shape (m, 4). Collective.

    Args:
        body: The solid.
        colour: What it is coloured by.
        run: What has the contacts, or None.
        corners: Nodes of the facets in the body's space, shape (m, 4).
        cells: Cell of each facet, shape (m,).

    Raises:
        TypeError: The user's colour is no Function.
        ValueError: It is no scalar.
    """
    if colour == "speed":
        return np.linalg.norm(body.v.x.array.reshape(-1, 3)[corners], axis=-1)
    if colour == "pressure":
        return _pressure(body, run)[corners]
    if body.law is None:
        return np.full(corners.shape, np.nan)
    if not callable(colour):
        return _of_function(body, von_mises(body, at="cells"), corners, cells)
    what = f"colour of body {body.name!r}"
    function = made(what, colour, body)
    shape = function.ufl_shape
    text = f"{what}: has shape {shape}; return a scalar Function, such as one component"
    raise_together(body.comm, text if shape else None)
    return _of_function(body, function, corners, cells)


def _pressure(body: Body, run: Any) -> FloatArray:
    """Contact pressure at nodes on this rank [Pa], NaN beside slaves, shape (n,). Collective."""
    index_map = body.space.dofmap.index_map
    total = np.full(index_map.size_local, np.nan)
    # During a run the mean of two steps, as those of single ones alternate.
    histories = run.system.of_slaves(run.state.contacts)
    force = getattr(run, "mean_force", lambda k: histories[k].force)
    for k, pair in enumerate(run.system.contacts):
        if pair.slave.body is body:
            pressure = pressures(pair.slave, force(k), run.system.slave_area(k, run.state))
            here = contact_fields.spread(pair.slave, np.nan, pressure, pressure)
            total = np.where(np.isnan(here), total, np.nan_to_num(total) + here)
    carrier = fem.Function(body.space)
    carrier.x.array[: 3 * len(total) : 3] = total
    carrier.x.scatter_forward()
    values: FloatArray = carrier.x.array[::3]
    return values


def _of_function(
    body: Any, function: fem.Function, corners: IntArray, cells: IntArray
) -> FloatArray:
    """As `at_corners`, of a scalar Function in cells, or of a continuous one. Collective."""
    function.x.scatter_forward()
    dofs = compat.cell_dofs(function.function_space)
    if dofs.shape[1] == 1:
        return np.tile(function.x.array[dofs[cells]], 4)
    scalars, of_vector = body.space.sub(0).collapse()
    nodal = fem.Function(scalars)
    nodal.interpolate(function)
    nodal.x.scatter_forward()
    # DOLFINx 0.11 has a list of one array.
    of_vector = np.ravel(of_vector)
    values = np.empty(len(of_vector))
    values[of_vector // 3] = nodal.x.array
    return values[corners]


class Scale(NamedTuple):
    """A scale of colours.

    Attributes:
        limits: Its ends.
        map: Name of matplotlib's colour map.
        text: What the colours are, with the unit; empty: there is nothing to read off.
        beyond: Whether values lie below and above it.
    """

    limits: tuple[float, float]
    map: str
    text: str
    beyond: tuple[bool, bool]

    @property
    def extend(self) -> str:
        """The same as matplotlib has it."""
        return {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[self.beyond]


def scale_of(values: FloatArray, colour: Colour, limits: Any, units: str) -> Scale:
    """The scale of values: between given limits, or percentiles, which one peak does not move.

    That of stress begins at zero. Of contact pressure the peak is asked for: from zero to the
    largest.

    Zeros, as of stress before an impact or of pressure beside a contact, are no part of the
    percentiles, but in the scale. It is symmetric where there are values of both signs.

    Args:
        values: What is coloured; NaN is not.
        colour: What they are.
        limits: Ends of the scale, or None.
        units: Of lengths.
    """
    if colour == "body":
        return Scale((-0.5, _BODIES - 0.5), *_NAMED["body"], (False, False))
    values = values[np.isfinite(values)]
    if not len(values):
        return Scale((0.0, 1.0), "viridis", "", (False, False))
    size = float(np.abs(values).max(initial=0.0))
    there = values[np.abs(values) > _NONE * size]
    low, high = np.percentile(there, _ENDS).tolist() if len(there) else (0.0, 0.0)
    if len(there) < len(values):
        low, high = min(low, 0.0), max(high, 0.0)
    if colour in ("stress", "pressure"):
        low, high = 0.0, high if colour == "stress" else float(values.max())
    signed = low < 0.0 < high
    if signed:
        low, high = min(low, -high), max(high, -low)
    if high - low <= _NONE * size:
        # A constant field would otherwise show its rounding errors.
        low, high = min(0.0, 1.1 * low), max(0.0, 1.1 * high) or float(low == 0.0)
    low, high = (low, high) if limits is None else limits
    beyond = bool((values < low).any()), bool((values > high).any())
    if callable(colour):
        text = getattr(colour, "__name__", type(colour).__name__).replace("_", " ")
        return Scale((low, high), "coolwarm" if signed else "plasma", text, beyond)
    name, text = _NAMED[colour]
    return Scale((low, high), name, text.format(units, UNITS[units]), beyond)
