"""The ledger (theory section 7): momenta, energy and its changes, from states and steps alone."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, overload

from mpi4py import MPI

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.bodies.solid.inversion import smallest_dets
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.interaction.coupling import Joint
from dolfinx_nts.interaction.evaluation import Evaluation
from dolfinx_nts.parallel import Asking, global_sum, together
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import BalanceRow, FloatArray

if TYPE_CHECKING:
    from dolfinx_nts.equations.problem import StepProblem

#: Columns of the balance table; momenta have three components.
COLUMNS = (
    "time",
    "kinetic",
    "potential",
    "energy",
    "external_work",
    "friction_dissipation",
    "contact_defect",
    "massless_defect",
    "impact_restored",
    "material_change",
    "interference_work",
    "ledger_residual",
    "linear_momentum",
    "angular_momentum",
    "active",
    "stick",
    "slip",
    "min_gap",
    "min_det",
    "newton_iterations",
)


def columns(system: System) -> tuple[str, ...]:
    """Columns of a system's balance table: `COLUMNS`, and what its joints and bodies add."""
    return COLUMNS + _losses(system)


def _losses(system: System) -> tuple[str, ...]:
    """Columns for energy that leaves through joints and bodies."""
    owners = (*system.joints, *system.bodies)
    return tuple(dict.fromkeys(name for owner in owners for name in owner.losses))


#: End of the names of columns that have of a column the part of each declared joint.
OF_JOINTS = " of joints"


def told_by(system: System) -> tuple[str, ...]:
    """Columns that joints may tell works of, none without joints."""
    if not system.declared_joints:
        return ()
    own = (name for joint in system.joints for name in joint.losses)
    return ("external_work", "friction_dissipation", "contact_defect", *dict.fromkeys(own))


#: Columns that add up over the steps, and those that count in a step.
WORKS = ("external_work", "friction_dissipation", "contact_defect", "massless_defect")
COUNTS = ("active", "stick", "slip")
#: Columns that add up what else changes the energy.
CHANGES = ("impact_restored", "material_change", "interference_work")


class Switch(NamedTuple):
    """An active node that went over to another facet at the start of a step.

    Attributes:
        time: End of the step [s].
        contact: Name of the contact.
        node: Input number of the slave node.
        facets: Numbers of the master's facets before and after.
        defect: What the change adds to contact_defect [J]; negative where it brings energy.
    """

    time: float
    contact: str
    node: int
    facets: tuple[int, int]
    defect: float


class Switches(Sequence[Switch]):
    """The newest changes of facet of a run, at most `KEPT` of them, and sums over all.

    Attributes:
        number: How many there were.
        defect: What all of them add to contact_defect [J].
        size: The same of absolute values [J].
        worst: The one with the largest absolute value, the first of several.
    """

    #: How many are kept; a run of a million steps may have many millions.
    KEPT = 10_000

    def __init__(self) -> None:
        self._newest: deque[Switch] = deque(maxlen=self.KEPT)
        self.number = 0
        self.defect = self.size = 0.0
        self.worst: Switch | None = None

    def extend(self, found: Iterable[Switch]) -> None:
        """Add changes of facet in the order in which they came."""
        for switch in found:
            self._newest.append(switch)
            self.number += 1
            self.defect += switch.defect
            self.size += abs(switch.defect)
            if self.worst is None or abs(switch.defect) > abs(self.worst.defect):
                self.worst = switch

    def __len__(self) -> int:
        return len(self._newest)

    @overload
    def __getitem__(self, index: int) -> Switch: ...
    @overload
    def __getitem__(self, index: slice) -> list[Switch]: ...
    def __getitem__(self, index: int | slice) -> Switch | list[Switch]:
        return list(self._newest)[index] if isinstance(index, slice) else self._newest[index]


#: Of a body: u and v, and its part of the energies and momenta on this rank, shape (8,).
Measured = tuple[FloatArray, FloatArray, FloatArray]


