#!/bin/bash
# ruff and mypy, from a venv of their own so that they cannot touch Debian's numpy.
# Without a package registry in reach this says so and succeeds.
set -euo pipefail
. "$(dirname "$0")/common.sh"
TOOLS=(ruff==0.14.5 mypy==1.18.2)

stamp=$LINT_VENV/.made-for
wanted="$REPO | $(readlink -f /usr/bin/python3) | ${TOOLS[*]}"
if ! [ -f "$stamp" ] || [ "$(cat "$stamp")" != "$wanted" ]; then
  say "making .venv-lint: ${TOOLS[*]}"
  rm -rf "$LINT_VENV"
  /usr/bin/python3 -m venv "$LINT_VENV"
  if env -u PYTHONPATH -u PYTHONHOME -u PIP_TARGET -u PIP_PREFIX -u PIP_USER \
    "$LINT_VENV/bin/python" -m pip install --quiet --disable-pip-version-check \
    --root-user-action=ignore --retries 1 --timeout 20 "${TOOLS[@]}"; then
    printf '%s' "$wanted" >"$stamp"
  else
    rm -rf "$LINT_VENV"
    say "lint SKIPPED: ${TOOLS[*]} could not be installed (no package registry in reach?)"
    exit 0
  fi
fi

clean_environment
cd "$REPO"
status=0
say "ruff check"
"$LINT_VENV/bin/ruff" check --quiet --output-format concise . || status=1
# Debian's numpy carries types: mypy reads them from .venv. Those of numpy 2 are others.
if "$PYTHON" -c 'import numpy; raise SystemExit(numpy.__version__ >= "2")'; then
  say "mypy"
  "$LINT_VENV/bin/mypy" --python-executable "$PYTHON" || status=1
else
  say "mypy SKIPPED: the package is checked with the types of Debian 12's numpy"
fi
exit $status
