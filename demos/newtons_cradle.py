"""Newton's cradle with rigid and with flexible balls: what each says about who gets the momentum.

Problem. Five equal balls of rubber (radius 20 mm, density 1100, E = 5e6, nu = 0.3) lie in a row,
touching or 3 mm apart. The first meets the others at 0.5 m/s. Threads, which carry weight alone
while the balls touch, are left out. A ball is a warped cube of hexahedra; balls with a node at
their tips alternate with balls with a facet there, so that a node meets the middle of a facet. All
weigh the same. In the textbook the last ball leaves with all the momentum.

Reference. Momentum and energy are two laws for five speeds, so they do not settle who gets what.

- Rigid, touching. What touches is held together through the whole step of the impact, and the
  other four balls are one body. If the gap closes in the part theta of the step, the step's mean
  approach is theta times the speed v, so the blow has the restitution e = 1 - 2 theta, and

      v_1 = v (1 - (n - 1) e) / n,   v_2 = .. = v_n = v (1 + e) / n,

  with the part (1 - e^2) (n - 1) / n of the energy lost: the contact defect.
- Rigid, apart. Blows of two balls follow each other. With theta = 0 in each the last gets all.
  In the step of a blow the ball that is hit makes half a step's way; gaps are longer by as much.
- Flexible, touching. Each pair is a spring that cannot pull; balls have the time to be pressed one
  after another. Point masses with springs end with speeds that depend on the law alone, not on
  stiffness or mass: for five balls the last gets 0.942 v if force is linear in approach (one node
  on a facet, as in coarse meshes), 0.989 v if it goes with the power 3/2 (Hertz), and the first
  recoils (Herrmann, Schmaelzle, Am. J. Phys. 49, 1981, 761).
- Flexible, apart. Blows of two again: all to the last ball, less what swings within the balls.

What to see. The rigid row that touches never hands all to the last ball: with theta = 0 the first
flies back at 0.6 v and four leave together, energy kept; with theta = 1/2 all five move on together
and 80 % of the energy is gone. Apart, the answer is the textbook's for theta = 0, and another one
for any other theta. None is what balls do; a rigid body has no time in which one contact opens
before the next one closes, and the step decides what the material should. Flexible balls do not
depend on theta by more than 0.04 v: touching, they agree with the chain of linear springs to 0.03
v, and apart the last one gets 0.89 to 0.91 v. Nodes that close their gaps within steps cost up to 4
% of the energy if balls touch and 10 to 12 % if they are apart (the contact defect of each blow); 1
to 2 % and 6 to 8 % swing within the balls at the end. Both fall with the step: of three balls apart
the last gets 0.954 v with 0.5 ms, 0.990 v with an eighth of a millisecond. Momentum is kept to
round-off by all.

    mpirun -n 2 python demos/newtons_cradle.py
"""

import argparse
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from dolfinx.mesh import CellType, GhostMode, create_box
from scipy.integrate import solve_ivp

import dolfinx_nts as nts
from dolfinx_nts.output import Fields, Film
from dolfinx_nts.output.pictures import picture

RADIUS, DENSITY, YOUNG, SPEED = 0.02, 1100.0, 5e6, 0.5
MASS = DENSITY * 4 / 3 * np.pi * RADIUS**3
#: Between balls that do not touch [m]; twelve steps of 0.5 ms at `SPEED`.
APART = 3e-3
KINDS = ("rigid, touching", "rigid, apart", "flexible, touching", "flexible, apart")
#: End of the run [s].
ENDS = {"touching": 0.03, "apart": 0.08}


