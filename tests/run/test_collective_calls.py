"""How many collective calls of MPI a step has: what ranks wait for is counted, not timed."""

import sys
from collections import Counter

from mpi4py import MPI

import pytest
from scenes import meeting_blocks

import dolfinx_nts as nts

COMM = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi
#: A Newton iterate is agreed on: whether it is new (as residual, and as Jacobian), has moved, and
#: whether its elements failed; norms of bodies, of elements, of both; whether the active set and
#: the matrices stay. Two surfaces are gathered in it.
OF_ITERATE = 11
#: Search 12, edges 4, layout and limits 7, ledger 7, looks for what is wrong 4, and in some steps
#: looks for warnings 11.
OF_STEP = 45
#: Objects travel pickled, in messages and two broadcasts: for warnings 10, and rows of whose number
#: other ranks do not know 6. Flags and positions do not.
PICKLED = 16


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


def test_a_step_has_few_collective_calls():
    """And flags travel as numbers, positions as they are."""
    if not calls_in(COMM.Barrier):
        pytest.skip("methods of this mpi4py are no C functions to Python's profiler")
    stepper = nts.Stepper(meeting_blocks(), nts.EnergyMomentum())
    for _ in range(3):  # contact begins, and what follows it
        stepper.advance(1e-3)
    calls = calls_in(lambda: stepper.advance(1e-3))
    iterations = stepper.solution.rows[-1]["newton_iterations"]
    stepper.close()
    assert sum(calls.values()) <= OF_STEP + OF_ITERATE * (iterations + 1)
    assert calls["allreduce"] + calls["allgather"] <= PICKLED
