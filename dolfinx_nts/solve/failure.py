"""What to say of a step that is not solved."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.equations.problem import StepProblem
from dolfinx_nts.interaction.evaluation import BodyTerms, Evaluation
from dolfinx_nts.parallel import everywhere, global_sum
from dolfinx_nts.solve.convergence import ratios

#: Friction where a failed load step starts, over its bound, from which on a body slides.
_USED_UP = 0.9


def diagnosis(
    problem: StepProblem, e: Evaluation, flips: Sequence[Any], why: str, iterations: int
) -> str:
    """One sentence that names the block that failed, and where. Collective.

    Args:
        problem: The step.
        e: The last iterate.
        flips: Of each batch of elements how often its elements changed their status.
        why: Reason that the solver gives.
        iterations: Newton iterations.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        found = ratios(problem, e)
    ratio = {k: r if np.isfinite(r) else np.inf for k, r in found.items()}
    worst = max(ratio, key=lambda name: ratio[name])
    notes = [
        (c.name, *c.describe(part, flipped))
        for c, part, flipped in zip(problem.elements, e.parts, flips, strict=True)
        if c.num_elements
    ]
    bodies = list(zip(problem.system.bodies, e.bodies, strict=True))
    notes += [_body_note(body, terms) for body, terms in bodies if body.num_owned]
    gathered = [n for part in problem.system.comm.allgather(notes) for n in part]
    # Of each body and contact the rank with the largest residual speaks, the worst one first.
    best = {name: text for name, _, text in sorted(gathered, key=lambda n: n[1])}
    trouble = {
        name: max((r for k, r in ratio.items() if f"{k} ".startswith(f"{name} ")), default=0.0)
        for name in best
    }
    top = [best[name] for name in sorted(best, key=lambda name: -trouble[name])[:4]]
    kinds = {
        "internal": "the energy of its material or form may not be defined for this deformation",
        "external": "check its loads and its extra_form for NaN",
    }
    for kind, hint in kinds.items():
        endless = [
            body
            for body, terms in bodies
            if not everywhere(problem.system.comm, np.isfinite(getattr(terms, kind)).all())
        ]
        if endless:
            names = ", ".join(repr(body.name) for body in endless)
            why += f"; the {kind} forces of {names} are not finite: {hint}"
            if kind == "internal" and any(body.has_inner for body in endless):
                why += ", or its cells have folded: leave bending=True out"
    top += _held_twice(problem, e)
    finite = ratio[worst] < np.inf
    size = f"at {ratio[worst]:.3g} times its tolerance" if finite else "is not finite"
    return (
        f"step from t={problem.state.time:.6g} with dt={problem.dt:.3g} not solved after "
        f"{iterations} iterations ({why}); worst block {worst!r} {size}; {'; '.join(top)}"
    )


def used_up(problem: StepProblem, e: Evaluation) -> str:
    """Of statics, which body slides as friction alone holds it, or nothing. Collective."""
    system = problem.system
    if problem.integrator.inertia:
        return ""
    # Nodes that carry and that stick, Coulomb's bound, friction, what else holds along each axis.
    local, rubs = np.zeros((len(system.bodies), 9)), set[tuple[int, str]]()
    both = zip(problem.couplings.touching(e), problem.couplings.bodies, strict=False)
    for (_, contact, part, old), of in both:
        bodies = list(of)
        if not contact.law.num_tangential:  # may hold the body against sliding, as a wall does
            local[bodies, 6:] += part.active.sum()
            continue
        local[bodies, 0] += part.active.sum()
        local[bodies, 1] += (part.active & contact.law.sticks(part)).sum()
        local[bodies, 2] += contact.law.coefficient * old.force.sum()
        # Of corners that of their slaves is opposite to that of the contact's.
        side = -1.0 if contact.pair.exchanged else 1.0
        local[bodies, 3:6] += side * old.tangential.sum(axis=0)
        if part.active.any() or old.force.any():
            rubs |= {(body, contact.name) for body in bodies}
    local[:, 6:] += [np.bincount(body.fixed % 3, minlength=3) for body in system.bodies]
    for linked in system.joint_bodies:
        local[list(linked), 6:] += 1
    carry, stick, bound, *rest = global_sum(system.comm, local).T
    friction, held = np.array(rest[:3]).T, np.array(rest[3:]).T > 0
    # What is held along some axes slides along the others, if friction is along these.
    slide = np.linalg.norm(np.where(held, 0.0, friction), axis=1) > _USED_UP * bound
    slide &= (bound > 0) & ~held.all(axis=1)
    slide |= (carry > 0) & (stick == 0) & ~held.any(axis=1)
    ranks, found = system.comm.allgather(rubs), np.flatnonzero(slide)
    if not found.size:
        return ""
    first = int(found[0])
    names = " and ".join(sorted({repr(name) for of in ranks for k, name in of if k == first}))
    how = f"friction of {names} carries more than {_USED_UP:.0%} of what it can"
    if not stick[first]:
        how = f"all nodes of {names} slip: |F_t| = mu F_n, and friction can carry no more load"
    name = system.bodies[first].name
    return f"friction is used up ({how}): body {name!r} slides; use simulate, or hold it; "


