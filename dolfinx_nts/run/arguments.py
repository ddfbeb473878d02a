"""Checks of what a `Stepper` is asked for, before any work and on all ranks alike."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dolfinx_nts.integrators import Integrator
from dolfinx_nts.ledger.impact import IMPACTS
from dolfinx_nts.run.start import refuse_moved
from dolfinx_nts.solve.accuracy import Newton
from dolfinx_nts.start.massless_start import check_massless
from dolfinx_nts.system import System
from dolfinx_nts.validation import is_finite, require_bool, require_one_of, require_same

#: PETSc's own tests of convergence, in whose place `StepSolver` has one of its own.
_WITHOUT_EFFECT = {"snes_rtol", "snes_atol", "snes_stol", "snes_convergence_test"}


def check_arguments(
    system: System, integrator: Any, newton: Any, petsc_options: Any, before_step: Any,
    impact: Any, restitution: Any, *, start: Any, start_time: Any, **flags: Any,
) -> None:  # fmt: skip
    """Raise where a `Stepper` is not asked for as it should be; arguments are its. Collective.

    Raises:
        TypeError: One is of another kind.
        ValueError: One is out of range or another one on other ranks, an option of PETSc has no
            effect, or a body was destroyed.
    """
    same_run(
        system, integrator=integrator, newton=newton, petsc_options=petsc_options, start=start,
        start_time=start_time, before_step=before_step, impact=impact, restitution=restitution,
        **flags,
    )  # fmt: skip
    _check_scheme(system, integrator, newton, petsc_options)
    for name, flag in flags.items():
        require_bool(name, flag)
    if not callable(before_step) and before_step is not None:
        raise TypeError(f"before_step={before_step!r}: pass a callable (time, dt)")
    _check_impact(system, integrator, impact, restitution)


def _check_scheme(system: System, integrator: Any, newton: Any, petsc_options: Any) -> None:
    """Raise where the equations of steps, or their solver, are not asked for as they should be."""
    if not isinstance(system, System):
        raise TypeError(f"system={system!r}: pass a System([body, ...])")
    system.check_alive()
    if not isinstance(integrator, Integrator) or isinstance(integrator, type):
        raise TypeError(
            f"integrator={integrator!r}: pass EnergyMomentum(), Midpoint() or another one with "
            "the Integrator protocol"
        )
    for joint in system.joints:
        if joint.mid_step and integrator.accelerations:
            raise ValueError(
                f"integrator={integrator!r}: {joint.name!r} may hold and let go. Accelerations "
                "jump there, and this integrator takes them from one step to the next; use "
                "EnergyMomentum() or Midpoint()"
            )
    if not isinstance(newton, Newton | None):
        raise TypeError(f"newton={newton!r}: pass Newton(rtol=...)")
    given = {} if petsc_options is None else petsc_options
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise TypeError(
            f"petsc_options={petsc_options!r}: pass a dict of names and values, e.g. "
            "{'pc_type': 'lu'}"
        )
    for name in sorted(name for name in given if name.lower() in _WITHOUT_EFFECT):
        raise ValueError(
            f"petsc_options[{name!r}]={given[name]!r}: each block of the residual is tested by "
            "itself, not by PETSc; pass newton=Newton(rtol=...)"
        )


def _check_impact(system: System, integrator: Integrator, impact: Any, restitution: Any) -> None:
    """Raise a ValueError where impacts cannot be treated as asked for. Collective."""
    require_one_of("impact", impact, IMPACTS)
    if not (is_finite(restitution) and 0.0 <= restitution <= 1.0):
        raise ValueError(f"restitution={restitution!r}: must lie between 0 and 1")
    if impact == "published" and restitution != 1.0:
        raise ValueError(f"restitution={restitution!r}: pass impact='restored', too")
    if impact != "published" and not integrator.keeps_energy:
        raise ValueError(
            f"impact={impact!r}: {integrator!r} keeps no energy in contact that could be given "
            "back; choose EnergyMomentum() or Midpoint()"
        )
    if impact != "published":
        refuse_moved(system)
    check_massless(system, integrator, impact)


def same_run(system: System, **options: Any) -> None:
    """Raise a ValueError on all ranks unless options and scene are the same there. Collective.

    Called before all that depends on them; ranks with other steps would wait for each other for
    ever. Numbers and texts are compared, of functions only that they are some.

    Args:
        system: The scene; what is none is refused elsewhere.
        **options: Of the run.
    """
    if isinstance(system, System):
        require_same(system.comm, **options, **_scene(system))


def _scene(system: System) -> dict[str, Any]:
    found: dict[str, Any] = {"gravity": system.gravity}
    for number, pair in enumerate(system.contacts):
        found[f"friction of contacts[{number}]"] = pair.friction
        found[f"interference of contacts[{number}]"] = pair.interference
        found[f"adjust of contacts[{number}]"] = pair.adjust
        found[f"integration of contacts[{number}]"] = pair.integration
        surfaces: Mapping[str, Any] = {"slave": pair.slave, "master": pair.master}
        for role, surface in surfaces.items():
            for name, value in surface.settings.items():
                found[f"{name} of the {role} of contacts[{number}]"] = value
    for item in (*system.bodies, *system.joints):
        for name, value in item.settings.items():
            found[f"{name} of {item.name!r}"] = value
    return found
