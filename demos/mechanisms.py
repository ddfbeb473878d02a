"""The five basic mechanisms of IFToMM's benchmark library, beside references of their own.

Problem. Each is built of rigid bodies and joints as a user would, without minimal coordinates.

- A01, pendulum: a point mass of 1 kg on a bar of 1 m falls from the horizontal.
- A02, four-bars: ten side by side, all bars 1 m and 1 kg, 1 m/s at their tops. They pass positions
  in which all bars lie in one line, where the joints' equations lose rank.
- A03, Andrews' squeezer: seven bodies of some grams in the plane, a torque of 0.033 N m, a spring;
  0.03 s, in which the crank turns two and a half times.
- A04, Bricard's loop: five bars of 1 m and 1 kg with six hinges along the edges of a cube, mobile
  though counting says that it is not: one equation repeats others in another way at each time.
- A05, governor: two rods with balls of 5 kg at a turning shaft hold a slider by stiff springs with
  dampers (8e5 N/m, 4e4 N s/m).

Reference. A01, A02 and A05 have equations of motion of one to three coordinates, solved by SciPy to
1e-10. The angles of A03 at 0.03 s are those of the test set for initial value problems (Mazzia and
Magherini, "Andrews' squeezing mechanism"). In A04 every other hinge turns alike, by x and y with
sin x - sin y + sin x sin y = 0.

What to see. Bricard's loop closes to round-off. All others differ from their references by what is
of order two in the step. Energies that nothing drives or damps are kept to 1e-11, and the ledger
closes to that elsewhere, through singular positions and with repeated equations as well.

    mpirun -n 2 python demos/mechanisms.py
"""

import argparse
import itertools
import time
from pathlib import Path

from mpi4py import MPI

import numpy as np
from scipy.integrate import solve_ivp

import dolfinx_nts as nts
from dolfinx_nts.output import Film, ForcesCSV
from dolfinx_nts.output.pictures import picture

G, Z = 9.81, np.array([0.0, 0.0, 1.0])
SHOWN = ("error", "energy", "ledger", "newton_iterations", "seconds")


def thin(comm, name, ends, mass=1.0, velocity=(0, 0, 0), spin=(0, 0, 0), thick=0.0):
    """A rigid bar between two points [m]."""
    p, q = np.asarray(ends, dtype=float)
    along, length = (q - p) / np.linalg.norm(q - p), np.linalg.norm(q - p)
    across = thick**2 / 12
    inertia = mass * (
        (length**2 / 12 + across) * (np.eye(3) - np.outer(along, along))
        + 2 * across * np.outer(along, along)
    )  # fmt: skip
    return nts.RigidBody.from_inertia(
        mass, inertia, 0.5 * (p + q), velocity=velocity, angular_velocity=spin, name=name, comm=comm
    )


def solved(rates, start, end, **options):
    """State at the end of an initial value problem, by SciPy."""
    return solve_ivp(rates, (0.0, end), start, rtol=1e-10, atol=1e-12, **options).y[:, -1]


# ---- A01
def pendulum(comm, t_end):
    """The pendulum, and what returns how far it is from its place [m]."""
    bob = nts.RigidBody.from_inertia(1.0, 3 * [1e-3], (-1, 0, 0), name="bob", comm=comm)
    bar = nts.Distance(None, bob, points=((0, 0, 0), (-1, 0, 0)), name="bar")
    system = nts.System([bob], joints=[bar], gravity=(0, -G, 0))

    def error():
        angle, _ = solved(lambda t, y: [y[1], -G * np.cos(y[0])], [np.pi, 0.0], t_end)
        return np.linalg.norm(bob.position - [np.cos(angle), np.sin(angle), 0.0])

    return system, error


