"""What loads a body: tractions and pressures, and the virtual work of those on a solid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import meshtags

from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.bodies.conditions import (
    VectorInTime,
    check_value,
    check_where,
    facets_of,
    refuse_ufl,
)
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import FloatArray, IntArray, Marker
from dolfinx_nts.validation import (
    is_finite,
    items,
    known_options,
    number_at,
    require_bool,
    vector_in_time,
)


@known_options
@dataclass(frozen=True)
class Traction:
    """Dead traction on a part of the boundary.

    Attributes:
        where: Function x (3, n) -> bool (n,), or a pair (facet meshtags, tag).
        value: Force per reference area [Pa]: a vector, or a function of time.

    Raises:
        TypeError: `where` is meshtags alone.
        ValueError: `value` is neither three finite numbers nor a function.
    """

    where: Marker
    value: VectorInTime

    def __post_init__(self) -> None:
        check_where("Traction", self.where)
        check_value("Traction.value", self.value, "Pa", "a function of time that returns them")


@known_options
@dataclass(frozen=True)
class Pressure:
    """Pressure on the boundary of a continuum, or on cells of a shell.

    It pushes a continuum inwards, and a shell's middle surface from the bottom to the top. One that
    follows acts along the normal and on the area that the surface has then.

    On a continuum it is taken at the place where the integrator takes its forces: in the middle of
    the step, in equilibrium at its end. A uniform one all around has neither resultant nor moment,
    and its work is p times the change of the volume but for a third-order term.

    On a shell its force in a step of `EnergyMomentum` is the mean on the way of the step. So the
    work of a constant one on a closed shell is p times the change of the volume exactly. Its moment
    on a closed shell, none, is then off by a third-order term; with `Midpoint` it is exact.

    Attributes:
        value: [Pa]: a number, or a function of time.
        where: None: everywhere. Of a continuum facets as of `Traction`; of a shell a function
            x (3, n) -> bool (n,), and it acts on cells at all whose corners it is true.
        follower: Whether it follows the body; False: it acts along the normal and on the area of
            the reference, a dead load.

    Raises:
        TypeError: follower is no bool, or `where` is meshtags alone.
        ValueError: value is neither a finite number nor a function.
    """

    value: float | Callable[[float], float]
    where: Marker = None
    follower: bool = True

    def __post_init__(self) -> None:
        require_bool("follower", self.follower)
        check_where("Pressure", self.where)
        refuse_ufl("Pressure.value", self.value, "a finite number [Pa], or a function of time")
        if not callable(self.value) and not is_finite(self.value):
            raise ValueError(
                f"Pressure.value={self.value!r}: must be a finite number [Pa], or a function of "
                "time that returns one"
            )


def load_at(
    comm: MPI.Comm, what: str, value: Any, unit: str, time: float, ramp: float
) -> FloatArray:
    """A load at a time; of one that is no function of time the part that acts. Collective."""
    return (1.0 if callable(value) else ramp) * vector_in_time(comm, what, value, time, unit)


def pressure_at(comm: MPI.Comm, what: str, value: Any, time: float, ramp: float) -> float:
    """The same of a pressure [Pa]. Collective."""
    return number_at(comm, what, value, time, "Pa") if callable(value) else ramp * value


class SolidLoads:
    """Body force, tractions and pressures of a solid body. Collective.

    Args:
        space: Function space of its displacement.
        name: Of the body, for messages.
        body_force: As of `Continuum`.
        traction: Likewise.
        dx: Measure of the body force; facets have its quadrature.

    Attributes:
        in_time: Whether any is a function of time.
        follows: Whether a pressure follows the body.
        settings: Of each traction its value, and of a pressure whether it follows.
        work: Virtual work in UFL of all that do not follow.

    Raises:
        TypeError: An item is no load.
        ValueError: A load selects no facet, or two of them the same.
    """

    def __init__(
        self, space: fem.FunctionSpace, name: str, body_force: VectorInTime,
        traction: Sequence[Traction | Pressure], dx: ufl.Measure,
    ) -> None:  # fmt: skip
        loads = items(
            "traction", traction, lambda t: isinstance(t, Traction | Pressure),
            "Traction or Pressure",
        )  # fmt: skip
        self._mesh, self._body_force, self._traction = space.mesh, body_force, loads
        self._name = name
        self.in_time = any(callable(value) for value in (body_force, *(t.value for t in loads)))
        self.settings = [
            (load.value, load.follower) if isinstance(load, Pressure) else load.value
            for load in loads
        ]
        now = self._at(0.0, 1.0)
        self._constants = [fem.Constant(self._mesh, np.zeros_like(value)) for value in now]
        self._assembled = np.zeros(sum(np.size(value) for value in now))
        w, n = ufl.TestFunction(space), ufl.FacetNormal(self._mesh)
        force, *on_facets = self._constants
        self.work, self._following = ufl.inner(force, w) * dx, []
        for load, value, ds in zip(loads, on_facets, self._measures(dx.metadata()), strict=True):
            if not isinstance(load, Pressure):
                self.work += ufl.inner(value, w) * ds
            elif load.follower:
                self._following.append((value, ds))
            else:
                self.work -= value * ufl.inner(n, w) * ds
        self.follows = bool(self._following)

    def _measures(self, metadata: dict[str, Any]) -> list[ufl.Measure]:
        """Of the facets of each traction."""
        facets: list[IntArray] = []
        for k, load in enumerate(self._traction):
            what = f"{type(load).__name__}.where of traction[{k}] of {self._name!r}"
            everywhere = load.where is None and isinstance(load, Pressure)
            facets.append(
                compat.exterior_facets(self._mesh) if everywhere
                else facets_of(self._mesh, load.where, what)
            )  # fmt: skip
        index = np.concatenate([np.empty(0, np.int32), *facets]).astype(np.int32)
        tag = np.repeat(np.arange(len(facets), dtype=np.int32), [len(own) for own in facets])
        shared = len(index) - len(np.unique(index))
        text = (
            f"traction of {self._name!r}: {shared} facets carry two loads; add their values up in "
            "one of them"
        )
        raise_together(self._mesh.comm, text if shared else None)
        order = np.argsort(index)
        data = meshtags(self._mesh, 2, index[order], tag[order])
        ds = ufl.Measure("ds", self._mesh, subdomain_data=data, metadata=metadata)
        return [ds(k) for k in range(len(facets))]

    def following(self, u: Any, v: Any, w: Any, t: Any) -> Any:
        """Virtual work of the pressures that follow, as of `extra_form`."""
        f = ufl.Identity(3) + ufl.grad(u)
        area = ufl.dot(ufl.det(f) * ufl.inv(f).T, ufl.FacetNormal(self._mesh))
        return sum(value * ufl.inner(area, w) * ds for value, ds in self._following)

    def begin(self, time: float, ramp: float) -> bool:
        """Set the loads of a step, and tell whether any is another one than before. Collective.

        Args:
            time: [s].
            ramp: Part of constant loads that acts.
        """
        now = self._at(time, ramp)
        for constant, value in zip(self._constants, now, strict=True):
            constant.value[...] = value
        before, self._assembled = self._assembled, np.concatenate([np.ravel(a) for a in now])
        return not np.array_equal(before, self._assembled)

    def _at(self, time: float, ramp: float) -> list[FloatArray | float]:
        """Body force, tractions and pressures at a time."""
        comm, what = self._mesh.comm, f"body_force of {self._name!r}"
        found: list[Any] = [load_at(comm, what, self._body_force, "N/m^3", time, ramp)]
        for k, load in enumerate(self._traction):
            what = f"{type(load).__name__}.value of traction[{k}] of {self._name!r}"
            if isinstance(load, Pressure):
                found.append(pressure_at(comm, what, load.value, time, ramp))
            else:
                found.append(load_at(comm, what, load.value, "Pa", time, ramp))
        return found
