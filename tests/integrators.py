"""The integrators by name: every list of them in the tests comes from here."""

import dolfinx_nts as nts

#: One of each integrator of the package.
INTEGRATORS = {
    "midpoint": nts.Midpoint(),
    "energy-momentum": nts.EnergyMomentum(),
    "newmark": nts.Newmark(),
    "generalized-alpha": nts.GeneralizedAlpha(),
}
#: Those whose forces act at mid-step: they keep the momenta also in contact.
MID_STEP = {name: INTEGRATORS[name] for name in ("midpoint", "energy-momentum")}
#: The energy-momentum scheme with other discrete gradients.
GRADIENTS = {
    "mean-value stress": nts.EnergyMomentum(stress="mean-value"),
    "gonzalez contact": nts.EnergyMomentum(contact_gradient="gonzalez"),
}
#: One of each way in which a contact force is evaluated at mid-step.
CONTACT_RULES = MID_STEP | {"gonzalez contact": GRADIENTS["gonzalez contact"]}
#: Those that carry the accelerations of a step on to the next.
ACCELERATED = {name: INTEGRATORS[name] for name in ("newmark", "generalized-alpha")}
