"""Edges that meet edges: `EdgeAttachment` is all that their element has of its own.

b(t) - a(s) of edges a and b is a parallelogram in (s, t): the gap of facets is theirs as it is.
"""

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx.mesh import CellType, create_box
from measures import STENCIL

import dolfinx_nts as nts
from dolfinx_nts.contact.candidates import Candidates
from dolfinx_nts.contact.edge_contact import EdgeAttachment
from dolfinx_nts.contact.edges import SHARES
from dolfinx_nts.contact.facet_gap import FacetGap
from dolfinx_nts.contact.making import elements_of
from dolfinx_nts.interaction.elements import evaluate_together
from dolfinx_nts.kernels import compiled, facets


def ends(surface, axis, value):
    """The ends of the edge of a cube's surface where a coordinate is this."""
    found = np.flatnonzero(np.abs(surface.reference[:, axis] - value) < 1e-9)
    assert len(found) == 2
    return found[None]


def crossed(friction, rule):
    """An edge along y above one along x, 0.02 away; positions of their ends, slave first."""
    low = create_box(MPI.COMM_SELF, [[0, 0, 0], [1, 1, 1]], [1, 1, 1], CellType.hexahedron)
    high = create_box(MPI.COMM_SELF, [[0, 0, 1.02], [1, 1, 2.02]], [1, 1, 1], CellType.hexahedron)
    rubber = nts.NeoHookean(1e3, 0.3)
    below = nts.Continuum(low, rubber, density=1.0, name="below")
    above = nts.Continuum(high, rubber, density=1.0, name="above")
    pair = nts.ContactPair(
        above.surface(lambda x: x[2] < 1.03), below.surface(lambda x: x[2] > 0.99),
        friction=friction,
    )  # fmt: skip
    attachment = EdgeAttachment(
        slave=pair.slave, master=pair.master, own=ends(pair.slave, 0, 0.0),
        other=ends(pair.master, 1, 0.0),
    )  # fmt: skip
    both = [s.reference[n] for s, n in zip(pair.surfaces, attachment.numbers, strict=True)]
    y = np.concatenate(both, axis=1)
    y[:, :2, :2] += [0.37, -0.45]
    y[:, 0, 2] += 0.1
    x = SHARES @ y
    xi, done = compiled.project(x[:, 0], x[:, 1:], np.zeros((1, 2)))
    foot, _, normal = facets.frame(x[:, 1:], xi)
    gap = np.einsum("ni,ni->n", x[:, 0] - foot, normal)
    length, none = facets.size(x[:, 1:]), np.zeros(1, dtype=int)
    found = Candidates(none, none, none, xi, normal, gap, length)
    measure = FacetGap(
        start=x, xi=xi, normal=normal, length=length, rule=rule, theta=0.5, condense=True
    )
    step = SimpleNamespace(scale=lambda surface, _: surface.mass)
    assert done.all()
    return elements_of(pair, found, attachment, measure, step), y


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_force_of_edges_does_the_work_of_the_gap_and_keeps_the_momenta(friction):
    edges, y0 = crossed(friction, "mean-value")
    (a1, a2, b1, b2), rng = y0[0], np.random.default_rng(1)
    normal = np.cross(b2 - b1, a2 - a1)
    normal *= np.sign(normal[2]) / np.linalg.norm(normal)
    assert edges.candidates.gap[0] == pytest.approx((a1 - b1) @ normal, rel=1e-12)
    y1 = y0 + 0.02 * rng.normal(size=y0.shape)
    y1[:, :2, 2] -= 0.2
    own = {"augmented": np.empty((1, 0)), "constraints": np.zeros((1, 3 if friction else 1))}
    own["constraints"][:, 0] = -0.7
    (part,) = evaluate_together(MPI.COMM_SELF, [edges], [y1], [own])
    assert part.active.all()
    force = part.residual[0, :12].reshape(4, 3)
    work = part.multiplier[0, 0] * (part.gap - edges.candidates.gap)[0]
    assert np.vdot(force, y1 - y0) == pytest.approx(work, rel=1e-12)
    size = np.abs(force).max()
    assert np.abs(force.sum(axis=0)).max() < 1e-14 * size
    assert np.abs(np.cross(0.5 * (y0 + y1)[0], force).sum(axis=0)).max() < 1e-14 * size
    on_slave = edges.nodal_forces(part)[0].sum(axis=0)
    assert np.abs(on_slave - part.force[0]).max() < 1e-14 * size


@pytest.mark.parametrize("rule", ["mean-value", "gonzalez", "direct"])
@pytest.mark.parametrize("tangential", [0.01, 0.5])
def test_tangent_of_edges_is_the_derivative_of_their_rows(tangential, rule):
    edges, y0 = crossed(0.3, rule)
    at = np.append(y0 - [0, 0, 0.01], [-0.7, tangential, -0.3 * tangential])
    at[:12] += 0.02 * np.random.default_rng(3).normal(size=12)

    def part(values):
        own = {"augmented": np.empty((1, 0)), "constraints": values[None, 12:]}
        x = values[:12].reshape(1, 4, 3)
        return evaluate_together(MPI.COMM_SELF, [edges], [x], [own])[0]

    found, step = part(at), 1e-4
    assert found.active.all() and found.stick.all() == (tangential < 0.1)
    expected = [
        sum(w / step * part(at + k * step * e).residual[0] for k, w in STENCIL) for e in np.eye(15)
    ]
    error = np.abs(found.tangent[0].T - expected).max()
    assert error < 1e-8 * np.abs(found.tangent).max()
