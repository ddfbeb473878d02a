"""Contact between a surface and a master: what the scene declares, whatever the master is.

A `ContactPair` is part of the scene and holds no history. What depends on the master's kind is in
`facet_pair` and `obstacle_pair`; another kind of master is one more file like these.
"""

from __future__ import annotations

import numbers
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from dolfinx_nts.contact import search
from dolfinx_nts.contact.candidates import MARGIN, Candidates, Found, Motion
from dolfinx_nts.contact.slave_choice import slave_and_master
from dolfinx_nts.contact.slip_friction import at_rest
from dolfinx_nts.contact.surfaces import Surface, gather_each
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.parallel import Asking, global_max
from dolfinx_nts.state import ContactHistory
from dolfinx_nts.types import BoolArray, FloatArray, IntArray
from dolfinx_nts.validation import (
    is_finite,
    known_options,
    require_bool,
    require_name,
    require_one_of,
)

#: Part of a facet's size by which a slave may penetrate at the start of a run.
INITIAL_PENETRATION = 0.01
#: The same of an equilibrium, by what is asked for at overlap; deeper nodes are no candidates.
INTERFERENCE = {"refuse": INITIAL_PENETRATION, "resolve": MARGIN}
#: What `ContactPair(integration=...)` may be.
INTEGRATIONS = ("nodes", "surface")


