"""Springs and dampers between points of bodies, and about axes (theory section 14)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.interaction.sketch import COIL, DASHPOT
from dolfinx_nts.joints.forces import AboutAxis, AlongMeasure, BetweenPoints, Stiff, Viscous
from dolfinx_nts.kernels import measures as kernel
from dolfinx_nts.parallel import raise_together
from dolfinx_nts.types import Vector, Vectors
from dolfinx_nts.validation import (
    call_together,
    is_finite,
    known_options,
    require_positive,
)

Function = Callable[[Any], Any]

#: Part of the start's coordinate over which a user's energy is compared with its force, and part of
#: the force by which they may differ there: enough for a kink, not for a sign.
_COMPARED, _ALIKE = 1e-2, 0.1


class _Stores(AlongMeasure):
    """What stores energy."""

    def _by_stiffness(self, stiffness: Any, rest: float, unit: str) -> None:
        require_positive("stiffness", stiffness, unit)
        linear = kernel.Linear(float(stiffness), rest)
        self.law = Stiff(linear, lambda function, *arrays: function(*arrays))

    def _by_energy(self, energy: Any, force: Any, start: float) -> None:
        """Take a user's V, after a look at it and at its derivative near the start. Collective."""
        for name, value in (("energy", energy), ("force", force)):
            if not (callable(value) or (value is None and name == "force")):
                raise TypeError(f"{name}={value!r}: pass a function of an array")
        stored = kernel.Stored(energy, force, self.measure.kind.unit)
        label = f"energy of {self.name!r}"
        shown = energy if force is None else (energy, force)

        def ask(function: Callable[..., Any], *arrays: Any) -> Any:
            return call_together(self.comm, label, function, *arrays, shown=shown)

        raise_together(self.comm, ask(_unlike, stored, start, label))
        self.law = Stiff(stored, ask)


def _unlike(stored: kernel.Stored, start: float, label: str) -> str | None:
    """Why a user's V and its derivative do not fit near the start, if they do not."""
    way = _COMPARED * max(abs(start), stored.unit)
    x = start + way * np.linspace(0.0, 1.0, 9)
    energy, force = stored.value(x), stored.force(x)
    if not (np.isfinite(energy) & np.isfinite(force)).all():
        return f"{label}: it or its derivative is not finite at {start:.6g}, where it starts"
    work = float(way * (0.5 * (force[0] + force[-1]) + force[1:-1].sum()) / 8.0)
    rounding = 8.0 * np.finfo(float).eps * float(np.abs(energy).max())
    missing = abs(float(energy[-1] - energy[0]) - work)
    if missing <= _ALIKE * way * float(np.abs(force).max()) + rounding:
        return None
    return (
        f"{label}: changes by {energy[-1] - energy[0]:.6g} from {x[0]:.6g} to {x[-1]:.6g}, its "
        f"derivative says {work:.6g}; pass force=dV/dl, or write it so that it takes complex "
        "arrays"
    )


def _one_of(stiffness: Any, energy: Any, force: Any, rest: tuple[str, Any]) -> None:
    """Raise unless either stiffness, with rest, or energy, with force, is given."""
    if (stiffness is None) == (energy is None):
        raise ValueError(
            f"stiffness={stiffness!r}, energy={energy!r}: pass one of them, energy as a function V"
        )
    if energy is None and force is not None:
        raise ValueError(f"force={force!r}: belongs to energy=; pass that, too, or leave it out")
    if energy is not None and rest[1] is not None:
        raise ValueError(f"{rest[0]}={rest[1]!r}: belongs to stiffness=; energy says where it is")