def ball_mesh(comm, cells):
    """A cube of this many hexahedra along its sides, warped to a ball about the origin."""
    mesh = create_box(
        comm, [[-1, -1, -1], [1, 1, 1]], [cells] * 3, CellType.hexahedron,
        ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    x = mesh.geometry.x
    far, length = np.abs(x).max(axis=1), np.linalg.norm(x, axis=1)
    # Spherical outside, nearly a cube inside, where spheres would leave no room for a grid.
    x *= RADIUS * (0.8 * (1 - far) + far * far / np.where(length > 0, length, 1.0))[:, None]
    return mesh


def reach(cells):
    """Return the way from the centre to the tip [m]: to a node, or to the middle of a facet."""
    corner = np.array([1.0, *(2 * [1.0 / cells])])
    return RADIUS * (1.0 if cells % 2 == 0 else 1.0 / np.linalg.norm(corner))


def ball(comm, kind, cells, place, speed, name):
    mesh = ball_mesh(comm, cells)
    mesh.geometry.x[:, 0] += place
    # Balls weigh what round ones do, whatever their facets cut off.
    density = MASS / nts.RigidBody(mesh, density=1.0).mass
    velocity = (speed, 0.0, 0.0)
    if kind.startswith("rigid"):
        return nts.RigidBody(mesh, density=density, velocity=velocity, name=name)
    rubber = nts.NeoHookean(young=YOUNG, poisson=0.3)
    return nts.Continuum(mesh, rubber, density=density, velocity=velocity, name=name)


def scene(comm, kind, balls, cells, first_gap, gap):
    """The row along x; `cells` is even, so that the first ball has a node at its tip."""
    sizes = [cells + k % 2 for k in range(balls)]
    gaps = [first_gap, *((balls - 2) * [gap])]
    ways = np.array([reach(a) + reach(b) for a, b in zip(sizes[:-1], sizes[1:], strict=True)])
    places = np.concatenate([[0.0], np.cumsum(ways + gaps)])
    row = [
        ball(comm, kind, n, x, SPEED if k == 0 else 0.0, f"ball {k + 1}")
        for k, (n, x) in enumerate(zip(sizes, places, strict=True))
    ]

    def cap(k, side):
        return row[k].surface(lambda x: side * (x[0] - places[k]) > 0.5 * RADIUS)

    contacts = []
    for k in range(balls - 1):
        sides = cap(k, 1.0), cap(k + 1, -1.0)
        slave, master = sides if k % 2 == 0 else sides[::-1]
        contacts.append(nts.ContactPair(slave=slave, master=master))
    return nts.System(row, contacts=contacts)


class Recorder:
    """A writer that keeps the speeds of the balls along the row over `SPEED`."""

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        self.time, self.rows = [], []
        self.write(stepper)

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        self.time.append(stepper.state.time)
        bodies = stepper.system.bodies
        self.rows.append([nts.motion_of(body).velocity[0] / SPEED for body in bodies])

    def close(self, stepper):
        """Make arrays of the rows."""
        self.time, self.speeds = np.array(self.time), np.array(self.rows)


# ---- references
def block(balls, theta):
    """Speeds over v of rigid balls that touch, and the lost part of the energy."""
    e = 1 - 2 * theta
    speeds = np.full(balls, (1 + e) / balls)
    speeds[0] = (1 - (balls - 1) * e) / balls
    return speeds, (1 - e**2) * (balls - 1) / balls


def chain(balls, power):
    """Speeds over v of equal point masses that touch, with springs of this power of approach."""

    def rates(_, y):
        force = np.maximum(-np.diff(y[:balls]), 0.0) ** power
        return np.concatenate([y[balls:], np.r_[0.0, force] - np.r_[force, 0.0]])

    start = np.zeros(2 * balls)
    start[balls] = 1.0
    return solve_ivp(rates, (0.0, 40.0 * balls), start, rtol=1e-10, atol=1e-12).y[balls:, -1]


def figures(run, path):
    """Speeds at the end over that of the first ball at the start, energies over the start's."""
    b = run.balance
    momentum, start = b["linear_momentum"], b["energy"][0]
    whole = (path.speeds[-1] ** 2).sum()
    return {
        "speeds": path.speeds[-1],
        "contact_defect": float(b["contact_defect"][-1] / start),
        "within": float(b["energy"][-1] / start - whole),
        "momentum": float(np.abs(momentum - momentum[0]).max() / momentum[0, 0]),
        "ledger": float(np.abs(b["ledger_residual"]).max() / start),
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "retries": run.retries,
        "status": run.status,
        "history": {"time": path.time, "speeds": path.speeds},
    }


def plot(results, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(len(results), 1, figsize=(8, 2.8 * len(results)), squeeze=False,
                                layout="constrained")  # fmt: skip
    for axis, (kind, runs) in zip(axes[:, 0], results.items(), strict=True):
        for style, r in zip(("-", "--", ":"), runs.values(), strict=False):
            h = r["history"]
            for k, speeds in enumerate(h["speeds"].T):
                label = f"ball {k + 1}" if style == "-" else None
                axis.plot(1e3 * h["time"], speeds, style, color=f"C{k}", lw=1, label=label)
        axis.set_title(f"{kind}; theta = {', '.join(f'{t:g}' for t in runs)}: lines, dashes, dots")
        axis.set(xlabel="time [ms]", ylabel="speed / v [-]")
        axis.legend(fontsize="small", ncols=2)
    figure.savefig(folder / "newtons_cradle.png", dpi=150)
    plt.close(figure)


def report(results, balls):
    print(f"{'':20}{'theta':>6}  {'speeds / v':{8 * balls}}  defect  within  momentum   ledger")
    for name, power in (("linear springs", 1.0), ("Hertz", 1.5)):
        print(f"{name:26}  " + "".join(f"{v:>8.3f}" for v in chain(balls, power)))
    for kind, runs in results.items():
        for theta, r in runs.items():
            print(f"{kind:20}{theta:>6.2f}  " + "".join(f"{v:>8.3f}" for v in r["speeds"])
                  + f"{r['contact_defect']:>10.3f}{r['within']:>8.3f}{r['momentum']:>10.1e}"
                  f"{r['ledger']:>9.1e}  {r['status']}, {r['seconds']:.0f} s")  # fmt: skip


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    kinds=KINDS,
    parts=(0.0, 0.25, 0.5),
    balls=5,
    cells=4,
    dt=5e-4,
    duration=None,
    progress=False,
):
    """Let the first ball hit the row.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        kinds: Which of `KINDS`.
        parts: Of its step in which the first gap closes [-].
        balls: How many.
        cells: Along the sides of the cubes that are warped to balls, even; every other has one
            more.
        dt: Step [s].
        duration: End of the run [s]; default: `ENDS`.
        progress: Show a progress line.

    Returns:
        {kind: {part: figures}}; see `figures`.
    """
    if cells < 2 or cells % 2:
        raise ValueError(f"cells={cells!r}: must be even, so that the first ball has a tip node")
    results = {}
    for kind in kinds:
        way = SPEED * dt
        first, gap = (APART, APART + 0.5 * way) if kind.endswith("apart") else (0.0, 0.0)
        for theta in parts:
            path, clock = Recorder(), time.perf_counter()
            system = scene(comm, kind, balls, cells, first + theta * way, gap)
            t_end = duration or ENDS[kind.split()[-1]]
            folder = output and Path(output) / f"{kind.replace(', ', '_')}_{theta:g}"
            writers, interval = [path], max(t_end / 30, dt)
            if folder:
                film = Film(folder / "film.gif", interval=interval, view=(20.0, -70.0))
                writers += [Fields(folder, interval=interval), film]
            run = nts.simulate(
                system, nts.EnergyMomentum(), dt=dt, t_end=t_end, progress=progress,
                output=writers,
            )  # fmt: skip
            if folder:
                picture(run, folder / "balls.png", view=(20.0, -70.0))
            seconds = time.perf_counter() - clock
            results.setdefault(kind, {})[theta] = figures(run, path) | {"seconds": seconds}
    if comm.rank == 0:
        report(results, balls)
        if output is not None:
            plot(results, Path(output))
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/newtons_cradle", help="pictures and fields")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--balls", type=int, default=5)
    parser.add_argument("--cells", type=int, default=4, help="even")
    parser.add_argument("--dt", type=float, default=5e-4, help="[s]")
    main(progress=True, **vars(parser.parse_args()))
