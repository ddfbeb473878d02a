#!/bin/bash
# The whole test suite: lint, then pytest in serial (a process on each core, a test file at a time),
# then the tests marked mpi on 2 ranks.
# A failing stage does not stop the later ones. PYTEST_ARGS is given to pytest ("-n0 --pdb ..." for
# those that need its terminal, with one process); NO_LINT=1 skips lint.
set -uo pipefail
. "$(dirname "$0")/common.sh"
cd "$REPO" || exit 1
failed=()

if [ -z "${NO_LINT:-}" ]; then
  scripts/lint.sh || failed+=(lint)
fi
clean_environment
read -r -a args <<<"${PYTEST_ARGS:-}"

say "pytest, serial"
"$PYTHON" -m pytest -q -n auto --dist loadfile "${args[@]}" </dev/null || failed+=("serial tests")

say "pytest, 2 ranks, the tests marked mpi"
color=no # mpirun gives every rank a terminal, so pytest cannot tell
[ ! -t 1 ] || color=yes
mpi 2 "$PYTHON" -m pytest -q -m mpi -p no:cacheprovider --color="$color" "${args[@]}"
status=$?
if [ $status = 5 ]; then
  say "no test marked mpi was selected"
elif [ $status != 0 ]; then
  failed+=("tests on 2 ranks (exit status $status)")
fi

if [ ${#failed[@]} != 0 ]; then
  printf 'FAILED: %s\n' "${failed[@]}"
  exit 1
fi
