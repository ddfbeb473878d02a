"""Contact of the sharp edges of one surface with those of another (theory section 18).

The difference of two edges is a parallelogram, whose gap from the origin is that of the edges: the
measure is `FacetGap`, at points of its own, and the law is that of contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from dolfinx_nts.contact.contact_elements import ContactElements, elements_of
from dolfinx_nts.contact.contact_measure import Batch
from dolfinx_nts.contact.edges import SHARES, Near, near, sharp_edges
from dolfinx_nts.contact.facet_gap import FacetGap
from dolfinx_nts.contact.pair import MARGIN, Candidates
from dolfinx_nts.contact.surfaces import Surface
from dolfinx_nts.interaction.coupling import Joint
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.interaction.kinematics import Kinematics
from dolfinx_nts.interaction.point_elements import EveryStep
from dolfinx_nts.interaction.points import Points
from dolfinx_nts.kernels import compiled, facets
from dolfinx_nts.kernels.vectors import cross
from dolfinx_nts.state import State
from dolfinx_nts.types import FloatArray, IntArray, Settings

_EPS = float(np.finfo(float).eps)
#: A gap of so many roundings of positions counts as closed.
_TOUCH = 4.0
#: Edges that have passed each other by this part of a facet, beside the step's motion, touch.
_NEAR = 1e-6
_STILL = np.zeros(3), np.zeros(3)


class EdgeHistory(NamedTuple):
    """What edges remember that have met on this rank; axis 0 = pair.

    Attributes:
        own: Edges of the slave, shape (n,).
        other: Edges of the master, shape (n,).
        force: Contact force p_N [N], shape (n,).
        tangential: Friction force on the slave [N], shape (n, 3).
    """

    own: IntArray
    other: IntArray
    force: FloatArray
    tangential: FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeAttachment(Batch):
    """Edges of two surfaces, by positions of their ends in these, (n, 2) each; see `Attachment`."""

    slave: Surface
    master: Surface
    own: IntArray
    other: IntArray
    path = _STILL

    @property
    def surfaces(self) -> tuple[Surface, Surface]:
        """Those of the slave and of the master."""
        return self.slave, self.master

    @property
    def numbers(self) -> tuple[IntArray, IntArray]:
        """The edges' ends."""
        return self.own, self.other

    @property
    def shares(self) -> FloatArray:
        """Weights of the ends in a_1 and in the corners of the parallelogram."""
        return np.broadcast_to(SHARES, (len(self.own), *SHARES.shape))

    @cached_property
    def sides(self) -> tuple[Points, ...]:
        """Nodes that both ends of an edge depend on, one end after the other."""
        both = zip(self.surfaces, self.numbers, strict=True)
        return tuple(_at_ends(surface.material, ends) for surface, ends in both)

    @cached_property
    def weights(self) -> FloatArray:
        """Weights of these nodes in the same points."""
        each = []
        for i, surface, ends in zip((0, 2), self.surfaces, self.numbers, strict=True):
            weights = surface.material.weights[ends]
            found = np.einsum("pe,nek->npek", SHARES[:, i : i + 2], weights)
            each.append(found.reshape(len(ends), len(SHARES), 2 * weights.shape[2]))
        return np.concatenate(each, axis=2)

    def place(self, i: int) -> str:
        """Numbers of the ends' nodes in the users' meshes."""
        both = zip(self.surfaces, self.numbers, strict=True)
        one, two = (surface.original[ends[i]].tolist() for surface, ends in both)
        return f"edges of nodes {one} and {two}"


def _at_ends(material: Points, ends: IntArray) -> Points:
    """Points at edges' ends (n, 2) as one point of all their nodes."""
    m, n = material, len(ends)
    arrays: tuple[Any, ...] = (m.nodes, m.weights, m.reference, m.fixed, m.places)
    both = (a[ends].reshape(n, 2 * a.shape[1], *a.shape[2:]) for a in arrays)
    return Points(m.body, *both)


