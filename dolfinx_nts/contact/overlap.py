"""Bodies that end up inside each other, or in obstacles, which contact of nodes may not see.

Nodes of the slave are kept out of the master's facets and of obstacles; an edge of the one may
still pass through the other between its nodes, a small obstacle into a large facet, and what is not
declared as a surface is not held at all. `OverlapWatch` looks at the bodies of a run as often as
their motion asks for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx_nts.contact.crossings import BodyPair, Finding, Pause
from dolfinx_nts.contact.obstacle_crossings import ObstacleContact
from dolfinx_nts.contact.overhang import FLAT, inside_rim
from dolfinx_nts.contact.self_crossings import SelfPair
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.kernels.vectors import range_of, relative_way
from dolfinx_nts.state import ContactHistory, EdgeHistory
from dolfinx_nts.types import BoolArray, FloatArray


@dataclass
class _Looked:
    """The last look at a pair.

    Attributes:
        where: What was where, as of `where`.
        pause: Until the next look.
    """

    where: list[FloatArray]
    pause: Pause


class _Everywhere(dict[int, FloatArray]):
    """Forces of all points of a contact's slave by its number, (p,) each. Collective.

    Args:
        contacts: All, with their bodies.
        histories: What each of them remembers.
    """

    def __init__(self, contacts: Sequence[Any], histories: Sequence[ContactHistory]) -> None:
        self._contacts, self._histories = contacts, histories

    def __missing__(self, k: int) -> FloatArray:
        force: FloatArray = self._contacts[k][0].slave.at_all(self._histories[k].force)
        return self.setdefault(k, force)


class OverlapWatch:
    """Looks whether bodies that are in a contact with each other end up inside each other.

    Also whether obstacles end up inside facets of a slave that they are the master of, inside those
    or over nodes of its body's remaining boundary, or inside the body. Bodies of which no contact
    is declared may pass through each other. A look is due when the two have moved relative to each
    other so far that they can touch; then by a quarter of a facet since the last one. The radius of
    a small obstacle counts as a facet, and so does the thickness of the thicker one of two bodies.
    Where they have moved by more than that thickness between two looks, the straight way is looked
    at, too.
    """

    def __init__(self, system: Any) -> None:
        self._comm, self._bodies, self._along = system.comm, system.bodies, system.edges
        self._of_slaves = system.of_slaves
        self._corners = [(n, c) for n, c in enumerate(system.pairs) if c.exchanged]

        @cache
        def start() -> tuple[FloatArray, ...]:
            return system.initial_state().u

        def boundary(k: int) -> Surface:
            whole: Surface = system.bodies[k].boundary()
            return whole

        between: dict[tuple[tuple[int, ...], bool], list[Any]] = {}
        obstacles, alone = list[ObstacleContact](), list[tuple[int, ...]]()
        self._contacts = list(zip(system.contacts, system.contact_bodies, strict=True))
        of_body: dict[int, list[Any]] = {}
        for contact, _ in self._contacts:
            of_body.setdefault(id(contact.slave.body), []).append(contact)
        for contact, bodies in self._contacts:
            if len(contact.bodies) == 1 and len(contact.slave.facets):
                others = of_body[id(contact.slave.body)]
                alike = [c.slave for c in others if _same_obstacle(contact, c)]
                slaves = [s for s in alike if len(s.facets)]
                obstacles.append(ObstacleContact(contact, bodies[0], slaves, boundary, start))
                alone.append(bodies)
            elif len(contact.bodies) == 2 and all(b.mesh is not None for b in contact.bodies):
                itself = contact.slave is contact.master
                between.setdefault((tuple(sorted(bodies)), itself), []).append(contact)
        pairs = [
            (SelfPair if itself else BodyPair)(k, c, boundary) for (k, itself), c in between.items()
        ]
        self._pairs: list[BodyPair | ObstacleContact] = [*obstacles, *pairs]
        self._movers: list[list[Any]] = [
            *([o.contact.slave.body, None] for o in obstacles),
            *([self._bodies[k] for k in bodies] for bodies, _ in between),
        ]
        # Of each its bodies, -1 for an obstacle; which obstacles move; a bound on the way since the
        # last look [m], and that from which on the next one is due.
        numbers: list[tuple[int, ...]] = [(bodies[0], -1) for bodies in alone]
        numbers += [bodies for bodies, _ in between]
        self._numbers_of = np.array(numbers, dtype=int).reshape(-1, 2)
        self._driven = np.zeros(len(numbers), dtype=bool)
        self._driven[: len(obstacles)] = [o.contact.driven for o in obstacles]
        self._ways, self._dues = np.zeros(len(numbers)), np.full(len(numbers), -np.inf)
        self._last: Sequence[FloatArray] = ()
        self._numbers = {id(c): k for k, c in enumerate(system.contacts)}
        # What the nodes of meshes miss each other by is no overlap.
        self._allowed = [
            *(o.contact.adjust for o in obstacles),
            *(max(c.adjust for c in contacts) for contacts in between.values()),
        ]
        self._looked: dict[int, _Looked] = {}

    def look(
        self,
        u: Sequence[FloatArray],
        time: float = 0.0,
        *,
        contacts: Sequence[ContactHistory] = (),
        edges: Sequence[EdgeHistory] = (),
        last: bool = False,
    ) -> list[Finding]:
        """The worst finding of each kind and pair, if a look is due. Collective, same on all ranks.

        Args:
            u: Owned displacements of all bodies [m]; kept until the next look, not to be changed.
            time: At which they are so [s].
            contacts: What each of `System.pairs` remembers; may be left out, and then contact
                inside a rim is not told.
            edges: What the edges of each contact remember; left out with `contacts`.
            last: Look again wherever anything has moved.
        """
        findings: list[Finding] = []
        forces = _Everywhere(self._contacts, self._of_slaves(contacts) if contacts else ())
        for k, where, way in self._due(u, time, last):
            before, pair = self._looked.get(k), self._pairs[k]
            found, pause = pair.look(where)
            if before and way > before.pause.clear + before.pause.through:
                found += pair.passed(before.where, where, way, before.pause.through)
            findings += [f for f in found if f.depth > self._allowed[k]]
            # Obstacles have no rim.
            if contacts and isinstance(pair, BodyPair):
                findings += self._of_contacts(pair, u, forces, contacts, edges)
            self._looked[k], self._dues[k] = _Looked(where, pause), pause.due
        worst: dict[tuple[str, tuple[str, ...]], Finding] = {}
        for f in findings:
            key = f.kind, f.about
            if key not in worst or f.size > worst[key].size:
                worst[key] = f
        return list(worst.values())

    def _of_contacts(
        self,
        pair: BodyPair,
        u: Sequence[FloatArray],
        everywhere: _Everywhere,
        histories: Sequence[ContactHistory],
        edges: Sequence[EdgeHistory],
    ) -> Iterator[Finding]:
        """What is told of contacts by their forces. Collective.

        That one ends inside the rim of a master.

        Args:
            pair: The bodies between which they are.
            u: As of `look`.
            everywhere: Normal forces of all points of each contact's slave [N].
            histories: As `contacts` of `look`.
            edges: As of `look`.
        """
        for contact in pair.contacts:
            k = self._numbers[id(contact)]
            bodies = self._contacts[k][1]
            # The surface of a contact of a body with itself may end where the body does not.
            if len(set(bodies)) < 2:
                continue
            carry = everywhere[k]
            if k in self._along:
                # Edges carry at a rim, where they cross it: between their nodes.
                carry = carry + self._along[k].nodal_forces(edges[k])
            borne = sum(c.borne(histories[n]) for n, c in self._corners if c.of is contact)
            if not carry.any():
                continue
            where = [u[b] for b in bodies]
            positions = contact.positions(where)
            held = self._held_otherwise(k, everywhere)
            rim = inside_rim(contact, positions, carry, held, borne)
            # Edges that cross will carry at the rim as soon as the body has tipped so far.
            if rim and k in self._along and self._along[k].meets(where, FLAT, carry > 0.0):
                rim = None
            if rim:
                yield rim

    def _held_otherwise(self, k: int, forces: _Everywhere) -> BoolArray:
        """Which points of contact k's slave carry in another contact, shape (p,).

        By the normal forces of all points of each contact's slave [N].
        """
        slave = self._contacts[k][0].slave
        held = np.zeros(len(slave.points), dtype=bool)
        for n, (contact, _) in enumerate(self._contacts):
            if n != k and contact.slave.body is slave.body:
                held |= np.isin(slave.original, contact.slave.original[forces[n] > 0.0])
        return held

    def enclosed(self, u: Sequence[FloatArray], time: float) -> list[Finding]:
        """Obstacles inside bodies that a contact is to hold out of them. Collective.

        Args:
            u: Owned displacements of all bodies [m].
            time: At which they are so [s].
        """
        pairs = [pair for pair in self._pairs if isinstance(pair, ObstacleContact)]
        return [found for pair in pairs for found in pair.inside(pair.where(u, time))]

    def _due(
        self, u: Sequence[FloatArray], time: float, last: bool
    ) -> list[tuple[int, list[FloatArray], float]]:
        """Pairs that have moved enough, what is where, and how far they have [m]. Collective."""
        last_ones = self._last
        if last_ones and len(self._ways):
            moved = np.array([
                *(body.motion_range(now - before)
                  for body, now, before in zip(self._bodies, u, last_ones, strict=True)),
                np.zeros((2, 3)),
            ])  # fmt: skip
            self._comm.Allreduce(MPI.IN_PLACE, moved, op=MPI.MAX)
            self._ways += relative_way(moved[self._numbers_of])
        self._last = u
        fresh, near = [], []
        dues = np.minimum(self._dues, 0.0) if last else self._dues
        for k in np.flatnonzero(self._driven | (self._ways > dues)).tolist():
            looked, where = self._looked.get(k), self._pairs[k].where(u, time)
            if looked is None:
                fresh.append((k, where, 0.0))
            else:
                near.append((k, looked, where))
        # Largest motion in each direction; the opposite ones are the least.
        moved = np.full((len(near), 2, 2, 3), -np.inf)
        for i, (k, looked, where) in enumerate(near):
            both = zip(self._movers[k], where, looked.where, strict=True)
            for j, (body, after, before) in enumerate(both):
                change = after - before
                # An obstacle has no body.
                moved[i, j] = range_of(change) if body is None else body.motion_range(change)
        if near:
            self._comm.Allreduce(MPI.IN_PLACE, moved, op=MPI.MAX)
        due = []
        for (k, _, where), way in zip(near, relative_way(moved).tolist(), strict=True):
            looks = way > dues[k]
            if looks:
                due.append((k, where, way))
            self._ways[k] = 0.0 if looks else way
        return fresh + due


def _same_obstacle(one: Any, two: Any) -> bool:
    """Return whether two contacts of a body are with the same obstacle."""
    return one.shares_master(two) is not None and one.master.motion is two.master.motion