@known_options
class Spring(_Stores, BetweenPoints):
    """A spring between a point of a body and one of another, or of the ground.

    Linear, V = k/2 (l - length)^2, or with a V(l) of one's own. A spring of length 0 is smooth
    wherever its points are. Any other one has no direction where they coincide, and none starts so.

    Args:
        a: A body, or None: the ground.
        b: A body, or None: the ground.
        points: In the reference [m], one of a and one of b, shape (3,) each; those of rigid bodies
            may lie outside of them.
        stiffness: k [N/m], > 0.
        length: Where a linear spring is free [m]; default: its length in the reference.
        energy: V(l) [J] of an array of lengths [m], in place of stiffness.
        force: dV/dl [N] of an array, positive in tension. Without it V is differentiated by complex
            step, for which it has to take complex arrays (no abs, no comparison of lengths but by
            their real parts).
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a point lies outside of a flexible body.
        UserFunctionError: energy or force raises.
    """

    shape = COIL

    def __init__(
        self,
        a: Body | None,
        b: Body | None,
        points: Vectors,
        *,
        stiffness: float | None = None,
        length: float | None = None,
        energy: Function | None = None,
        force: Function | None = None,
        name: str | None = None,
    ) -> None:
        _one_of(stiffness, energy, force, ("length", length))
        super().__init__(a, b, points, name=name)
        start = self.distance
        if length is not None and not (is_finite(length) and length >= 0):
            raise ValueError(f"length={length!r}: must be >= 0 and finite [m]")
        if energy is not None:
            if start == 0.0:
                raise self._undirected("a force of one's own has no direction there")
            self._by_energy(energy, force, start)
            return
        rest = start if length is None else float(length)
        if start == 0.0 and rest > 0.0:
            raise self._undirected(f"a spring of length={rest!r} has no direction there")
        self._by_stiffness(stiffness, rest, "N/m")


@known_options
class Damper(BetweenPoints):
    """A damper between a point of a body and one of another, or of the ground: force c dl/dt.

    What it takes is `damping_dissipation` in the ledger. In equilibrium it does nothing.

    Args:
        a: A body, or None: the ground.
        b: A body, or None: the ground.
        points: In the reference [m], one of a and one of b, apart from each other.
        damping: c [N s/m], > 0.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a point lies outside of a flexible body.
    """

    losses = ("damping_dissipation",)
    entry = ("damping_dissipation", 1.0)
    shape = DASHPOT

    def __init__(
        self, a: Body | None, b: Body | None, points: Vectors, *, damping: float,
        name: str | None = None,
    ) -> None:
        require_positive("damping", damping, "N s/m")
        super().__init__(a, b, points, name=name)
        if self.distance == 0.0:
            raise self._undirected("a damper has no direction there")
        self.law = Viscous(float(damping))


@known_options
class TorsionSpring(_Stores, AboutAxis):
    """A torsion spring about an axis that two rigid bodies, or one and the ground, share.

    Its angle phi is the turn of a relative to b about the axis since the reference, over any number
    of turns; less than half a turn in a step. A joint with this axis has to hold the bodies.
    `TorsionSpring.about(joint, stiffness=...)` takes bodies and axis from a joint.

    Args:
        a: A rigid body, or None: the ground.
        b: A rigid body, or None: the ground.
        axis: In the reference, of any length.
        stiffness: k [N m], > 0, of V = k/2 (phi - angle)^2.
        angle: Where it is free [rad]; default: 0.
        energy: V(phi) [J] of an array of angles [rad], in place of stiffness.
        force: dV/dphi [N m] of an array, as of `Spring`.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is flexible.
        UserFunctionError: energy or force raises.
    """

    def __init__(
        self,
        a: Body | None,
        b: Body | None,
        *,
        axis: Vector,
        stiffness: float | None = None,
        angle: float | None = None,
        energy: Function | None = None,
        force: Function | None = None,
        name: str | None = None,
    ) -> None:
        _one_of(stiffness, energy, force, ("angle", angle))
        super().__init__(a, b, axis=axis, name=name)
        if angle is not None and not is_finite(angle):
            raise ValueError(f"angle={angle!r}: must be finite [rad]")
        if energy is not None:
            self._by_energy(energy, force, 0.0)
        else:
            self._by_stiffness(stiffness, float(angle or 0.0), "N m")


@known_options
class TorsionDamper(AboutAxis):
    """A torsion damper about an axis, as of `TorsionSpring`: torque c dphi/dt.

    What it takes is `damping_dissipation` in the ledger. In equilibrium it does nothing.

    Args:
        a: A rigid body, or None: the ground.
        b: A rigid body, or None: the ground.
        axis: In the reference, of any length.
        damping: c [N m s], > 0.
        name: In messages and files; default: kind and bodies.

    Raises:
        TypeError: An argument is of another kind.
        ValueError: An argument is out of range, or a body is flexible.
    """

    losses = ("damping_dissipation",)
    entry = ("damping_dissipation", 1.0)

    def __init__(
        self, a: Body | None, b: Body | None, *, axis: Vector, damping: float,
        name: str | None = None,
    ) -> None:
        require_positive("damping", damping, "N m s")
        super().__init__(a, b, axis=axis, name=name)
        self.law = Viscous(float(damping))
