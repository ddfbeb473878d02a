"""Contact added by hand to a problem of one's own is that of the package."""

import numpy as np
import own_problem
import pytest


@pytest.mark.mpi
def test_by_hand_is_as_by_package():
    found = own_problem.main(cells=2, steps=4)
    ours, theirs = found["by_hand"], found["by_package"]
    assert found["status"] == "completed"
    assert ours[-1, 1] > 1
    assert np.abs(ours[:, 0] - theirs[:, 0]).max() < 1e-6 * np.abs(theirs[:, 0]).max()
