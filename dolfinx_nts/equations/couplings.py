"""All that couples the bodies of a scene, and its elements in a step, contacts first."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.bodies.batches import Batches
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_law import Contribution
from dolfinx_nts.contact.contact_search import ContactSearch
from dolfinx_nts.contact.edge_contact import EdgeElements
from dolfinx_nts.contact.edge_coupling import EdgeCoupling
from dolfinx_nts.equations.leaning import BearingLoad, Load, PressingLoad
from dolfinx_nts.equations.least_norm import hanging
from dolfinx_nts.interaction.constraints import Constraints
from dolfinx_nts.interaction.coupling import Coupling, JointCoupling
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.interaction.measured import Measured, MeasuredPart, leans, rubs
from dolfinx_nts.parallel import Asking, together
from dolfinx_nts.state import ContactHistory, EdgeHistory
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray


class OfJoints(NamedTuple):
    """What makes the elements of a joint, or of many that are alike, and their numbers."""

    coupling: JointCoupling
    numbers: list[int]


class Couplings:
    """What makes the elements of each step.

    Attributes:
        contacts: What makes the elements of contacts. Used directly only for what contacts alone
            have: closing gaps, checkpoints.
        joints: What makes those of `System.joints`.
        mechanisms: How many groups of bodies joints link.
    """

    def __init__(self, system: System) -> None:
        edges = {k: EdgeCoupling(own) for k, own in system.edges.items()}
        self.contacts = ContactSearch(system.pairs, system.pair_bodies, system.comm, edges)
        self._contacts = len(system.contacts)
        both = zip(system.joints, system.joint_bodies, strict=True)
        each: list[JointCoupling] = [joint.coupling(bodies) for joint, bodies in both]
        _lend_less(system, each)
        declared = len(system.declared_joints)
        self._number = len(each)
        self.joints = _together(each, system.joint_bodies, declared, system.batches)
        # What holds a body together may leave a step with it.
        self._own = [c for c, (k, *_) in self.joints if k >= declared]
        self._remembered: tuple[ContactHistory, ...] = ()
        linked = _linked(system.joint_bodies[:declared])
        self.mechanisms = max(linked, default=-1) + 1
        self._linked = [np.array([linked[k] for k in of if k < declared]) for _, of in self.joints]
        self._loads, self._pressed = self._bearings(system), self._pressing(system)
        self._comm, self._contact_of = system.comm, system.contact_of
        # Batches of elements of contacts and of edges in the step, which come first.
        self.num_touching = 0

    def _bearings(self, system: System) -> dict[int, tuple[int, int, int]]:
        """Number among `joints` of each law that depends on what its joint carries.

        With the number of that joint, its place among those that are evaluated with it, and in how
        many constraints it carries.
        """
        places = {
            id(system.joints[n]): (k, row)
            for k, (_, of) in enumerate(self.joints) for row, n in enumerate(of)
        }  # fmt: skip
        return {
            k: (*places[id(law.of)], law.of.bearing)
            for k, (_, (n, *_)) in enumerate(self.joints)
            if leans(getattr(law := system.joints[n], "law", None))
        }

    def _pressing(self, system: System) -> dict[int, int]:
        """Number among `joints` of each law that depends on a contact, and that of the contact."""
        number = {id(pair): k for k, pair in enumerate(system.contacts)}
        return {
            k: number[id(pair)]
            for k, (_, (n, *_)) in enumerate(self.joints)
            if (pair := getattr(system.joints[n], "pressed_by", None)) is not None
        }

    @property
    def _all(self) -> list[Coupling]:
        return [*self._of_contacts, *(coupling for coupling, _ in self.joints)]

    @property
    def _of_contacts(self) -> list[Coupling]:
        return [self.contacts, *self.contacts.edges.values()]

    def begin(self, step: Step, again: Evaluation | None, search: bool) -> None:
        """Make the elements of a step; arguments as of `Coupling.begin`. Collective."""
        state = step.state
        self._remembered = state.contacts
        self.contacts.begin(step, state.contacts, again, search)
        for edges in self.contacts.edges.values():
            edges.make()
        self.num_touching = sum(len(coupling.elements) for coupling in self._of_contacts)
        for coupling, of in self.joints:
            coupling.begin(step, itemgetter(*of)(state.joints), again, search)

    @property
    def elements(self) -> list[Any]:
        """Batches of elements in the step."""
        found: list[Any] = list(self.contacts.elements)
        for edges in self.contacts.edges.values():
            found += edges.elements
        for coupling, _ in self.joints:
            found += coupling.elements
        return found

    @property
    def bodies(self) -> list[tuple[int, ...]]:
        """Numbers of the bodies of each batch, see `Batches.batch_of`."""
        return [of for coupling in self._all for of in coupling.bodies]

    @property
    def linked(self) -> list[Any]:
        """Number of the mechanism of each of `elements`, (n,) of many joints; None: of none."""
        found: list[Any] = [None] * self.num_touching
        for (coupling, _), linked in zip(self.joints, self._linked, strict=False):
            for batch in coupling.elements:
                several = len(linked) > 1
                found.append(linked[batch.joint] if several else linked[0] if len(linked) else None)
        return found

    def extents(self) -> FloatArray:
        """Largest `Elements.extent` of all, then of each of `mechanisms`, on this rank [m]."""
        found = np.zeros(1 + self.mechanisms)
        for batch, of in zip(self.elements, self.linked, strict=True):
            found[0] = max(found[0], batch.extent)
            if of is not None:
                np.maximum.at(found, 1 + of, batch.extents if np.ndim(of) else batch.extent)
        return found

    def loads(self) -> dict[int, Load]:
        """Of the batches among `elements` whose laws lean on others' forces. Collective."""
        if not (self._loads or self._pressed):
            return {}
        starts = np.cumsum([self.num_touching, *(len(c.elements) for c, _ in self.joints)]).tolist()
        found: dict[int, Load] = {}
        for i, (k, row, bearing) in self._loads.items():
            (batch,) = self.joints[k].coupling.elements
            rows = np.flatnonzero(batch.joint == row)
            found[starts[i]] = BearingLoad(starts[k], rows, bearing)
        pressing = together(self._comm, [self._load_of(i) for i in self._pressed])
        found |= zip((starts[i] for i in self._pressed), pressing, strict=True)
        return found

    def _load_of(self, i: int) -> Asking[PressingLoad]:
        """What a law leans on that depends on a contact, as of `parallel.together`.

        Args:
            i: Its number among `joints`.
        """
        contact, (law,) = self._pressed[i], self.joints[i].coupling.elements
        numbers = [self._contact_of[k] for k in self.contacts.numbers]
        batches = [k for k, of in enumerate(numbers) if of == contact]
        guesses = [self.contacts.carried(k) for k in batches]
        start = len(numbers)
        for k, edges in self.contacts.edges.items():
            for j, batch in enumerate(edges.elements):
                if k == contact:
                    batches.append(start + j)
                    guesses.append(edges.guess(j, batch.reference()))
            start += len(edges.elements)
        return PressingLoad.of(
            self._comm, batches, self.elements, guesses, law.num_elements
        )

    def tell_loads(
        self, own: Sequence[dict[str, FloatArray]], loads: Mapping[int, Load]
    ) -> None:
        """Add to the unknowns of laws what others of the iterate are that they lean on.

        Of joints it is forces, see `Load.told`, of contacts what holds their slaves.

        Args:
            own: Of each of `elements` its own unknowns, see `Unknowns.own_values`.
            loads: `loads` of these elements.
        """
        self.contacts.held.tell(self.contacts.elements, own)
        elements = self.elements if loads else []
        for i, load in loads.items():
            own[i].update(load.told(elements, own))

    def each(self, e: Evaluation) -> Iterator[tuple[Coupling, tuple[Any, ...]]]:
        """All with their parts of an evaluation."""
        start = 0
        for coupling in self._all:
            stop = start + len(coupling.elements)
            yield coupling, e.parts[start:stop]
            start = stop

    def of_joints(
        self, e: Evaluation
    ) -> Iterator[tuple[JointCoupling, list[int], tuple[Any, ...]]]:
        """`joints` with their parts of an evaluation."""
        start = self.num_touching
        for coupling, of in self.joints:
            stop = start + len(coupling.elements)
            yield coupling, of, e.parts[start:stop]
            start = stop

    def of_edges(self, e: Evaluation) -> Iterator[tuple[int, EdgeElements, Contribution]]:
        """Numbers of contacts whose edges are near each other, their elements and parts."""
        start = len(self.contacts.elements)
        for k, coupling in self.contacts.edges.items():
            for batch in coupling.elements:
                part: Any = e.parts[start]
                yield k, batch, part
                start += 1

    @property
    def rubbing(self) -> list[Measured]:
        """Those of joints that stick and slip."""
        return [coupling for coupling, _ in self.joints if rubs(coupling)]

    def of_rubbing(self, e: Evaluation) -> list[MeasuredPart]:
        """Parts of an evaluation, of each of `rubbing`."""
        return [parts[0] for coupling, _, parts in self.of_joints(e) if rubs(coupling)]

    def blur(self, width: float, gap_width: float) -> None:
        """Let contacts of nodes and edges obey laws of these widths [m], see `ContactLaw`."""
        for coupling in self._of_contacts:
            coupling.elements = [
                replace(c, law=replace(c.law, width=width, gap_width=gap_width))
                for c in coupling.elements
            ]

    def steepen(self, scales: Iterable[FloatArray | float]) -> None:
        """Let slips tell which contacts stick, by scales of each batch, see `ContactLaw.steep`."""
        given = iter(scales)
        for coupling in self._of_contacts:
            coupling.elements = [
                replace(c, law=replace(c.law, steep=next(given))) for c in coupling.elements
            ]

    def forget_solution(self) -> None:
        """Guess contact forces of t_n again, where those of a solution of the step led nowhere."""
        self.contacts.forget_solution()
        for edges in self.contacts.edges.values():
            edges.forget_solution()

    def history(
        self, e: Evaluation
    ) -> tuple[tuple[ContactHistory, ...], tuple[Any, ...], tuple[EdgeHistory, ...]]:
        """What contacts, each of `System.joints`, and edges remember of an accepted step."""
        out: list[Any] = [None] * self._number
        for coupling, of, parts in self.of_joints(e):
            found = coupling.history(parts)
            for k, own in zip(of, found if len(of) > 1 else [found], strict=True):
                out[k] = own
        contacts = self.contacts.history(e.parts[: len(self.contacts.elements)])
        edges = [EdgeHistory.of_start()] * self._contacts
        for k, _, part in self.of_edges(e):
            edges[k] = self.contacts.edges[k].history([part])
        return contacts, tuple(out), tuple(edges)

    def touching(
        self, e: Evaluation
    ) -> list[tuple[int, ContactElements, Contribution, ContactHistory]]:
        """Of each of `System.pairs` that may act its number, elements, part, and memory of t_n.

        For results that only contacts have: pressures, impacts, changes of facet.
        """
        numbers, elements = self.contacts.numbers, self.contacts.elements
        parts: Any = e.parts[: len(elements)]
        remembered = [self._remembered[k] for k in numbers]
        return list(zip(numbers, elements, parts, remembered, strict=True))

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
        return set().union(*(c.touched() for c in self._all if c not in self._own))

    def rest(self, bodies: Collection[int]) -> None:
        """Leave out of the step what holds bodies together that are left out. Collective."""
        for coupling in self._own:
            coupling.rest(bodies)

    def rouse(self, bodies: Collection[int]) -> None:
        """Take in again what `rest` left out. Collective."""
        for coupling in self._own:
            coupling.rouse(bodies)

    def wake(self, e: Evaluation) -> bool:
        """Whether a solved step asks for more elements, which are made. Collective."""
        return any([coupling.wake(e, parts) for coupling, parts in [*self.each(e)]])

    def misses(self, e: Evaluation, motion: FloatArray) -> bool:
        """Whether a solved step may have passed by something, see `Coupling.misses`. Collective."""
        return any([coupling.misses(e, parts, motion) for coupling, parts in self.each(e)])


