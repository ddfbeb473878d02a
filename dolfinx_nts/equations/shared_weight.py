"""How the contact forces of rigid bodies share a load that more nodes carry than are needed.

Gaps of a rigid box on a plane repeat each other from the fourth node on: of its contact forces only
the resultants on each body act. Newton's matrix lends gaps a compliance (`constraints.SHIFT`), so
that a part of the forces in the null space would be the rounding of the gaps over the compliance.
Here the equations of the gaps say there that this part is zero, and nothing else. Slips of nodes
that stick repeat each other, too, and miss each other by what no motion closes, as where a face
comes down on its edge: its turn takes nodes apart by half its square. Where that counts as none,
the equations of the slips do without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from scipy.sparse.csgraph import connected_components

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_law import Contribution
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.kernels.compiled_law import wrenches
from dolfinx_nts.parallel import gather_rows
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Square of the singular values that count as zero, over that of the largest.
_NONE = 1e-12
#: Bodies up to which dense arrays are the faster ones.
_FEW = 8
#: Solves by least squares, each for what that threshold has left of the one before.
_PASSES = 3


class Rows(NamedTuple):
    """Active gaps, and slips of nodes that stick, of rigid bodies; axis 0 = row.

    Attributes:
        body: Numbers of both bodies, that of the first twice where there is no second, (n, 2).
        push: Force and moment of a unit force on each of them, shape (n, 2, 6).
        value: Gap or slip [m] and its multiplier, shape (n, 2).
        limit: Gap or slip that counts as none [m], shape (n,).
        is_gap: Which are gaps, shape (n,).
    """

    body: IntArray
    push: FloatArray
    value: FloatArray
    limit: FloatArray
    is_gap: BoolArray


class ActiveRows(NamedTuple):
    """Rows on this rank, and where they come from.

    Attributes:
        rows: The rows.
        chosen: Of each of several parts their elements, row of the residual, scales, and whether
            they are gaps.
        counts: How many rows each rank has, but for other ranks 0; empty without rigid contacts.
    """

    rows: Rows
    chosen: list[tuple[Any, IntArray, int, FloatArray, bool]]
    counts: FloatArray


def _is_rigid(pair: Any) -> bool:
    """Whether it is one of rigid bodies, with each other or with an obstacle."""
    return all(body.rigid for body in pair.bodies)


class SharedWeight:
    """Gaps and slips of rigid bodies without what is redundant in them.

    Attributes:
        any_rigid: Whether any contact is of rigid bodies alone.
        none: No rows.
        kept: Whether forces in the null space stay as they are: those of blurred laws press
            everywhere, and the least of them might pull.
    """

    def __init__(self, comm: MPI.Comm, contacts: Sequence[ContactPair]) -> None:
        self._comm = comm
        self.any_rigid = any(_is_rigid(pair) for pair in contacts)
        self.kept = False
        self.none = ActiveRows(_joined([]), [], np.zeros(comm.size if self.any_rigid else 0))

    def active(
        self, elements: Sequence[ContactElements], bodies: Sequence[tuple[int, ...]],
        parts: Sequence[Contribution], places: Sequence[FloatArray],
        closed: Callable[[ContactElements], float],
    ) -> ActiveRows:  # fmt: skip
        """Return the rows of rigid contacts that may share a weight, for `divide`.

        Args:
            elements: Batches of contacts.
            bodies: Numbers of their bodies.
            parts: Their contributions at an iterate.
            places: Nodes of the batches [m], as of `Elements.evaluate`.
            closed: Gap of a batch that counts as closed [m].
        """
        found, chosen = [], []
        batches = elements if self.any_rigid else ()
        for batch, numbers, part, x in zip(batches, bodies, parts, places, strict=False):
            on = np.flatnonzero(part.active)
            if not on.size or not _is_rigid(batch.pair) or batch.law.gap_width:
                continue
            law = batch.law
            which: list[tuple[IntArray, int, Any]] = [(on, batch.gap_row, closed(batch))]
            moved = law.prescribed is not None and law.prescribed.any
            if law.num_tangential and not law.width and not moved:
                sticks = np.flatnonzero(part.active & part.stick)
                last = batch.gap_row + law.num_constraints
                which += [(sticks, row, law.still[sticks]) for row in (last - 2, last - 1)]
            for of, row, limit in which:
                found.append(_rows(batch, numbers, part, x, of, row, limit))
                chosen.append((part, of, row, batch.law.scale[of], row == batch.gap_row))
        if not found:
            return self.none
        own, counts = _joined(found), self.none.counts.copy()
        counts[self._comm.rank] = len(own.body)
        return ActiveRows(own, chosen, counts)

    def divide(self, active: ActiveRows, counts: FloatArray) -> None:
        """Write the rows of gaps and slips anew, (1 - P) g - c P lambda = 0. Collective.

        P projects on the null space of what these forces push the bodies with at t_{n+1}, in
        P lambda of those along the normals alone; c is the compliance that the matrix lends. As c
        stands in the matrix, too, the iteration takes P lambda out, and the gaps close as without
        it: P g vanishes with the rest.
        Where it does not, as of feet that lie in no plane, gaps cannot all close, and some node has
        to leave: the rows of bodies that touch each other stay as they are then.

        Args:
            active: Rows of an iterate, whose parts' residuals are changed.
            counts: How many rows each rank has.
        """
        if not counts.any():
            return
        own, chosen, number = active.rows, active.chosen, counts.astype(int)
        rows = _unpacked(gather_rows(self._comm, _packed(own), number))
        first = int(number[: self._comm.rank].sum())
        here = slice(first, first + len(own.body))
        null = _null_part(rows)[here, 0]
        forces = np.zeros(len(null))
        if not self.kept:
            gaps = np.flatnonzero(rows.is_gap)
            both = np.zeros(len(rows.body))
            both[gaps] = _null_part(Rows._make(a[gaps] for a in rows))[:, 1]
            forces = both[here]
        ends = np.cumsum([0] + [len(on) for _, on, *_ in chosen])
        for (part, on, row, scale, is_gap), (start, stop) in zip(
            chosen, pairwise(ends), strict=True
        ):
            part.residual[on, row] -= scale * null[start:stop]
            if is_gap:
                lent = -part.tangent[on, row, row] / scale**2
                part.residual[on, row] -= scale * lent * forces[start:stop]


def _packed(rows: Rows) -> FloatArray:
    """Rows as one array, shape (n, 18)."""
    push = rows.push.reshape(-1, 12)
    return np.column_stack([rows.body, push, rows.value, rows.limit, rows.is_gap])


def _unpacked(table: FloatArray) -> Rows:
    return Rows(
        table[:, :2].astype(int), table[:, 2:14].reshape(-1, 2, 6), table[:, 14:16], table[:, 16],
        table[:, 17] > 0.0,
    )  # fmt: skip


def _joined(rows: Sequence[Rows]) -> Rows:
    """Those of several batches or ranks, one after the other."""
    if len(rows) == 1:
        return rows[0]
    none = (
        np.empty((0, 2), dtype=int), np.empty((0, 2, 6)), np.empty((0, 2)), np.empty(0),
        np.empty(0, dtype=bool),
    )  # fmt: skip
    return Rows(*map(np.concatenate, zip(none, *rows, strict=True)))


def _rows(
    batch: ContactElements, numbers: tuple[int, ...], part: Contribution, x: FloatArray,
    on: IntArray, row: int, limit: Any,
) -> Rows:  # fmt: skip
    push, start, scale = np.zeros((len(on), 2, 6)), 0, batch.law.scale[on]
    rows = part.tangent[on, row, : batch.num_coordinates] / scale[:, None]
    y = x[on]
    force = rows.reshape(y.shape)
    for k, side in enumerate(batch.attachment.sides):
        here = slice(start, start + side.nodes.shape[1])
        push[:, k] = wrenches(y[:, here], force[:, here], side.places[on], side.fixed[on])
        start = here.stop
    value = part.residual[on, row] / scale
    return Rows(
        np.tile([numbers[0], numbers[-1]], (len(on), 1)),
        push,
        np.column_stack([value, part.multiplier[on, row - batch.gap_row]]),
        np.broadcast_to(limit, value.shape),
        np.full(len(on), row == batch.gap_row),
    )


def _null_part(rows: Rows) -> FloatArray:
    """P g and P lambda, zero where gaps cannot all close, shape (n, 2)."""
    n = len(rows.body)
    known, place = np.unique(rows.body, return_inverse=True)
    place = place.reshape(n, 2)
    few, width = len(known) <= _FEW, 6 * len(known)
    g: Any
    if few:
        g = np.zeros((n, len(known), 6))
        for side in range(2):
            g[np.arange(n), place[:, side]] += rows.push[:, side]
        g = g.reshape(n, width)
        square = np.einsum("nk,nk->k", g, g)
    else:
        columns = 6 * place[:, :, None] + np.arange(6)
        at = np.repeat(np.arange(n), 12), columns.ravel()
        g = scipy.sparse.csr_array((rows.push.ravel(), at), shape=(n, width))
        square = g.power(2).sum(axis=0)
    # Turns in the length that makes their gaps as large as those of translations, if any do.
    square = square.reshape(-1, 2, 3).sum(axis=2)
    wanted = np.where(square[:, :1] > 0.0, square[:, :1], 1.0)
    unit = np.sqrt(np.divide(wanted, square, out=np.zeros_like(square), where=square > 0.0))
    unit = np.repeat(unit.ravel(), 3)
    g = g * unit if few else g @ scipy.sparse.diags(unit)
    a, b = g.T @ g, g.T @ rows.value
    largest = a.diagonal().reshape(-1, 6).max(axis=1)
    held = np.repeat(_NONE * np.where(largest > 0.0, largest, 1.0), 6)
    if few:
        inverse = np.linalg.inv(a + np.diag(held))
        solve: Callable[[FloatArray], FloatArray] = inverse.__matmul__
    else:
        solve = scipy.sparse.linalg.splu((a + scipy.sparse.diags(held)).tocsc()).solve
    best = np.zeros_like(b)
    for _ in range(_PASSES):
        best += solve(b - a @ best)
    null: FloatArray = rows.value - g @ best
    stuck = np.abs(null[:, 0]) > rows.limit
    if stuck.any():
        touch = scipy.sparse.csr_array((np.ones(n), place.T), shape=(len(known),) * 2)
        count, group = connected_components(touch, directed=False)
        of_group = np.zeros(count, dtype=bool)
        np.logical_or.at(of_group, group[place[:, 0]], stuck)
        null[of_group[group[place[:, 0]]]] = 0.0
    return null
