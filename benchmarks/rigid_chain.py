"""CPU time of a step of a chain of rigid bodies with ball joints, which falls from the horizontal.

python benchmarks/rigid_chain.py [--bodies 10 100]
"""

import argparse
import time

import numpy as np

import dolfinx_nts as nts


def chain(bodies: int) -> nts.System:
    """The scene."""
    links = [
        nts.RigidBody.from_inertia(1.0, (0.01, 0.1, 0.1), centre=(k + 0.5, 0, 0), name=f"link {k}")
        for k in range(bodies)
    ]
    joints = [
        nts.Spherical(b, links[k - 1] if k else None, point=(k, 0, 0), name=f"joint {k}")
        for k, b in enumerate(links)
    ]
    return nts.System(links, joints=joints, gravity=(0, 0, -9.81))


def main(bodies: int, steps: int = 20) -> tuple[float, float]:
    """Fastest of the steps [s] and mean Newton iterations."""
    stepper = nts.Stepper(chain(bodies), nts.EnergyMomentum())
    times = []
    for _ in range(steps + 2):
        start = time.process_time()
        stepper.advance(5e-3)
        times.append(time.process_time() - start)
    iterations = stepper.solution.balance["newton_iterations"][3:]
    return min(times[2:]), float(np.mean(iterations))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bodies", type=int, nargs="+", default=[1, 10, 100, 200])
    for number in parser.parse_args().bodies:
        fastest, mean = main(number)
        print(f"{number:4d} bodies: {1e3 * fastest:7.1f} ms a step, {mean:.1f} Newton iterations")
