"""Nodes that several contacts hold out of one master: each of them belongs to one contact."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.nodal_pressure import carried_areas
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.state import ContactHistory
from dolfinx_nts.types import BoolArray, FloatArray

#: Difference of two normals, or of two gaps over the facet's size, that counts as none.
_ONE = 1e-6


def check_shared(contacts: Sequence[ContactPair]) -> None:
    """Raise unless what two contacts hold out of one master is a row of nodes between them.

    Raises:
        ValueError: Two slaves share facets, or one's nodes are all the other's, or both share nodes
            and their masters share but a part of their facets.
    """
    for i, j, what in _beside(contacts):
        one, two = contacts[i], contacts[j]
        name = one.slave.body.name
        same = np.isin(one.slave.points, two.slave.points)
        every = same.all() or np.isin(two.slave.points, one.slave.points).all()
        if every or one.slave.facet_points & two.slave.facet_points:
            raise ValueError(
                f"contacts: two of them hold the same nodes of {name!r} out of {what}; drop one"
            )
        if not one.has_master_of(two):
            number = int(one.slave.original[same].min())
            raise ValueError(
                f"contacts: two of them hold a row of nodes of {name!r}, node {number} among them, "
                f"out of {what}, and out of others each by itself; pass one master to both, or "
                "masters without a common facet"
            )


def held_before(contacts: Sequence[ContactPair]) -> list[BoolArray]:
    """Which points of each slave belong to a contact declared before, with the same master.

    Returns:
        Of each contact, shape (points,).
    """
    found = [np.zeros(len(c.slave.points), dtype=bool) for c in contacts]
    for i, j, _ in _beside(contacts):
        found[j] |= np.isin(contacts[j].slave.points, contacts[i].slave.points)
    return found


def meeting(contacts: Sequence[ContactPair], held: Sequence[BoolArray]) -> list[BoolArray]:
    """Which points of each slave two contacts hold, such as a node between floor and wall.

    Of rigid bodies none: there `Together` tells nodes of each other in any case.

    Args:
        contacts: Those of the system.
        held: As of `held_before`: what another contact holds in place of this one.

    Returns:
        Of each contact, shape (points,).
    """
    found = [np.zeros(len(c.slave.points), dtype=bool) for c in contacts]
    # Which nodes a contact shares with what is added to it changes from step to step.
    some = {k: c for k, c in enumerate(contacts) if not (c.redundant or c.of and not c.exchanged)}
    for i, j in _of_one_body(some):
        one, two = contacts[i].slave.points, contacts[j].slave.points
        both = np.intersect1d(one[~held[i]], two[~held[j]])
        found[i] |= np.isin(one, both)
        found[j] |= np.isin(two, both)
    return found


def drop_doubles(found: dict[int, ContactElements], histories: Sequence[ContactHistory]) -> None:
    """Keep one of two pairs that keep a node out of the same fixed surface.

    Two constraints on one gap are one too many where no master can yield, as over the seam of two
    plates. A node stays with the one that carried it.

    Args:
        found: Candidates of contacts by their number, which are replaced.
        histories: What each contact remembers of the last step.
    """
    for i, j in _of_one_body({k: c.pair for k, c in found.items()}):
        a, b = found[i], found[j]
        one, two = (c.pair.slave.points[c.pair.slave.share[c.candidates.node]] for c in (a, b))
        _, ia, ib = np.intersect1d(one, two, return_indices=True)
        ca, cb = a.candidates.select(ia), b.candidates.select(ib)
        double = np.einsum("ni,ni->n", ca.normal, cb.normal) > 1.0 - _ONE
        double &= np.abs(ca.gap - cb.gap) < _ONE * np.minimum(ca.length, cb.length)
        double &= a.immovable[ia] & b.immovable[ib]
        stay = histories[i].force[ca.node] >= histories[j].force[cb.node]
        for k, c, there in ((i, a, ia[double & ~stay]), (j, b, ib[double & stay])):
            if len(there):
                found[k] = c.select(~np.isin(np.arange(len(c.candidates.node)), there))


def carried_area(contacts: Sequence[ContactPair], k: int, u: FloatArray) -> FloatArray:
    """Area of the pressure at the points of a contact's slave [m^2], (points,). Collective.

    Args:
        contacts: Those of the system; later ones give theirs at nodes that they share with this.
        k: Number of the contact.
        u: Owned displacements of the slave's body [m].
    """
    slave = contacts[k].slave
    found = carried_areas(slave, slave.positions(u))
    for i, j, _ in _beside(contacts):
        if i == k:
            other = contacts[j].slave
            _, here, there = np.intersect1d(slave.points, other.points, return_indices=True)
            found[here] += carried_areas(other, other.positions(u))[there]
    return found


def _of_one_body(contacts: Mapping[int, ContactPair]) -> list[tuple[int, int]]:
    """Numbers of contacts whose slaves are of one body, two and two."""
    of: dict[int, list[int]] = {}
    for k, pair in contacts.items():
        of.setdefault(id(pair.slave.body), []).append(k)
    return sorted(both for each in of.values() for both in combinations(each, 2))


def _beside(contacts: Sequence[ContactPair]) -> Iterator[tuple[int, int, str]]:
    """Pairs of contacts that share slave nodes and a master, in order, and what the master is.

    What is added to a contact stands beside it, but for corners, which come last.
    """
    number = {id(pair): k for k, pair in enumerate(contacts)}
    place = [(pair.exchanged, number[id(pair.of or pair)]) for pair in contacts]
    for both in _of_one_body(dict(enumerate(contacts))):
        i, j = sorted(both, key=place.__getitem__)
        one, two = contacts[i], contacts[j]
        what: Any = one.shares_master(two)
        # What is added to a contact holds its nodes out of other facets.
        added = (one.of or two.of) and (one.of or one) is (two.of or two)
        if what and not added and np.isin(one.slave.points, two.slave.points).any():
            yield i, j, what
