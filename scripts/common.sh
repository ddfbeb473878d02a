# Sourced by the other scripts: where the repository is, how to speak, how to become root, and an
# environment in which neither another Python nor another PETSc or MPI gets in front of Debian's.
# shellcheck shell=bash

REPO=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
PYTHON=$REPO/${NTS_VENV:-.venv}/bin/python
LINT_VENV=$REPO/.venv-lint

say() { printf '==> %s\n' "$*"; }
die() { printf 'error: %s\n' "$*" >&2; exit 1; }

# The packages of debian-packages.txt, or of another list, one a line.
debian_packages() { sed 's/#.*//; /^ *$/d' "$REPO/scripts/${1:-debian-packages.txt}"; }

# Run a command as root: directly, or through sudo.
as_root() {
  if [ "$(id -u)" = 0 ]; then
    "$@"
  elif command -v sudo >/dev/null; then
    sudo -- "$@"
  else
    die "not root and no sudo: run as root: $*"
  fi
}

# Install the given Debian packages that are missing; the package index is refreshed only then.
apt_need() {
  local installed missing
  installed=$(dpkg-query -W -f '${db:Status-Status} ${Package}\n' "$@" 2>/dev/null) || true
  missing=$(for name in "$@"; do grep -qx "installed $name" <<<"$installed" || echo "$name"; done)
  [ -n "$missing" ] || return 0
  say "installing Debian packages:" $missing
  command -v apt-get >/dev/null || die "no apt-get here; install these by hand:" $missing
  local log
  log=$(mktemp)
  # shellcheck disable=SC2086
  if ! { as_root apt-get -q update && as_root env DEBIAN_FRONTEND=noninteractive apt-get -q install -y \
    -o DPkg::Lock::Timeout=300 --no-install-recommends $missing; } </dev/null >"$log" 2>&1; then
    tail -n 30 "$log" >&2
    die "apt-get could not install these (its log: $log):" $missing
  fi
  rm -f "$log"
}

# For everything that runs the package. pip's own settings (index, certificates) are left alone.
clean_environment() {
  unset PYTHONPATH PYTHONHOME PYTHONSTARTUP PYTHONUSERBASE PYTHONOPTIMIZE PYTHONSAFEPATH
  unset VIRTUAL_ENV CONDA_PREFIX PYENV_VERSION PYENV_VIRTUAL_ENV
  unset PETSC_DIR PETSC_ARCH SLEPC_DIR PETSC_OPTIONS LD_LIBRARY_PATH LD_PRELOAD PKG_CONFIG_PATH
  unset CC CFLAGS CPPFLAGS LDFLAGS CPATH LIBRARY_PATH OPAL_PREFIX
  export PATH=/usr/sbin:/usr/bin:/sbin:/bin
  export PYTHONNOUSERSITE=1 # a numpy in ~/.local would break Debian's petsc4py
  export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
  export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
  # Ranks that wait give way: tests share two cores with whatever else runs.
  export OMPI_MCA_mpi_yield_when_idle=1
  export PRTE_ALLOW_RUN_AS_ROOT=1 PRTE_ALLOW_RUN_AS_ROOT_CONFIRM=1 # newer OpenMPI
  # Not as flags of mpirun, which MPICH's does not know.
  export OMPI_MCA_hwloc_base_binding_policy=none OMPI_MCA_rmaps_base_oversubscribe=1
  export PRTE_MCA_hwloc_default_binding_policy=none PRTE_MCA_rmaps_default_mapping_policy=:oversubscribe
  # One machine: shared memory will do, and containers often allow neither sockets nor ptrace.
  export OMPI_MCA_btl=^tcp OMPI_MCA_btl_vader_single_copy_mechanism=none
  export MPLBACKEND=Agg
}

# mpi RANKS COMMAND...: a hanging run is ended after MPI_TIMEOUT seconds.
mpi() {
  local ranks=$1 mpirun
  shift
  mpirun=$(dirname "$PYTHON")/mpirun # MPICH's, where it is in the venv
  [ -x "$mpirun" ] || mpirun=mpirun
  timeout --kill-after=20 "${MPI_TIMEOUT:-3600}" "$mpirun" -n "$ranks" "$@" </dev/null
}
