"""What pages of the site are made of: the scripts in them, notebooks, demos and the reference.

`python docs/pages.py` (a part of `make docs`) runs every whole script of the pages and the demos,
short, keeps what they write in docs/made/runs, and writes a page for each demo, each notebook and
each folder of the package to docs/made, and a gallery. Runs whose sources have not changed are
kept. With `--no-runs` it only writes pages, without the pictures that are not there.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
MADE = DOCS / "made"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: Options with which a demo's picture is made in less than about a minute on one core.
SHORT: dict[str, str] = {
    "bar_impact": "--elements 50",
    "domino": "--dominoes 6",
    "flying_l_block": "--t-end 40",
    "heavy_top": "--steps 4e-3 2e-3",
    "hertz": "--problems cylinders",
    "ironing": "--block 24 3 --die 6 2 --steps 10 50 --end 1.5",
    "newtons_cradle": "--kinds 'rigid, touching' 'flexible, touching'",
    "partial_slip": "--scales 1 --refinement 0.5",
    "rolling": "--facets 32",
    "slider_crank": "--cells 24",
    "sliding_block": "--floors plane",
    "slope": "--floors plane",
    "stability": "--bouncing 300 --rubbing 800",
    "stick_slip": "--floors plane",
    "two_tori": "--dt 0.2 --t-end 5",
    "wheel": "--facets 24 --dt 4e-3",
}
#: Modules that users import themselves, by the page they are on.
MORE = {
    "output": [
        f"dolfinx_nts.output.{name}"
        for name in ("fields", "tables", "film", "pictures", "interactive", "plots")
    ],
    "study": [
        f"dolfinx_nts.study.{name}"
        for name in sorted(p.stem for p in (ROOT / "dolfinx_nts/study").glob("[a-z]*.py"))
    ],
}
CLASS = ":members:\n   :inherited-members: Exception, tuple\n   :show-inheritance:"
#: Longest time that a run may take [s].
LIMIT = 900


@dataclass(frozen=True)
class Block:
    """A block of Python in a page.

    Attributes:
        page: The page.
        line: Where its code starts.
        code: The code.
    """

    page: Path
    line: int
    code: str

    @property
    def name(self) -> str:
        """Page and line, for messages and folders."""
        return f"{self.page.relative_to(ROOT).with_suffix('')}:{self.line}".replace("/", "-")

    @property
    def whole(self) -> bool:
        """Whether it runs by itself: it begins with an import."""
        return isinstance(ast.parse(self.code).body[0], ast.Import | ast.ImportFrom)


def pages() -> list[Path]:
    """README, all pages that a person wrote, and notebooks."""
    found = [*DOCS.rglob("*.md"), *DOCS.rglob("*.ipynb")]
    written = (p for p in found if not {"made", "_build"} & set(p.parts))
    more = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"]
    return [p for p in more if p.exists()] + sorted(written)


def notebooks() -> list[Path]:
    """All notebooks."""
    return [page for page in pages() if page.suffix == ".ipynb"]


def text_of(page: Path) -> str:
    """What a page says in Markdown; of a notebook its cells, one after the other."""
    if page.suffix != ".ipynb":
        return page.read_text()
    cells = [(c["cell_type"], "".join(c["source"])) for c in json.loads(page.read_text())["cells"]]
    return "\n\n".join(f"```python\n{s}\n```" if kind == "code" else s for kind, s in cells) + "\n"


def blocks() -> Iterator[Block]:
    """All blocks of Python in all pages; the cells of a notebook are one."""
    for page in pages():
        text = text_of(page)
        if page.suffix == ".ipynb":
            yield Block(page, 1, "\n\n".join(BLOCK.findall(text)))
            continue
        for found in BLOCK.finditer(text):
            yield Block(page, text.count("\n", 0, found.start(1)) + 1, found[1])


# ---- runs
def source(demo: Path) -> str:
    """The text of a demo, and of other demos and meshes that it imports."""
    text = demo.read_text()
    for other in re.findall(r"^from (\w+) import", text, re.MULTILINE):
        places = (ROOT / folder / f"{other}.py" for folder in ("demos", "meshes"))
        text += "".join(path.read_text() for path in places if path.exists())
    return text


def fingerprint(*more: str) -> str:
    """Of the package and of what else a run depends on."""
    summed = hashlib.sha256("\n".join(more).encode())
    for path in sorted((ROOT / "dolfinx_nts").rglob("*.*")):
        if path.suffix in {".py", ".c", ".h"}:
            summed.update(path.read_bytes())
    return summed.hexdigest()


def run(command: list[str], folder: Path, code: str) -> None:
    """Run a command in a folder unless it has been run there with the same sources.

    Args:
        command: What to run; what it prints is in the folder, too.
        folder: Where; made if it is missing.
        code: What the command runs.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = fingerprint(*command, code)
    said = folder / f"said_{hashlib.sha256(shlex.join(command).encode()).hexdigest()[:8]}.txt"
    if said.exists() and said.read_text().startswith(wanted):
        return
    began = time.perf_counter()
    environment = os.environ | {"MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=folder, env=environment, timeout=LIMIT, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{shlex.join(command)} in {folder} failed:\n{done.stdout[-3000:]}")
    said.write_text(f"{wanted}\n{done.stdout}")
    seconds = time.perf_counter() - began
    print(f"{seconds:6.1f} s  {folder.name}: {shlex.join(command[1:])}", flush=True)


