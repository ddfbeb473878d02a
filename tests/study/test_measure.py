"""The program that runs the commands of docs/measured.md and notes when they passed."""

from datetime import date
from pathlib import Path

from dolfinx_nts.study import measure

PAGE = """\
| scene | command | passed |
|---|---|---|
| one | `python -c "print(1 + 1)"` | 2020-01-01 old |
|  | |  |
| two | `python -c "raise SystemExit(3)"` (slow) | 2020-01-01 old |
| three | by hand |  |
| four | `python -c "print(1 + 1)"`, `python -c "raise SystemExit(3)"` |  |
| five | `python -c "import time; time.sleep(600)"` |  |
"""


def test_it_notes_what_passes(tmp_path, monkeypatch):
    monkeypatch.setattr(measure, "version", lambda: "0123abc")
    page = tmp_path / "page.md"
    page.write_text(PAGE)
    arguments = ["--page", str(page), "--output", str(tmp_path / "out")]
    failed = [
        *measure.main([*arguments, "--only", "1 + 1"]),
        *measure.main([*arguments, "--only", "(3)"]),
        *measure.main([*arguments, "--only", "sleep", "--limit", "1"]),
    ]
    assert [command.split()[-1] for command in failed] == [
        'SystemExit(3)"', 'SystemExit(3)"', 'time.sleep(600)"'
    ]
    was, now = PAGE.splitlines(), page.read_text().splitlines()
    assert [k for k in range(len(was)) if was[k] != now[k]] == [2]
    assert now[2].startswith(f'| one | `python -c "print(1 + 1)"` | {date.today()} 0123abc |')
    printed = {f.read_text().splitlines()[-1] for f in (tmp_path / "out").iterdir()}
    assert printed == {"2", 'python -c "raise SystemExit(3)"', "not done after 1 s"}


def test_what_the_page_has_can_be_run():
    """Files that its commands name are there, and tests that they choose exist by name."""
    root = Path(__file__).parents[2]
    rows = measure.rows_of((root / "docs/measured.md").read_text())
    assert len(rows) > 100
    words = {word for row in rows for command in row.commands for word in command.split()}
    files = {word for word in words if word.endswith(".py")}
    assert not [name for name in sorted(files) if not (root / name).exists()]
