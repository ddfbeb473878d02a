"""The layers of the package: imports only go down, and importing does nothing else."""

import ast
import functools
import importlib.metadata
import json
import logging
import re
import tomllib
from pathlib import Path

import pages
from integrators import INTEGRATORS
from processes import in_fresh_python

import dolfinx_nts as nts
from dolfinx_nts.integrators import Static

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "dolfinx_nts"

#: Floors from below: files, and folders that stand for all of theirs.
LEVELS = [
    {"types", "parallel", "validation", "mpi_first", "dolfinx_compat", "petsc_compat", "forms",
     "kernels"},
    {"integrators"},
    {"state"},
    {"interaction"},
    {"contact"},
    {"bodies"},
    {"joints"},
    {"system"},
    {"equations"},
    {"solve"},
    {"ledger"},
    {"start"},
    {"output"},
    {"run"},
    {"study"},
    {"__init__"},
    {"__main__"},
]
LEVEL = {name: level for level, names in enumerate(LEVELS) for name in names}
#: What the kernels do without.
KNOW_RANKS = {"parallel", "dolfinx_compat", "petsc_compat"}


def named(path):
    """Return the dotted name of a file within the package."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and parts[1:] else parts)


FILES = {named(path): path for path in PACKAGE.rglob("*.py")}
PRESENT = sorted(FILES)
OPTIONAL = {"matplotlib", "h5py", "tqdm", "gmsh", "pyvista"}


def source(module):
    return FILES[module].read_text()


def level(module):
    return LEVEL[module.split(".")[0]]


@functools.cache
def imported(module):
    """Return the absolute dotted names that a module imports, at its top or inside functions."""
    return [*_imported(module)]


def _imported(module):
    for node in ast.walk(ast.parse(source(module))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level <= 1, f"{module}: the package has no parent"
            base = ".".join(filter(None, ["dolfinx_nts" if node.level else "", node.module or ""]))
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


@functools.cache
def siblings(module):
    """Return the modules of the package that a module imports, for types alone, too."""
    names = (n.removeprefix("dolfinx_nts.") for n in imported(module) if "." in n)
    return {name for name in names if name in FILES} - {module}


@functools.cache
def code_without_text(module):
    """Return the source without comments, docstrings and other bare strings."""
    tree = ast.parse(source(module))
    for node in ast.walk(tree):
        for field in ("body", "orelse", "finalbody"):
            body = getattr(node, field, None)
            if isinstance(body, list):
                kept = [n for n in body if not is_bare_string(n)]
                setattr(node, field, kept or ([ast.Pass()] if body else []))
    return ast.unparse(ast.fix_missing_locations(tree))


def is_bare_string(node):
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def test_every_module_is_known():
    unknown = {name.split(".")[0] for name in PRESENT} ^ set(LEVEL)
    assert not unknown, f"LEVELS and the files differ in {sorted(unknown)}"


def offences(found_in, modules=PRESENT):
    """What is found in a module, by the modules in which it is."""
    return {module: found for module in sorted(modules) if (found := found_in(module))}


def test_imports_only_go_down():
    def up(module):
        return {name for name in siblings(module) if level(name) > level(module)}

    assert not offences(up), "these import from above"


def test_no_imports_in_a_ring():
    below = {module: siblings(module) for module in PRESENT}
    while leaves := [module for module, names in below.items() if not names & below.keys()]:
        for module in leaves:
            del below[module]
    assert not below, f"these import each other in a ring, or stand above one: {sorted(below)}"


def test_no_rooms_in_a_ring():
    """A room is a folder, or a file beside the folders."""
    below = {}
    for module in PRESENT:
        folder = module.split(".")[0]
        names = {name.split(".")[0] for name in siblings(module)}
        below.setdefault(folder, set()).update(names - {folder})
    while leaves := [folder for folder, names in below.items() if not names & below.keys()]:
        for folder in leaves:
            del below[folder]
    assert not below, f"these import each other in a ring, or stand above one: {sorted(below)}"


def test_no_module_imports_the_whole_package():
    def attributes(module):
        names = {n.split(".")[1] for n in imported(module) if n.startswith("dolfinx_nts.")}
        return names - set(LEVEL)

    found = offences(attributes, set(PRESENT) - {"__init__"})
    assert not found, "import from the modules that define these"


def test_kernels_know_neither_mpi_nor_petsc():
    def ranks(module):
        top = {name.split(".")[0] for name in imported(module)}
        return top & {"mpi4py", "petsc4py", "dolfinx"} | siblings(module) & KNOW_RANKS

    kernels = [name for name in PRESENT if name.startswith("kernels.")]
    assert kernels and not offences(ranks, kernels)


#: What makes PETSc matrices.
MATRICES = {
    "equations.assembly", "equations.schur", "equations.mass_solves", "solve.model_problem",
    "solve.instability", "petsc_compat",
}  # fmt: skip


def test_few_files_create_petsc_matrices():
    def makes(module):
        made = r"\bMat\(\)|\.create(?:Seq)?S?B?AIJ\(|\.createNest\("
        return re.findall(made, code_without_text(module))

    assert not offences(makes, set(PRESENT) - MATRICES), "these make PETSc matrices"


def test_only_compat_knows_dolfinx_versions():
    def asks(module):
        asked = (
            r"dolfinx\.__version__|version\(['\"](?:fenics-)?dolfinx['\"]\)"
            r"|DOLFINX_VERSION|(?:hasattr|getattr)\((?:_?dolfinx|fem|mesh)\b"
        )
        return re.findall(asked, code_without_text(module))

    found = offences(asks, set(PRESENT) - {"dolfinx_compat"})
    assert not found, "these ask for the DOLFINx version; dolfinx_compat does that"


SHOW = """
import json, logging, sys
root, own = logging.root, logging.getLogger("dolfinx_nts")
print(json.dumps({
    "modules": [*sys.modules], "root": [len(root.handlers), root.level],
    "own": [len(own.handlers), own.level], "version": getattr({}, "__version__", None),
}))
"""


@functools.cache
def after(*modules):
    """What a new interpreter holds that has imported these."""
    shown = in_fresh_python(f"import {', '.join(modules)}" + SHOW.replace("{}", modules[0]))
    return json.loads(shown)


def ours():
    return after("dolfinx_nts")


def theirs():
    return after("mpi4py.MPI", "dolfinx", "dolfinx.fem.petsc")


def test_dolfinx_of_pypi_is_prepared_before_it_is_imported(tmp_path):
    """A package `dolfinx_solver` is imported where it is there, ahead of DOLFINx and PETSc."""
    seen = "import sys\nprint(*{'dolfinx', 'petsc4py'} & set(sys.modules), 'first')\n"
    seen += "from mpi4py import MPI\n"
    (tmp_path / "dolfinx_solver.py").write_text(seen)
    found = in_fresh_python(f"import sys; sys.path[:0] = [{str(tmp_path)!r}]; import dolfinx_nts")
    assert found.split() == ["first"]


def scripts():
    """What a user may run, by a name: demos, benchmarks, and blocks of pages that are whole."""
    for folder in ("demos", "benchmarks", "meshes"):
        yield from ((str(p.name), p.read_text()) for p in (ROOT / folder).glob("*.py"))
    yield from ((block.name, block.code) for block in pages.blocks() if block.whole)


def test_mpi_is_imported_before_dolfinx():
    """DOLFINx of PyPI finds its MPI only then."""
    for script, code in scripts():
        nodes = [n for n in ast.parse(code).body if isinstance(n, ast.Import | ast.ImportFrom)]
        names = [getattr(node, "module", None) or node.names[0].name for node in nodes]
        packages = [name.split(".")[0] for name in names]
        of_mpi = [packages.index(p) for p in ("mpi4py", "dolfinx_nts") if p in packages]
        later = [packages.index(p) for p in ("dolfinx", "petsc4py") if p in packages]
        assert not later or (of_mpi and min(of_mpi) < min(later)), f"{script}: {packages}"


def test_importing_is_cheap():
    loaded = {name for name in ours()["modules"] if name.split(".")[0] in OPTIONAL}
    # What DOLFINx itself loads is not ours to avoid.
    assert not loaded - set(theirs()["modules"])


def test_importing_sets_up_no_logging():
    # DOLFINx 0.5 itself adds a handler.
    assert ours()["root"] in (theirs()["root"], [0, logging.WARNING])
    assert ours()["own"] == [0, 0]


def test_version_is_stated_once():
    """What a release states beside it is compared in test_packaging."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert importlib.metadata.version("dolfinx_nts") == version
    for module in PRESENT:
        assert f'"{version}"' not in source(module), f"{module} states the version again"
    if "__init__" in PRESENT:
        assert ours()["version"] == version


def test_the_list_of_integrators_in_the_tests_is_whole():
    theirs = {kind for kind in vars(nts.integrators).values() if isinstance(kind, type)}
    assert {type(rule) for rule in INTEGRATORS.values()} == theirs - {nts.Integrator, Static}


def test_no_test_module_is_imported_by_another():
    """Shared helpers stand in modules of their own; what runs on ranks may import itself."""
    for path in (ROOT / "tests").rglob("*.py"):
        names = set(re.findall(r"\b(?:from|import) (?:tests\.)?(test_\w+)", path.read_text()))
        assert not names - {path.stem}, f"{path.name} imports {sorted(names - {path.stem})}"
