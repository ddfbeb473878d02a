"""Time integrators, one file each: where a step evaluates its terms, and how its motion ends."""

from dolfinx_nts.integrators.energy_momentum import EnergyMomentum
from dolfinx_nts.integrators.generalized_alpha import GeneralizedAlpha
from dolfinx_nts.integrators.midpoint import Midpoint
from dolfinx_nts.integrators.newmark import Newmark
from dolfinx_nts.integrators.rule import Integrator
from dolfinx_nts.integrators.static import Static

__all__ = [
    "EnergyMomentum",
    "GeneralizedAlpha",
    "Integrator",
    "Midpoint",
    "Newmark",
    "Static",
]