def measure(
    system: System, state: State, known: dict[str, Measured] | None = None
) -> dict[str, Any]:
    """Energies [J] and momenta [kg m/s, kg m^2/s] of a state, the same on all ranks.

    Args:
        system: Its bodies.
        state: The state.
        known: Of each body's name what was measured last, which holds while its arrays are the
            same objects; brought up to date. What is evaluated together costs little.

    Returns:
        kinetic, potential, linear_momentum (3,), angular_momentum (3,).
    """
    return together(system.comm, [measuring(system, state, known)])[0]


def measuring(
    system: System, state: State, known: dict[str, Measured] | None = None
) -> Asking[dict[str, Any]]:
    """`measure` as of `parallel.together`."""
    local, known = np.zeros(8), {} if known is None else known
    before = system.take_inner(state.inner)
    for body, u, v in _ends(system, state):
        last = known.get(body.name)
        if last is None or last[0] is not u or last[1] is not v:
            known[body.name] = last = u, v, _of_body(body, u, v)
        local += last[2]
    joints = zip(system.joints, system.joint_bodies, state.joints, strict=True)
    for joint, bodies, history in joints:
        if getattr(type(joint), "potential", None) is not Joint.potential:
            local[1] += joint.potential([state.u[b] for b in bodies], history)
    # The state may be one that is dropped.
    system.take_inner(before)
    total, _ = yield local, np.empty(0)
    return {
        "kinetic": float(total[0]),
        "potential": float(total[1]),
        "linear_momentum": total[2:5],
        "angular_momentum": total[5:],
    }


def momenta(system: System, state: State) -> Asking[dict[str, FloatArray]]:
    """Momenta of a state [kg m/s, kg m^2/s], as `measure` has them, as of `parallel.together`."""
    local = np.zeros(6)
    for body, u, v in _ends(system, state):
        local += np.concatenate(_momenta(body, u, body.inertia(v)))
    total, _ = yield local, np.empty(0)
    return {"linear_momentum": total[:3], "angular_momentum": total[3:]}


def _ends(system: System, state: State) -> Iterator[tuple[Any, FloatArray, FloatArray]]:
    """Batches of bodies with their u and v."""
    batches = system.batches
    return zip(batches.bodies, batches.join(state.u), batches.join(state.v), strict=True)


def _of_body(body: Body, u: FloatArray, v: FloatArray) -> FloatArray:
    """This rank's part of a body's energies and momenta, shape (8,)."""
    momentum = body.inertia(v)
    energies = [0.5 * float(v @ momentum), body.potential(u)]
    return np.concatenate([energies, *_momenta(body, u, momentum)])


def _momenta(body: Body, u: FloatArray, momentum: FloatArray) -> tuple[FloatArray, FloatArray]:
    """This rank's part of a body's linear and angular momentum."""
    return body.linear_momentum(momentum), body.angular_momentum(u, momentum)


def step_terms(problem: StepProblem, step: Evaluation) -> Asking[dict[str, Any]]:
    """Works and counts of an accepted step, the same on all ranks, as of `parallel.together`.

    Loads and supports do external work; what elements and bodies add, they name, see
    `Elements.ledger` and `Body.lost`.

    Returns:
        By columns of the balance table: works [J] and counts of the step, min_gap [m] (infinite
        without candidates), min_det (infinite without flexible bodies; see `Body.smallest_det`).
        And the works of each joint, see `OF_JOINTS`.
    """
    scale = 1.0 / problem.factor
    losses = _losses(problem.system)
    sums, smallest = dict.fromkeys((*WORKS, *COUNTS, *losses), 0.0), {"min_gap": np.inf}
    sums["external_work"] = scale * problem.loads.work_at_ends(step)
    for (k, *_), terms in zip(problem.batches.numbers, step.terms, strict=True):
        work = scale * float(terms.external @ terms.du)
        sums["external_work"] += work + problem.supports.work(k, terms, problem.factor)
    for name, lost in _lost_by_bodies(problem, step):
        sums[name] += lost
    touching = problem.elements[: problem.couplings.num_touching]
    for elements, part in zip(touching, step.parts, strict=False):
        for name, value in elements.ledger(part, problem.factor).items():
            sums[name] += value
    by_joints = told_by_joints(problem, step)
    for name, works in by_joints.items():
        sums[name] += float(works.sum())
    for coupling, parts in problem.couplings.each(step):
        for name, value in coupling.smallest(parts).items():
            smallest[name] = min(smallest[name], value)
    told, declared = told_by(problem.system), len(problem.system.declared_joints)
    own = np.concatenate([list(sums.values()), *(by_joints[name][:declared] for name in told)])
    least = np.array(list(smallest.values()))
    total, lowest = yield own, -least
    of_joints = total[len(sums) :].reshape(len(told), declared)
    return {
        **dict(zip(sums, total.tolist(), strict=False)),
        **dict(zip((name + OF_JOINTS for name in told), of_joints, strict=True)),
        **dict(zip(smallest, (-lowest).tolist(), strict=True)),
        "min_det": step.min_det,
    }


