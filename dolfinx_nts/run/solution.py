"""What a run computed: its table, warnings, state and the results of contacts."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from dolfinx_nts.parallel import write_on_root
from dolfinx_nts.run.run_warnings import RunWarnings
from dolfinx_nts.run.step_size import PaceMemory
from dolfinx_nts.run.table import Table
from dolfinx_nts.step import balance, contact_fields, resultants
from dolfinx_nts.step.contact_fields import ContactLoads
from dolfinx_nts.system import State, System
from dolfinx_nts.validation import (
    as_path,
)

FloatArray = npt.NDArray[np.float64]


@dataclass(eq=False)
class Solution:
    """What a run computed, complete up to where it ended.

    Attributes:
        system: The scene; its bodies hold the last accepted state.
        status: "completed"; "completed, but ..." with what may be wrong in it; or why the run
            stopped and what to do.
        rows: Balance table, one row for the start and one per accepted step; some 150 B each.
        retries: How often a step was dropped and cut.
        rejected: How often a step was dropped for its error and shortened, see `Adapt`.
        exceeded: Steps taken though their motion errs more than `Adapt` asks for: the shortest it
            may take, and those that move nodes out from behind their facets.
        switches: Changes of facet of nodes in contact: the newest 10,000, and sums over all.
        state: Last accepted state, from which another run may start.
        warnings: What the run has to say against its result, by kind; see `RunWarning`.
        contact_loads: Contact forces of the last step, from which `contact_fields` are made.
    """

    system: System
    status: str = "running"
    rows: Table = field(default_factory=Table)
    retries: int = 0
    rejected: int = 0
    exceeded: int = 0
    switches: balance.Switches = field(default_factory=balance.Switches)
    warnings: RunWarnings = field(default_factory=RunWarnings)
    state: State | None = None
    contact_loads: ContactLoads | None = None
    #: Whether its state moves, or a run from it begins with the bodies' initial velocities.
    moving: ClassVar[bool] = True

    @property
    def balance(self) -> dict[str, npt.NDArray[np.float64]]:
        """Columns of the balance table, shape (rows,) or (rows, 3), identical on all ranks.

        They are read-only and hold the rows up to now.
        """
        return {name: self.rows.column(name) for name in balance.columns(self.system)}

    @property
    def reactions(self) -> dict[str, FloatArray]:
        """Of each body, force of each `Dirichlet` condition on it [N], shape (rows, conditions, 3).

        Of a rigid body those of its prescribed motion: force, then moment of rotation [N m].

        Of each joint, by its name, force [N] and moment about its point [N m] on the first of its
        bodies, shape (rows, 2, 3). They are NaN where elements of one's own do not say them, see
        `Elements.resultant`.

        In dynamics that of each step, with inertia, where the integrator takes its forces. A
        coordinate that two conditions prescribe counts with the later one.
        """
        return {
            item.name: self.rows.column(resultants.reactions_of(item))
            for item in (*self.system.bodies, *self.system.declared_joints)
        }

    @property
    def contact_forces(self) -> FloatArray:
        """Resultant of each contact on its slave body [N], shape (rows, contacts, 3).

        In dynamics that of each step; with a consistent mass the forces of single steps alternate.
        """
        return self.rows.column(resultants.CONTACT_FORCES)

    @property
    def contact_moments(self) -> FloatArray:
        """Moment of each contact on its slave body about the origin [N m], (rows, contacts, 3).

        Of the forces of `contact_forces`, where their nodes are when the integrator takes them;
        that on the master, if it is a body, is its opposite.
        """
        return self.rows.column(resultants.CONTACT_MOMENTS)

    def contact_fields(self, body: Any) -> dict[str, Any]:
        """Results of a body's contacts at the last accepted state as DOLFINx Functions. Collective.

        During a run a writer of one's own calls it of `stepper.solution`. By name, to which the
        contact's name is appended (and its number, if several have one name):

        - contact_load [N], a vector: the contact's force on each node, of slave and of master; its
          sums over both bodies are `contact_forces` and the opposite. Of the last step, where the
          integrator takes forces; zero before the first one.
        - on the slave body: contact_force p_N [N], contact_pressure, that per tributary reference
          area [Pa], contact_gap [m] (NaN where unknown), contact_status (-1 not a slave node, 0 far
          away, 1 near, 2 in contact, 3 sticking); with friction contact_friction, the tangential
          force [N], a vector, and contact_slip, the distance slipped so far [m].

        Args:
            body: Body of the system with a mesh.

        Raises:
            ValueError: It is not in the system, has no mesh, or its space is not of degree 1.
        """
        state = self.state
        if state is None or not any(b is body for b in self.system.bodies):
            raise ValueError(f"body={body!r}: is not in the system of this run")
        if body.degree != 1:
            raise ValueError(
                f"body {body.name!r}: has no mesh with nodes of degree 1; its contacts are in "
                "contact_forces and contact_moments"
            )
        nodal = contact_fields.at_nodes(self.system, state, self.contact_loads, body)
        return contact_fields.functions(body, nodal)

    @property
    def summary(self) -> str:
        """How the run went in a few lines: steps, energy, changes of facet; equal on all ranks."""
        first, last = self.rows[0], self.rows[-1]
        steps = len(self.rows) - 1
        iterations = self.balance["newton_iterations"].sum() / max(steps, 1)
        lines = [
            f"{self.status}: {steps} steps to t = {last['time']:.6g} s, {self.retries} retries, "
            f"{self.rejected} rejected, {iterations:.2f} Newton iterations per step",
        ]
        if np.isnan(last["energy"]):
            lines.append("no ledger was kept")
        else:
            others = {"massless_defect": -1.0, "impact_restored": 1.0, "material_change": 1.0}
            lost = {name for joint in self.system.joints for name in joint.losses}
            others |= dict.fromkeys(lost, -1.0)
            more = "".join(
                f"{' + ' if sign > 0 else ' - '}{name.replace('_', ' ')} {last[name]:.6g} J"
                for name, sign in sorted(others.items())
                if last[name]
            )
            lines.append(
                f"energy {first['energy']:.6g} J + external work {last['external_work']:.6g} J - "
                f"friction {last['friction_dissipation']:.6g} J - contact "
                f"{last['contact_defect']:.6g} J{more} = {last['energy']:.6g} J, "
                f"but for {last['ledger_residual']:.2g} J"
            )
        if self.exceeded:
            lines.append(f"{self.exceeded} steps taken though they err more than their tolerance")
        found, worst = self.switches, self.switches.worst
        if worst is not None:
            lines.append(
                f"{found.number} changes of facet: contact defect {found.defect:.3g} J in all, "
                f"mean of absolute values {found.size / found.number:.3g} J; most "
                f"{worst.defect:.3g} J at t = {worst.time:.6g} s ({worst.contact}, node "
                f"{worst.node}, facet {worst.facets[0]} to {worst.facets[1]})"
            )
        return "\n".join([*lines, *self.warnings.lines])

    def warn(self, kind: str, time: float, size: float, text: str, *, grave: bool = False) -> None:
        """Add a warning; every rank must make the same call, see `RunWarnings.add`."""
        root = self.system.comm.rank == 0
        self.warnings.add(kind, time, size, text, grave=grave, speak=root)

    def finish(self) -> None:
        """Say in the status that the run is complete, and what may be wrong in it."""
        grave = "; ".join(w.text for w in self.warnings.grave)
        self.status = f"completed, but {grave}" if grave else "completed"

    def plot(self, path: str) -> None:
        """Write a picture of energies, ledger and momenta over time. Every rank must call it.

        Args:
            path: Picture file; its ending chooses the format.
        """
        from dolfinx_nts.output.plots import plot_balance

        as_path("path", path)
        write_on_root(self.system.comm, f"path={path!r}", lambda: plot_balance(self.balance, path))


@dataclass(eq=False)
class Restart(Solution):
    """A run up to a checkpoint, from which it goes on; see `restart`.

    Attributes:
        memory: What its stepper remembers beside, see `Stepper.memory`.
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
            warnings=RunWarnings(self.warnings.values()),
            state=self.state,
        )
