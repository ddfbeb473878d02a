#!/bin/bash
# The site in docs/_build/html: scripts of pages and demos run first (see docs/pages.py), then Sphinx.
# A warning is an error. Sphinx comes from Debian, as everything that runs the package does.
set -euo pipefail
. "$(dirname "$0")/common.sh"
# shellcheck disable=SC2046
apt_need $(debian_packages docs-packages.txt)
clean_environment
cd "$REPO"
"$PYTHON" docs/pages.py
"$PYTHON" -m sphinx -q -W --keep-going -b html docs docs/_build/html
say "docs/_build/html/index.html is the site's first page"
