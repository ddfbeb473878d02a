"""What a run is made of must be the same on all ranks: else each would solve another problem."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dolfinx_nts.system import System
from dolfinx_nts.validation import require_same


def same_run(system: Any, **options: Any) -> None:
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
        surfaces: Mapping[str, Any] = {"slave": pair.slave, "master": pair.master}
        for role, surface in surfaces.items():
            for name, value in surface.settings.items():
                found[f"{name} of the {role} of contacts[{number}]"] = value
    for item in (*system.bodies, *system.joints):
        for name, value in item.settings.items():
            found[f"{name} of {item.name!r}"] = value
    return found