def _lost_by_bodies(problem: StepProblem, step: Evaluation) -> Iterator[tuple[str, float]]:
    """Columns and energies [J] of what leaves through bodies in a step, on this rank. Collective.

    As work of loads, it is the mean of both ends in the methods that carry accelerations, see
    `Loads.work_at_ends`.
    """
    rule, state, dt = problem.integrator, problem.state, problem.dt
    for k, (body, terms) in enumerate(zip(problem.system.bodies, step.bodies, strict=True)):
        if not body.losses:
            continue
        if not rule.accelerations:
            yield from ((name, dt * power) for name, power in body.lost(terms.u1).items())
            continue
        moment, v0 = problem.loads.moments[k], state.v[k]
        v1, _ = problem.supports.advance(k, terms.du, v0, state.acceleration(k))
        for u, v in ((moment.u0, v0), (terms.u1, v1)):
            body.begin_step(rule, moment._replace(u0=u, rate=0.0, drift=v))
            yield from ((name, 0.5 * dt * power) for name, power in body.lost(u).items())
        body.begin_step(rule, moment)


def told_by_joints(problem: StepProblem, step: Evaluation) -> dict[str, FloatArray]:
    """Works of an accepted step by elements, of each joint on this rank [J], shape (joints,)."""
    count = len(problem.system.joints)
    works = {name: np.zeros(count) for name in told_by(problem.system)}
    for coupling, numbers, parts in problem.couplings.of_joints(step):
        for batch, part in zip(coupling.elements, parts, strict=True):
            for name, value in batch.ledger(part, problem.factor).items():
                of = works.setdefault(name, np.zeros(count))
                if len(numbers) > 1:
                    np.add.at(of, np.array(numbers)[batch.joint], batch.works(part, problem.factor))
                else:
                    of[numbers[0]] += value
    return works


def switches(problem: StepProblem, step: Evaluation, time: float) -> Asking[list[Switch]]:
    """Changes of facet in an accepted step, the same on all ranks, as of `parallel.together`."""
    if not problem.system.contacts:
        return []
    found = []
    for _, contact, part, old in problem.couplings.touching(step):
        c = contact.candidates
        before, gain = old.facet[c.node], contact.gains(part, problem.factor)
        stayed = (old.force[c.node] > 0.0) & part.active
        for i in np.flatnonzero(stayed & (before >= 0) & (before != c.facet)):
            facets = (int(before[i]), int(c.facet[i]))
            node = contact.input_node(i)
            found.append(Switch(time, contact.name, node, facets, -float(gain[i])))
    gathered = problem.system.comm.allgather(found) if (yield bool(found)) else []
    return sorted((s for part in gathered for s in part), key=lambda s: s[:3])


