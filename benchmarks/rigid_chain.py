"""CPU time of a step of a chain of rigid bodies with ball joints, which falls from the horizontal.

    python benchmarks/rigid_chain.py [--bodies 10 100]

Beside it stands Exudyn's, where that is installed (`pip install exudyn`): the same links, joints
and steps with its generalised alpha and its sparse solver, on one core.
"""

import argparse
import time
from importlib.util import find_spec

import numpy as np

import dolfinx_nts as nts

STEP, GRAVITY, INERTIA = 5e-3, (0, 0, -9.81), (0.01, 0.1, 0.1)


def chain(bodies: int) -> nts.System:
    """The scene."""
    links = [
        nts.RigidBody.from_inertia(1.0, INERTIA, centre=(k + 0.5, 0, 0), name=f"link {k}")
        for k in range(bodies)
    ]
    joints = [
        nts.Spherical(b, links[k - 1] if k else None, point=(k, 0, 0), name=f"joint {k}")
        for k, b in enumerate(links)
    ]
    return nts.System(links, joints=joints, gravity=GRAVITY)


def main(bodies: int, steps: int = 20) -> tuple[float, float]:
    """Fastest of the steps [s] and mean Newton iterations."""
    stepper = nts.Stepper(chain(bodies), nts.EnergyMomentum())
    times = []
    for _ in range(steps + 2):
        start = time.process_time()
        stepper.advance(STEP)
        times.append(time.process_time() - start)
    iterations = stepper.solution.balance["newton_iterations"][3:]
    return min(times[2:]), float(np.mean(iterations))


def exudyn(bodies: int, steps: int = 20) -> float:
    """Mean time of its steps [s]."""
    import exudyn as exu
    from exudyn.utilities import RigidBodyInertia

    mbs = exu.SystemContainer().AddSystem()
    last = mbs.CreateGround()
    for k in range(bodies):
        body = mbs.CreateRigidBody(
            referencePosition=[k + 0.5, 0, 0], gravity=list(GRAVITY),
            inertia=RigidBodyInertia(mass=1.0, inertiaTensor=np.diag(INERTIA)),
        )  # fmt: skip
        mbs.CreateSphericalJoint(itemNumbers=[last, body], position=[k, 0, 0])
        last = body
    mbs.Assemble()
    settings = exu.SimulationSettings()
    settings.timeIntegration.numberOfSteps = steps
    settings.timeIntegration.endTime = steps * STEP
    settings.linearSolver.solverType = exu.LinearSolverType.EigenSparse
    settings.solution.file.write = False
    settings.parallel.numberOfThreads = 1
    start = time.process_time()
    mbs.SolveDynamic(settings)
    return (time.process_time() - start) / steps


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bodies", type=int, nargs="+", default=[1, 10, 100, 200])
    for number in parser.parse_args().bodies:
        fastest, mean = main(number)
        text = f"{number:4d} bodies: {1e3 * fastest:.2f} ms a step, {mean:.1f} Newton iterations"
        beside = f"; Exudyn {1e3 * exudyn(number):.2f} ms" if find_spec("exudyn") else ""
        print(text + beside)
