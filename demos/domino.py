"""Twenty rigid dominoes fall: a wave of impacts with friction, beside a train that leans.

Problem. Dominoes 48 high, 24 wide and 7.5 thick (mm, density 1200) stand 23.5 apart, g = 9.81.
Revolute joints hold the lower edge in front of each, the toe, to the ground; the heel stands on a
plane without friction. Heads rub on the backs of the next, friction 0.2. The first starts to turn
with three times the spin that it needs to fall. Head and heel are rounded across the width by
0.5 mm, so that they touch in their middles: two corners would say the same twice.

What is modelled, and what is not. Feet do not slide: hinges hold them, which is the assumption of
the reference. Free dominoes that stand on the floor by friction did not run to the end: among feet
that stick, slip and bounce within a step Newton's method found no set that holds.

Reference. The train of van Leeuwen (The domino effect, Am. J. Phys. 78, 2010, 721): the fallen
dominoes lean on each other, so that the tilt of the foremost gives all others,

    H sin(theta_1 - theta_0) = p cos(theta_0) - D,

H the height, D the thickness, p the pitch. Heads slide with friction, and an impact is wholly
inelastic. What the contact forces do to the tilts adds up to one equation for the foremost, and one
for its spin after each impact. Up to the first impact both are one domino on a hinge.

What to see. All fall. An impact of rigid bodies takes a step, and where in the step the gap closes
decides how much of the approach is kept, between nothing and all; the train loses all. So heads
rebound and hit again, and single impacts come up to 12 ms off the train's with a step of 3 ms. How
far off is a matter of chance, not in proportion to the step: of the first seven impacts of a row of
eight it is 5, 9 and 1 ms at most with 3, 2 and 1 ms. The wave, in the mean over the later half of
the impacts, has a speed of 1.38 to 1.43 sqrt(g H), as the step changes by up to 1.5 % and as
numbers are rounded; the train's is 1.379. Half of the energy goes into gaps that close (the contact
defect), 27 % into friction. The ledger closes to round-off through all impacts, and momentum along
the row is what the push gave plus the impulses of hinges and floor. Fronts and heels of dominoes
that lie on each other are no declared contact; the run ends as the last domino falls past 55
degrees, which nothing catches.

    mpirun -n 2 python demos/domino.py
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

HEIGHT, WIDTH, THICK, PITCH = 0.048, 0.024, 0.0075, 0.0235
DENSITY, GRAVITY, PUSH = 1.2e3, 9.81, 3.0
#: By how much the middle of head and heel is ahead of their ends [m].
ROUND = 5e-4
#: From the train's last impact to the end of the run [s], and the tilt of the fallen [rad].
LAST, FALLEN = 0.06, np.radians(55.0)
SHOWN = ("fallen", "speed", "train", "first", "late", "friction", "contact_defect", "ledger",
         "given", "momentum")  # fmt: skip


def push():
    """Spin of the first domino at the start [rad/s], `PUSH` times what it needs to fall."""
    inertia = (HEIGHT**2 + THICK**2) / 3
    climb = 0.5 * (np.hypot(HEIGHT, THICK) - HEIGHT)
    return PUSH * np.sqrt(2 * GRAVITY * climb / inertia)


def domino(comm, k):
    """The k-th domino; its back is at x = k PITCH."""
    back = k * PITCH
    mesh = create_box(
        comm, [[back, -0.5 * WIDTH, 0.0], [back + THICK, 0.5 * WIDTH, HEIGHT]], [1, 2, 2],
        CellType.hexahedron, ghost_mode=GhostMode.shared_facet,
    )  # fmt: skip
    x = mesh.geometry.x
    side, front = np.abs(x[:, 1]) > 0.1 * WIDTH, x[:, 0] > back + 0.5 * THICK
    x[side & front & (x[:, 2] > 0.9 * HEIGHT), 0] -= ROUND
    x[side & ~front & (x[:, 2] < 0.1 * HEIGHT), 2] += ROUND
    spin = np.array([0.0, push() if k == 0 else 0.0, 0.0])
    centre = nts.RigidBody(mesh, density=DENSITY).centre
    return nts.RigidBody(
        mesh, density=DENSITY, velocity=np.cross(spin, centre - [back + THICK, 0.0, 0.0]),
        angular_velocity=spin, name=f"domino {k + 1}",
    )  # fmt: skip


def scene(comm, dominoes, friction):
    """The row; its first contacts are those with the floor, the next those of heads with backs."""
    row, edge = [domino(comm, k) for k in range(dominoes)], 1e-6 * THICK
    floor = nts.Plane((0, 0, 0), (0, 0, 1), name="floor")
    contacts, joints = [], []
    for k, body in enumerate(row):
        back = k * PITCH + edge
        heel = body.surface(lambda x, back=back: (x[0] < back) & (x[2] < 0.6 * HEIGHT))
        contacts.append(nts.ContactPair(slave=heel, master=floor))
        toe = (k * PITCH + THICK, 0.0, 0.0)
        joints.append(nts.Revolute(body, None, point=toe, axis=(0, 1, 0), name=f"toe {k + 1}"))
    for k in range(dominoes - 1):
        head = row[k].surface(lambda x: x[2] > HEIGHT - edge)
        back = row[k + 1].surface(lambda x, k=k: x[0] < (k + 1) * PITCH + edge)
        contacts.append(nts.ContactPair(slave=head, master=back, friction=friction))
    return nts.System(row, contacts=contacts, joints=joints, gravity=(0, 0, -GRAVITY))


class Tilts:
    """A writer that keeps how far each domino has turned [rad]."""

    def start(self, stepper):
        """Begin anew with the state the run starts from."""
        self._upright = [body.rotation for body in stepper.system.bodies]
        self.time, self.rows = [], []
        self.write(stepper)

    def write(self, stepper, *, last=False):
        """Add the accepted state."""
        bodies = zip(stepper.system.bodies, self._upright, strict=True)
        up = [(body.rotation @ before.T)[:, 2] for body, before in bodies]
        self.time.append(stepper.state.time)
        self.rows.append([np.arctan2(z[0], z[2]) for z in up])

    def close(self, stepper):
        """Make arrays of the rows."""
        self.time, self.rows = np.array(self.time), np.array(self.rows)


# ---- the train of dominoes that lean on each other
def train(first, number, friction):
    """Tilts of a train and the weights of their torques in the equation of the foremost.

    Without friction the weights are the spins of all over that of the foremost (virtual work).

    Args:
        first: Tilt of the foremost [rad].
        number: Of dominoes.
        friction: Between them.

    Returns:
        Tilts [rad] and weights [-], shape (number,), the foremost first.
    """
    tilts, weights = [first], [1.0]
    for _ in range(number - 1):
        a = tilts[-1]
        b = a + np.arcsin((PITCH * np.cos(a) - THICK) / HEIGHT)
        along, across = HEIGHT * np.cos(b - a), HEIGHT * np.sin(b - a)
        # Arms of the contact force about the feet of the one in front and of the one that leans.
        front = along - PITCH * np.sin(a) - friction * THICK
        weights.append(weights[-1] * front / (along + friction * across))
        tilts.append(b)
    return np.array(tilts), np.array(weights)


def impacts(dominoes, friction):
    """Times at which the train meets the next domino [s], shape (dominoes - 1,)."""
    inertia = (HEIGHT**2 + THICK**2) / 3
    meets, small = np.arcsin((PITCH - THICK) / HEIGHT), 1e-6

    def faster(_, y, number):
        tilts, weights = train(y[0], number, friction)
        spins = train(y[0], number, 0.0)[1]
        ahead, behind = (train(y[0] + s, number, 0.0)[1] for s in (small, -small))
        bend = (ahead - behind) / (2 * small)
        torque = 0.5 * GRAVITY * (HEIGHT * np.sin(tilts) - THICK * np.cos(tilts))
        gain = weights @ (torque / inertia - bend * y[1] ** 2)
        return [y[1], gain / (weights @ spins)]

    def gap(_, y, number):
        return y[0] - meets

    gap.terminal = True
    now, spin, times = 0.0, push(), []
    for number in range(1, dominoes):
        way = solve_ivp(
            faster, (now, now + 10.0), [0.0, spin], args=(number,), events=gap, rtol=1e-8
        )
        now, spin = way.t[-1], way.y[1, -1]
        times.append(now)
        before = spin * train(meets, number, 0.0)[1]
        weights, spins = (train(0.0, number + 1, mu)[1] for mu in (friction, 0.0))
        spin = weights[1:] @ before / (weights @ spins)
    return np.array(times)


def speed(times):
    """Return the speed of the wave over sqrt(g H), the mean of the later half of the impacts."""
    part = times[min(len(times) // 2, len(times) - 2) :]
    return PITCH * (len(part) - 1) / (part[-1] - part[0]) / np.sqrt(GRAVITY * HEIGHT)


def figures(run, tilts, dominoes, friction):
    """Times in s, momenta in kg m/s, energies over the largest that fell into the row."""
    b, t, right = run.balance, tilts.time, impacts(dominoes, friction)
    size = np.abs(b["external_work"]).max() + b["energy"][0]
    heads = np.abs(run.contact_forces[:, dominoes:]).max(axis=2) > 0.0
    met = heads.any(axis=0)
    times = np.where(met, t[heads.argmax(axis=0)], np.inf)
    toes = [force[1:, 0, 0] for name, force in run.reactions.items() if name.startswith("toe")]
    touch = run.contact_forces[1:, :, 0].T
    momentum = b["linear_momentum"][:, 0]
    missing = np.diff(momentum) - np.diff(t) * (sum(toes) + touch[:dominoes].sum(axis=0))
    impulses = np.diff(t) * np.abs([*toes, *touch]).sum(axis=0)
    return {
        "fallen": int((tilts.rows[-1] > FALLEN).sum()),
        "impacts": times,
        "speed": float(speed(times)) if met.all() else np.nan,
        "train": float(speed(right)),
        "first": float(times[0] - right[0]),
        "late": float(np.abs(times - right).max()),
        "friction": float(b["friction_dissipation"][-1] / size),
        "contact_defect": float(b["contact_defect"][-1] / size),
        "ledger": float(np.abs(b["ledger_residual"]).max() / size),
        "given": float(momentum[0] / np.abs(momentum).max()),
        "momentum": float(np.abs(missing).max() / impulses.max()),
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "retries": run.retries,
        "status": run.status,
        "history": {"time": t, "tilts": tilts.rows},
    }


def plot(r, dominoes, friction, folder):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
    left.plot(r["history"]["time"], np.degrees(r["history"]["tilts"]), lw=1)
    left.set(xlabel="time [s]", ylabel="tilts [degrees]")
    number = np.arange(1, dominoes)
    right.plot(r["impacts"], number, "o", label="dominoes")
    right.plot(impacts(dominoes, friction), number, "k:", label="train")
    right.set(xlabel="time of the first touch [s]", ylabel="domino")
    right.legend()
    figure.savefig(folder / "wave.png", dpi=150)
    plt.close(figure)


def report(r, dominoes):
    print(f"{dominoes} dominoes: {r['status']}")
    for name in SHOWN:
        print(f"  {name:16}{r[name]:>12.5g}")
    print(f"  {r['newton_iterations']:.2f} iterations a step, {r['retries']} retries, "
          f"{r['seconds']:.0f} s")  # fmt: skip


def main(
    *,
    comm=MPI.COMM_WORLD,
    output=None,
    dominoes=20,
    friction=0.2,
    dt=3e-3,
    duration=None,
    progress=False,
):
    """Push the first domino.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and fields, or None.
        dominoes: How many.
        friction: Between dominoes.
        dt: Step [s].
        duration: End of the run [s]; None: `LAST` after the train meets the last domino.
        progress: Show a progress line.

    Returns:
        Figures; see `figures`.
    """
    if dominoes < 3:
        raise ValueError(f"dominoes={dominoes!r}: a wave takes at least 3")
    tilts, clock = Tilts(), time.perf_counter()
    system, folder = scene(comm, dominoes, friction), output and Path(output)
    writers = []
    if folder:
        film = Film(folder / "film.gif", interval=max(0.02, dt), view=(15.0, -70.0))
        writers = [Fields(folder, interval=max(0.01, dt)), film]
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=dt,
        t_end=duration or impacts(dominoes, friction)[-1] + LAST, progress=progress,
        output=[tilts, *writers],
    )  # fmt: skip
    r = figures(run, tilts, dominoes, friction) | {"seconds": time.perf_counter() - clock}
    if folder:
        picture(run, folder / "dominoes.png", view=(15.0, -70.0))
    if comm.rank == 0:
        report(r, dominoes)
        if folder:
            plot(r, dominoes, friction, folder)
    return r


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/domino", help="pictures and fields")
    parser.add_argument("--dominoes", type=int, default=20)
    parser.add_argument("--friction", type=float, default=0.2)
    parser.add_argument("--dt", type=float, default=3e-3, help="[s]")
    main(progress=True, **vars(parser.parse_args()))
