#!/bin/bash
# The fast tests on DOLFINx of PyPI, in a virtual environment .venv-wheels with the extras of pyproject.toml.
# Needs no root: a C compiler, and a Python of 3.12 to 3.14 with its headers. PYTHON_WHEELS chooses it;
# without, it is one on PATH or of pyenv.
set -euo pipefail
. "$(dirname "$0")/common.sh"

# Whether a Python can make a venv and has what extensions are compiled with.
serves() {
  "$1" -c 'import ensurepip, pathlib, sys, sysconfig, venv
assert (3, 12) <= sys.version_info[:2] <= (3, 14)
assert pathlib.Path(sysconfig.get_path("include"), "Python.h").exists()' 2>/dev/null
}

find_python() {
  local version candidate
  for version in 3.13 3.12 3.14; do
    for candidate in "$(command -v "python$version")" \
      "${PYENV_ROOT:-${HOME:-/root}/.pyenv}/versions/$version".*/bin/python; do
      if [ -x "$candidate" ] && serves "$candidate"; then
        echo "$candidate"
        return
      fi
    done
  done
}

python=${PYTHON_WHEELS:-$(find_python)}
[ -n "$python" ] || die "no Python of 3.12 to 3.14 with venv and headers on PATH or of pyenv: set PYTHON_WHEELS to one"
serves "$python" || die "PYTHON_WHEELS=$python is no Python of 3.12 to 3.14 with venv and headers"
python=$(command -v "$python")

export NTS_VENV=.venv-wheels
venv=$REPO/$NTS_VENV
wanted="$REPO | $(readlink -f "$python") | $(cat "$REPO/pyproject.toml" "$0" | sha256sum)"
if ! [ -f "$venv/.made-for" ] || [ "$(cat "$venv/.made-for")" != "$wanted" ]; then
  say "making $NTS_VENV on $("$python" --version)"
  rm -rf "$venv"
  "$python" -m venv "$venv"
  env -u PYTHONPATH -u PYTHONHOME -u PIP_TARGET -u PIP_PREFIX -u PIP_USER \
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --root-user-action=ignore \
    --editable "$REPO[wheels,gmsh,tests]"
  printf '%s' "$wanted" >"$venv/.made-for"
fi
NO_LINT=1 exec "$REPO/scripts/test.sh"
