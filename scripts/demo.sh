#!/bin/bash
# A demo on 2 ranks: demo.sh NAME [ARGUMENTS]; writes to out/NAME.
set -euo pipefail
. "$(dirname "$0")/common.sh"
clean_environment
cd "$REPO"
name=${1:-two_blocks}
shift || true
mkdir -p out
mpi 2 "$PYTHON" "demos/$name.py" --output "out/$name" "$@"
