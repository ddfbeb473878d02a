"""What is in the scene: bodies, contacts, gravity; its validation and its state."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, reduce
from typing import NamedTuple

from mpi4py import MPI

import numpy as np

from dolfinx_nts.bodies.batches import Batches
from dolfinx_nts.bodies.body import Body, is_body
from dolfinx_nts.bodies.conditions import jumps
from dolfinx_nts.contact.candidates import Candidates
from dolfinx_nts.contact.corners import corners_of
from dolfinx_nts.contact.crossings import point
from dolfinx_nts.contact.edge_contact import EdgeContact
from dolfinx_nts.contact.overlap import OverlapWatch
from dolfinx_nts.contact.pair import INITIAL_PENETRATION, INTERFERENCE, ContactPair
from dolfinx_nts.contact.shared_nodes import carried_area, check_shared
from dolfinx_nts.contact.surface_pair import other_faces
from dolfinx_nts.contact.valleys import valleys_of
from dolfinx_nts.interaction.coupling import Joint, is_joint
from dolfinx_nts.parallel import need_kernels, together
from dolfinx_nts.state import ContactHistory, EdgeHistory, State
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import items, known_options, require_same, vector

#: Overlap over the sag of facets up to which these alone may be its cause.
_SAGS = 1.1
#: Names of a kind that its one-line description shows.
_SHOWN = 8


class _Over(NamedTuple):
    """What slaves of a contact lie over."""

    pair: ContactPair
    candidates: Candidates


@known_options
class System:
    """Bodies, contacts between them, and gravity.

    Programs that make hundreds of systems free each of them, as Python does not free what PETSc
    keeps for several ranks:

        with nts.System([ball, plate], contacts=[pair]) as system:
            run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-3, t_end=0.1)

    Args:
        bodies: Objects whose classes inherit from `Body`, or have all that it has, on one
            communicator, of different names.
        contacts: Pairs of surfaces of these bodies.
        joints: What else couples them, objects with the `Joint` protocol.
        gravity: Acceleration [m/s^2]; its work counts as external work.

    Attributes:
        size: Coordinates of all bodies.
        declared_joints: As given, each followed by its parts.
        joints: These, then those that bodies bring, such as what keeps a rigid body rigid.
        pairs: Contacts, then what is added to them: corners of their masters, and other faces.
        contact_of: Number of the contact that each of these belongs to.
        edges: Contact of edges by the number of the contact that has any.

    Raises:
        TypeError: An item is no body or no contact.
        ValueError: No body, other names on other ranks, equal names, several communicators,
            `gravity` is not three numbers, a contact of a body that is not in the system, initial
            penetration deeper than its pair takes, see `ContactPair`, or an obstacle inside a
            body.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        *,
        contacts: Sequence[ContactPair] = (),
        joints: Sequence[Joint] = (),
        gravity: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        wanted = "bodies; the class of a body of your own inherits from nts.Body"
        self.bodies = items("bodies", bodies, is_body, wanted)
        self.contacts = items(
            "contacts", contacts, lambda c: isinstance(c, ContactPair), "ContactPair"
        )
        wanted = "joints; the class of a joint of your own inherits from nts.Joint"
        given_joints = items("joints", joints, is_joint, wanted)
        self.joints = tuple(part for joint in given_joints for part in (joint, *joint.parts))
        if not self.bodies:
            raise ValueError(f"bodies={bodies!r}: pass at least one body")
        self.comm = self.bodies[0].comm
        given = {"bodies": self.bodies, "contacts": self.contacts, "joints": self.joints}
        require_same(
            self.comm, **{f"names of {k}": [item.name for item in v] for k, v in given.items()}
        )
        self.check_alive()
        _check_differ("bodies", self.bodies, [body.name for body in self.bodies], "body")
        _check_communicators(self.bodies)
        self.gravity = vector("gravity", gravity, "m/s^2")
        self.gravity.flags.writeable = False
        self.size = int(self.comm.allreduce(sum(b.num_owned for b in self.bodies)))
        self.declared_joints = self.joints
        own = (joint for body in self.bodies for joint in body.joints)
        self.joints = (*self.declared_joints, *own)
        _check_contacts(self.contacts, self.bodies)
        _check_differ("joints", self.declared_joints, [j.name for j in self.joints], "joint")
        _check_joints(self.joints, self.bodies, self.contacts)
        surfaces = [surface for pair in self.contacts for surface in pair.surfaces]
        # What contacts of other systems use says nothing of this one.
        for surface in surfaces:
            surface.leave()
        for surface in surfaces:
            surface.touch()
        index = {id(b): i for i, b in enumerate(self.bodies)}
        self.joint_bodies = [tuple(index[id(b)] for b in j.bodies) for j in self.joints]
        self.contact_bodies = [tuple(index[id(b)] for b in c.bodies) for c in self.contacts]
        added = [
            (k, c) for k, pair in enumerate(self.contacts)
            for c in (*corners_of(pair), *valleys_of(pair), *other_faces(pair))
        ]  # fmt: skip
        self.pairs = (*self.contacts, *(c for _, c in added))
        self.contact_of = [*range(len(self.contacts)), *(k for k, _ in added)]
        #: Of each contact those of `pairs` that hold its slave, itself first.
        self.holding = [[k] for k in range(len(self.contacts))]
        for n, (k, c) in enumerate(added, len(self.contacts)):
            if not c.exchanged:
                self.holding[k].append(n)
        self.pair_bodies = [tuple(index[id(b)] for b in c.bodies) for c in self.pairs]
        self.edges: dict[int, EdgeContact] = {}
        for k, (pair, numbers) in enumerate(zip(self.contacts, self.contact_bodies, strict=True)):
            if pair.has_edges:
                before = tuple(self.edges.values())
                self.edges[k] = EdgeContact(pair, numbers, before)
        check_shared(self.contacts)
        if self.contacts or self.joints:
            need_kernels(self.comm)
        start = self.initial_state()
        for pair, where in zip(self.pairs, self.pair_bodies, strict=True):
            pair.settle([start.u[b] for b in where])
        depths = self.penetration(start)
        for k, (pair, where) in enumerate(zip(self.contacts, self.contact_bodies, strict=True)):
            # The search looks half a facet deep; this, the whole body.
            inside = pair.depth([start.u[b] for b in where])
            depths[k] = np.maximum(depths[k], np.where(pair.settled, 0.0, inside))
        self._check_sides(start)
        self._check_penetration(depths, jumps(self.bodies))
        self._check_enclosed(start)

    def __repr__(self) -> str:
        members = {
            "bodies": self.bodies, "contacts": self.contacts, "joints": self.declared_joints
        }  # fmt: skip
        named = []
        for kind, those in members.items():
            names = ", ".join(repr(item.name) for item in those[:_SHOWN])
            named += [f"{kind} {names}{', ...' * (len(those) > _SHOWN)}"] if those else []
        return f"<System of {'; '.join(named)}>"

    @cached_property
    def batches(self) -> Batches:
        """Its bodies as steps evaluate them: plain rigid ones together. Collective at first."""
        return Batches(self.bodies)

    def destroy(self) -> None:
        """Free the PETSc objects of its bodies, which are of no use then. Collective.

        What a run has computed can still be read, saved and plotted.
        """
        self.batches.destroy()
        for body in self.bodies:
            body.destroy()

    def check_alive(self) -> None:
        """Refuse a system with a body that was destroyed.

        Raises:
            ValueError: One was.
        """
        for body in self.bodies:
            body.check_alive()

    def __enter__(self) -> System:
        return self

    def __exit__(self, *_: object) -> None:
        self.destroy()

    def initial_state(self) -> State:
        """Bodies with their initial displacements and velocities at t = 0."""
        u = tuple(self._at_start(b) for b in self.bodies)
        return State(
            time=0.0,
            u=u,
            v=tuple(b.initial_velocity.copy() for b in self.bodies),
            a=(),
            contacts=tuple(c.history_at_start() for c in self.pairs),
            joints=tuple(joint.start() for joint in self.joints),
            edges=tuple(EdgeHistory.of_start() for _ in self.contacts),
            inner=self.inner_of(lambda k: self.bodies[k].inner_at_rest(u[k])),
        )

    def inner_of(self, each: Callable[[int], FloatArray]) -> tuple[FloatArray, ...]:
        """`State.inner`, of what a function gives for each body that has any."""
        if not self.has_inner:
            return ()
        none = np.empty(0)
        return tuple(each(k) if b.has_inner else none for k, b in enumerate(self.bodies))

    def take_inner(self, inner: tuple[FloatArray, ...]) -> tuple[FloatArray, ...]:
        """Give its bodies a `State.inner`, and return the one that they had."""
        both = zip(self.bodies, inner, strict=False)
        return tuple(body.take_inner(own) for body, own in both)

    @cached_property
    def has_inner(self) -> bool:
        """Whether any body has, see `Body`."""
        return any(body.has_inner for body in self.bodies)

    @staticmethod
    def _at_start(body: Body) -> FloatArray:
        u = body.initial_displacement.copy()
        u[body.fixed] = body.prescribed(0.0)
        return u

    def on_slaves(self, values: FloatArray) -> FloatArray:
        """Forces or moments on the slaves of its contacts from those on the slaves of `pairs`.

        Args:
            values: Shape (pairs, ...).

        Returns:
            Shape (contacts, ...).
        """
        found = values[: len(self.contacts)].copy()
        added = self.pairs[len(found) :]
        signs = np.array([-1.0 if pair.exchanged else 1.0 for pair in added])
        signs = signs.reshape(-1, *[1] * (values.ndim - 1))
        np.add.at(found, np.array(self.contact_of[len(found) :], int), signs * values[len(found) :])
        return found

    def of_slaves(self, histories: Sequence[ContactHistory]) -> list[ContactHistory]:
        """What each of its contacts remembers of its slave nodes, from that of each of `pairs`."""
        return [reduce(ContactHistory.beside, [histories[n] for n in of]) for of in self.holding]

    def slave_area(self, k: int, state: State) -> FloatArray:
        """Present area that carries at each point of a slave [m^2], (points,). Collective.

        Args:
            k: Number of the contact.
            state: Where the body is.
        """
        u = state.u[self.bodies.index(self.contacts[k].slave.body)]
        return carried_area(self.contacts, k, u)

    def penetration(self, state: State, left: float = 0.0) -> list[FloatArray]:
        """Return how deep slaves lie behind their facets, in facet sizes, by contact. Collective.

        Args:
            state: Where they are.
            left: Part of their overlap at the start that they may have.

        Returns:
            Of each contact, shape (points,), the same on all ranks; 0 outside and, but for
            obstacles, deep inside.
        """
        depths = [np.zeros(len(pair.slave.points)) for pair in self.contacts]
        for n, found in self._facing(state):
            overlap, k = state.contacts[n].overlap[found.node], self.contact_of[n]
            deep = np.maximum(-found.gap - left * overlap, 0.0) / found.length
            at = self.pairs[n].slave.share[found.node]
            depths[k][at] = np.maximum(depths[k][at], deep)
        for depth in depths:
            self.comm.Allreduce(MPI.IN_PLACE, depth, op=MPI.MAX)
        return depths

    def _facing(self, state: State) -> Iterator[tuple[int, Candidates]]:
        """What this rank's slaves lie over, where they are, by numbers of `pairs`. Collective."""
        over: dict[int, list[_Over]] = {}
        for n, (pair, bodies) in enumerate(zip(self.pairs, self.pair_bodies, strict=True)):
            if pair.exchanged:
                continue
            together(self.comm, [pair.leave_to(over, None)])
            positions = pair.positions([state.u[b] for b in bodies])
            path = pair.path(state.time, state.time)
            asked = pair.find(positions, state.contacts[n].facet, path)
            candidates = together(self.comm, [asked])[0].candidates
            over.setdefault(id(pair.slave.body), []).append(_Over(pair, candidates))
            yield n, candidates

    def with_overlap(self, state: State, left: float) -> State:
        """The state with the overlap of nodes that no load step has known, see `ContactHistory`.

        Collective.

        Args:
            state: At the start of an equilibrium.
            left: Part of the overlap at pseudo time 0 that is left then.

        Raises:
            ValueError: Nothing is left, but nodes are inside a master.
        """
        if not left:
            self.refuse_overlap(state)
            return state
        contacts = list(state.contacts)
        for n, found in self._facing(state):
            old = contacts[n]
            new, known = np.zeros_like(old.overlap), np.isfinite(old.gap)
            new[found.node] = np.maximum(-found.gap, 0.0) / left
            # In an inner edge it is that of this face, whichever is nearer in the first load step.
            facet = old.facet.copy()
            facet[found.node] = np.where(known[found.node], facet[found.node], found.facet)
            contacts[n] = old._replace(overlap=np.where(known, old.overlap, new), facet=facet)
        return replace(state, contacts=tuple(contacts))

    def refuse_overlap(self, state: State) -> None:
        """Raise on every rank if slaves are inside a master where no load steps press them out."""
        remedy = (
            'interference="resolve" is for load steps of equilibrium up to the pseudo time 1; '
            "begin from the result of one that has got there, start=equilibrium(...)"
        )
        for pair, depth in zip(self.contacts, self.penetration(state), strict=True):
            _refuse_deep(pair, depth, INITIAL_PENETRATION, remedy)

    def _check_penetration(self, depths: list[FloatArray], jump: str = "") -> None:
        """Raise on every rank, with nodes and a jump, if slaves start deeper than pairs take."""
        remedy = jump or (
            "move the bodies apart, or, for a fit of up to half a facet, pass "
            'interference="resolve" to the pair and let equilibrium press the overlap out'
        )
        for pair, depth in zip(self.contacts, depths, strict=True):
            _refuse_deep(pair, depth, INTERFERENCE[pair.interference], remedy)

    def check_apart(self, state: State) -> None:
        """Raise on every rank if bodies start inside each other, or around obstacles."""
        self._check_penetration(self.penetration(state))
        self._check_enclosed(state)

    def _check_sides(self, state: State) -> None:
        """Raise on every rank if a body starts on the wrong side of an obstacle."""
        for pair, where in zip(self.contacts, self.contact_bodies, strict=True):
            if pair.encloses([state.u[b] for b in where], state.time):
                raise ValueError(
                    f"contact {pair.name!r}: all of {pair.slave.body.name!r} starts inside "
                    f"{pair.master.name!r}; move the two apart, let the normal of a plane point to "
                    "the body, or pass inside=True to a sphere or cylinder around it"
                )

    def _check_enclosed(self, state: State) -> None:
        """Raise on every rank, with the place, if an obstacle starts inside a body."""
        for found in OverlapWatch(self).enclosed(state.u, state.time):
            name, obstacle = found.bodies
            raise ValueError(
                f"contact '{name}-{obstacle}': {obstacle!r} starts inside {name!r} as a whole, at "
                f"({point(found.place)}), {found.depth:.3g} from the boundary; move the two "
                "apart, or give the mesh a hole there"
            )