# ---- A02
def four_bars(comm, t_end, number=10):
    """Four-bars side by side, upright, and the error of the first crank's middle [m]."""
    top, spin = np.array([0.0, 1.0, 0.0]), -1.0
    feet = [np.array([float(k), 0.0, 0.0]) for k in range(number + 1)]
    cranks = [
        thin(comm, f"crank {k}", (x, x + top), velocity=(0.5, 0, 0), spin=spin * Z)
        for k, x in enumerate(feet)
    ]
    couplers = [
        thin(comm, f"coupler {k}", (a + top, b + top), velocity=(1.0, 0, 0))
        for k, (a, b) in enumerate(itertools.pairwise(feet))
    ]
    joints = []
    for k, x in enumerate(feet):
        joints.append(nts.Revolute(cranks[k], None, point=x, axis=Z, name=f"foot {k}"))
        for coupler in couplers[max(k - 1, 0) : k + 1]:
            joints.append(nts.Revolute(
                cranks[k], coupler, point=x + top, axis=Z, name=f"{coupler.name} on crank {k}"
            ))  # fmt: skip
    system = nts.System([*cranks, *couplers], joints=joints, gravity=(0, -G, 0))
    weight, inertia = (number + 1) / 2 + number, (number + 1) / 3 + number

    def error():
        fall = solved(
            lambda t, y: [y[1], -G * weight / inertia * np.cos(y[0])], [np.pi / 2, spin], t_end
        )
        right = 0.5 * np.array([np.cos(fall[0]), np.sin(fall[0]), 0.0])
        return np.linalg.norm(cranks[0].position - right)

    return system, error


# ---- A03
#: Angles beta, Theta, gamma, Phi, delta, Omega, epsilon at the start, and at 0.03 s [rad].
FIRST = (-0.0617138900142764496, 0.0, 0.455279819163070380, 0.222668390165885885,
         0.487364979543842550, -0.222668390165885885, 1.23054744454982119)  # fmt: skip
LAST = (15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948,
        0.5244099658805304, 0.5347301163226948, 1.048080741042263)  # fmt: skip
MASSES = (0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498)
INERTIAS = (2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5)
GROUND_A, GROUND_B, GROUND_C = (-0.06934, -0.00227), (-0.03635, 0.03273), (0.014, 0.072)


def directions(q):
    """Of angles of the plane: the turns of the seven bodies [rad]."""
    return np.array([q[0], q[0] + q[1], q[2], q[3] + q[4], q[4], q[5] + q[6], q[6]])


def squeezer(comm, t_end):
    """Andrews' mechanism, and the error of its seven angles [rad]."""
    turn = directions(FIRST)
    e, n = np.column_stack([np.cos(turn), np.sin(turn)]), np.column_stack(
        [-np.sin(turn), np.cos(turn)]
    )
    a, b = np.array(GROUND_A), np.array(GROUND_B)
    crank, at_e, at_f = 0.007 * e[0], a + 0.04 * e[4], a - 0.04 * n[6]
    centres = [
        0.00092 * e[0], crank - 0.0115 * e[1], b - 0.01874 * n[2] + 0.01043 * e[2],
        at_e - 0.00579 * n[3], a + 0.02308 * e[4] + 0.00916 * n[4], at_f + 0.00579 * e[5],
        a - 0.01228 * n[6] - 0.00449 * e[6],
    ]  # fmt: skip
    pin = crank - 0.028 * e[1]

    def solid(x):
        return np.array([*x, 0.0])

    bodies = [
        nts.RigidBody.from_inertia(m, 3 * [i], solid(x), name=f"K{k}", comm=comm)
        for k, (m, i, x) in enumerate(zip(MASSES, INERTIAS, centres, strict=True), 1)
    ]
    places = [
        (0, None, np.zeros(2)), (1, 0, crank), (1, 2, pin), (1, 3, pin), (1, 5, pin), (2, None, b),
        (3, 4, at_e), (4, None, a), (5, 6, at_f), (6, None, a),
    ]  # fmt: skip
    joints = [
        nts.Revolute(
            bodies[i], None if j is None else bodies[j], point=solid(x), axis=Z, name=f"pin {k}",
            motor=(lambda t, angle, rate: 0.033) if k == 0 else None,
        )
        for k, (i, j, x) in enumerate(places)
    ]  # fmt: skip
    hook = solid(b + 0.02 * e[2] - 0.018 * n[2])
    spring = nts.Spring(
        bodies[2], None, (hook, solid(GROUND_C)), stiffness=4530.0, length=0.07785, name="spring"
    )
    system, frames = nts.System(bodies, joints=[*joints, spring]), [b.rotation for b in bodies]

    def error():
        moved = [body.rotation @ f.T for body, f in zip(bodies, frames, strict=True)]
        found = np.array([np.arctan2(m[1, 0], m[0, 0]) for m in moved])
        off = found - (directions(LAST) - turn)
        return float(np.abs(np.angle(np.exp(1j * off))).max()) if t_end == 0.03 else np.nan

    return system, error


