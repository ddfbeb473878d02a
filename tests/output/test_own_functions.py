"""Functions of a user's own in the files of `Fields`, and what a run shows in Jupyter."""

import base64
import re
from functools import partial

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from scenes import CELLS, RUBBER, box
from xdmf import read_xdmf

import dolfinx_nts as nts
from dolfinx_nts import dolfinx_compat as compat
from dolfinx_nts.output import Fields

pytest.importorskip("h5py")

COMM = MPI.COMM_WORLD
mpi = pytest.mark.mpi


def moving(cell="hexahedron"):
    """A cube that is stretched, beside a rigid one."""
    body = nts.Continuum(
        box(cells=(2, 2, 3), cell=CELLS[cell]), RUBBER, density=1e3, name="soft",
        displacement=lambda x: np.stack([0.1 * x[0] ** 2, 0 * x[0], 0.05 * x[2]]),
    )  # fmt: skip
    other = nts.RigidBody(box(low=(3, 0, 0), high=(4, 1, 1), cells=1), density=1e3, name="hard")
    return body, nts.System([body, other])


@mpi
@pytest.mark.fast("hexahedron")
@pytest.mark.parametrize("cell", CELLS)
def test_they_are_as_they_were(cell, mpi_tmp_path):
    """Scalars, vectors and tensors in cells and at nodes, at their places on any ranks."""
    body, system = moving(cell)
    spaces = {
        "heat": compat.function_space(body.mesh, "Lagrange", 1),
        "flow": compat.vector_space(body.mesh, 1),
        "tensor": compat.function_space(body.mesh, "Lagrange", 1, (3, 3)),
        "damage": compat.function_space(body.mesh, "DG", 0),
    }
    laws = {
        "heat": lambda x: x[0] + 2 * x[2],
        "flow": lambda x: np.stack([x[1], x[0], 3 * x[2]]),
        "tensor": lambda x: np.stack([k * x[k % 3] for k in range(9)]),
        "damage": lambda x: x[0] + 5 * x[1] + 25 * x[2],
    }
    given = [fem.Function(space, name=name) for name, space in spaces.items()]
    for function in given:
        function.interpolate(laws[function.name])
    stresses = {
        "cauchy_stress": partial(nts.cauchy_stress, at="cells"), "von_mises": nts.von_mises
    }  # fmt: skip
    writer = Fields(mpi_tmp_path, functions=[*given, *stresses.values()])
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-4, t_end=2e-4, output=[writer])
    assert run.status == "completed"
    file = read_xdmf(mpi_tmp_path / "soft.xdmf")
    middles = file.points[file.cells].mean(axis=1)
    for name, law in laws.items():
        x = middles if name == "damage" else file.points
        expected = law(x.T).T
        np.testing.assert_allclose(file.fields[-1][name], expected, atol=1e-14)
    # Their sums do not depend on the order of cells and nodes.
    for name, function in stresses.items():
        found, values = file.fields[-1][name], function(body)
        width = 9 if name == "cauchy_stress" else 1
        owned = values.function_space.dofmap.index_map.size_local
        local = values.x.array.reshape(-1, width)[:owned].sum(axis=0)
        total = np.zeros(width)
        COMM.Allreduce(local, total)
        assert found.shape == ((len(file.cells), 9) if width == 9 else (len(file.points),))
        size = np.abs(found).sum()
        np.testing.assert_allclose(found.reshape(-1, width).sum(axis=0), total, atol=1e-12 * size)
    hard = read_xdmf(mpi_tmp_path / "hard.xdmf")
    assert set(hard.fields[-1]) == {"displacement", "velocity"}


@mpi
def test_what_cannot_be_written_is_refused(mpi_tmp_path):
    body, system = moving()
    with pytest.raises(TypeError, match=r"functions\[0\]=3: pass a sequence of Functions, or"):
        Fields(mpi_tmp_path, functions=[3])
    for space in (compat.vector_space(body.mesh, 2), compat.function_space(body.mesh, "DG", 1)):
        writer = Fields(mpi_tmp_path, functions=[fem.Function(space)])
        with pytest.raises(ValueError, match="other values than one at each node or in each cell"):
            nts.simulate(system, nts.EnergyMomentum(), dt=1e-4, t_end=1e-4, output=[writer])


def named(space, name):
    """A Function of zeros; without a name of its own DOLFINx calls each one "f"."""
    return fem.Function(space) if name is None else fem.Function(space, name=name)


