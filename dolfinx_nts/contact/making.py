"""Makes the elements of a pair's candidates in a step, by its law."""

from __future__ import annotations

from typing import Any

import numpy as np

from dolfinx_nts.contact.candidates import Candidates
from dolfinx_nts.contact.contact_elements import ContactElements
from dolfinx_nts.contact.contact_law import ContactLaw
from dolfinx_nts.contact.contact_measure import Attachment, ContactMeasure, fixed_of
from dolfinx_nts.contact.prescribed_slip import PrescribedSlip
from dolfinx_nts.contact.slip_friction import SlipFriction
from dolfinx_nts.interaction.elements import Step
from dolfinx_nts.types import FloatArray


def _moves(attachment: Attachment, foot: FloatArray) -> FloatArray:
    """Weights of the surfaces' points in the motion of slaves against their feet, (n, sum of p)."""
    weights = np.concatenate([np.ones((len(foot), 1)), -foot], axis=1)
    if attachment.shares is None:
        return weights
    return np.einsum("nk,nkp->np", weights, attachment.shares)


def _varying(
    pair: Any, attachment: Attachment, measure: ContactMeasure, step: Step
) -> SlipFriction | None:
    """What a pair's coefficient depends on, if on anything; edges press on a square of facets."""
    if pair.friction_function is None:
        return None
    node = getattr(attachment, "node", None)
    area = measure.length**2 if node is None else pair.slave.area[node]
    dt = step.dt if step.integrator.inertia else 0.0
    return SlipFriction(function=pair.friction_function, dt=dt, area=area, factor=step.factor)


def elements_of(
    pair: Any, found: Candidates, attachment: Attachment, measure: ContactMeasure, step: Step
) -> ContactElements:
    """Elements of a pair's candidates in a step, by its law. Collective."""
    moves = _moves(attachment, measure.foot)
    fixed = fixed_of(attachment)
    scales = [step.scale(surface, pair.bodies) for surface in attachment.surfaces]
    scale = np.concatenate(
        [s[number] for s, number in zip(scales, attachment.numbers, strict=True)], axis=1
    )
    own = attachment.numbers[0].shape[1]
    eases = moves**2 / scale
    ease = (eases * ~fixed.all(axis=2))[:, own:].sum(axis=1)
    scale = 1.0 / eases[:, :own].sum(axis=1)
    prescribed = None
    if pair.friction:
        square = moves**2
        free = np.einsum("np,npi->ni", square, ~fixed) / square.sum(axis=1)[:, None]
        prescribed = PrescribedSlip(
            start=measure.start, foot=measure.foot, normal=measure.normal,
            tangents=measure.tangents, free=free,
        )  # fmt: skip
    law = ContactLaw(
        friction=pair.friction, yields=pair.yields, redundant=pair.redundant,
        row=3 * measure.start.shape[1] + measure.num_augmented,
        num_normal=measure.num_normal, scale=scale, yielding=scale / (1.0 + scale * ease),
        size=measure.length, prescribed=prescribed,
        varies=_varying(pair, attachment, measure, step),
    )  # fmt: skip
    return ContactElements(
        pair=pair, candidates=found, attachment=attachment, measure=measure, law=law
    )
