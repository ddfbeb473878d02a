#!/bin/bash
# sdist and wheel in dist/, built from the sdist with Debian's tools and checked by twine.
set -euo pipefail
. "$(dirname "$0")/common.sh"
apt_need python3-build twine python3-setuptools python3-wheel python3-venv
clean_environment
cd "$REPO"
rm -rf dist build ./*.egg-info
/usr/bin/python3 -m build --no-isolation --outdir dist .
twine check --strict dist/*
rm -rf build ./*.egg-info