@mpi
@pytest.mark.parametrize("names", [(None, None), ("displacement",), ("von_mises",)])
def test_two_fields_of_one_name_are_refused(names, mpi_tmp_path):
    """One of the two would be missing in the file."""
    body, system = moving()
    space = compat.function_space(body.mesh, "DG", 0)
    functions = [nts.von_mises, *(named(space, name) for name in names)]
    writer = Fields(mpi_tmp_path, functions=functions)
    text = rf"of body 'soft': there is another field '{names[-1] or 'f'}' in its file"
    with pytest.raises(ValueError, match=text):
        nts.simulate(system, nts.EnergyMomentum(), dt=1e-4, t_end=1e-4, output=[writer])


@mpi
def test_a_function_on_no_mesh_of_the_scene_is_refused(mpi_tmp_path):
    _, system = moving()
    elsewhere = fem.Function(compat.function_space(box(cells=1), "DG", 0))
    writer = Fields(mpi_tmp_path, functions=[nts.von_mises, elsewhere])
    with pytest.raises(ValueError, match=r"functions\[1\]=f: is on none of the bodies' meshes"):
        nts.simulate(system, nts.EnergyMomentum(), dt=1e-4, t_end=1e-4, output=[writer])


@mpi
def test_what_makes_no_function_is_refused(mpi_tmp_path):
    body, system = moving()
    with pytest.raises(TypeError, match=r"functions\[0\]=.*: pass a sequence of Functions, or"):
        Fields(mpi_tmp_path, functions=[ufl.SpatialCoordinate(body.mesh)])
    writer = Fields(mpi_tmp_path, functions=[lambda body: body.u.x.array])
    text = r"(?s)functions\[0\] of body 'soft': .* returned array\(.*return a dolfinx Function"
    with pytest.raises(TypeError, match=text):
        nts.simulate(system, nts.EnergyMomentum(), dt=1e-4, t_end=1e-4, output=[writer])


def test_another_reader_sees_them(tmp_path):
    """Of meshio, whose reader follows the file's own references."""
    meshio = pytest.importorskip("meshio")
    body, system = moving()
    writer = Fields(tmp_path, functions=[nts.von_mises])
    nts.simulate(system, nts.EnergyMomentum(), dt=1e-4, t_end=1e-4, output=[writer])
    with meshio.xdmf.TimeSeriesReader(tmp_path / "soft.xdmf") as reader:
        points, cells = reader.read_points_cells()
        time, at_points, in_cells = reader.read_data(reader.num_steps - 1)
    file = read_xdmf(tmp_path / "soft.xdmf")
    assert np.array_equal(points, file.points) and np.array_equal(cells[0].data, file.cells)
    assert time == file.times[-1]
    assert np.array_equal(at_points["displacement"], file.fields[-1]["displacement"])
    assert np.array_equal(at_points["von_mises"], file.fields[-1]["von_mises"])
    assert not in_cells


# ---- what a run shows
@mpi
@pytest.mark.fast_on_ranks()
def test_a_plot_is_a_figure(mpi_tmp_path):
    figure = pytest.importorskip("matplotlib.figure").Figure
    _, system = moving()
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-4, t_end=2e-4)
    for shown in (run.plot(), run.plot(mpi_tmp_path / "balance.png")):
        assert isinstance(shown, figure if COMM.rank == 0 else type(None))
        if shown is not None:
            # Without contacts and works there are energy, ledger and momenta.
            titles = [axes.get_title(loc="left") for axes in shown.axes]
            first = sorted(title.split()[0] for title in titles)
            assert first == ["Change", "Change", "Energy", "Ledger"]
            np.testing.assert_array_equal(shown.axes[0].lines[0].get_xdata(), run.balance["time"])


def test_a_run_shows_itself_in_jupyter():
    pytest.importorskip("matplotlib")
    _, system = moving()
    run = nts.simulate(system, nts.EnergyMomentum(), dt=1e-4, t_end=2e-4)
    text, image = run._repr_html_().split("<img ")
    assert text.startswith("<pre>completed: 2 steps to t = 0.0002,")
    picture = base64.b64decode(re.search(r"base64,([^\"]+)\"", image)[1])
    assert picture.startswith(b"\x89PNG") and len(picture) < 1e5
    without = nts.simulate(system, nts.EnergyMomentum(), dt=1e-4, t_end=2e-4, ledger=False)
    assert "<img" not in without._repr_html_()
    assert "no ledger was kept" in without._repr_html_()
