"""Run the commands of a page of measured figures, and note there when each passed.

A row of its tables ends with a cell of commands in back quotes and one of the date and commit at
which all of them last passed. What they print is kept, as figures are read off it by hand.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import NamedTuple

#: What a command may begin with, and what is run for it.
PROGRAMS = {
    "pytest": [sys.executable, "-m", "pytest", "-q"],
    "python": [sys.executable],
    "mpirun": ["mpirun"],
    "make": ["make"],
}
_CELL = re.compile(r"(?<!\\)\|")


class Row(NamedTuple):
    """A row of a page with commands.

    Attributes:
        line: Number of its line, from 0.
        cells: Its cells, the last two being commands and note.
        commands: What is run.
    """

    line: int
    cells: list[str]
    commands: list[str]


def rows_of(page: str) -> list[Row]:
    """Rows of a page that have commands."""
    found = []
    for number, line in enumerate(page.splitlines()):
        cells = [cell.strip() for cell in _CELL.split(line.strip())[1:-1]]
        if len(cells) < 2:
            continue
        commands = re.findall(r"`([^`]+)`", cells[-2])
        commands = [c for c in commands if c.split()[0] in PROGRAMS]
        if commands:
            found.append(Row(number, cells, commands))
    return found


def version() -> str:
    """Git's name of the commit of this folder, and whether files differ from it."""
    git = ["git", "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError) as error:
        sys.exit(f"measure: run it in a clone, where git knows the commit: {error}")


def passes(command: str, file: Path, limit: float) -> bool:
    """Whether a command ends well within a time [s]; what it prints goes to a file.

    Tests that are all skipped do not pass.
    """
    words = shlex.split(command)
    for k in reversed(range(len(words))):
        if words[k] in PROGRAMS and (k == 0 or words[k] == "python"):
            words[k : k + 1] = PROGRAMS[words[k]]
    with file.open("w") as out:
        out.write(f"{command}\n")
        out.flush()
        process = subprocess.Popen(
            words, stdout=out, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code = process.wait(limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # ranks, too
            out.write(f"not done after {limit:g} s\n")
            return False
    return code == 0 and ("pytest" not in command or " passed" in file.read_text())


def main(arguments: Sequence[str] | None = None) -> list[str]:
    """Run the program; returns the commands that failed."""
    parser = argparse.ArgumentParser(prog="dolfinx-nts-study measure", description=__doc__)
    parser.add_argument("--page", type=Path, default=Path("docs/measured.md"))
    parser.add_argument("--only", default="", help="a part of the commands to be run")
    parser.add_argument("--limit", type=float, default=1800.0, help="time of a command [s]")
    parser.add_argument("--output", type=Path, default=Path("out/measured"), help="folder")
    options = parser.parse_args(arguments)
    lines = options.page.read_text().splitlines()
    options.output.mkdir(parents=True, exist_ok=True)
    commit = version()
    known: dict[str, bool] = {}
    for row in rows_of(options.page.read_text()):
        if options.only not in row.cells[-2]:
            continue
        for command in row.commands:
            if command in known:
                continue
            start, name = time.monotonic(), re.sub(r"\W+", "_", command)[:100]
            known[command] = passes(command, options.output / f"{name}.txt", options.limit)
            word = "passed" if known[command] else "FAILED"
            print(f"{word} in {time.monotonic() - start:.0f} s: {command}", flush=True)
        if all(known[command] for command in row.commands):
            note = f"{date.today().isoformat()} {commit}"
            lines[row.line] = f"| {' | '.join([*row.cells[:-1], note])} |"
            # Each row by itself: a run of hours may be ended at any time.
            beside = options.page.with_suffix(".new")
            beside.write_text("\n".join(lines) + "\n")
            os.replace(beside, options.page)
    return [command for command, passed in known.items() if not passed]


if __name__ == "__main__":
    failed = main()
    if failed:
        sys.exit(f"measure: {len(failed)} commands failed; see what they printed")
