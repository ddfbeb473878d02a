"""The demo of a crane: capstan and weight while it hoists, a pendulum of SciPy's when it stands."""

import crane as demo
import pytest


@pytest.mark.mpi
def test_hoists():
    r = demo.main(dt=2e-2, t_end=demo.UP)
    assert r["status"] == "completed"
    assert r["ratio"] < 1e-9 and r["tension"] == pytest.approx(1.0, rel=1e-9)
    assert r["height"] == pytest.approx(demo.HOIST, rel=1e-12)
    assert r["rubbed"] > 0.0 and r["ledger"] < 1e-11


@pytest.mark.slow
def test_sways_as_a_pendulum_of_order_two():
    found = [demo.main(dt=dt) for dt in (2e-2, 1e-2)]
    assert found[0]["off"] / found[1]["off"] == pytest.approx(4.0, rel=0.1)
    assert found[1]["off"] < 2e-3 and found[1]["ledger"] < 1e-11
