#!/bin/bash
# Debian's packages and .venv with this package in it (editable). Does nothing if all is in place.
set -euo pipefail
. "$(dirname "$0")/common.sh"
clean_environment

# shellcheck disable=SC2046
apt_need $(debian_packages)

# A venv is as good as the paths and versions it was made with: a moved clone gets a new one.
[ -f "$REPO/dolfinx_nts/__init__.py" ] || die "no dolfinx_nts/__init__.py in $REPO"
wanted="$REPO | $(readlink -f /usr/bin/python3) | $(cat "$REPO/pyproject.toml" "$0" | sha256sum)"
stamp=$REPO/.venv/.made-for
if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ]; then
  exit 0
fi
say "making .venv on Debian's $(/usr/bin/python3 --version)"
rm -rf "$REPO/.venv"
/usr/bin/python3 -m venv --system-site-packages "$REPO/.venv"
# --no-deps --no-index: nothing comes from a registry, so nothing can replace Debian's numpy.
"$PYTHON" -m pip --isolated install --quiet --disable-pip-version-check --root-user-action=ignore \
  --no-deps --no-index --no-build-isolation --editable "$REPO"
"$PYTHON" -c 'import dolfinx_nts' ||
  die "dolfinx or dolfinx_nts cannot be imported in .venv (see above)"
printf '%s' "$wanted" >"$stamp"
