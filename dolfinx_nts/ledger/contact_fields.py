"""Results of contacts at the nodes of a body's mesh: forces, pressure, gap, slip, status."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, NamedTuple

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.contact.nodal_pressure import pressures
from dolfinx_nts.contact.pair import ContactPair
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.state import ContactHistory, State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray

if TYPE_CHECKING:
    from dolfinx_nts.equations.problem import StepProblem


class ContactLoads(NamedTuple):
    """Contact forces of a step, as its elements have them.

    Attributes:
        contacts: Those of the system.
        elements: Those of each contact that has some, of nodes, corners and edges that are near,
            with their solution.
        factor: What the step equations multiply forces by [s^2].
    """

    contacts: tuple[ContactPair, ...]
    elements: dict[int, list[tuple[Any, Any]]]
    factor: float

    @classmethod
    def of_step(cls, problem: StepProblem, step: Evaluation) -> ContactLoads:
        """Of a solved step; its tangents are not kept."""
        couplings, found = problem.couplings, dict[int, list[tuple[Any, Any]]]()
        both = [(problem.system.contact_of[k], c, p) for k, c, p, _ in couplings.touching(step)]
        for k, c, part in [*both, *couplings.of_edges(step)]:
            found.setdefault(k, []).append((c, part._replace(tangent=np.empty(0))))
        return cls(problem.system.contacts, found, problem.factor)

    def on(self, k: int) -> list[tuple[Surface, FloatArray]]:
        """Forces of a contact on the points of its surfaces [N], (p, 3) each. Collective."""
        pair, found = self.contacts[k], []
        total = [np.zeros((len(surface.points), 3)) for surface in pair.surfaces]
        for c, part in self.elements.get(k, ()):
            forces = c.nodal_forces(part)
            turned = -1 if c.pair.exchanged else 1
            for all_forces, own in zip(total, forces[::turned], strict=True):
                all_forces += own
        for surface, force in zip(pair.surfaces, total, strict=True):
            surface.body.comm.Allreduce(MPI.IN_PLACE, force, op=MPI.SUM)
            found.append((surface, force / self.factor))
        return found

    def pressing(self, k: int, force: FloatArray) -> FloatArray:
        """Contact forces p_N of this rank's slave nodes as their body feels them [N]. Collective.

        Those of edges are left out.

        Args:
            k: Number of the contact.
            force: Those of its law, shape (share,).
        """
        # Surfaces that are integrated over have no corners, but several faces may hold them.
        parts = [c.pressing(part) for c, part in self.elements.get(k, ())]
        over = [part for part in parts if part is not None]
        if not over:
            return force
        found: FloatArray = np.sum(over, axis=0)
        slave = self.contacts[k].slave
        slave.body.comm.Allreduce(MPI.IN_PLACE, found, op=MPI.SUM)
        return found[slave.share] / self.factor


def labels(system: System) -> list[str]:
    """Names of the contacts for fields, all different: those of the same name are numbered."""
    names = [re.sub(r"^\.+|[^\w.-]+", "_", pair.name) for pair in system.contacts]
    found = []
    for k, name in enumerate(names):
        label = name if names.count(name) == 1 else f"{name}_{k}"
        while label != name and label in names:
            label += "_"
        found.append(label)
    return found


def at_nodes(
    system: System, state: State, loads: ContactLoads | None, body: Body
) -> dict[str, FloatArray]:
    """Contact fields at the nodes of a body's mesh that this rank owns. Collective.

    Args:
        system: The scene.
        state: Last accepted state.
        loads: Contact forces of the step that led there; None before the first one.
        body: Body with a mesh.

    Returns:
        By name, see `Solution.contact_fields`, shape (nodes,) or (nodes, 3).
    """
    fields: dict[str, FloatArray] = {}
    histories = system.of_slaves(state.contacts)
    for k, (label, pair) in enumerate(zip(labels(system), system.contacts, strict=True)):
        if not any(b is body for b in pair.bodies):
            continue
        load = np.zeros((body.space.dofmap.index_map.size_local, 3))
        for surface, force in [] if loads is None else loads.on(k):
            if surface.body is body:
                np.add.at(load, surface.rows, surface.owned(force))
        fields[f"contact_load_{label}"] = load
        if pair.slave.body is body:
            own = histories[k]
            first = np.where(own.force > 0.0, own.force, -own.gap)
            area = system.slave_area(k, state)
            press = own.force if loads is None else loads.pressing(k, own.force)
            for name, (elsewhere, values) in _of_slave(pair, own, press, area).items():
                fields[f"{name}_{label}"] = spread(pair.slave, elsewhere, values, first)
    return fields


def spread(
    slave: Surface, elsewhere: float, values: FloatArray, order: FloatArray | None = None
) -> FloatArray:
    """Values at this rank's share of a slave's points, at the nodes it owns. Collective.

    Args:
        slave: The slave.
        elsewhere: Value at other nodes.
        values: At the points.
        order: Of several points at a node, as of beams, that with the largest counts.
    """
    owned = slave.body.space.dofmap.index_map.size_local
    nodal = np.full((owned, *values.shape[1:]), elsewhere)
    own, rows = slave.at_own(values), slave.rows
    if order is not None and not slave.material.are_nodes:
        last = np.argsort(slave.at_own(order), kind="stable")
        own, rows = own[last], rows[last]
        first = np.unique(rows[::-1], return_index=True)[1]
        own, rows = own[::-1][first], rows[::-1][first]
    nodal[rows] = own
    return nodal


def _of_slave(
    pair: ContactPair, own: ContactHistory, press: FloatArray, area: FloatArray
) -> dict[str, tuple[float, FloatArray]]:
    """Name -> value elsewhere and values at this rank's slave nodes. Collective.

    Args:
        pair: The contact.
        own: What it remembers.
        press: Forces at this rank's slave nodes [N].
        area: Of all points of the slave [m^2].
    """
    gap, near = own.gap, np.isfinite(own.gap)
    fields = {
        "contact_force": (0.0, press),
        "contact_pressure": (0.0, pressures(pair.slave, press, area)),
        "contact_gap": (np.nan, np.where(near, gap, np.nan)),
        "contact_status": (-1.0, np.where(own.force > 0, 2.0, near.astype(float)) + own.stick),
    }
    if pair.friction:
        fields["contact_friction"] = (0.0, own.tangential)
        fields["contact_slip"] = (0.0, own.slip)
    return fields


def functions(body: Body, fields: dict[str, FloatArray]) -> dict[str, Any]:
    """DOLFINx Functions of nodal fields on the body's mesh, of its degree. Collective."""
    scalars, of_vector = body.space.sub(0).collapse()
    # Its nodes may have other owners than those of the vectors.
    first = fem.Function(body.space)
    found = {}
    for name, values in fields.items():
        vector = values.ndim == 2
        found[name] = function = fem.Function(body.space if vector else scalars)
        function.name = re.sub(r"\W", "_", name, flags=re.ASCII)
        carrier, each = (function, 1) if vector else (first, 3)
        carrier.x.array[: each * values.size : each] = values.ravel()
        carrier.x.scatter_forward()
        if not vector:
            function.x.array[:] = first.x.array[of_vector]
    return found
