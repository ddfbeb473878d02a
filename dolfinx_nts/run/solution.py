"""What a run computed: its record, its state and the results of contacts."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from dolfinx_nts.bodies.body import Body
from dolfinx_nts.ledger import contact_fields
from dolfinx_nts.ledger.contact_fields import ContactLoads
from dolfinx_nts.parallel import on_root, write_on_root
from dolfinx_nts.run.record import Record, Table
from dolfinx_nts.run.run_file import save
from dolfinx_nts.run.run_warnings import RunWarnings
from dolfinx_nts.run.step_size import PaceMemory
from dolfinx_nts.state import State
from dolfinx_nts.system import System
from dolfinx_nts.types import FloatArray
from dolfinx_nts.validation import StrPath, as_path


@dataclass(eq=False, repr=False)
class Solution(Record):
    """What a run computed, complete up to where it ended; see `Record` for its tables.

    Attributes:
        system: The scene; its bodies hold the last accepted state.
        state: Last accepted state, from which another run may start.
        contact_loads: Contact forces of the last step, from which `contact_fields` are made.
    """

    system: System
    state: State | None = None
    contact_loads: ContactLoads | None = None
    #: Whether its state moves, or a run from it begins with the bodies' initial velocities.
    moving: ClassVar[bool] = True

    def contact_fields(self, body: Body) -> dict[str, Any]:
        """Results of a body's contacts at the last accepted state as DOLFINx Functions. Collective.

        During a run a writer of one's own calls it of `stepper.solution`. By name, to which the
        contact's name is appended (and its number, if several have one name):

        - contact_load [N], a vector: the contact's force on each node, of slave and of master; its
          sums over both bodies are `contact_forces` and the opposite. Of the last step, where the
          integrator takes forces; zero before the first one.
        - on the slave body: contact_force p_N [N], contact_pressure, that per present area around
          the node [Pa], contact_gap [m] (NaN where unknown), contact_status (-1 not a slave node,
          0 far away, 1 near, 2 in contact, 3 sticking); with friction contact_friction, the
          tangential force [N], a vector, and contact_slip, the distance slipped so far [m].

        Args:
            body: Body of the system with a mesh.

        Raises:
            ValueError: It is not in the system, or has no mesh.
        """
        state = self.state
        if state is None or not any(b is body for b in self.system.bodies):
            raise ValueError(f"body={body!r}: is not in the system of this run")
        if body.degree is None:
            raise ValueError(
                f"body {body.name!r}: has no mesh; its contacts are in contact_forces and "
                "contact_moments"
            )
        nodal = contact_fields.at_nodes(self.system, state, self.contact_loads, body)
        return contact_fields.functions(body, nodal)

    def warn(
        self, kind: str, time: float, size: float, text: str, *, grave: bool = False,
        about: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        """Add a warning; every rank must make the same call, see `RunWarnings.add`."""
        root, text = self.system.comm.rank == 0, self.worded(text)
        self.warnings.add(kind, time, size, text, grave=grave, about=about, speak=root)

    def worded(self, text: str) -> str:
        """A sentence of a step as this kind of run says it."""
        return text

    def finish(self) -> None:
        """Say in the status that the run is complete, and what may be wrong in it."""
        grave = "; ".join(w.text for w in self.warnings.grave)
        self.status = f"completed, but {grave}" if grave else "completed"

    def plot(self, path: StrPath | None = None) -> Any:
        """Plot energies, ledger and momenta over time. Every rank must call it.

        Args:
            path: Picture file; its ending chooses the format. None: no file.

        Returns:
            matplotlib's Figure on rank 0, which Jupyter shows; None on the others.
        """
        from dolfinx_nts.output.plots import plot_balance

        if path is None:
            return on_root(self.system.comm, lambda: plot_balance(self.balance))
        as_path("path", path)
        return write_on_root(
            self.system.comm, f"path={path!r}", lambda: plot_balance(self.balance, path)
        )

    def save(self, path: StrPath) -> None:
        """Write what `load` reads without the scene: tables, last state, warnings. Collective.

        Args:
            path: HDF5 file; its folder is made, and what is there is replaced.

        Raises:
            TypeError: `path` is not a path, or a joint remembers something that has no place in a
                file.
            ValueError: The run has no state yet.
            OSError: The file cannot be written.
        """
        place = as_path("path", path)
        if self.state is None:
            raise ValueError(f"path={str(path)!r}: the run has no state yet; save it after a step")
        save(self, self.system, self.state, self._fields, place)

    @property
    def _fields(self) -> dict[str, tuple[FloatArray, ...]]:
        """What a file has of the coordinates of each body beside the state, by name."""
        return {}


@dataclass(eq=False, repr=False)
class Equilibrium(Solution):
    """What `equilibrium` computed, complete up to where it ended.

    `balance` has one row per accepted load step. "time" is the pseudo time. "potential" and
    "energy" are the strain energy. "external_work" is that of loads and prescribed motion, of the
    mean of the forces at both ends of each step, and so is "interference_work" of overlap at the
    start. "ledger_residual" is what energy and friction_dissipation miss of both. "kinetic" and the
    momenta are 0. Changes of facet cost nothing and are not listed.

    Attributes:
        rates: Owned displacements of each body in the last load step, per pseudo time [m].
        forces: Owned loads, and forces of supports, of each body at its end [N].
    """

    rates: tuple[FloatArray, ...] = ()
    forces: tuple[FloatArray, ...] = ()
    moving: ClassVar[bool] = False

    def worded(self, text: str) -> str:
        """What contacts and joints say knows of no load steps, which are what can be smaller."""
        return text.replace("a smaller dt", "more load steps")

    @property
    def _fields(self) -> dict[str, tuple[FloatArray, ...]]:
        return {"rate": self.rates, "force": self.forces}


@dataclass(eq=False, repr=False)
class Restart(Solution):
    """A run up to a checkpoint, from which it goes on; see `restart`.

    Attributes:
        memory: What its stepper remembers beside, see `RunMemory`.
        nodal_memory: The same of slave nodes.
        pace: What its steps by `Adapt` remember; None: there were none.
    """

    memory: Mapping[str, Any] = field(default_factory=dict)
    nodal_memory: Mapping[str, Any] = field(default_factory=dict)
    pace: PaceMemory | None = None

    def go_on(self) -> Solution:
        """The solution to which further steps are added; this one stays as it is."""
        return Solution(
            self.system,
            rows=Table.of(self.rows.columns),
            retries=self.retries,
            rejected=self.rejected,
            exceeded=self.exceeded,
            switches=copy.deepcopy(self.switches),
            warnings=RunWarnings(self.warnings.every),
            state=self.state,
        )
