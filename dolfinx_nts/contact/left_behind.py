"""Nodes that an accepted step leaves behind a surface without contact."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mpi4py import MPI

import numpy as np

from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_law import Contribution
from dolfinx_nts.interaction.coupling import StepWarning
from dolfinx_nts.parallel import global_max

#: Depth in facet sizes from which on a node is told that lies behind its facet without a force.
_UNHELD = 1e-6


def unheld(
    comm: MPI.Comm, elements: Sequence[ContactElements], parts: Sequence[Contribution]
) -> Iterator[StepWarning]:
    """Nodes behind their facets whose forces would be rounding of other forces. Collective."""
    # Without friction no force counts as rounding.
    rub = [(c, part) for c, part in zip(elements, parts, strict=True) if c.pair.friction]
    if not rub:
        return
    depths = [
        (-part.gap / c.candidates.length)[~part.active].max(initial=0.0) for c, part in rub
    ]
    for (c, _), depth in zip(rub, global_max(comm, np.array(depths)), strict=True):
        if depth > _UNHELD:
            text = (
                f"nodes of contact {c.pair.name!r} lie up to {depth:.3g} of a facet behind their "
                "master without contact: a force that holds them is below the rounding of the "
                "forces in the bodies, where friction has no direction; pass friction=0, or "
                "let the bodies differ less in stiffness and weight"
            )
            yield StepWarning("contact below rounding", float(depth), text, (c.pair.name,), True)