class EdgeElements(ContactElements):
    """Elements of edges, which also say what holds each body; see `ContactElements`."""

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"edges of {self.pair.name}"

    def ratios(
        self, part: Any, largest: Any, motion: float, rounded: float, rtol: float
    ) -> dict[str, float]:
        """As of `ContactElements`."""
        return super().ratios(part, np.asarray(largest), motion, rounded, rtol)

    def resultant(self, part: Any, k: int, u: FloatArray) -> FloatArray:
        """As of `Elements.resultant`. Collective."""
        side = self.attachment.sides[k]
        y = side.reference + side.nodal(u)
        start = sum(3 * other.nodes.shape[1] for other in self.attachment.sides[:k])
        force = -part.residual[:, start : start + 3 * side.nodes.shape[1]].reshape(y.shape)
        sums = (force * side.places[:, :, None]).sum(axis=(0, 1)), cross(y, force).sum(axis=(0, 1))
        place = 0.5 * np.einsum("nk,nki->i", side.weights, y)
        return np.stack([*sums, place, np.full(3, float(len(y)))])


class EdgeContact(Joint):
    """Sharp convex edges of a pair's slave, which must not pass through those of its master.

    Args:
        pair: The pair.
        name: For messages.

    Attributes:
        surfaces: Whole boundaries of the slave's and of the master's body.
        edges: Edges in these, of the pair's surfaces.

    Raises:
        ValueError: A body is no solid one, with a mesh of cells.
    """

    def __init__(self, pair: Any, name: str) -> None:
        self.pair, self.name, self.bodies = pair, name, pair.bodies
        for body in self.bodies:
            if body.mesh is None or body.mesh.topology.dim != 3:
                raise ValueError(
                    f"edges=True: body {body.name!r} of contact {pair.name!r} has no mesh of cells "
                    "in space, whose edges could meet others; leave edges out"
                )
        self.surfaces = tuple(body.boundary() for body in self.bodies)
        both = zip(self.surfaces, pair.surfaces, strict=True)
        self.edges = [sharp_edges(whole, part) for whole, part in both]

    def positions(self, u: Sequence[FloatArray]) -> list[FloatArray]:
        """Positions of all points of both boundaries in the pair's frame [m]. Collective.

        Args:
            u: Owned displacements of each body [m].
        """
        both = zip(self.surfaces, u, strict=True)
        return [surface.positions(each) - self.pair.origin for surface, each in both]

    @cached_property
    def settings(self) -> Settings:
        """What a restart compares."""
        return {"friction": self.pair.friction, "edges": [len(e.ends) for e in self.edges]}

    def start(self) -> EdgeHistory:
        """Return that none has met."""
        none = np.empty(0, dtype=np.int64)
        return EdgeHistory(none, none, np.empty(0), np.empty((0, 3)))

    def coupling(self, bodies: tuple[int, ...]) -> EdgeCoupling:
        """What makes its elements in a run."""
        return EdgeCoupling(self, bodies)


