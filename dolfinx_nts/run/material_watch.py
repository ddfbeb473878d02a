"""Parameters of materials that a caller changes in the course of a run."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from dolfinx_nts.parallel import global_max
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray


class MaterialWatch:
    """Notices that a caller has changed parameters of materials between steps. Collective.

    Args:
        system: The scene; its bodies take over what has changed since they were made.
    """

    def __init__(self, system: System) -> None:
        self._comm = system.comm
        for body in system.bodies:
            body.take_parameters()
        sizes = np.array([float(body.parameters().size) for body in system.bodies])
        have = global_max(self._comm, sizes)
        self._bodies = [body for body, size in zip(system.bodies, have, strict=True) if size]
        self._known = self._values()

    def _values(self) -> list[FloatArray]:
        return [body.parameters() for body in self._bodies]

    def changed(self) -> list[str]:
        """Names of the bodies whose parameters differ from those of the last call.

        Those bodies take them over. Collective.
        """
        if not self._bodies:
            return []
        now = self._values()
        both = zip(self._known, now, strict=True)
        differ = [not np.array_equal(a, b) for a, b in both]
        flags = np.array(differ, dtype=bool)
        self._comm.Allreduce(MPI.IN_PLACE, flags, op=MPI.LOR)
        bodies = [body for body, flag in zip(self._bodies, flags, strict=True) if flag]
        for body in bodies:
            body.take_parameters()
        # After one that refuses them, the next step is to ask again.
        self._known = now
        return [body.name for body in bodies]
