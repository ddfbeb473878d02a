"""What is in the scene: bodies, contacts, gravity; its validation and its state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from dolfinx_nts.contact import INITIAL_PENETRATION, ContactPair
from dolfinx_nts.continuum import Body

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.signedinteger[Any]]


@dataclass(frozen=True, eq=False)
class State:
    """Everything a step starts from; never changed, a step makes a new one.

    Attributes:
        time: t [s].
        u: Owned displacements of each body [m].
        v: Owned velocities of each body [m/s].
        facets: Facet of each owned slave node of each contact in the last step, or -1.
        force: Contact force p_N of the same nodes [N], >= 0.
        gap: Gap of the same nodes [m], infinite where a node was no candidate.
    """

    time: float
    u: tuple[FloatArray, ...]
    v: tuple[FloatArray, ...]
    facets: tuple[IntArray, ...]
    force: tuple[FloatArray, ...]
    gap: tuple[FloatArray, ...]


class System:
    """Bodies, contacts between them, and gravity.

    Args:
        bodies: Objects with the `Body` protocol, on one communicator, with different names.
        contacts: Pairs of surfaces of these bodies.
        gravity: Acceleration [m/s^2]; its work counts as external work.

    Raises:
        TypeError: `gravity` is not three numbers.
        ValueError: No body, equal names, a contact of a body that is not in the system, or initial
            penetration beyond one part in a hundred of the facet size.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        *,
        contacts: Sequence[ContactPair] = (),
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        if not bodies:
            raise ValueError(f"bodies={bodies!r}: pass at least one body")
        names = [b.name for b in bodies]
        if len(set(names)) < len(names):
            raise ValueError(f"bodies: names {names} are not unique; pass name= to each body")
        self.bodies, self.contacts = tuple(bodies), tuple(contacts)
        self.gravity = np.asarray(gravity, dtype=np.float64)
        if self.gravity.shape != (3,) or not np.isfinite(self.gravity).all():
            raise ValueError(f"gravity={gravity!r}: pass three finite components [m/s^2]")
        self.comm = self.bodies[0].comm
        for pair in self.contacts:
            for role, surface in (("slave", pair.slave), ("master", pair.master)):
                if not any(surface.body is b for b in self.bodies):
                    raise ValueError(
                        f"contacts: the {role} body {surface.body.name!r} is not among bodies={names}"
                    )
        index = {id(b): i for i, b in enumerate(self.bodies)}
        self.contact_bodies = [
            (index[id(c.slave.body)], index[id(c.master.body)]) for c in self.contacts
        ]
        self._check_penetration()

    def initial_state(self) -> State:
        """Undeformed bodies with their initial velocities at t = 0."""
        nodes = [len(c.slave.owned) for c in self.contacts]
        return State(
            time=0.0,
            u=tuple(np.zeros(b.num_owned) for b in self.bodies),
            v=tuple(b.initial_velocity.copy() for b in self.bodies),
            facets=tuple(np.full(n, -1) for n in nodes),
            force=tuple(np.zeros(n) for n in nodes),
            gap=tuple(np.full(n, np.inf) for n in nodes),
        )

    def _check_penetration(self) -> None:
        """Raise on every rank, with the nodes, if slaves start inside their masters."""
        state = self.initial_state()
        for pair, (slave, master), facets in zip(
            self.contacts, self.contact_bodies, state.facets, strict=True
        ):
            found = pair.find(state.u[slave], state.u[master], facets, 0.0)
            deep = found.gap < -INITIAL_PENETRATION * found.length
            nodes = pair.slave.original[pair.slave.owned[found.node[deep]]]
            worst = float((found.gap / found.length).min(initial=0.0))
            gathered = self.comm.allgather((nodes.tolist(), worst))
            all_nodes = sorted(n for part, _ in gathered for n in part)
            if all_nodes:
                raise ValueError(
                    f"contact {pair.name!r}: {len(all_nodes)} slave nodes start inside the master, up to "
                    f"{-min(w for _, w in gathered):.3g} of a facet (allowed {INITIAL_PENETRATION}); nodes "
                    f"{all_nodes[:10]}: move the bodies apart"
                )
