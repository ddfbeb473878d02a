"""Angles, ways and lengths of joints, springs and cables over time; tensions of cables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx_nts.joints.cable import Cable
from dolfinx_nts.joints.forces import AlongMeasure
from dolfinx_nts.joints.kinds import Cylindrical, Prismatic, Revolute
from dolfinx_nts.joints.laws import on_joint
from dolfinx_nts.ledger.resultants import mean_of_two_steps
from dolfinx_nts.output.running import Running
from dolfinx_nts.types import FloatArray

#: Ends of the names of a cable's tensions and of their means.
_TENSIONS = " tensions", " mean tensions"


class Motions:
    """Keeps how far joints have turned or slid since the start, and how fast they do.

        motions = Motions(hinge, slide, spring, rope)
        nts.simulate(..., output=[motions])
        plt.plot(motions.time, motions["hinge"][:, 0])
        plt.plot(motions.time, motions["rope mean tensions"][:, 1])  # behind the first eyelet

    Angles count whole turns while a joint turns by less than half of one from row to row. A run
    that goes on from a checkpoint begins with the turn within half of one to either side.

    Args:
        *joints: `Revolute`, `Prismatic` and `Cylindrical` joints, of which A moves relative to B;
            springs, dampers and actuators, which have a length or an angle; cables, whose length
            is that of their path.

    Raises:
        TypeError: There is none, or one is of another kind.
        ValueError: From `start`: one is not in the run's system, or two have one name.
    """

    def __init__(self, *joints: Any) -> None:
        kinds = Revolute, Prismatic, Cylindrical, AlongMeasure, Cable
        wrong = [joint for joint in joints if not isinstance(joint, kinds)]
        if wrong or not joints:
            raise TypeError(
                f"joints={wrong or joints!r}: pass Revolute, Prismatic or Cylindrical joints, "
                "springs, dampers, actuators or cables"
            )
        self.joints = joints
        self._rows: list[FloatArray] = []
        #: Columns of the rows by name.
        self._columns: dict[str, slice] = {}
        self._means: set[str] = set()

    def start(self, stepper: Running) -> None:
        """Begin anew with the state the run starts from. Collective."""
        system = stepper.system
        for joint in self.joints:
            if not any(joint is other for other in system.joints):
                raise ValueError(f"joints: {joint.name!r} is no joint of the system; add it there")
        both = [pair for joint in self.joints for pair in _measured(joint)]
        self._cables = [joint for joint in self.joints if isinstance(joint, Cable)]
        names = [name for name, _ in both]
        names += [f"{cable.name}{word}" for cable in self._cables for word in _TENSIONS]
        if len(set(names)) < len(names):
            raise ValueError(f"joints: names {names} are not unique; rename a joint")
        widths = [2] * len(both) + [len(cable.friction) + 1 for cable in self._cables]
        ends = [slice(b - w, b) for w, b in zip(widths, 1 + np.cumsum(widths), strict=True)]
        self._means = {f"{cable.name}{_TENSIONS[1]}" for cable in self._cables}
        shown = ends[: len(both)] + [own for own in ends[len(both) :] for _ in _TENSIONS]
        self._columns = dict(zip(names, shown, strict=True))
        self._of = [
            ([system.bodies.index(body) for body in part.bodies], part.measure) for _, part in both
        ]
        self._near = [np.zeros(len(measure.length)) for _, measure in self._of]
        self._rows = []
        self.write(stepper)

    def write(self, stepper: Running, *, last: bool = False) -> None:
        """Add the accepted state. Collective."""
        state, found = stepper.state, np.zeros((len(self._of), 2))
        for k, (of, measure) in enumerate(self._of):
            y = measure.reference() + measure.nodal([state.u[b] for b in of])
            p, kind = measure.vectors(y), measure.kind
            speed = measure.directed(measure.nodal([state.v[b] for b in of]))
            self._near[k] = at = kind.value(p, self._near[k])
            gradient = kind.gradient(p, p, at, at).mean.reshape(p.shape)
            found[k] = at.sum(), (gradient * speed).sum()
        # Each is on one rank.
        stepper.system.comm.Allreduce(MPI.IN_PLACE, found)
        tensions = [cable.tensions(stepper) for cable in self._cables]
        self._rows.append(np.concatenate([[state.time], found.ravel(), *tensions]))

    def close(self, stepper: Running) -> None:
        """Nothing is left to do."""

    @property
    def time(self) -> FloatArray:
        """Times of the rows [s]."""
        return np.array([row[0] for row in self._rows])

    def __getitem__(self, name: str) -> FloatArray:
        """Angle [rad], way or length [m] and its rate, shape (rows, 2); tensions, (rows, parts).

        Args:
            name: Of the joint; "NAME way" and "NAME angle" of a cylindrical one; "NAME tensions" of
                a cable has those of its parts [N], from the first point to the last, "NAME mean
                tensions" their mean over each step and the one before it, which does not alternate.

        Raises:
            KeyError: There is no such name.
        """
        if name not in self._columns:
            raise KeyError(f"name={name!r}: no such motion; choose from {list(self._columns)}")
        found = np.array(self._rows)[:, self._columns[name]]
        return mean_of_two_steps(self.time, found) if name in self._means else found


def _measured(joint: Any) -> Iterator[tuple[str, Any]]:
    """Names and what has a measure, of one joint."""
    if isinstance(joint, AlongMeasure | Cable):
        yield joint.name, joint
    elif isinstance(joint, Cylindrical):
        yield f"{joint.name} way", on_joint(joint, turns=False)
        yield f"{joint.name} angle", on_joint(joint, turns=True)
    else:
        yield joint.name, on_joint(joint, turns=isinstance(joint, Revolute))