def contact_on(problem: StepProblem, e: Evaluation, flips: Sequence[Any], body: int) -> str:
    """The contact that may have crushed a body, to be told before its cell, or nothing. Collective.

    Args:
        problem: The step.
        e: The last iterate.
        flips: As of `diagnosis`.
        body: Number of the body with a cell that is inside out or nearly so.
    """
    found = []
    both = zip(problem.couplings.touching(e), problem.couplings.bodies, flips, strict=False)
    for (_, contact, part, _), bodies, changes in both:
        if body not in bodies or not len(part.active):
            continue
        # What flips most, else what carries.
        times = changes.sum(axis=0) + part.active
        i = int(times.argmax())
        how = f"flips {changes[:, i].sum()} times" if changes[:, i].any() else "carries"
        where = contact.place(i)
        found.append((int(times[i]), f"contact {contact.name!r} {how} at {where}"))
    most, text = max(f for part in problem.system.comm.allgather([(0, ""), *found]) for f in part)
    if not most:
        return ""
    return (
        f"{text} and may have crushed the body that is named next: look there first; if these "
        "should not touch, leave them out of the contact's surfaces; "
    )


def _body_note(body: Body, terms: BodyTerms) -> tuple[str, float, str]:
    """Name, weight and text of where the body's equation is worst solved."""
    r = np.nan_to_num(np.abs(terms.residual), nan=np.inf)
    r[body.fixed] = 0.0
    worst = int(np.argmax(r)) // 3
    # Directors follow the place of their node.
    place = int(np.flatnonzero(body.places[: worst + 1])[-1])
    of = f"of director {worst - place} " if worst > place else ""
    x = ", ".join(f"{c:.4g}" for c in body.reference.reshape(-1, 3)[place])
    return body.name, float(r.max()), f"body {body.name!r}: largest residual {of}at X = ({x})"


def _held_twice(problem: StepProblem, e: Evaluation) -> list[str]:
    """Which contacts push nodes that others push, too, or none that could move. Collective."""
    names, pushed, stuck = [], [], []
    # A rigid body's directors are pushed by all that touches it, and so are those of batches.
    nodal = {k for k, body in enumerate(problem.system.bodies) if not body.oriented}
    for c, bodies, part in zip(problem.elements, problem.couplings.bodies, e.parts, strict=True):
        if c.bilateral or not c.widths["constraints"] or not nodal.issuperset(bodies):
            continue
        force = np.abs(part.residual[:, : c.num_coordinates]) > 0.0
        free = np.concatenate(c.dofs(), axis=1) >= 0
        points, moved = c.points(), force & free
        of = [np.full_like(p, k) for k, p in zip(bodies, points, strict=True)]
        both = (np.concatenate(arrays, axis=1)[moved] for arrays in (of, points))
        names.append(c.name)
        pushed.append(set(zip(*(a.tolist() for a in both), strict=True)))
        stuck.append(bool((force.any(axis=1) & ~moved.any(axis=1)).any()))
    ranks = problem.system.comm.allgather((pushed, stuck))
    everywhere = [set().union(*(nodes[k] for nodes, _ in ranks)) for k in range(len(names))]
    found = [
        f"{names[i]!r} and {names[j]!r}"
        for i, j in combinations(range(len(names)), 2)
        if everywhere[i] & everywhere[j]
    ]
    found += [
        f"{name!r} and a support" for k, name in enumerate(names) if any(s[k] for _, s in ranks)
    ]
    return [f"{both} may hold the same nodes" for both in found]
