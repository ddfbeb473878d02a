"""What the elements of a step contribute to its equations at an iterate."""

from __future__ import annotations

from operator import is_not
from typing import Any

import numpy as np
from petsc4py import PETSc

from dolfinx_nts.contact.alike import Alike
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.equations.couplings import Couplings
from dolfinx_nts.equations.scales import Lengths
from dolfinx_nts.equations.shared_weight import ActiveRows, SharedWeight
from dolfinx_nts.equations.unknowns import Unknowns
from dolfinx_nts.interaction.elements import Raised, evaluate_here
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.types import FloatArray

#: What elements contribute on this rank, or raise there, and rows of weight that is shared.
Parts = tuple[tuple[Any, ...], Raised | None, ActiveRows]


class ElementTerms:
    """The elements of a step, evaluated together; `begin` fixes the step.

    Args:
        couplings: What makes them.
        weight: Weight that contacts of rigid bodies share.
        lengths: Of the step.
        rtol: As of `StepProblem`.
    """

    def __init__(
        self, couplings: Couplings, weight: SharedWeight, lengths: Lengths, rtol: float
    ) -> None:
        self._couplings, self._weight, self._lengths = couplings, weight, lengths
        self._rtol, self._alike = rtol, Alike(())

    def begin(self, laid: Unknowns, bearing: dict[int, Any]) -> None:
        """Fix layout and forces that laws lean on, as of `Couplings.loads`."""
        self._laid, self._bearing = laid, bearing
        #: Where no rank has elements: nothing, at every iterate.
        self._nothing: Parts | None = None

    def at(self, x: PETSc.Vec, values: FloatArray) -> Parts:
        """What they contribute at an iterate, whose part here are the values. Collective."""
        if self._nothing is not None:
            return self._nothing
        found = self._evaluated(x, values)
        self._nothing = None if self._laid.blocks or found[1] else found
        return found

    def _evaluated(self, x: PETSc.Vec, values: FloatArray) -> Parts:
        """`at` where there may be some."""
        laid, couplings, elements = self._laid, self._couplings, self._couplings.elements
        positions, own = laid.positions(x, elements), laid.own_values(values, elements)
        couplings.tell_loads(own, self._bearing)
        alike = self._alike
        if len(elements) != len(alike.of) or any(map(is_not, elements, alike.of)):
            self._alike = alike = Alike(elements, alike)
        parts, raised = evaluate_here(
            laid.layout.comm, alike.elements, alike.places(positions), alike.own(own)
        )
        if raised is not None:
            return (), raised, self._weight.none
        parts, touching = alike.apart(parts), couplings.num_touching
        active = self._weight.active(
            elements[:touching], couplings.bodies, parts[:touching], positions[:touching],
            self._closed,
        )  # fmt: skip
        return parts, None, active

    def _closed(self, batch: ContactElements) -> float:
        """Gap of a batch that surely counts as closed [m], see `ContactElements.ratios`."""
        motion = float(self._lengths.motion.max())
        limits = batch.ratios(
            None, [0.0, 1.0, 0.0, 0.0], motion, motion + self._lengths.rounded, self._rtol
        )
        return 1.0 / limits[f"{batch.name} constraints"]

    def turned(self, last: Evaluation | None, parts: tuple[Any, ...]) -> bool:
        """Whether contacts have another status on this rank than in the last iterate, if any."""
        before = () if last is None else last.parts
        both = zip(before, parts[: self._couplings.num_touching], strict=False)
        return any(bool((a.status != b.status).any()) for a, b in both)

    def measures(self, parts: tuple[Any, ...]) -> FloatArray:
        """`Evaluation.measures` on this rank; zeros where elements raised."""
        elements = self._couplings.elements
        found = np.zeros((len(elements) if "augmented" in self._laid.own else 0, 2))
        for row, batch, part in zip(found, elements, parts, strict=False):
            row[:] = batch.largest(part)[2:]
        return found
