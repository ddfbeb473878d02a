#!/bin/bash
# The site in docs/_build/html: scripts of pages and demos run first (see docs/pages.py), then Sphinx.
# A warning is an error. RUNS=no leaves the runs and their pictures out, which takes seconds. Sphinx comes from Debian, as everything that runs the package does.
set -euo pipefail
missing=()
. "$(dirname "$0")/common.sh"
# shellcheck disable=SC2046
apt_need $(debian_packages docs-packages.txt)
clean_environment
cd "$REPO"
if [ "${RUNS:-yes}" = no ]; then
  "$PYTHON" docs/pages.py --no-runs
  missing=(-D suppress_warnings=image.not_readable)
else
  "$PYTHON" docs/pages.py
fi
# -E: pages that are kept would keep their warnings to themselves.
"$PYTHON" -m sphinx -q -E -W --keep-going -b html "${missing[@]}" docs docs/_build/html
say "docs/_build/html/index.html is the site's first page"
