"""An elastic bar hits a rigid wall: contact against a solution that is known exactly.

Problem (Doyen, Ern, Piperno 2011). A bar of length 10, cross-section 1 x 1, E = 900, nu = 0,
rho = 1 (wave speed c = 30) flies end first at a wall that is h0 away. Gap and speed are a
thousandth of the original's, h0 = 5e-3 and v0 = -1e-2, so that strains stay below 1e-3 and a
large-strain code sees the linear bar. One hexahedron fills the cross-section and the Courant number
is 1: a step takes a wave through one element. The wall is a rigid plane without a mesh.

Reference. On impact a compression wave of pressure rho c |v0| = 0.3 runs to the free end and comes
back as the release wave: contact lasts 2 L / c, from 0.5 to 1.166667, the bar is shortened by at
most 3.3333e-3 and leaves with +1e-2, undeformed.

With `--gravity` the bar is dropped instead (acceleration 1e-2, v0 = 0). Contact is from 1 to 5/3 at
a pressure that rises from 0.3 to 0.5, and from 11/3 to 13/3 at one that falls from 0.5 to 0.3,
because the bar vibrates in the flight between; impulse 0.266667 each; at 16/3 it is at rest where
it started.

What to see. The end of the bar follows the exact solution. The pressure oscillates about it from
step to step, as contact enforced at t_{n+1} on nodes that have mass must; the mean of two steps is
right. Energy is lost only in steps that close a gap: here not at the impact, which falls on the
end of a step, but at the release, where the end touches the wall once more. It is less on a finer
mesh: E/E0 = 0.9978, 0.9987, 0.9992 and rebound 0.9841, 0.9892, 0.9927 of v0 with 50, 100, 200
elements. In the linear range the midpoint rule and the energy-momentum scheme coincide.

    mpirun -n 2 python demos/bar_impact.py --elements 100
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box

import dolfinx_nts as nts
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

LENGTH, AREA, YOUNG, DENSITY = 10.0, 1.0, 900.0, 1.0
GAP, SPEED, GRAVITY = 5e-3, 1e-2, 1e-2
WAVE = (YOUNG / DENSITY) ** 0.5
CONTACT = 2 * LENGTH / WAVE
INTEGRATORS = {"energy-momentum": nts.EnergyMomentum(), "midpoint": nts.Midpoint()}
SHOWN = (
    "contact_start", "contact_end", "pressure", "impulse", "shortening", "gap_error", "rebound",
    "energy",
)  # fmt: skip


def scene(comm, elements, gravity, mass="consistent"):
    """Bar along x in front of a wall whose face is x = 0."""
    box = [[GAP, 0, 0], [GAP + LENGTH, 1, 1]]
    mesh = create_box(
        comm, box, [elements, 1, 1], CellType.hexahedron, ghost_mode=GhostMode.shared_facet
    )
    material = nts.StVenantKirchhoff(young=YOUNG, poisson=0.0)
    velocity = (0.0, 0.0, 0.0) if gravity else (-SPEED, 0.0, 0.0)
    bar = nts.Continuum(mesh, material, density=DENSITY, velocity=velocity, name="bar")
    end = bar.surface(lambda x: x[0] < GAP + 1e-6, mass=mass)
    pair = nts.ContactPair(slave=end, master=nts.Plane(point=(0, 0, 0), normal=(1, 0, 0)))
    acceleration = (-GRAVITY if gravity else 0.0, 0.0, 0.0)
    return nts.System([bar], contacts=[pair], gravity=acceleration)


def exact(t, gravity):
    """Gap between bar and wall [m] and contact pressure [Pa] at times t (n,), by d'Alembert.

    In the flight between two contacts under gravity the end moves with the centre of mass and
    vibrates about it with the period 2 L / c.
    """
    if not gravity:
        hit = GAP / SPEED
        gap = np.maximum(0.0, SPEED * np.maximum(hit - t, t - hit - CONTACT))
        return gap, np.where((t > hit) & (t < hit + CONTACT), DENSITY * WAVE * SPEED, 0.0)
    first, flight = 1.0, 2.0
    away, second = first + CONTACT, first + CONTACT + flight
    after = t - away
    phase = np.mod(after, CONTACT)
    between = SPEED * after - GRAVITY * after**2 / 2 - GRAVITY * phase * (CONTACT - phase)
    up = t - second - CONTACT
    gap = np.select(
        [t < first, t < away, t < second, up < 0],
        [GAP - GRAVITY * t**2 / 2, 0.0, between, 0.0],
        SPEED * up - GRAVITY * up**2 / 2,
    )
    rise = SPEED + GRAVITY * (t - first)
    fall = SPEED + GRAVITY * (second + CONTACT - t)
    pressing = [(t > first) & (t < away), (t > second) & (up < 0)]
    return gap, DENSITY * WAVE * np.select(pressing, [rise, fall])


class Recorder:
    """A writer that keeps what happens at both ends of the bar, the same on all ranks."""

    def start(self, stepper):
        """Begin anew."""
        self.rows = []

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        pair, state = stepper.system.contacts[0], stepper.state
        bar = stepper.system.bodies[0]
        x = bar.reference[0::3] + state.u[0][0::3]
        end, slaves = bar.reference[0::3] > GAP + LENGTH - 1e-6, pair.slave.rows
        local = [state.contacts[0].force.sum(), x[slaves].sum() / 4, x[end].sum() / 4]
        force, near, far = stepper.system.comm.allreduce(np.array(local))
        self.rows.append((state.time, near, force / AREA, LENGTH - (far - near)))

    def close(self, stepper):
        """Make columns of the rows."""
        self.time, self.gap, self.pressure, self.shortening = np.array(self.rows).T


def figures(run, end, dt, gravity):
    """The numbers to compare, from the balance table and the recorded end of the bar."""
    pressing = end.pressure > 1e-6 * DENSITY * WAVE * SPEED
    edges = np.flatnonzero(np.diff(np.r_[False, _bridged(pressing), False]))
    start, stop = end.time[edges[0::2]] - dt, end.time[edges[1::2] - 1]
    impulse = np.array(
        [
            end.pressure[(end.time > a + dt / 2) & (end.time < b + dt / 2)].sum() * dt * AREA
            for a, b in zip(start, stop, strict=True)
        ]
    )
    b, mass = run.balance, DENSITY * AREA * LENGTH
    impact = mass * SPEED**2 / 2
    energy = 1 + (b["energy"] - b["energy"][0] - b["external_work"]) / impact
    return {
        "contact_start": start,
        "contact_end": stop,
        "impulse": impulse,
        "pressure": impulse / (stop - start) / AREA,
        "gap_error": float(np.abs(end.gap - exact(end.time, gravity)[0]).max() / GAP),
        "shortening": float(end.shortening.max()),
        "rebound": float(b["linear_momentum"][-1, 0] / mass / SPEED),
        "energy": float(energy[-1]),
        "ledger": float(np.abs(b["ledger_residual"]).max() / impact),
        "min_gap": float(b["min_gap"].min()),
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "retries": run.retries,
        "status": run.status,
        "history": {"time": end.time, "gap": end.gap, "pressure": end.pressure},
    }


def _bridged(pressing):
    """Contact may flicker from step to step; single steps off inside a contact belong to it."""
    bridged = pressing.copy()
    bridged[1:-1] |= pressing[:-2] & pressing[2:]
    return bridged


def plot(results, balances, gravity, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from dolfinx_nts.output.plots import compare_balances

    folder.mkdir(parents=True, exist_ok=True)
    compare_balances(balances, str(folder / "balance.png"))
    figure, axes = plt.subplots(2, 1, sharex=True, figsize=(8, 6), layout="constrained")
    last = next(iter(results.values()))["history"]["time"][-1]
    t = np.linspace(0, last, 2001)
    for axis, values in zip(axes, exact(t, gravity), strict=True):
        axis.plot(t, values, "k-", lw=1, label="exact")
    for label, result in results.items():
        h = result["history"]
        axes[0].plot(h["time"], h["gap"], "--", lw=1, label=label)
        mean = (h["pressure"][1:] + h["pressure"][:-1]) / 2
        (line,) = axes[1].plot(h["time"][:-1], mean, lw=1, label=f"{label}, mean of two steps")
        axes[1].plot(h["time"], h["pressure"], ".", ms=2, color=line.get_color())
    axes[0].set_ylabel("gap of the end [m]")
    axes[1].set(ylabel="contact pressure [Pa]", xlabel="time [s]")
    for axis, place in zip(axes, ("upper center", "lower center"), strict=True):
        axis.legend(fontsize="small", loc=place)
    figure.savefig(folder / "bar_impact.png", dpi=150)
    plt.close(figure)


def report(results, elements, gravity):
    print(f"bar on a wall, {elements} elements" + (", dropped" if gravity else ""))
    print(f"{'':16}" + "".join(f"{name:>19}" for name in ("exact", *results)))
    first = np.array([1.0, 11 / 3]) if gravity else np.array([GAP / SPEED])
    impulse = 2 * DENSITY * AREA * LENGTH * SPEED + (
        DENSITY * AREA * LENGTH * GRAVITY * CONTACT if gravity else 0.0
    )
    right = {
        "contact_start": first,
        "contact_end": first + CONTACT,
        "pressure": np.full(len(first), impulse / AREA / CONTACT),
        "impulse": np.full(len(first), impulse),
        "shortening": None if gravity else SPEED * CONTACT / 2,
        "gap_error": 0.0,
        "rebound": 0.0 if gravity else 1.0,
        "energy": 1.0,
    }
    for name in SHOWN:
        row = [right[name], *(r[name] for r in results.values())]
        print(f"{name:16}" + "".join(f"{_text(x):>19}" for x in row))
    for label, r in results.items():
        print(
            f"{label}: {r['status']}, {r['retries']} retries, {r['newton_iterations']:.2f} "
            f"iterations a step, ledger {r['ledger']:.1e}, {r['seconds']:.0f} s"
        )


def _text(value):
    return "" if value is None else " ".join(f"{x:.6g}" for x in np.atleast_1d(value))


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    elements=100,
    gravity=False,
    courant=1.0,
    t_end=None,
    integrators=tuple(INTEGRATORS),
    mass="consistent",
    progress=False,
):
    """Run the impact with each integrator.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        elements: Hexahedra along the bar.
        gravity: Drop the bar instead of throwing it.
        courant: Step over the time a wave needs for one element.
        t_end: End of the run [s]; default just after the last contact.
        integrators: Which of "energy-momentum", "midpoint".
        mass: Of the nodes that touch, "consistent" or "redistributed".
        progress: Show a progress line.

    Returns:
        {integrator: figures}; see `figures`.
    """
    dt = courant * LENGTH / elements / WAVE
    end = t_end or (16 / 3 if gravity else 1.5)
    results, balances = {}, {}
    for name in integrators:
        recorder, clock = Recorder(), time.perf_counter()
        system = scene(comm, elements, gravity, mass)
        folder = output and Path(output) / name
        writers = [recorder]
        if folder:
            writers += [Fields(folder, every=5), Film(folder / "film.gif", interval=end / 30)]
        run = nts.simulate(
            system, INTEGRATORS[name], dt=dt, t_end=end, output=writers, progress=progress
        )
        if folder:
            picture(run, folder / "bar.png", colour="stress")
        results[name] = figures(run, recorder, dt, gravity)
        results[name]["seconds"] = time.perf_counter() - clock
        balances[name] = run.balance
    if comm.rank == 0:
        report(results, elements, gravity)
        if output is not None:
            plot(results, balances, gravity, Path(output))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/bar_impact", help="pictures and fields")
    parser.add_argument("--elements", type=int, default=100)
    parser.add_argument("--gravity", action="store_true", help="drop the bar")
    main(progress=True, **vars(parser.parse_args()))
