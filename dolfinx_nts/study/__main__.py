"""Studies by name, such as `dolfinx-nts-study tradeoff two_blocks`."""

from __future__ import annotations

import runpy
import sys

#: Modules of this package that are programs.
STUDIES = ("tradeoff", "stability", "impacts", "measure")


def main() -> None:
    """Run the study that the first argument names, with the others."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in STUDIES:
        sys.exit(f"dolfinx-nts-study {name}: pass one of {', '.join(STUDIES)}, and its arguments")
    del sys.argv[1]
    runpy.run_module(f"dolfinx_nts.study.{name}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