def _refuse_deep(pair: ContactPair, depth: FloatArray, limit: float, remedy: str) -> None:
    """Raise a ValueError if a contact's slaves (points,) are deeper inside than a limit."""
    deep = depth > limit
    if deep.any():
        remedy = cut_off(pair, depth) or remedy
        raise ValueError(
            f"contact {pair.name!r}: {deep.sum()} slave nodes start inside the master, up to "
            f"{depth.max():.3g} of a facet (allowed {limit}), nodes "
            f"{np.sort(pair.slave.original[deep])[:10].tolist()}; {remedy}"
        )


def cut_off(pair: ContactPair, depth: FloatArray) -> str:
    """What to say of slaves (points,) no deeper than flat facets cut off a curve, or nothing."""
    if not 0.0 < depth.max(initial=0.0) <= _SAGS * pair.sag(depth > 0.0):
        return ""
    name = pair.master.body.name
    return (
        f"that is no more than the flat facets of {name!r} cut off its curved surface: pass "
        "smoothing=True to its surface, adjust= to the contact, or take a finer mesh; pressed out "
        "it is a fit by that much, which the curves do not have"
    )


def _check_differ(kind: str, given: Sequence[Body | Joint], names: list[str], one: str) -> None:
    """Raise a ValueError unless what is given, and its names, differ."""
    for k, item in enumerate(given):
        if any(item is other for other in given[:k]):
            raise ValueError(f"{kind}[{k}]: {item.name!r} is given twice; drop one")
    if len(set(names)) < len(names):
        raise ValueError(f"{kind}: names {names} are not unique; pass name= to each {one}")