@known_options
class ContactPair:
    """Slave nodes of one surface must not penetrate the facets of another (19)-(21).

    Slaves of two pairs of a system may share a row of nodes between them, as two patches of a face
    with other coefficients of friction do. Where both have the same master, a shared node belongs
    to the pair that is declared first: its friction holds there, and its forces and fields have
    what the node carries, over the areas of both patches.

    Args:
        slave: Surface whose nodes are kept outside.
        master: Surface whose facets keep them outside, or a `Plane`, `Sphere` or `Cylinder`.
        friction: Coulomb's coefficient mu [-], >= 0; above 1e6 it counts as 1e6, but infinite:
            nodes in contact stick. Or a function of arrays (n,) of the speed of slip in the step
            [m/s], 0 in statics, and of the pressure of each node's force over its undeformed area
            [Pa], which returns positive coefficients, such as
            lambda v, p: 0.2 + 0.1 * np.exp(-v / 0.01).
        interference: What becomes of slave nodes that start inside the master by more than one part
            in a hundred of a facet. "refuse" them, or "resolve" it, as for a press fit: the load
            steps of `equilibrium` press nodes out that start up to half a facet deep, in proportion
            to the pseudo time, until none is left at 1; the work of that is `interference_work` in
            the balance. `simulate` starts from its result. Equilibrium presses out any overlap in
            this way, also the small one that "refuse" allows. "resolve" presses sharp edges that
            start inside each other out, too, in the first load steps; "refuse" warns of them.
        adjust: Slave nodes whose gap at the start is at most this, outside or inside, touch then
            without strain or force, as if they stood on the master: what the nodes of two meshes
            miss each other by. The gap that they start with goes on being none; bodies are drawn
            where their meshes are, and may be that deep inside each other without a warning. At
            most half a facet of the master inwards; edges stay as meshed [m].
        edges: Whether sharp edges of solid and rigid bodies are kept out of each other, too, and
            the master's nodes there out of the slave's facets; else they may pass between the
            slave's nodes, mostly without a word.
        integration: What of the slave is kept out: its "nodes", or the "surface" between them in
            the mean around each node, by points of all facets (theory section 17).
        name: Name in messages and files. Default: those of slave body and master, as "seal-lid".

    Attributes:
        origin: Point of space that positions are relative to [m], shape (3,).
        extent: Largest of the reference positions' components, relative to it [m].
        given: Largest of the slave's as they were given, whose rounding they have [m].
        friction_function: A function that was given for `friction`, which then is its value at rest
            without pressure; else None.
        offset: Gap at the start that counts as none, of each slave node of `Surface.share` [m].
        lift: The largest of them, or 0 [m]; alike on all ranks.

    Raises:
        TypeError: `slave` is no Surface, `master` of no known kind, or `name` no text.
        ValueError: `name` is empty, friction or `adjust` is negative or no number, `interference`
            or `integration` is unknown, the surfaces share nodes, or "surface" where no body
            deforms, of a smoothed master, of nodes without mass or with `adjust`.
    """

    #: Name that was given.
    _label: str | None = None
    #: Whether it keeps nodes out where they are; else what is around them, in the mean.
    holds_nodes: ClassVar[bool] = True
    #: What of the slave is kept out.
    integration: ClassVar[str] = "nodes"
    #: The contact that it is added to, whose surfaces it has; None: it is declared.
    of: ContactPair | None = None
    #: Of one that is added: whether its slave is on the contact's master.
    exchanged: ClassVar[bool] = False
    #: Number of one that is added among those of its kind; they are sought in this order.
    added: int = 0
    #: Class of pairs for each class of masters.
    _kinds: ClassVar[dict[tuple[type, str], type[ContactPair]]] = {}

    def __init_subclass__(cls, master: type | None = None, integration: str = "nodes") -> None:
        if master is not None:
            cls.integration = integration
            ContactPair._kinds[master, integration] = cls

    def __new__(
        cls, slave: Any = None, master: Any = None, *_: Any, integration: Any = "nodes", **__: Any
    ) -> ContactPair:
        """Make a pair of the kind that the master and the integration ask for."""
        kinds = {how: pair for (kind, how), pair in cls._kinds.items() if isinstance(master, kind)}
        return super().__new__(kinds.get(integration, cls))

    def __init__(
        self, slave: Surface, master: Any, *, friction: Any = 0.0, interference: str = "refuse",
        adjust: float = 0.0, edges: bool = True, integration: str = "nodes",
        name: str | None = None,
    ) -> None:  # fmt: skip
        rest = _at_rest(friction)
        if name is not None:
            require_name("name", name)
            self._label = name
        require_bool("edges", edges)
        if not (is_finite(adjust) and adjust >= 0.0):
            raise ValueError(f"adjust={adjust!r}: pass a distance >= 0 [m]")
        require_one_of("interference", interference, INTERFERENCE)
        require_one_of("integration", integration, INTEGRATIONS)
        masters = tuple(kind for kind, _ in self._kinds)
        if not isinstance(slave, Surface):
            other = isinstance(slave, masters)
            hint = "; an obstacle is a master" if other else ""
            raise TypeError(f"slave={slave!r}: pass a Surface, e.g. body.surface(marker){hint}")
        if type(self) is ContactPair and isinstance(master, masters):
            raise ValueError(
                f"integration={integration!r}: {master!r} has no facets to integrate over; use "
                "integration='nodes'"
            )
        if type(self) is ContactPair:
            raise TypeError(
                f"master={master!r}: pass a Surface, e.g. body.surface(marker), or a Plane, Sphere "
                "or Cylinder"
            )
        self.friction_function: Any = friction if callable(friction) else None
        if callable(friction) and not self.holds_nodes:
            raise ValueError(
                f"friction={friction!r}: integration={integration!r} takes a number; use "
                "integration='nodes'"
            )
        self.slave, self.friction, self.interference = slave, rest, interference
        self.master: Any = master
        self.edges, self.adjust = edges, float(adjust)
        # Searches reach farther by the largest gap that counts as none.
        self.offset, self.lift = np.zeros(len(slave.share)), 0.0
        #: Facets to which gaps count as none from the start, or -1, shape (share,).
        self.adjusted: IntArray = np.full(len(slave.share), -1)
        # What is near is small: gaps keep their digits wherever in space the bodies meet.
        self.origin, self.given = slave.reference[0], float(np.abs(slave.reference).max())
        self.extent = slave.material.extent(self.origin)
        self._set_up()

    def __repr__(self) -> str:
        return f"<ContactPair {self.name!r}, slave {self.slave.body.name!r}>"

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """The surfaces of bodies that it holds apart."""
        return (self.slave,)

    @classmethod
    def between(cls, a: Any, b: Any, **options: Any) -> ContactPair:
        """A pair whose slave is the surface that is finer where both are near. Collective.

        Master nodes may enter the slave between its nodes, the farther the fewer these are. If the
        spacings of the nodes differ by less than 10 %, the softer surface is the slave; if the
        stiffnesses do, too, the first one. An obstacle is always the master, and so is a rigid body
        beside one that is not. All is measured in the reference, on all ranks alike; where contact
        moves to parts that are meshed differently, choose yourself.

        Args:
            a: A surface, or a `Plane`, `Sphere` or `Cylinder`.
            b: The other one.
            options: As of `ContactPair`, e.g. friction.

        Raises:
            TypeError: `a` or `b` is of no known kind, both are obstacles, or an unknown option.
            ValueError: As of `ContactPair`.
        """
        slave, master = slave_and_master(a, b)
        return cls(slave, master, **options)

    # ---- what a kind of master has of its own
    def _set_up(self) -> None:
        """Check the master and prepare the search."""

    @property
    def has_edges(self) -> bool:
        """Whether sharp edges of both sides may meet."""
        return False

    def sag(self, points: BoolArray) -> float:
        """How deep flat facets of the master cut into a curved surface, in facet sizes.

        Args:
            points: Which of the slave's lie over these, shape (p,).
        """
        return 0.0

    @property
    def driven(self) -> bool:
        """Whether its master moves as prescribed by a function of time, apart from bodies."""
        return False

    @property
    def bodies(self) -> tuple[Any, ...]:
        """The slave's body, and the master's if it has one."""
        return (self.slave.body,)

    @property
    def redundant(self) -> bool:
        """Whether more points may touch than their bodies have freedom for, see `Surface`."""
        return self.slave.redundant

    @property
    def yields(self) -> bool:
        """Whether points of a surface may move against each other; rigid bodies' may not."""
        return not self.slave.body.rigid

    @property
    def master_name(self) -> str:
        """Name of the master for messages and files."""
        return self.master.name

    def has_master_of(self, other: ContactPair) -> bool:
        """Return whether the masters of both are equal, also of different systems."""
        raise NotImplementedError

    def shares_master(self, other: ContactPair) -> str | None:
        """Return what both have for a master, for messages, if that is so at least in part."""
        raise NotImplementedError

    def path(self, start: float, end: float) -> FloatArray:
        """Displacements of a master that is no body at two times [m], shape (2, 3). Collective."""
        return np.zeros((2, 3))

    def positions(self, u: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """Positions of all points of the pair's surfaces [m], (p, 3) each. Collective.

        They are relative to `origin`.

        Args:
            u: Owned displacements of each of `bodies` [m].
        """
        return self.placed(gather_each(self.surfaces, u))

    def placed(self, moved: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
        """`positions` by displacements of all points of each of `surfaces` [m], (p, 3) each."""
        both = zip(self.surfaces, moved, strict=True)
        return tuple(surface.reference - self.origin + way for surface, way in both)

    def points(self, positions: Sequence[FloatArray], found: Candidates) -> FloatArray:
        """Slave and control points of pairs [m], shape (n, nc + 1, 3)."""
        return positions[0][self.slave.share[found.node]][:, None]

    def depth(self, u: Sequence[FloatArray]) -> FloatArray | float:
        """Return how deep slaves start inside another body, in facet sizes, wherever. Collective.

        Args:
            u: Owned displacements of each of `bodies` at the start [m].
        """
        return 0.0

    def settle(self, u: Sequence[FloatArray]) -> None:
        """Take the gaps at the start that count as none, see `offset`. Collective."""
        self.offset, self.lift = np.zeros(len(self.slave.share)), 0.0
        if not self.adjust:
            return
        found = self._at_start(self.positions(u), self.path(0.0, 0.0))
        rounding = search.ROUNDING * (self.adjust + self.extent)
        near = np.abs(found.gap) <= self.adjust + rounding
        self.offset[found.node[near]] = found.gap[near]
        self.adjusted[found.node[near]] = found.facet[near]
        largest = np.array([self.offset.max(initial=0.0)])
        self.lift = float(global_max(self.slave.body.comm, largest)[0])

    @property
    def settled(self) -> BoolArray:
        """Which of all slave nodes were adjusted, shape (points,). Collective."""
        return self.slave.at_all(self.offset != 0.0)

    def _at_start(self, positions: Sequence[FloatArray], path: FloatArray) -> Candidates:
        """This rank's slaves within `adjust` of the master; arguments as of `find`. Collective."""
        raise NotImplementedError

    def encloses(self, u: Sequence[FloatArray], time: float) -> bool:
        """Return whether all of the slave's body starts inside an obstacle. Collective."""
        return False

    def find(
        self,
        positions: Sequence[FloatArray],
        current: IntArray,
        path: FloatArray,
        motion: Motion | None = None,
        followed: BoolArray | None = None,
    ) -> Asking[Found]:
        """Search for this rank's candidates; as of `together`.

        A node is a candidate behind its facet only if it has come there through the surface. One
        that has passed by the surface's edge is let through, and followed again once it is outside.

        Args:
            positions: Of all points at t_n [m], as from `positions`.
            current: Facet of each of the rank's slave nodes in the last step or -1.
            path: Displacements of a master that is no body at t_n and t_{n+1} [m], shape (2, 3).
            motion: Expected in the step; None: only what touches already.
            followed: Which of the rank's nodes were followed in the last step; None: all.
        """
        raise NotImplementedError

    def leave_to(self, slaves: Mapping[int, Sequence[Any]], edges: Any) -> Asking[None]:
        """Note what else holds in a step, of one that is added, before `find`; as of `together`.

        Args:
            slaves: Elements of contacts in which a body is the slave, by the body's id.
            edges: The contact's edges that are near each other, or None.
        """
        yield from ()

    def elements(
        self, found: Candidates, positions: Sequence[FloatArray], path: FloatArray, step: Step
    ) -> Any:
        """Equations of candidates in a step, see `ContactElements`. Collective.

        Args:
            found: The candidates.
            positions: Of all points at t_n [m].
            path: As of `find`.
            step: The step.
        """
        raise NotImplementedError

    def strayed(
        self, positions: Sequence[FloatArray], found: Candidates, due: FloatArray
    ) -> float:
        """How far from the real surface those end that have left their facets, in facet sizes.

        Args:
            positions: Of all points at the end of a load step.
            found: Candidates that carry.
            due: Gaps that they are to have [m].
        """
        return 0.0

    def missed(
        self,
        positions: Sequence[FloatArray],
        motions: Sequence[FloatArray],
        path: FloatArray,
        reach: float,
        held: IntArray,
        aimed: IntArray,
    ) -> Asking[IntArray | None]:
        """For each slave of the rank the facet that should hold it, not its own, or -1.

        As of `together`.

        It has come through it unseen, or is held in the plane of another one, beside the body.

        Args:
            positions: Of all points at t_n [m].
            motions: Displacement of each of `bodies` in the solved step [m], owned coordinates.
            path: As of `find`.
            reach: Bound on the motion of slaves relative to the master [m].
            held: Facet that each of the rank's slaves is held at in the end, or -1, shape (share,).
            aimed: As of `Motion`.

        Returns:
            Shape (share,), or None where that cannot be.

        Raises:
            StepFailedError: A node has passed the master, or hits it and slides over its edge, and
                a shorter step is needed.
        """
        raise NotImplementedError

    # ---- what they share
    def history_at_start(self) -> ContactHistory:
        """What it remembers of its slave nodes before the first step."""
        return ContactHistory.of_start(len(self.slave.share))

    @property
    def name(self) -> str:
        """Name for messages and files."""
        return self._label or f"{self.slave.body.name}-{self.master_name}"

    def is_like(self, other: ContactPair) -> bool:
        """Return whether both hold the same nodes, of bodies of equal names, out of one master."""
        alike = type(self) is type(other) and self.name == other.name
        alike = alike and self.added == other.added
        same_nodes = alike and np.array_equal(self.slave.points, other.slave.points)
        return same_nodes and self.has_master_of(other)


def _at_rest(friction: Any) -> float:
    """A coefficient as given, or what a function says without slip and pressure."""
    if callable(friction):
        return at_rest(friction)
    number = isinstance(friction, numbers.Real) and not isinstance(friction, bool)
    if not number or not float(friction) >= 0.0:
        raise ValueError(f"friction={friction!r}: pass a number >= 0 (math.inf: never slips)")
    return float(friction)