# ---- A04
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1), (0, 0, 1)], dtype=float)
HINGES = np.array([(0, 1, 0), (0, 0, 1), (1, 0, 0)] * 2, dtype=float)


def bricard(comm, t_end):
    """Bricard's loop, and how far its hinges are from turning as they must [-]."""
    bars = [
        thin(comm, f"bar {k}", CORNERS[k : k + 2], thick=0.1) for k in range(len(CORNERS) - 1)
    ]
    joints = [
        nts.Revolute(*pair, point=p, axis=n, name=f"hinge {k}")
        for k, (pair, p, n) in enumerate(
            zip(itertools.pairwise([None, *bars, None]), CORNERS, HINGES, strict=True)
        )
    ]
    first = [bar.rotation for bar in bars]

    def error():
        moved = [bar.rotation @ f.T for bar, f in zip(bars, first, strict=True)]
        turns, sines = [np.eye(3), *moved, np.eye(3)], []
        for n, (one, other) in zip(HINGES, itertools.pairwise(turns), strict=True):
            m = np.roll(n, 1)
            sines.append(abs(np.cross(one @ m, other @ m) @ one @ n))
        x, y = sines[:2]
        return max(np.abs(np.array(sines) - 3 * [x, y]).max(), abs(x - y + x * y))

    return nts.System(bars, joints=joints, gravity=(0, -G, 0)), error


# ---- A05
STIFFNESS, DAMPING, BALL, ROD, SLIDER, SPIN = 8e5, 4e4, 5.0, 0.3, 3.0, 2 * np.pi
#: Half of the hinges' and of the slider's width, section of rods, and angle below the horizontal.
HALF, SECTION, DOWN = 0.05, 0.01, np.pi / 6
AXIAL, CROSS = ROD * SECTION**2 / 6, ROD * (1.0 + SECTION**2) / 12
SHAFT = 0.3 * SECTION**2 / 6


def governor(comm, t_end):
    """The governor, and the error of its slider's height [m]."""
    spin, half = SPIN * Z, 0.5 * SLIDER * (2 * HALF) ** 2 / 3
    shaft = nts.RigidBody.from_inertia(
        0.3, (0.025, 0.025, SHAFT), (0, 0, 0.5), angular_velocity=spin, name="shaft", comm=comm
    )
    slider = nts.RigidBody.from_inertia(
        SLIDER, 3 * [half], (0, 0, 0.5), angular_velocity=spin, name="slider", comm=comm
    )
    bodies = [shaft, slider]
    joints = [
        nts.Revolute(shaft, None, point=(0, 0, 0), axis=Z, name="bearing"),
        nts.Prismatic(slider, shaft, point=(0, 0, 0.5), axis=Z, name="slide"),
    ]
    for side, name in ((1.0, "right"), (-1.0, "left")):
        hinge = np.array([side * HALF, 0.0, 1.0])
        end = hinge + [side * np.cos(DOWN), 0.0, -np.sin(DOWN)]
        middle, held = 0.5 * (hinge + end), np.array([side * HALF, 0.0, 0.5])
        rod = thin(
            comm, f"{name} rod", (hinge, end), ROD, np.cross(spin, middle), spin, SECTION
        )
        ball = nts.RigidBody.from_inertia(
            BALL, 3 * [1e-9], end, velocity=np.cross(spin, end), angular_velocity=spin,
            name=f"{name} ball", comm=comm,
        )  # fmt: skip
        bodies += [rod, ball]
        joints += [
            nts.Revolute(rod, shaft, point=hinge, axis=(0, 1, 0), name=f"{name} hinge"),
            nts.Fixed(ball, rod, point=end, name=f"{name} weld"),
            nts.Spring(slider, rod, (held, middle), stiffness=STIFFNESS, name=f"{name} spring"),
            nts.Damper(slider, rod, (held, middle), damping=DAMPING, name=f"{name} damper"),
        ]

    def rates(t, y):
        angle, height, turning, rising = y
        c, s = np.cos(angle), np.sin(angle)
        place = [ROD * (HALF + 0.5 * c) ** 2 + BALL * (HALF + c) ** 2 + AXIAL * s * s
                 + CROSS * c * c for c, s in ((c, s), (np.cos(DOWN), np.sin(DOWN)))]  # fmt: skip
        rest = SHAFT + half
        now, first = (rest + 2 * p for p in place)
        slope = 2 * (
            -ROD * (HALF + 0.5 * c) * s - 2 * BALL * (HALF + c) * s + 2 * (AXIAL - CROSS) * s * c
        )
        speed = SPIN * first / now
        away, below = 0.5 * c, 1.0 - 0.5 * s - height
        long = np.hypot(away, below)
        by = np.array([-0.5 * s * away - 0.5 * c * below, -below]) / long
        pull = STIFFNESS * (long - 0.5) + DAMPING * (by @ [turning, rising])
        inertia = ROD / 4 + CROSS + BALL
        return [
            turning, rising,
            (0.25 * slope * speed**2 + (0.5 * ROD + BALL) * G * c - pull * by[0]) / inertia,
            -G - 2 * pull * by[1] / SLIDER,
        ]  # fmt: skip

    def error():
        right = solved(rates, [DOWN, 0.5, 0.0, 0.0], t_end, method="Radau")[1]
        return abs(slider.position[2] - right)

    return nts.System(bodies, joints=joints, gravity=-G * Z), error


