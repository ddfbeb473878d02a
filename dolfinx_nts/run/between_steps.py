"""What a user changes between steps: by `before_step`, and parameters of materials."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from dolfinx_nts.equations.sleep import Sleepers
from dolfinx_nts.parallel import global_max
from dolfinx_nts.run.balance_table import Ledger
from dolfinx_nts.run.start import refuse_written
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import BeforeStep, FloatArray
from dolfinx_nts.validation import call_together


class MaterialWatch:
    """Notices that a caller has changed parameters of materials between steps. Collective.

    Args:
        system: The scene; its bodies take over what has changed since they were made.
    """

    def __init__(self, system: System) -> None:
        self.system, self._comm = system, system.comm
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


class BetweenSteps:
    """Lets the user change what the forms of a step hold, and accounts for it. Collective.

    Args:
        materials: Those of the scene.
        before_step: As of `Stepper`.
        ledger: Which names changes.
        sleepers: Bodies whose forces are looked at anew then.
    """

    def __init__(
        self, materials: MaterialWatch, before_step: BeforeStep | None, ledger: Ledger,
        sleepers: Sleepers,
    ) -> None:  # fmt: skip
        self._system, self._before_step, self._ledger = materials.system, before_step, ledger
        self._sleepers, self._materials = sleepers, materials

    def begin(self, time: float, dt: float) -> None:
        """Call the user's function for a step from a time; what it sets is not accounted for."""
        self._call(time, dt)
        self._materials.changed()

    def prepare(self, state: State, dt: float) -> None:
        """The same for a step from an accepted state, whose energy what is set may change."""
        self._call(state.time, dt)
        names = self._materials.changed()
        if names:
            self._sleepers.forget()
            what = f"a changed parameter of the material of {', '.join(map(repr, names))}"
            self._ledger.restate(state, what, beyond=0.0)

    def _call(self, time: float, dt: float) -> None:
        if self._before_step is not None:
            name = f"before_step at t={time!r} with dt={dt!r}"
            call_together(self._system.comm, name, self._before_step, time, dt)
        refuse_written(self._system, time)
