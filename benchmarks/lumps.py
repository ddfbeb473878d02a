"""Newton iterations of irregular tetrahedra that collide: two lumps of rubber, one thrown.

Each lump is three balls melted into one, meshed by Gmsh with cells of 9 and 10 mm. The lower one is
held below, the other hits it at 1.5 m/s and slides off. Printed are steps, iterations a step,
retries and seconds of the processor.
"""

import argparse
import time

from mpi4py import MPI

import gmsh

import dolfinx_nts as nts


def lump(centre, name, cell):
    """Mesh of a lump around a point, with its skin."""
    x, y, z = centre
    gmsh.initialize()
    gmsh.option.setNumber("General.Verbosity", 1)
    occ = gmsh.model.occ
    ball = occ.addSphere(x, y, z, 0.03)
    others = [(x + 0.025, y, z + 0.025, 0.018), (x - 0.02, y + 0.012, z - 0.012, 0.02)]
    volumes, _ = occ.fuse([(3, ball)], [(3, occ.addSphere(*o)) for o in others])
    occ.synchronize()
    gmsh.model.setPhysicalName(3, gmsh.model.addPhysicalGroup(3, [v for _, v in volumes]), name)
    skin = [s for _, s in gmsh.model.getBoundary(volumes, oriented=False)]
    gmsh.model.setPhysicalName(2, gmsh.model.addPhysicalGroup(2, skin), "skin")
    gmsh.option.setNumber("Mesh.MeshSizeMax", cell)
    gmsh.option.setNumber("Mesh.MeshSizeMin", cell)
    gmsh.model.mesh.generate(3)
    part = nts.bodies_from_gmsh(gmsh.model, MPI.COMM_WORLD)[name]
    gmsh.finalize()
    return part


def main(friction, t_end, dt):
    below = lump((0, 0, 0), "below", 0.009)
    above = lump((0.012, 0.006, 0.078), "above", 0.010)
    rubber = nts.NeoHookean(young=3e5, poisson=0.4)
    held = nts.Dirichlet(lambda x: x[2] < -0.024)
    low = below.continuum(rubber, density=1e3, bcs=[held], name="below")
    up = above.continuum(rubber, density=1e3, velocity=(0.3, 0, -1.5), name="above")
    skins = (b.surface(*p.where("skin")) for b, p in ((up, above), (low, below)))
    pair = nts.ContactPair(*skins, friction=friction)
    system = nts.System([low, up], contacts=[pair], gravity=(0, 0, -9.81))
    start = time.process_time()
    run = nts.simulate(
        system, nts.EnergyMomentum(), dt=dt, t_end=t_end, accuracy="balanced", progress=True
    )
    if MPI.COMM_WORLD.rank == 0:
        counts = run.balance["newton_iterations"][1:]
        print(f"friction {friction}: {run.status}; {len(counts)} steps, {counts.mean():.2f} "
              f"iterations a step, {run.retries} retries, {time.process_time() - start:.1f} s"
        )  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--friction", type=float, default=0.4)
    parser.add_argument("--t-end", type=float, default=0.06, help="[s]")
    parser.add_argument("--dt", type=float, default=1e-3, help="[s]")
    main(**vars(parser.parse_args()))
