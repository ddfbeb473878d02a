"""Where the unknowns of a step stand, and how elements read them and add forces to them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.bodies.batch import BodyBatch
from dolfinx_nts.bodies.batches import Batches
from dolfinx_nts.equations.layout import ElementBlocks, Layout
from dolfinx_nts.equations.leaning import Load
from dolfinx_nts.interaction.combination import num_multipliers, of_multipliers
from dolfinx_nts.types import BoolArray, FloatArray, IntArray

#: Fields of the elements' own unknowns; the first is left out where nobody has any.
_OWN = ("augmented", "constraints")


class Unknowns:
    """Layout of the unknowns: batches of bodies first, then those that elements have of their own.

    Args:
        batches: Of the bodies.
        awake: Numbers of the bodies in the step, the same on all ranks, in order.
        elements: Batches of elements.
        bodies: Numbers of the bodies of each batch, see `Batches.batch_of`.
        loads: Multipliers of others that laws of batches depend on, as of `Couplings.loads`; their
            columns follow all others in the tangents.

    Attributes:
        awake: Numbers of the batches of bodies with bodies in the step: one field each.
        layout: Fields of the unknowns.
        own: Fields of the elements' own unknowns by name; empty if they have none.
        blocks: Unknowns of each batch of elements; empty if there are no elements on any rank.
        x: PETSc vector of the unknowns.
        held: Where prescribed coordinates stand among this rank's unknowns.
    """

    def __init__(
        self, batches: Batches, awake: Sequence[int], elements: Sequence[Any],
        bodies: Sequence[tuple[int, ...]], loads: Mapping[int, Load] = MappingProxyType({}),
    ) -> None:  # fmt: skip
        comm = batches.comm
        self._batches = batches
        self.awake = sorted({batches.batch_of(k) for k in awake})
        self._field = {j: f for f, j in enumerate(self.awake)}
        self._awake = _of_awake(batches, awake)
        counts = [
            int(self._awake[j].here.sum()) if j in self._awake else batches.bodies[j].num_owned
            for j in self.awake
        ]
        local = [sum(_size(c, name) for c in elements) for name in _OWN]
        there = comm.allreduce(np.array([*local, sum(c.num_elements for c in elements)]))
        self.own: dict[str, int] = {}
        for name, size, total in zip(_OWN, local, there[:-1], strict=True):
            if total:
                self.own[name] = len(counts)
                counts.append(size)
        self.layout = Layout(comm, counts)
        self._places = {j: self.layout.owned(f) for j, f in self._field.items()}
        self.held = np.concatenate(
            [np.empty(0, np.int64)]
            + [place.start + batches.bodies[j].fixed for j, place in self._places.items()]
        )
        self._parts: dict[int, Any] = {}
        self.blocks = self._blocks(elements, bodies, loads) if there[-1] else []
        index, owners = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        for c, numbers in zip(elements, bodies, strict=True):
            if c.num_elements:
                both = list(zip(numbers, c.points(), strict=True))
                parts = [self.numbers_of(b, p) for b, p in both]
                index.append(np.concatenate(parts, axis=1).ravel())
                of = [batches.body_of(b, p) for b, p in both]
                owners.append(np.concatenate(of, axis=1).ravel())
        self._body_of_row = np.concatenate(owners)
        needed = np.concatenate(index).astype(PETSc.IntType)
        self.x = PETSc.Vec().createMPI((self.layout.num_owned, None), comm=comm)
        self._forces = self.x.duplicate()
        self._local = PETSc.Vec().createSeq(len(needed), comm=PETSc.COMM_SELF)
        source = PETSc.IS().createGeneral(needed, comm=PETSc.COMM_SELF)
        self._scatter = PETSc.Scatter().create(self.x, source, self._local, None)
        source.destroy()

    def _in_field(self, k: int, numbers: IntArray) -> tuple[int, IntArray]:
        """Field of a body, and its coordinates' numbers there; negative numbers stay."""
        j, found = self._batches.batch_of(k), self._batches.in_batch(k, numbers)
        if j in self._awake:
            found = np.where(found < 0, found, self._awake[j].numbers[found])
        return self._field[j], found

    def numbers_of(self, k: int, numbers: IntArray) -> IntArray:
        """A body's coordinates -> all unknowns; negative numbers stay."""
        field, own = self._in_field(k, numbers)
        return np.where(own < 0, own, self.layout.to_system(field, own))

    def _blocks(
        self, elements: Sequence[Any], bodies: Sequence[tuple[int, ...]], loads: Mapping[int, Load]
    ) -> list[ElementBlocks]:
        """Numbers of the elements' unknowns in their fields."""
        blocks = []
        sizes = [_size(c, "constraints") for c in elements]
        starts = np.cumsum([0, *sizes]).tolist()
        offset = {name: self.layout.start(f) for name, f in self.own.items()}
        for i, (c, of) in enumerate(zip(elements, bodies, strict=True)):
            if not all(self._batches.batch_of(b) in self._field for b in of):
                none = np.empty((0, 0), dtype=bool)
                blocks.append(ElementBlocks((), (), (), none, none))
                continue
            of_bodies = [self._in_field(b, dofs) for b, dofs in zip(of, c.dofs(), strict=True)]
            numbers = [number for _, number in of_bodies]
            for name in self.own:
                shape = c.num_elements, c.widths[name]
                numbers.append(offset[name] + np.arange(shape[0] * shape[1]).reshape(shape))
            stops = np.cumsum([0, *(n.shape[1] for n in numbers)])
            pattern, entries = np.ones((2, stops[-1], stops[-1]), dtype=bool)
            columns, weights = [np.arange(a, b) for a, b in pairwise(stops)], None
            both = np.arange(stops[len(of_bodies)])
            if "constraints" in self.own:
                pattern[stops[-2] :, stops[-2] :] = c.pattern
                both = np.concatenate([both, columns[-1]])
                if c.combination is not None:
                    number, weight, _ = c.combination
                    columns[-1] = columns[-1].repeat(weight.shape[2])
                    weights = weight.reshape(len(weight), len(columns[-1]))
                    new = offset["constraints"] + number.reshape(weights.shape)
                    numbers[-1] = np.where(weights == 0.0, -1, new)
            entries[np.ix_(both, both)] = c.entries[: len(both), : len(both)]
            for name in self.own:
                offset[name] += _size(c, name)
            fields = (*(field for field, _ in of_bodies), *self.own.values())
            block = ElementBlocks(
                fields, tuple(columns), tuple(numbers), pattern, entries, weights
            )
            if i in loads:
                field = self.own["constraints"]
                first = [self.layout.start(field) + start for start in starts]
                block = block.with_columns(field, loads[i].columns(elements, first))
            blocks.append(block)
        return blocks

    # ---- bodies
    def of_body(self, k: int) -> slice:
        """Where a body's coordinates stand among this rank's unknowns."""
        j = self._batches.batch_of(k)
        place, batch = self._places[j], self._batches.bodies[j]
        if not isinstance(batch, BodyBatch):
            return place
        of = batch.number_here
        found = np.flatnonzero((of[self._awake[j].here] if j in self._awake else of) == k)
        start = place.start + (int(found[0]) if found.size else 0)
        return slice(start, start + len(found))

    def part(self, j: int, matrix: PETSc.Mat) -> Any:
        """The part of a batch's PETSc matrix that is in the step. Collective."""
        if j not in self._awake:
            return matrix
        start, _ = matrix.getOwnershipRange()
        numbers = (start + np.flatnonzero(self._awake[j].here)).astype(PETSc.IntType)
        chosen = PETSc.IS().createGeneral(numbers, comm=self._batches.comm)
        chosen.setBlockSize(3)
        found = matrix.createSubMatrix(chosen, chosen, self._parts.get(j))
        chosen.destroy()
        self._parts[j] = found
        return found

    def read(self, values: FloatArray, base: Sequence[FloatArray]) -> list[FloatArray]:
        """Owned coordinates of each batch, from this rank's unknowns.

        Args:
            values: This rank's unknowns.
            base: Coordinates of each batch, for those that are not in the step.
        """
        out = list(base)
        for j, place in self._places.items():
            if j in self._awake:
                out[j] = base[j].copy()
                out[j][self._awake[j].here] = values[place]
            else:
                out[j] = values[place]
        return out

    def moves(
        self, places: Sequence[FloatArray], known: Mapping[int, FloatArray]
    ) -> list[float]:
        """1 for each batch `awake` that is not where it is known to have been here, else 0.

        Args:
            places: Displacements of each batch [m].
            known: Those there by the batch's number; one without is elsewhere.
        """
        return [
            float(j not in known or not np.array_equal(places[j], known[j])) for j in self.awake
        ]

    def write(self, values: Sequence[FloatArray | None], out: FloatArray) -> None:
        """Owned coordinates of each batch -> this rank's unknowns; `read` in reverse."""
        for j, place in self._places.items():
            own = values[j]
            assert own is not None
            out[place] = own[self._awake[j].here] if j in self._awake else own

    def of_elements(self, name: str) -> slice:
        """Where a field of the elements' own unknowns stands among this rank's unknowns."""
        return self.layout.owned(self.own[name])

    def guess(
        self, places: Sequence[FloatArray], prescribed: Sequence[FloatArray],
        elements: Sequence[Any], multipliers: Callable[[list[FloatArray]], FloatArray] | None,
    ) -> None:  # fmt: skip
        """Write a first guess into `x`, d and f that fit its positions among it. Collective.

        Args:
            places: Displacements of each batch of bodies [m], as of `write`.
            prescribed: The same where coordinates are prescribed [m].
            elements: Batches of elements.
            multipliers: From positions as of `positions`; None: they are none.
        """
        with self.x as x:
            self.write(prescribed, x)
            held = x[self.held].copy()
            x[:] = 0.0
            self.write(places, x)
            x[self.held] = held
        if "constraints" in self.own and multipliers is not None:
            found = multipliers(self.positions(self.x, elements))
            with self.x as x:
                x[self.of_elements("constraints")] = found
        if "augmented" in self.own:
            both = zip(elements, self.positions(self.x, elements), strict=True)
            guess = [c.initial_guess(positions).ravel() for c, positions in both]
            with self.x as x:
                x[self.of_elements("augmented")] = np.concatenate(guess)

    def positions(self, x: PETSc.Vec, elements: Sequence[Any]) -> list[FloatArray]:
        """Positions that each batch depends on [m], see `Elements.evaluate`. Collective."""
        references = [c.reference() for c in elements]
        if not self.blocks:
            return references
        both = zip(references, self.at_elements(x, elements), strict=True)
        return [reference + u.reshape(reference.shape) for reference, u in both]

    def at_elements(self, x: PETSc.Vec, elements: Sequence[Any]) -> list[FloatArray]:
        """A vector's values at the coordinates of each batch, shape (n, columns). Collective."""
        self._scatter.scatter(x, self._local, mode=PETSc.ScatterMode.FORWARD)
        values, start, out = self._local.array_r.copy(), 0, []
        for c in elements:
            stop = start + c.num_elements * c.num_coordinates
            out.append(values[start:stop].reshape(c.num_elements, c.num_coordinates))
            start = stop
        return out

    def own_values(
        self, values: FloatArray, elements: Sequence[Any]
    ) -> list[dict[str, FloatArray]]:
        """Own unknowns of each batch by field, shape (n, width), from this rank's unknowns."""
        out: list[dict[str, FloatArray]] = [{} for _ in elements]
        for name in _OWN:
            of_field = values[self.of_elements(name)] if name in self.own else None
            start = 0
            for own, c in zip(out, elements, strict=True):
                shape, stop = (c.num_elements, c.widths[name]), start + _size(c, name)
                if of_field is None:
                    own[name] = np.zeros(shape)
                elif name == "constraints" and c.combination is not None:
                    own[name] = c.combination.of_constraints(of_field[start:stop])
                else:
                    own[name] = of_field[start:stop].reshape(shape)
                start = stop
        return out

    def own_rows(
        self, name: str, elements: Sequence[Any], rows: Sequence[FloatArray]
    ) -> FloatArray:
        """Rows of a field of own unknowns, from those of each batch's elements (n, width)."""
        if name == "constraints":
            rows = [of_multipliers(c, row) for c, row in zip(elements, rows, strict=True)]
        return np.concatenate([row.ravel() for row in rows])

    def gross_forces(
        self, elements: Sequence[Any], parts: Sequence[Any], bodies: int
    ) -> FloatArray:
        """Sum of the squares of all elements' forces on each body on this rank, shape (bodies,).

        Forces that cancel each other count in full.
        """
        if not self.blocks:
            return np.zeros(bodies)
        squares: FloatArray = np.square(_coordinate_rows(elements, parts))
        found: Any = np.bincount(self._body_of_row, squares, minlength=bodies)
        return found

    def forces(self, elements: Sequence[Any], parts: Sequence[Any]) -> FloatArray:
        """Rows of coordinates of all elements, summed up at this rank's unknowns. Collective."""
        self._local.array_w[:] = _coordinate_rows(elements, parts)
        self._forces.set(0.0)
        add, reverse = PETSc.InsertMode.ADD_VALUES, PETSc.ScatterMode.REVERSE
        self._scatter.scatter(self._local, self._forces, addv=add, mode=reverse)
        return self._forces.array_r.copy()

    def destroy(self) -> None:
        """Free the PETSc objects, which Python's collector does not."""
        for a in (self.x, self._forces, self._local, self._scatter, *self._parts.values()):
            a.destroy()


class _Awake(NamedTuple):
    """Which coordinates of a batch are in the step, where not all are.

    Attributes:
        numbers: Of all coordinates of the batch among those in the step.
        here: Which of those on this rank are.
    """

    numbers: IntArray
    here: BoolArray


def _of_awake(batches: Batches, awake: Collection[int]) -> dict[int, _Awake]:
    """Of batches by their number, where some of their bodies are in the step and some are not."""
    found = {}
    for j, batch in enumerate(batches.several):
        there = np.isin(batch.number_of, list(awake))
        if there.any() and not there.all():
            found[j] = _Awake(np.cumsum(there) - 1, np.isin(batch.number_here, list(awake)))
    return found


def _size(batch: Any, name: str) -> int:
    """Own unknowns of a batch of elements on this rank."""
    if name == "constraints":
        return num_multipliers(batch)
    return int(batch.num_elements * batch.widths[name])


def _coordinate_rows(elements: Sequence[Any], parts: Sequence[Any]) -> FloatArray:
    """Residuals of the coordinates of all elements, one after the other [kg m]."""
    rows = [
        part.residual[:, : c.num_coordinates].ravel()
        for c, part in zip(elements, parts, strict=True)
    ]
    return np.concatenate([np.empty(0), *rows])
