"""What a file says of the scene that it belongs to, and how a scene differs from it."""

from __future__ import annotations

import json
import zlib
from typing import Any

import numpy as np

from dolfinx_nts.ledger import balance, resultants
from dolfinx_nts.system import System
from dolfinx_nts.types import Rows

#: Options of bodies in which a restart may differ: loads, supports and viscosity.
_LOADS = ("body_force", "viscosity", "traction", "bcs", "forces", "force", "torque")
#: Differences that a refusal names.
_NAMED = 5
#: Part of masses and of a body's size by which the same scene may differ on other ranks.
ROUNDED = 1e-9


def describe(system: System) -> dict[str, Any]:
    """Return what a system must share with the one of a checkpoint, for JSON. Collective."""
    comm, bodies = system.comm, system.bodies
    sizes = [[b.num_owned // 3, float(b.nodal_mass[::3].sum())] for b in bodies]
    total = comm.allreduce(np.array(sizes))
    empty = dict.fromkeys(balance.columns(system), 0.0) | resultants.at_start(system)
    empty |= dict.fromkeys(("linear_momentum", "angular_momentum"), np.zeros(3))
    return {
        "bodies": [
            {
                "name": b.name,
                "kind": type(b).__name__,
                "degree": b.degree,
                **_cells_of(b),
                "nodes": int(nodes),
                "mass": float(mass),
            }
            for b, (nodes, mass) in zip(bodies, total, strict=True)
        ],
        "contacts": [_describe_contact(pair) for pair in system.contacts],
        "joints": [
            _settings(j) | {"name": j.name, "kind": type(j).__name__} for j in system.joints
        ],
        "gravity": system.gravity.tolist(),
        "columns": {name: list(np.shape(value)) for name, value in empty.items()},
    }


def loads(system: System) -> Rows:
    """Constant loads and supports of the bodies by their options, for JSON; functions are None."""
    settings = [_settings(body) for body in system.bodies]
    return [
        {"name": body.name} | {name: of[name] for name in _LOADS if name in of}
        for body, of in zip(system.bodies, settings, strict=True)
    ]


def _cells_of(body: Any) -> dict[str, Any]:
    """What the cells of a body have that others do not."""
    given = {name: body.settings.get(name) for name in ("volume", "bending")}
    return {name: value for name, value in given.items() if value not in (None, "full", False)}


def _settings(item: Any) -> dict[str, Any]:
    """`settings` of a body, joint or obstacle, as they come back from JSON; functions are None."""
    text = json.dumps(item.settings, default=lambda a: a.tolist() if hasattr(a, "tolist") else None)
    return json.loads(text)


def _describe_contact(pair: Any) -> dict[str, Any]:
    found = {
        "name": pair.name, "friction": float(pair.friction), "adjust": pair.adjust,
        "integration": pair.integration,
    }  # fmt: skip
    for role in ("slave", "master"):
        surface = getattr(pair, role)
        facets = getattr(surface, "facets", None)
        if facets is None:
            found[role] = _settings(surface) | {"kind": type(surface).__name__}
        else:
            numbers = np.ascontiguousarray(surface.original[facets], dtype=np.int64)
            found[role] = {
                "nodes": len(surface.original),
                "facets": len(facets),
                "which facets": zlib.crc32(numbers.tobytes()),
            }
    return found


def differences(there: Any, here: Any, where: str = "") -> list[str]:
    """Sentences on what differs between two descriptions.

    Args:
        there: Of the file.
        here: Of the system.
        where: Place in both.
    """
    if isinstance(there, dict) and isinstance(here, dict):
        named = "name" in there and there["name"] == here.get("name")
        name = f" of {there['name']!r}" if named else ""
        pairs = [(f"{where}.{k}" if where else k, there.get(k), here.get(k))
                 for k in dict.fromkeys((*there, *here))]  # fmt: skip
        return [text + name for pair in pairs for text in differences(*pair[1:], pair[0])]
    if isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        pairs = [(f"{where}[{k}]", a, b) for k, (a, b) in enumerate(zip(there, here, strict=True))]
        return [text for pair in pairs for text in differences(*pair[1:], pair[0])]
    if isinstance(there, float) and isinstance(here, float):
        # Equal infinities have no difference.
        same = there == here or abs(there - here) <= ROUNDED * max(abs(there), abs(here))
    else:
        same = there == here
    if isinstance(there, list) and isinstance(here, list):
        there, here = ([item.get("name", item) if isinstance(item, dict) else item
                        for item in items] for items in (there, here))  # fmt: skip
    return [] if same else [f"{where} is {there!r} there and {here!r} here"]


def listed(sentences: list[str]) -> str:
    """The first of some differences."""
    return "; ".join(sentences[:_NAMED]) + ("; ..." if len(sentences) > _NAMED else "")