def run_block(block: Block, folder: Path) -> None:
    """Run a whole script of a page; what it writes is in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    script = folder / f"script_{block.line}.py"
    if not script.exists() or script.read_text() != block.code:
        script.write_text(block.code)
    run([sys.executable, script.name], folder, block.code)


def demos() -> list[Path]:
    """All demos."""
    return sorted((ROOT / "demos").glob("*.py"))


def run_demo(demo: Path) -> None:
    """Run a demo, short; what it writes is in the folder of its name."""
    options = shlex.split(SHORT.get(demo.stem, ""))
    command = [sys.executable, str(demo), "--output", ".", *options]
    run(command, MADE / "runs" / demo.stem, source(demo))


def run_page(page: Path, scripts: list[Block]) -> None:
    """Run the scripts of a page one after another in one folder, as a reader does."""
    for block in scripts:
        run_block(block, MADE / "runs" / page.stem)


# ---- pages that are made
def demo_page(demo: Path) -> str:
    """The page of a demo: its text, what a run draws with its command, and its code."""
    text = ast.get_docstring(ast.parse(demo.read_text())) or ""
    title, _, rest = text.partition("\n")
    options = SHORT.get(demo.stem, "")
    folder = MADE / "runs" / demo.stem
    runs = f"runs/{demo.stem}"
    pictures = [f"![{p.stem}]({runs}/{p.relative_to(folder)})" for p in drawn(folder)]
    return "\n".join([
        f"# {demo.stem}\n", f"**{title}**\n", rest, "\n## Films and pictures\n",
        f"`python demos/{demo.name} {options}".rstrip() + "` makes these:\n", "\n\n".join(pictures),
        "\n## Code\n", f"```{{literalinclude}} ../../demos/{demo.name}\n:language: python\n```\n",
    ])  # fmt: skip


def notebook_page(notebook: Path) -> str:
    """The page of a notebook: its cells, each with the pictures that it names, and the file."""

    def with_pictures(block: re.Match[str]) -> str:
        names = re.findall(r'(?:picture|savefig)\([^)]*?"([\w.-]+\.png)"', block[0])
        shown = [f"![{name}](runs/{notebook.stem}/{name})" for name in names]
        return "\n\n".join([block[0], *shown])

    title, _, rest = text_of(notebook).partition("\n")
    file = f"{{download}}`{notebook.name} <../notebooks/{notebook.name}>`"
    return f"{title}\n\nAs a notebook: {file}.\n{BLOCK.sub(with_pictures, rest)}"


def gallery() -> str:
    """A picture of each notebook and demo, if it is there, which leads to its page."""
    kinds = [("notebook", p) for p in notebooks()] + [("demo", p) for p in demos()]
    lines = ["# Gallery\n", "```{container} gallery"]
    for kind, path in kinds:
        pictures = sorted(drawn(MADE / "runs" / path.stem), key=lambda p: p.suffix != ".png")
        shown = "".join(f"![{path.stem}]({p.relative_to(MADE)})\n" for p in pictures[:1])
        lines.append(f"[{shown}{path.stem}]({kind}_{path.stem}.md)\n")
    return "\n".join([*lines, "```\n"])


def drawn(folder: Path) -> list[Path]:
    """Films and pictures of a run: films first, then those of the folder itself."""
    found = [p for p in folder.rglob("*.*") if p.suffix in (".gif", ".png")]
    return sorted(found, key=lambda p: (p.suffix, len(p.parts), p))


def reference() -> dict[str, str]:
    """A page for each folder of the package whose names users see, {file name: text}."""
    import dolfinx_nts

    groups: dict[str, list[str]] = {}
    for name in dolfinx_nts.__all__:
        parts = getattr(dolfinx_nts, name).__module__.split(".")
        groups.setdefault(parts[1] if len(parts) > 2 else "scene", []).append(name)
    for title, modules in MORE.items():
        groups.setdefault(title, []).extend(modules)
    return {f"api_{title}.md": api_page(title, names) for title, names in groups.items()}


def members(of: type) -> str:
    """Options of a class's section: of joints, springs and cables what scenes call alone."""
    import dolfinx_nts

    bases = dolfinx_nts.Joint, dolfinx_nts.BetweenPoints, dolfinx_nts.AboutAxis
    if not issubclass(of, dolfinx_nts.Joint) or of in bases:
        return CLASS
    called = ", ".join(name for name in ("about", "tensions") if hasattr(of, name))
    return (f":members: {called}\n   " if called else "") + ":show-inheritance:"


