"""How many collective calls of MPI a step has: what ranks wait for is counted, not timed."""

import sys
from collections import Counter

from mpi4py import MPI

import pytest
from scenes import box, meeting_blocks

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi
#: What ranks agree on at an iterate: is it new, did elements raise, which bodies and statuses have
#: changed, how far all moved; then norms, and whether it is what SNES has.
OF_ITERATE = 2
#: Where points of rigid bodies touch that share a load: their mean force before, and all their rows
#: after that.
OF_SHARED_LOAD = 2
#: A solution: which bodies moved since t_n, and their det F, or candidates that it wakes.
OF_SOLUTION = 2
#: Search 9, positions 4, what came before and predicted lengths 3, layout and gaps of flight 3, a
#: solution 4, ledger 2, looks for what is wrong 2; and in some steps for warnings 6.
OF_STEP = 33
#: Objects travel pickled, in messages and two broadcasts: rows of whose number other ranks do not
#: know. Flags and positions do not.
PICKLED = 4


def calls_in(work):
    """Calls of mpi4py's communicators by name while it works."""
    found = Counter()

    def see(_frame, event, function):
        if event == "c_call" and isinstance(getattr(function, "__self__", None), MPI.Comm):
            found[function.__name__] += 1

    before = sys.getprofile()
    sys.setprofile(see)
    try:
        work()
    finally:
        sys.setprofile(before)
    return found


def resting():
    """Two rigid cubes on a rubber one's place each: eight nodes touch where six hold them."""
    floor = nts.Plane((0, 0, 0), normal=(0, 0, 1))
    cubes = [
        nts.RigidBody(box([2.0 * k, 0, 0], [2.0 * k + 1, 1, 1], 2), density=1e3, name=f"cube {k}")
        for k in range(2)
    ]
    pairs = [nts.ContactPair(c.surface(lambda x: x[2] < 1e-9), floor) for c in cubes]
    return nts.System(cubes, contacts=pairs, gravity=(0, 0, -9.81))


def needs_a_profiler():
    if not calls_in(COMM.Barrier):
        pytest.skip("methods of this mpi4py are no C functions to Python's profiler")


def test_a_step_has_few_collective_calls():
    """And flags travel as numbers, positions as they are."""
    needs_a_profiler()
    stepper = nts.Stepper(meeting_blocks(), nts.EnergyMomentum())
    for _ in range(3):  # contact begins, and what follows it
        stepper.advance(1e-3)
    calls = calls_in(lambda: stepper.advance(1e-3))
    iterations = stepper.solution.rows[-1]["newton_iterations"]
    stepper.close()
    assert sum(calls.values()) <= OF_STEP + OF_ITERATE * (iterations + 1)
    assert calls["allreduce"] + calls["allgather"] <= PICKLED


@pytest.mark.parametrize("rigid", [False, True])
@pytest.mark.fast_on_ranks("False", "True")
def test_an_iteration_has_two_reductions(rigid):
    """Two more where rigid bodies share loads, however many contacts there are."""
    needs_a_profiler()
    system = resting() if rigid else meeting_blocks()
    stepper = nts.Stepper(system, nts.EnergyMomentum())
    for _ in range(3):
        stepper.advance(1e-3)
    assert stepper.solution.rows[-1]["active"] > 0
    stepper.problem.begin(stepper.state, 1e-3)
    calls, solver = calls_in(stepper.solver.solve), stepper.solver
    iterates = solver.snes.getIterationNumber() + 1
    stepper.close()
    each = OF_ITERATE + (OF_SHARED_LOAD if rigid else 0)
    assert sum(calls.values()) <= each * iterates + OF_SOLUTION
    assert not calls["allreduce"] + calls["allgather"]