class EdgeCoupling(EveryStep):
    """Makes the elements of edges that may meet in a step.

    Args:
        contact: The scene's part.
        bodies: Numbers of its bodies in the system.
    """

    def __init__(self, contact: EdgeContact, bodies: tuple[int, ...]) -> None:
        super().__init__(bodies, self._elements)
        self._contact, self._cover = contact, 0.0
        slave = contact.surfaces[0]
        comm, ends = slave.body.comm, slave.original[contact.edges[0].ends]
        self._mine = ends.sum(axis=1) % comm.size == comm.rank

    def _reach(self, motion: FloatArray) -> float:
        return float(np.sqrt(3.0) * sum(motion[b] for b in self.bodies[0]))

    def _elements(self, step: Step, history: EdgeHistory) -> EdgeElements:
        contact, pair, of = self._contact, self._contact.pair, self.bodies[0]
        surfaces = contact.surfaces
        size = min(surface.smallest for surface in surfaces)
        reach = self._reach(step.motion)
        self._cover = reach + MARGIN * size
        u0 = [step.state.u[b] for b in of]
        u1 = [u + step.ahead[b] for u, b in zip(u0, of, strict=True)]
        found, ahead = (self._near(contact.positions(u)) for u in (u0, u1))
        key = len(contact.edges[1].ends)
        will = (ahead.own * key + ahead.other)[ahead.inside]
        held = history.own * key + history.other
        pairs = found.own * key + found.other
        known = np.isin(pairs, held)
        ahead_of = found.gap > -reach - _NEAR * size
        chosen = (found.inside | np.isin(pairs, will)) & (known | ahead_of)
        chosen &= self._mine[found.own]
        found = Near._make(a[chosen] for a in found)
        ends = [edges.ends[k] for edges, k in zip(contact.edges, found[:2], strict=True)]
        turned = found.turned
        ends[0] = np.where(turned[:, None], ends[0][:, ::-1], ends[0])
        y = found.ends.copy()
        y[turned, :2] = y[turned, 1::-1]
        x = np.matmul(SHARES, y)
        xi, _ = compiled.project(x[:, 0], x[:, 1:], np.zeros((len(x), 2)))
        _, _, normal = facets.frame(x[:, 1:], xi)
        length = facets.size(x[:, 1:])
        candidates = Candidates(
            found.own, found.other, found.other, xi, normal, found.gap, length
        )
        rule = step.integrator
        measure = FacetGap(
            start=x, xi=xi, normal=normal, length=length, rule=rule.contact_gradient,
            theta=rule.theta, condense=step.condense,
        )  # fmt: skip
        attachment = EdgeAttachment(
            slave=surfaces[0], master=surfaces[1], own=ends[0], other=ends[1]
        )
        made = elements_of(pair, candidates, attachment, measure, step)
        gap = _EPS * (made.extent + float(max(step.length[b] for b in of)))
        force = step.force_rounding(of) if pair.friction else 0.0
        law = replace(made.law, rounding=_TOUCH * gap, force_rounding=_TOUCH * force)
        return EdgeElements(
            pair=pair, candidates=candidates, attachment=attachment, measure=measure, law=law
        )

    def _near(self, positions: Sequence[FloatArray]) -> Near:
        """Pairs of edges within reach at positions of all points [m]."""
        contact = self._contact
        slave, master = zip(contact.surfaces, contact.edges, positions, strict=True)
        return near(slave, master, self._cover)

    def misses(self, e: Evaluation, parts: Sequence[Any], motion: FloatArray) -> bool:
        """Whether bodies have moved farther than edges were looked for."""
        return self._reach(motion) > self._cover

    def guess(self, k: int, x: FloatArray) -> FloatArray:
        """Multipliers of the forces of the last step."""
        c, old = self.elements[k], self._history
        assert self.step is not None
        key = len(self._contact.edges[1].ends)
        where = {int(i): n for n, i in enumerate(old.own * key + old.other)}
        at = np.array([where.get(int(i), -1) for i in c.candidates.node * key + c.candidates.facet],
                      dtype=int)  # fmt: skip
        force = np.append(old.force, 0.0)[at]
        tangential = np.vstack([old.tangential, np.zeros(3)])[at]
        found = c.multipliers(force, np.zeros_like(tangential) if c.law.redundant else tangential)
        guess: FloatArray = self.step.factor * found / c.law.scale[:, None]
        return guess

    def smallest(self, parts: Sequence[Any]) -> dict[str, float]:
        """The smallest gap."""
        return {"min_gap": float(parts[0].gap.min(initial=np.inf))}

    def history(self, parts: Sequence[Any]) -> EdgeHistory:
        """The pairs that carry, and their forces."""
        c, part, step = self.elements[0], parts[0], self.step
        assert step is not None
        on = part.active
        force = -part.multiplier[:, 0] / step.factor
        tangential = part.tangential / step.factor
        return EdgeHistory(c.candidates.node[on], c.candidates.facet[on], force[on], tangential[on])

    def kinematics(self, state: State, dt: float) -> list[Kinematics | None]:
        """Starts need not fit what is one-sided."""
        return [None] * len(self.elements)