def api_page(title: str, names: list[str]) -> str:
    """A page of the reference: a section for each name of the package, then whole modules."""
    import dolfinx_nts

    lines = [f"# {title}: reference"]
    for name in names:
        if name.startswith("dolfinx_nts."):
            lines += [f"## {name}", "```{eval-rst}", f".. automodule:: {name}", "   :members:"]
        else:
            kind = "class" if isinstance(getattr(dolfinx_nts, name), type) else "function"
            lines += [f"## {name}", "```{eval-rst}", f".. auto{kind}:: dolfinx_nts.{name}"]
            lines += [f"   {members(getattr(dolfinx_nts, name))}"] if kind == "class" else []
        lines += ["```"]
    return "\n".join(lines) + "\n"


def run_all() -> None:
    """Run what has changed of demos and scripts, on two cores."""
    scripts: dict[Path, list[Block]] = {}
    for block in blocks():
        if block.whole:
            scripts.setdefault(block.page, []).append(block)
    with ThreadPoolExecutor(2) as pool:
        jobs = [pool.submit(run_demo, demo) for demo in demos()]
        jobs += [pool.submit(run_page, page, some) for page, some in scripts.items()]
        for job in jobs:
            job.result()


def main() -> None:
    """Run what has changed unless told not to, and write the pages that are made."""
    MADE.mkdir(exist_ok=True)
    if "--no-runs" not in sys.argv[1:]:
        run_all()
    for name, text in reference().items():
        write(MADE / name, text)
    for demo in demos():
        write(MADE / f"demo_{demo.stem}.md", demo_page(demo))
    for notebook in notebooks():
        write(MADE / f"notebook_{notebook.stem}.md", notebook_page(notebook))
    write(MADE / "gallery.md", gallery())


def write(path: Path, text: str) -> None:
    """Write a page if it says something new, so that Sphinx reads no more than it must."""
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


if __name__ == "__main__":
    main()