def _check_communicators(bodies: Sequence[Body]) -> None:
    """Raise a ValueError unless bodies live on the same ranks."""
    first = bodies[0]
    for b in bodies:
        if MPI.Comm.Compare(b.comm, first.comm) not in (MPI.IDENT, MPI.CONGRUENT):
            raise ValueError(
                f"bodies: {b.name!r} and {first.name!r} live on different communicators, of "
                f"{b.comm.size} and {first.comm.size} ranks; make all meshes on one, e.g. "
                "MPI.COMM_WORLD, each with its cells spread over the ranks"
            )


def _check_contacts(contacts: Sequence[ContactPair], bodies: Sequence[Body]) -> None:
    """Raise a ValueError unless contacts are of these bodies."""
    for pair in contacts:
        for role, body in zip(("slave", "master"), pair.bodies, strict=False):
            _check_among(f"contacts: the {role} body {body.name!r}", body, bodies)


def _check_joints(
    joints: Sequence[Joint], bodies: Sequence[Body], contacts: Sequence[ContactPair]
) -> None:
    """Raise a ValueError unless joints are of these bodies and contacts, of other names."""
    both = sorted({joint.name for joint in joints} & {body.name for body in bodies})
    if both:
        raise ValueError(f"joints, bodies: both have the names {both}; rename the joints")
    for joint in joints:
        pair = getattr(joint, "pressed_by", None)
        if pair is not None and not any(pair is other for other in contacts):
            raise ValueError(
                f"joints: {joint.name!r} is of contact {pair.name!r}, which is not among "
                "contacts; add it"
            )
        for body in joint.bodies:
            _check_among(f"joints: {joint.name!r} holds body {body.name!r}, which", body, bodies)


def _check_among(what: str, body: Body, bodies: Sequence[Body]) -> None:
    """Raise a ValueError, with what to do, unless a body is one of these."""
    if any(body is other for other in bodies):
        return
    names = [other.name for other in bodies]
    if body.name in names:
        raise ValueError(
            f"{what} is another object than the one of that name among bodies={names}; make each "
            "body once, and pass that one to both"
        )
    raise ValueError(f"{what} is not among bodies={names}; add it")