def expelled(problem: StepProblem, step: Evaluation) -> str:
    """The node or edge that brings most energy in by starting behind. Every rank must call it."""
    best = (0.0, "")
    for contact, part in zip(problem.elements, step.parts, strict=True):
        if not isinstance(contact, ContactElements):
            continue
        gain = contact.gains(part, problem.factor)
        if len(gain) and gain.max() > best[0]:
            i = int(gain.argmax())
            where = f"{contact.place(i)} of {contact.name!r}"
            text = f"{gain[i]:.3g} by {where}, deep by {-contact.candidates.gap[i]:.3g}"
            best = float(gain[i]), text
    return max(problem.system.comm.allgather(best))[1]


def largest_loss(
    problem: StepProblem, step: Evaluation, before: BalanceRow, row: BalanceRow
) -> str:
    """What takes most energy in a step by touching or stopping; "": nothing. Collective.

    Args:
        problem: Equations of the step.
        step: Their solution.
        before: Row of the balance table before it.
        row: That of the step.
    """
    losses, system = {"": 0.0}, problem.system
    touching = problem.elements[: problem.couplings.num_touching]
    for elements, part in zip(touching, step.parts, strict=False):
        lost = elements.ledger(part, problem.factor).get("contact_defect", 0.0)
        name = repr(elements.name)
        losses[name] = losses.get(name, 0.0) + lost
    total = dict(zip(losses, global_sum(system.comm, np.array([*losses.values()])), strict=True))
    if system.declared_joints:
        of_joints = row["contact_defect" + OF_JOINTS] - before["contact_defect" + OF_JOINTS]
        names = (f"{joint.name!r}{joint.stops}" for joint in system.declared_joints)
        total |= zip(names, of_joints, strict=True)
    return max(total, key=lambda name: total[name])


def first_row(system: System, state: State) -> dict[str, Any]:
    """Balance table row of the state a run starts from."""
    row: dict[str, Any] = dict.fromkeys(columns(system), 0.0)
    row |= measure(system, state)
    row |= {"time": state.time, "energy": row["kinetic"] + row["potential"]}
    local = np.zeros(len(COUNTS))
    for pair, old in zip(system.pairs, state.contacts, strict=True):
        on = old.force > 0.0
        slips = (on & ~old.stick).sum() if pair.friction else 0
        local += on.sum(), (on & old.stick).sum(), slips
    row |= dict(zip(COUNTS, system.comm.allreduce(local).tolist(), strict=True))
    smallest = min((float(c.gap.min(initial=np.inf)) for c in state.contacts), default=np.inf)
    row["min_gap"] = float(system.comm.allreduce(smallest, op=MPI.MIN))
    return row | {"min_det": float(smallest_dets(system, state.u).min())}


def unknown_row(system: System) -> dict[str, Any]:
    """Balance table row of a step without a ledger."""
    row: dict[str, Any] = dict.fromkeys(columns(system), np.nan)
    none = np.full(len(system.declared_joints), np.nan)
    row |= {name + OF_JOINTS: none for name in told_by(system)}
    return row | dict.fromkeys(("linear_momentum", "angular_momentum"), np.full(3, np.nan))


def next_row(
    first: float, last: BalanceRow, measured: BalanceRow, terms: Mapping[str, Any]
) -> dict[str, Any]:
    """Row of an accepted step; work, dissipation, defect and ledger residual are cumulative.

    Args:
        first: Energy that the ledger is opened with [J].
        last: BalanceRow before the step.
        measured: `measure` of the new state.
        terms: `step_terms` of the step.
    """
    row = {**last, **measured, **terms}
    more = [name for name in terms if name not in COLUMNS]
    losses = [name for name in more if not name.endswith(OF_JOINTS)]
    for name in (*WORKS, *CHANGES, *more):
        row[name] = last[name] + terms.get(name, 0.0)
    row["energy"] = row["kinetic"] + row["potential"]
    row["ledger_residual"] = (
        row["energy"]
        - first
        - row["external_work"]
        - sum(row[name] for name in CHANGES)
        + row["friction_dissipation"]
        + row["contact_defect"]
        + row["massless_defect"]
        + sum(row[name] for name in losses)
    )
    return row
