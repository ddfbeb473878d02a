#!/bin/bash
# chroot.sh SUITE [COMMAND] | --remove: run the fast tests (or COMMAND) on a copy of this repository in a
# minimal Debian SUITE (trixie). The root is
# made once and kept in
#   ${DOLFINX_NTS_ROOTS:-${XDG_CACHE_HOME:-$HOME/.cache}/dolfinx_nts}
# and the mirror is the one this machine's apt uses (or DEBIAN_MIRROR). Every mount is made in a
# private mount namespace, and the copy lives in memory there: nothing is left behind, however it
# ends. In a container that forbids mounting, a plain chroot does.
set -euo pipefail
. "$(dirname "$0")/common.sh"

suite=$1
command=${2:-}
roots=${DOLFINX_NTS_ROOTS:-${XDG_CACHE_HOME:-$HOME/.cache}/dolfinx_nts}
if [ "$(id -u)" != 0 ]; then
  exec sudo -- env DOLFINX_NTS_ROOTS="$roots" CI="${CI:-}" PYTEST_ARGS="${PYTEST_ARGS:-}" \
    DEBIAN_MIRROR="${DEBIAN_MIRROR:-}" "$0" "$@"
fi
case $suite in
  --remove)
    say "removing the roots in $roots"
    exec rm -rf --one-file-system "$roots"
    ;;
  trixie) root=$roots/debian13 ;;
  *) root=$roots/$suite ;;
esac

# The archive that this machine's apt installs Debian's own packages from.
debian_mirror() {
  if [ -n "${DEBIAN_MIRROR:-}" ]; then
    echo "$DEBIAN_MIRROR"
    return
  fi
  local query=(apt-get indextargets --format '$(REPO_URI)' 'Identifier: Packages' 'Origin: Debian' 'Label: Debian')
  [ -n "$("${query[@]}")" ] || apt-get -q update >&2
  "${query[@]}" | head -n1
}

# Proxy, certificates and clock settings of this machine's apt, as options for mmdebstrap.
apt_options() {
  apt-config dump | grep -E '^Acquire::(https?::(.*::)?(Proxy|CaInfo)|Check-(Valid-Until|Date)) ' |
    sed 's/^/--aptopt=/' || true
}

make_root() {
  local mirror packages options include
  apt_need mmdebstrap debian-archive-keyring
  if [ "$suite" = trixie ] && ! [ -e /usr/share/keyrings/debian-archive-trixie-stable.gpg ]; then
    apt-get -q update && apt-get -q install -y debian-archive-keyring
  fi
  mirror=$(debian_mirror)
  [ -n "$mirror" ] || die "apt knows no Debian archive here: set DEBIAN_MIRROR to one"
  mapfile -t packages < <(debian_packages)
  mapfile -t options < <(apt_options)
  include=$(IFS=, && echo "${packages[*]}")
  say "making a Debian $suite root in $root (once, some minutes; log: $root.log)"
  rm -rf "$root" "$root.partial"
  env -u TMPDIR mmdebstrap --mode=root --variant=apt --components=main --include="$include" \
    --dpkgopt=force-unsafe-io --dpkgopt='path-exclude=/usr/share/man/*' \
    --dpkgopt='path-exclude=/usr/share/doc/*' "${options[@]}" \
    "$suite" "$root.partial" "$mirror" </dev/null >"$root.log" 2>&1 || {
    tail -n 30 "$root.log" >&2
    rm -rf "$root.partial"
    die "mmdebstrap failed; its log is $root.log"
  }
  debian_packages >"$root.partial/made-of"
  mv "$root.partial" "$root"
}

mkdir -p "$roots"
exec 9>"$root.lock"
flock 9
if ! [ -f "$root/made-of" ] || [ "$(cat "$root/made-of")" != "$(debian_packages)" ]; then
  make_root
fi
flock -u 9

# What runs in the namespace: mounts, a copy of the repository, the chroot. The JIT cache outlives the
# run, except in CI.
inside='
set -euo pipefail
root=$1 repo=$2 mounts=$3 command=$4
cd "$root"
if [ "$mounts" = yes ]; then
  mount --bind "$root" "$root"
  cd "$root"
  mount -t proc proc proc
  mount --rbind /sys sys || true # hwloc, and so OpenMPI, looks up the cores there
  mount -t tmpfs tmpfs tmp
  mount -t tmpfs tmpfs dev -o mode=755
  mkdir dev/shm
  mount -t tmpfs tmpfs dev/shm -o mode=1777
  mkdir dev/pts && mount -t devpts devpts dev/pts -o newinstance,ptmxmode=0666 || true
  ln -s pts/ptmx dev/ptmx
  ln -s /proc/self/fd dev/fd
  for node in null zero full random urandom tty; do
    : >dev/$node
    mount --bind /dev/$node dev/$node
  done
fi
work=$(mktemp -d tmp/dolfinx_nts.XXXXXX)
trap "rm -rf $work" EXIT
tar -C "$repo" -c --exclude=./.git --exclude="./.venv*" --exclude=./out --exclude="*.egg-info" \
  --exclude=__pycache__ --exclude=".*_cache" . | tar -C "$work" -x --no-same-owner
cache=/root/.cache
[ -z "${CI:-}" ] || cache=/$work/.jit
env -i CI="${CI:-}" PYTEST_ARGS="${PYTEST_ARGS:-}" MPI_TIMEOUT="${MPI_TIMEOUT:-}" TESTS_UNTIL="${TESTS_UNTIL:-}" NO_LINT=1 \
  HOME=/root LANG=C.UTF-8 TERM=dumb PATH=/usr/sbin:/usr/bin:/sbin:/bin XDG_CACHE_HOME="$cache" \
  chroot . /bin/bash -c "cd /$work && scripts/setup.sh && $command"
'

if [ -n "$command" ]; then
  say "Debian $suite: $command"
else
  say "Debian $suite: the fast tests"
  command=scripts/test.sh
fi
namespace=(unshare --mount --propagation private --pid --fork --kill-child)
mounts=yes
if ! "${namespace[@]}" true 2>/dev/null; then
  say "mounting is not allowed here: a plain chroot, without /proc and with its own /dev and /tmp"
  namespace=()
  mounts=no
fi
"${namespace[@]}" bash -c "$inside" inside "$root" "$REPO" $mounts "$command" </dev/null
