"""The version is the same wherever a release states it, and files that tests need are shipped."""

import re
import tomllib
from pathlib import Path

import pytest

import dolfinx_nts as nts

ROOT = Path(__file__).resolve().parents[2]


def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def stated():
    """Version by file."""
    changes = re.search(r"^## (\d\S*), (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    cite = (ROOT / "CITATION.cff").read_text()
    return {
        "pyproject.toml": project()["version"],
        "CHANGELOG.md": changes[1],
        "CITATION.cff": re.search(r"^version: (\S+)$", cite, re.MULTILINE)[1],
        "debian/changelog": re.match(r"\S+ \((\S+?)(?:-\d+)?\)", debian())[1],
        "conda/recipe.yaml": re.search(r'^  version: "(\S+)"$', recipe(), re.MULTILINE)[1],
    }, (changes[2], re.search(r'^date-released: "(\S+)"$', cite, re.MULTILINE)[1])


def debian():
    return (ROOT / "debian/changelog").read_text()


def recipe():
    return (ROOT / "conda/recipe.yaml").read_text()


def test_the_version_is_one():
    versions, dates = stated()
    assert set(versions.values()) == {nts.__version__}, versions
    assert len(set(dates)) == 1, dates


@pytest.mark.parametrize("folder", ["tests", "demos", "meshes", "benchmarks", "docs", "scripts"])
def test_the_sdist_has_what_tests_need(folder):
    text = (ROOT / "MANIFEST.in").read_text()
    endings = set(re.search(rf"^recursive-include {folder} (.*)$", text, re.MULTILINE)[1].split())
    made = {"__pycache__", "_build", "made"}
    files = [p for p in (ROOT / folder).rglob("*") if p.is_file() and not made & set(p.parts)]
    missing = {p for p in files if f"*{p.suffix}" not in endings}
    assert files and not missing, missing


def test_nothing_is_pulled_in_front_of_another_dolfinx():
    """What comes from PyPI is asked for by name, and in the versions that were run together."""
    extras = project()["optional-dependencies"]
    assert project()["dependencies"] == []
    names = {}
    for extra, wanted in extras.items():
        names[extra] = {name for name, _, _ in (each.partition("==") for each in wanted)}
        assert all(re.fullmatch(r"[\w-]+==[\d.]+(post\d+)?", each) for each in wanted), wanted
    assert {"dolfinx-solver-real", "mpich", "mpi4py", "numpy", "scipy"} <= names["wheels"]
    assert {"h5py", "matplotlib", "tqdm"} <= names["wheels"] and names["gmsh"] == {"gmsh"}
