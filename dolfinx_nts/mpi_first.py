"""The package `dolfinx_solver` comes with DOLFINx from PyPI and has to be imported before it.

It loads the MPI that DOLFINx was compiled for, and refuses a second PETSc.
"""

from importlib.util import find_spec

if find_spec("dolfinx_solver"):
    import dolfinx_solver  # noqa: F401
