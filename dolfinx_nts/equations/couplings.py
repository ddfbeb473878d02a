"""All that couples the bodies of a scene, and its elements in a step, contacts first."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_laws import Contribution
from dolfinx_nts.contact.contact_search import ContactSearch
from dolfinx_nts.equations.least_norm import hanging
from dolfinx_nts.interaction.coupling import Coupling, JointCoupling
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.state import ContactHistory
from dolfinx_nts.system import System

FloatArray = npt.NDArray[np.float64]


class Couplings:
    """What makes the elements of each step.

    Args:
        system: The scene.

    Attributes:
        contacts: What makes the elements of contacts. Used directly only for what contacts alone
            have: closing gaps, checkpoints.
        joints: What makes those of each of `System.joints`.
    """

    def __init__(self, system: System) -> None:
        self.contacts = ContactSearch(system.contacts, system.contact_bodies, system.comm)
        both = zip(system.joints, system.joint_bodies, strict=True)
        self.joints: list[JointCoupling] = [joint.coupling(bodies) for joint, bodies in both]
        own = slice(len(system.declared_joints), None)
        alone = zip(self.joints[own], system.joint_bodies[own], strict=True)
        # What holds a body together may leave a step with it.
        self._own = [(c, k) for c, (k, *_) in alone if c.rests]
        self._remembered: tuple[ContactHistory, ...] = ()
        self._mechanisms = _linked(system.joint_bodies[: len(system.declared_joints)])
        _lend_less(system, self.joints)

    @property
    def _all(self) -> list[Coupling]:
        return [self.contacts, *self.joints]

    def begin(self, step: Step, again: Evaluation | None, search: bool) -> None:
        """Make the elements of a step; arguments as of `Coupling.begin`. Collective."""
        state = step.state
        self._remembered = state.contacts
        histories: tuple[Any, ...] = (state.contacts, *state.joints)
        for coupling, history in zip(self._all, histories, strict=True):
            coupling.begin(step, history, again, search)

    @property
    def elements(self) -> list[Any]:
        """Batches of elements in the step."""
        return [batch for coupling in self._all for batch in coupling.elements]

    @property
    def bodies(self) -> list[tuple[int, ...]]:
        """Numbers of the bodies of each batch."""
        return [of for coupling in self._all for of in coupling.bodies]

    @property
    def mechanisms(self) -> list[list[int]]:
        """Positions among `elements` of those of joints, of each mechanism that bodies link."""
        if not self._mechanisms:
            return []
        found: list[list[int]] = [[] for _ in range(max(self._mechanisms, default=-1) + 1)]
        start = len(self.contacts.elements)
        for mechanism, coupling in zip(self._mechanisms, self.joints, strict=False):
            stop = start + len(coupling.elements)
            found[mechanism] += range(start, stop)
            start = stop
        return found

    def each(self, e: Evaluation) -> Iterator[tuple[Coupling, tuple[Any, ...]]]:
        """All with their parts of an evaluation."""
        yield self.contacts, e.parts[: len(self.contacts.elements)]
        yield from self.of_joints(e)

    def of_joints(self, e: Evaluation) -> Iterator[tuple[JointCoupling, tuple[Any, ...]]]:
        """`joints` with their parts of an evaluation."""
        start = len(self.contacts.elements)
        for coupling in self.joints:
            stop = start + len(coupling.elements)
            yield coupling, e.parts[start:stop]
            start = stop

    def history(self, e: Evaluation) -> tuple[Any, tuple[Any, ...]]:
        """What contacts, and each of `System.joints`, remember of an accepted step."""
        contacts, *joints = (coupling.history(parts) for coupling, parts in self.each(e))
        return contacts, tuple(joints)

    def touching(
        self, e: Evaluation
    ) -> list[tuple[ContactElements, Contribution, ContactHistory]]:
        """Of each contact its elements, their part of an evaluation, and its memory of t_n.

        For results that only contacts have: pressures, impacts, changes of facet.
        """
        elements = self.contacts.elements
        parts: Any = e.parts[: len(elements)]
        return list(zip(elements, parts, self._remembered, strict=True))

    def guess(self, positions: Sequence[FloatArray], *, carried: bool) -> FloatArray:
        """Constraints' unknowns of all elements as in the last step, one after the other.

        Args:
            positions: Of each batch of elements, as of `Coupling.guess`.
            carried: Whether those of contacts are taken unchanged.
        """
        places = iter(positions)
        guess = [
            coupling.guess(k, next(places)).ravel()
            for coupling in self._all
            for k in range(len(coupling.elements))
        ]
        if carried:
            of_contacts = range(len(self.contacts.elements))
            guess[: len(of_contacts)] = [self.contacts.carried(k).ravel() for k in of_contacts]
        return np.concatenate(guess)

    def touched(self) -> set[int]:
        """Bodies that elements move but for those that hold one together, alike on all ranks.

        Collective.
        """
        own = {id(coupling) for coupling, _ in self._own}
        return set().union(*(c.touched() for c in self._all if id(c) not in own))

    def rest(self, bodies: Container[int]) -> None:
        """Leave out of the step what holds bodies together that are left out."""
        for coupling, k in self._own:
            if k in bodies:
                coupling.rest()

    def rouse(self, bodies: Container[int]) -> None:
        """Take in again what `rest` left out."""
        for coupling, k in self._own:
            if k in bodies:
                coupling.rouse()

    def wake(self, e: Evaluation) -> bool:
        """Whether a solved step asks for more elements, which are made. Collective."""
        return any([coupling.wake(e, parts) for coupling, parts in [*self.each(e)]])

    def misses(self, e: Evaluation, motion: FloatArray) -> bool:
        """Whether a solved step may have passed by something, see `Coupling.misses`. Collective."""
        return any([coupling.misses(e, parts, motion) for coupling, parts in self.each(e)])

    @property
    def may_slip(self) -> bool:
        """Whether `let_slip` changes anything."""
        return any(coupling.may_slip for coupling in self._all)

    def let_slip(self) -> None:
        """Let sticking nodes slip under a slight pull in the iterations; no solution changes."""
        for coupling in self._all:
            coupling.let_slip()

    def give_way(self) -> bool:
        """From the next step on, limit forces that had no limit; return whether there was one."""
        return any([coupling.give_way() for coupling in self._all])


def _linked(of: Sequence[tuple[int, ...]]) -> list[int]:
    """Number of the mechanism of each joint, whose bodies' numbers are given."""
    held: list[set[int]] = []
    for bodies in of:
        linked = [other for other in held if other & set(bodies)]
        held = [other for other in held if other not in linked] + [set(bodies).union(*linked)]
    return [next(k for k, one in enumerate(held) if set(bodies) <= one) for bodies in of]


def _lend_less(system: System, joints: Sequence[JointCoupling]) -> None:
    """Lend no compliance to joints of rigid bodies that form no loop. Collective."""
    found: list[tuple[JointCoupling | None, tuple[int, ...]]] = []
    of = zip(system.declared_joints, joints, system.joint_bodies, strict=False)
    for joint, coupling, bodies in of:
        still = [np.zeros(body.num_owned) for body in joint.bodies]
        if joint.slopes(still, joint.start()) is not None:  # a spring holds nothing
            continue
        rigid = all(body.rigid for body in joint.bodies)
        found.append((coupling if rigid else None, bodies))
    moved = system.comm.allreduce(np.array([b.fixed.size for b in system.bodies]))
    free = {k for k, b in enumerate(system.bodies) if b.rigid and not moved[k]}
    alone = hanging([bodies for _, bodies in found], free)
    for (rigid_ones, _), hangs in zip(found, alone, strict=True):
        if rigid_ones is not None and hangs:
            rigid_ones.hold_alone()