#: Scene, step and end [s] of each.
CASES = {
    "pendulum": (pendulum, 1e-2, 10.0), "four-bars": (four_bars, 1e-2, 10.0),
    "squeezer": (squeezer, 1e-4, 0.03), "bricard": (bricard, 1e-2, 10.0),
    "governor": (governor, 1e-2, 10.0),
}  # fmt: skip


def run_case(comm, name, *, dt, t_end, folder, progress):
    """Figures of one mechanism: see `main`."""
    make, step, end = CASES[name]
    dt, end = dt or step, t_end or end
    system, error = make(comm, end)
    writers = []
    if folder:
        film = Film(folder / "film.gif", interval=max(end / 60, dt), colour="body")
        writers = [film, ForcesCSV(folder / "forces.csv")]
        picture(system, folder / "start.png", colour="body")
    clock = time.process_time()
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=dt, t_end=end, progress=progress, output=writers
    )
    b, taken = run.balance, time.process_time() - clock
    moved = np.ptp(b["kinetic"])
    return {
        "error": float(error()),
        "energy": float(np.abs(b["energy"] - b["external_work"] - b["energy"][0]).max() / moved),
        "ledger": float(np.abs(b["ledger_residual"]).max() / moved),
        "newton_iterations": float(b["newton_iterations"][1:].mean()),
        "seconds": comm.allreduce(taken, op=MPI.MAX),
        "status": run.status,
    }


def report(results):
    print(f"{'':12}" + "".join(f"{name:>20}" for name in SHOWN))
    for case, r in results.items():
        print(f"{case:12}" + "".join(f"{r[name]:>20.3g}" for name in SHOWN))


def main(
    *, comm=MPI.COMM_WORLD, output=None, cases=tuple(CASES), dt=None, t_end=None, progress=False
):
    """Run the mechanisms.

    Args:
        comm: MPI communicator.
        output: Folder for pictures and films, or None.
        cases: Which of them.
        dt: Step [s]; None: that of each.
        t_end: [s]; None: that of each.
        progress: Show a progress line.

    Returns:
        {case: figures}: error beside the reference [m, rad or -], energy and ledger over the
        largest change of kinetic energy, iterations a step and processor time [s].
    """
    results = {}
    for name in cases:
        folder = output and Path(output) / name
        results[name] = run_case(
            comm, name, dt=dt, t_end=t_end, folder=folder, progress=progress
        )
    if comm.rank == 0:
        report(results)
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", default="out/mechanisms", help="pictures and films")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--dt", type=float, default=None, help="[s]")
    parser.add_argument("--t-end", type=float, default=None, help="[s]")
    main(progress=True, **vars(parser.parse_args()))
