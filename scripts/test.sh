#!/bin/bash
# The tests: pytest in serial (a process on each core, a test file at a time), and the tests marked
# mpi on 2 ranks.
#   test.sh          the fast tests, and lint beside the serial ones
#   test.sh --slow   the tests marked slow, which the fast ones leave out, those on ranks first; those
#                    that start 3 or 4 ranks of their own one by one, as waiting ranks take a core each
# A failing stage does not stop the later ones. PYTEST_ARGS is given to pytest ("-n0 --pdb ..." for
# those that need its terminal, with one process); NO_LINT=1 skips lint; TESTS_UNTIL is its --until.
set -uo pipefail
. "$(dirname "$0")/common.sh"
cd "$REPO" || exit 1
failed=()

case ${1:-} in
  '') name=fast which='not slow' ;;
  --slow) name=slow which=slow NO_LINT=1 ;;
  *) die "unknown argument: $1" ;;
esac
if [ -z "${NO_LINT:-}" ]; then # beside the tests, as most of it waits or takes one core
  said=$(mktemp) || exit 1
  trap 'rm -f "$said"' EXIT
  scripts/lint.sh >"$said" 2>&1 &
fi
clean_environment
read -r -a args <<<"${PYTEST_ARGS:-}"
until=(${TESTS_UNTIL:+--until=$TESTS_UNTIL})

# finished STAGE STATUS: pytest's status 5 says that PYTEST_ARGS selected no test of this stage.
finished() {
  if [ "$2" = 5 ] && [ ${#args[@]} != 0 ]; then
    say "$1: no test was selected"
  elif [ "$2" != 0 ]; then
    failed+=("$1 (exit status $2)")
  fi
}

in_serial() {
  local stage="$name tests, serial"
  say "$stage"
  "$PYTHON" -m pytest -q -n auto --dist loadfile -m "$which and not on_ranks" "${args[@]}" "${until[@]}" </dev/null
  finished "$stage" $?
}

on_two_ranks() {
  local stage="$name tests marked mpi, 2 ranks" color=no
  say "$stage"
  [ ! -t 1 ] || color=yes # mpirun gives every rank a terminal, so pytest cannot tell
  mpi 2 "$PYTHON" -m pytest -q -m "mpi and $which" -p no:cacheprovider --color="$color" "${args[@]}" "${until[@]}"
  finished "$stage" $?
}

if [ "$which" = slow ]; then
  # Those in serial take longest: where time is up (--until), some of them are left out.
  on_two_ranks
  stage="tests on 3 and 4 ranks"
  say "$stage"
  "$PYTHON" -m pytest -q -m on_ranks "${args[@]}" "${until[@]}" </dev/null
  finished "$stage" $?
  in_serial
else
  in_serial
  if [ -z "${NO_LINT:-}" ]; then
    wait $! || failed+=(lint)
    cat "$said"
  fi
  on_two_ranks
fi

if [ ${#failed[@]} != 0 ]; then
  printf 'FAILED: %s\n' "${failed[@]}"
  exit 1
fi
