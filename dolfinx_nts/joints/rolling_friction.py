"""Rolling and spinning friction of contacts of rigid bodies: dry moments against relative turns.

Each has its own bound, a length times the sum of the contact's normal forces (theory section 13).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.interaction.coupling import StepWarning
from dolfinx_nts.interaction.measures import Measure
from dolfinx_nts.joints.between import OfTwo
from dolfinx_nts.joints.directed_friction import (
    DirectedCoupling,
    DirectedElements,
    DirectedPart,
    Turn,
    at_start,
)
from dolfinx_nts.kernels.vectors import triad
from dolfinx_nts.parallel import Asking
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import is_finite, known_options, require_same

#: Part of the forces along a second axis from which on a run warns that there is no one normal.
_UNCLEAR = 0.3


class _Rolls(Turn):
    """The part of a turn about axes in the plane of contact."""

    groups = (2,)
    axes = slice(0, 2)


class _Spins(Turn):
    """The part about the normal."""

    groups = (1,)
    axes = slice(2, 3)


class _RollsAndSpins(Turn):
    """Both."""

    groups = (2, 1)
    axes = slice(0, 3)


class _RollingElements(DirectedElements):
    """`DirectedElements` whose measures follow the contact's normal, and their bounds its force.

    The law has each measure's bound over the force [m], shape (m,).
    """

    def evaluate(self, x: FloatArray, own: Mapping[str, FloatArray]) -> Asking[DirectedPart]:
        """Residual and tangent."""
        sums, _ = yield own["load"], np.empty(0)
        load, kind = max(float(sums[0]), 0.0), self.measure.kind
        turned = triad(own["normal"])[kind.axes] @ self.since[:, :3].swapaxes(1, 2)
        forms = np.einsum("nak,nkvw->navw", turned, self.forms)
        arms = np.tile(self.law, (len(x), 1))
        slopes = arms[:, :, None] * (load > 0.0) * own["by_unknowns"][:, None]
        part = self._obeyed(x, own["constraints"], forms, arms * load / self.step.factor, slopes)
        return part._replace(spread=float(own["spread"]))


class _RollingCoupling(DirectedCoupling):
    """Makes `_RollingElements`."""

    _of: ClassVar[type[DirectedElements]] = _RollingElements

    def warnings(self, parts: Sequence[DirectedPart]) -> list[StepWarning]:
        """That a contact presses in several directions, between which rounding may choose."""
        spread = max((part.spread for part in parts), default=0.0)
        if spread < _UNCLEAR:
            return []
        pair = self._joint.pressed_by.name
        text = (
            f"contact {pair!r} presses in several directions, along a second one by {spread:.2g} "
            f"of the first: {self._joint.name!r} tells rolling from spinning by one normal; "
            "declare a contact for each face, with a RollingFriction of its own"
        )
        return [StepWarning("several normals", spread, text, (self._joint.name,))]


@known_options
class RollingFriction(OfTwo):
    """Friction of a contact against rolling and spinning, beside that against sliding.

    A dry moment acts between both bodies against the part of their relative turn about axes in the
    plane of contact, up to `rolling` times the sum N of the contact's normal forces, and one
    against the part about the normal, up to `spinning` times N. A wheel of radius r stays at rest
    up to the slope tan(alpha) = rolling / r. Pass it among the `joints` of the system:

        floor = nts.Plane((0, 0, 0), (0, 0, 1))
        pair = nts.ContactPair(ball.surface(skin), floor, friction=0.5)
        drag = nts.RollingFriction(pair, rolling=1e-3, spinning=2e-4)
        system = nts.System([ball], contacts=[pair], joints=[drag], gravity=(0, 0, -9.81))

    Args:
        pair: A contact of the system between two rigid bodies, or a rigid one and an obstacle.
        rolling: Moment over normal force [m]; 0: rolling meets none.
        spinning: The same about the normal.
        name: In messages and files; default: "rolling friction of" the contact.

    Attributes:
        pressed_by: The contact, whose normal forces its elements are told, see `Couplings`.

    Raises:
        TypeError: `pair` is no ContactPair.
        ValueError: A body of the pair may deform, a number is negative, or both are 0.
    """

    mid_step = True

    def __init__(
        self, pair: ContactPair, *, rolling: float = 0.0, spinning: float = 0.0,
        name: str | None = None,
    ) -> None:  # fmt: skip
        if not isinstance(pair, ContactPair):
            raise TypeError(f"pair={pair!r}: pass a ContactPair of the system")
        for body in pair.bodies:
            if not body.rigid:
                raise ValueError(
                    f"pair={pair.name!r}: {body.name!r} may deform, and rolling takes its energy "
                    "through its material; pass a contact of rigid bodies"
                )
        for argument, arm in (("rolling", rolling), ("spinning", spinning)):
            if not (is_finite(arm) and arm >= 0.0):
                raise ValueError(f"{argument}={arm!r}: pass a length >= 0 [m]")
        if not (rolling or spinning):
            raise ValueError(
                f"rolling={rolling!r}, spinning={spinning!r}: pass a length above 0 [m] of one"
            )
        ends = (*pair.bodies, None)[:2]
        super().__init__(ends, f"rolling friction of {pair.name}" if name is None else name)
        require_same(self.comm, rolling=rolling, spinning=spinning, name=name)
        self.pressed_by = pair
        self._given = {"rolling": float(rolling), "spinning": float(spinning)}
        kind = _RollsAndSpins if rolling and spinning else _Rolls if rolling else _Spins
        self.law = np.array([rolling, rolling, spinning], dtype=float)[kind.axes]
        both = [body.directions(np.eye(3)) for body in self.bodies]
        widths = [points.weights.shape[1] for points in both]
        weights, constants = np.zeros((6, sum(widths))), np.zeros((6, 3))
        weights[:3, : widths[0]] = both[0].weights
        if both[1:]:
            weights[3:, widths[0] :] = both[1].weights
        else:
            constants[3:] = np.eye(3)
        n = self._here
        sides = tuple(points.select(slice(n)) for points in both)
        length = float(np.exp(np.mean(np.log([body.length for body in self.bodies]))))
        self.measure = Measure(
            kind, sides, weights[None][:n], constants[None][:n], np.full(n, length)
        )

    @cached_property
    def settings(self) -> dict[str, Any]:
        """What a restart compares."""
        return {"bodies": self._names, "contact": self.pressed_by.name, **self._given}

    def start(self) -> FloatArray:
        """No moment."""
        return at_start(self.measure)

    def coupling(self, bodies: tuple[int, ...]) -> DirectedCoupling:
        """What makes its elements in a run, and remembers its moments."""
        return _RollingCoupling(bodies, self)