def _together(
    each: Sequence[JointCoupling], bodies: Sequence[tuple[int, ...]], declared: int,
    batches: Batches,
) -> list[OfJoints]:  # fmt: skip
    """Joints between bodies of one batch that are alike as one, all others one by one.

    Args:
        each: What makes the elements of each joint.
        bodies: Numbers of the bodies of each.
        declared: Number of those that the user has declared, which come first.
        batches: Of the bodies.
    """
    groups: dict[Any, list[int]] = {}
    for k, (coupling, of) in enumerate(zip(each, bodies, strict=True)):
        j, *others = {batches.batch_of(b) for b in of}
        one = j < len(batches.several) and not others
        # A class of the user's own may override anything.
        shared: Any = coupling if one and type(coupling) in (Constraints, Measured) else None
        alike = None if shared is None else shared.alike
        group = k if alike is None else (type(coupling), k < declared, j, alike)
        groups.setdefault(group, []).append(k)
    out = []
    for numbers in groups.values():
        coupling = each[numbers[0]]
        if len(numbers) > 1:
            several: Any = [each[k] for k in numbers]
            j = batches.batch_of(bodies[numbers[0]][0])
            coupling = type(several[0]).together(several, batches.bodies[j], batches.count + j)
        out.append(OfJoints(coupling, numbers))
    return out


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
