"""What pages say exists: files, commands, tests, options and names; and their scripts run."""

import ast
import functools
import importlib
import importlib.util
import inspect
import json
import re
import shlex

import pages
import pytest

import dolfinx_nts as nts

ROOT = pages.ROOT
PAGES = pages.pages()
BLOCKS = list(pages.blocks())
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
#: Where a path that a page mentions may begin.
ROOTS = [ROOT, ROOT / "dolfinx_nts", ROOT / "docs"]
FOLDERS = (
    "demos", "docs", "tests", "benchmarks", "meshes", "scripts", "dolfinx_nts", "debian",
    *(p.name for p in (ROOT / "dolfinx_nts").iterdir() if p.is_dir()),
)  # fmt: skip
#: What a sentence of a page may have of words, and an entry of the limits, a row of a table.
SENTENCE, ENTRY = 35, 60


def commands(page):
    """What a page says in code: spans, and lines of blocks that are not Python."""
    text = pages.BLOCK.sub("", pages.text_of(page))
    lines = [line.strip() for line in text.splitlines() if line.startswith("    ")]
    fences = re.findall(r"^```\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [*CODE.findall(text), *lines, *"".join(fences).splitlines()]


def exists(name):
    """Whether there is such a file or folder, or one of such files if it has a star."""
    return any(list(root.glob(name.rstrip("/"))) for root in ROOTS)


def prose(page):
    """Paragraphs, items of lists and cells of tables; a span of code and a formula are a word."""
    text = re.sub(r"^(```+).*?^\1$", "", pages.text_of(page), flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)|\$\$.*?\$\$", "", text, flags=re.DOTALL)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]+`|\$[^$]+\$", "Code", text)
    text = re.sub(r"^\s*(?:#.*|[-*] |\d+\. )", "\n\n", text, flags=re.MULTILINE)
    text = re.sub(r"^\|(.*)\|$", lambda row: row[0].replace("|", "\n\n"), text, flags=re.MULTILINE)
    return [part for part in text.split("\n\n") if not part.lstrip("\n").startswith("    ")]


def words(text):
    return len(re.findall(r"[^\W_][\w'./-]*", text))


def test_sentences_are_short():
    for page in PAGES:
        if page.name == "CHANGELOG.md":
            continue
        for part in prose(page):
            for sentence in re.split(r"(?<=[.!?])[\"')*]*\s+(?=[\"'(*]*[A-Z0-9])", part):
                assert words(sentence) <= SENTENCE, sentence


def test_limits_are_few_and_short():
    text = re.sub(r"`[^`]+`", "Code", (ROOT / "docs/limits.md").read_text())
    entries = [r for r in re.findall(r"^\| (.*) \|$", text, re.MULTILINE) if "---" not in r]
    entries = [entry for entry in entries if not entry.startswith("what you see")]
    assert 0 < len(entries) <= 25
    for entry in entries:
        assert words(re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", entry)) <= ENTRY, entry


def test_links_lead_somewhere():
    for page in PAGES:
        for target in LINK.findall(pages.text_of(page)):
            path = target.partition("#")[0]
            if path and "://" not in path and "made/" not in path:
                assert (page.parent / path).exists(), target


def test_files_exist():
    mentioned = re.compile(rf"(?<![\w./-])(?:{'|'.join(FOLDERS)})/[\w./*-]*[\w*/]")
    for page in PAGES:
        for name in mentioned.findall("\n".join(commands(page))):
            assert "_build" in name or exists(name), name


def test_commands_exist():
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for page in PAGES:
        for command in commands(page):
            for target in re.findall(r"^make ([a-z][\w-]*)", command):
                assert target in targets, command
            for module in re.findall(r"python -m (dolfinx_nts[\w.]*)", command):
                assert importlib.util.find_spec(module), command
            for name in re.findall(r"(?:^|\s)((?:demos|benchmarks)/\w+\.py)", command):
                check_options(ROOT / name, command)
            if re.match(r"(\S*python -m )?pytest", command):
                check_tests(command)


def check_options(script, command):
    """Options of a demo or benchmark are in its text, or in that of a demo that it imports."""
    text = pages.source(script)
    of_script = command.split(script.name, 1)[1] if "tradeoff" not in command else ""
    for option in re.findall(r"(?<!\S)--[a-z-]+", of_script):
        assert f'"{option}"' in text, f"{option} of {script.name}"


def test_short_runs_have_options_of_their_demos():
    for demo, options in pages.SHORT.items():
        check_options(ROOT / "demos" / f"{demo}.py", f"{demo}.py {options}")


@functools.cache
def names_in(path):
    """Names of a file's tests and of their cases, as far as its text has them."""
    text = path.read_text()
    return (text if "def test_" in text else "").lower()


def check_tests(command):
    """A command's files exist, and words of its -k are in one of them."""
    words = shlex.split(command)
    files = [ROOT / w.partition("::")[0] for w in words if w.startswith("tests/")]
    assert all(path.is_file() for path in files), command
    files = files or sorted((ROOT / "tests").rglob("test_*.py"))
    chosen = words[words.index("-k") + 1] if "-k" in words else ""
    for word in re.findall(r"\w+", chosen):
        found = word in ("or", "and", "not") or any(word.lower() in names_in(f) for f in files)
        assert found, f"{word!r} of {command}"


def test_names_of_the_package_exist():
    for page in PAGES:
        for name in re.findall(r"\bnts\.(\w+)", pages.text_of(page)):
            assert hasattr(nts, name), name
        for name in re.findall(r"`dolfinx_nts\.([\w.]+)`", pages.text_of(page)):
            module, _, attribute = f"dolfinx_nts.{name}".rpartition(".")
            whole = importlib.util.find_spec(module) and importlib.import_module(module)
            found = hasattr(whole, attribute) or importlib.util.find_spec(f"{module}.{attribute}")
            assert found, name


def test_calls_have_these_arguments():
    """Also of blocks that are no whole scripts."""
    for node in (node for block in BLOCKS for node in ast.walk(ast.parse(block.code))):
        called = node.func if isinstance(node, ast.Call) else None
        of_package = isinstance(called, ast.Attribute) and isinstance(called.value, ast.Name)
        if not (of_package and called.value.id == "nts"):
            continue
        function = getattr(nts, called.attr)
        known = inspect.signature(getattr(function, "__init__", function)).parameters
        if isinstance(function, type) and "args" in known:
            continue
        if not isinstance(function, type):
            known = inspect.signature(function).parameters
        for word in node.keywords:
            assert word.arg is None or word.arg in known, f"{called.attr}({word.arg}=)"


TABLES = re.compile(r"^\| `nts\.([\w.]+)` \| unit \| default .*\n\|[-|]+\n((?:\|.*\n)+)", re.M)


def test_tables_of_parameters_have_the_defaults_of_signatures():
    tables = [found for page in PAGES for found in TABLES.findall(pages.text_of(page))]
    assert tables
    for name, rows in tables:
        found = functools.reduce(getattr, name.split("."), nts)
        taken = inspect.signature(found.__init__ if isinstance(found, type) else found).parameters
        for row in rows.splitlines():
            argument, _, told, *_ = (cell.strip() for cell in row.strip("|").split(" | "))
            default = taken[argument.strip("`")].default
            if told == "required":
                assert default is inspect.Parameter.empty, f"{name}: {row}"
            else:
                assert ast.literal_eval(told) == default, f"{name}: {row}"


def test_every_docstring_section_of_theory_is_there():
    theory = (ROOT / "docs/theory.md").read_text()
    sections = set(map(int, re.findall(r"^## (\d+)\. ", theory, re.MULTILINE)))
    for path in (ROOT / "dolfinx_nts").rglob("*.py"):
        for number in re.findall(r"theory (?:section )?(\d+)", path.read_text()):
            assert int(number) in sections, path


def test_notebooks_are_without_output():
    """What a run has left in them would grow old, and change with each run."""
    for page in pages.notebooks():
        notebook = json.loads(page.read_text())
        assert notebook["nbformat"] == 4
        for cell in notebook["cells"]:
            assert not cell.get("outputs") and not cell.get("execution_count")


@pytest.mark.slow
@pytest.mark.parametrize("block", [b for b in BLOCKS if b.whole], ids=lambda b: b.name)
def test_whole_scripts_run(block, tmp_path):
    pages.run_block(block, tmp_path)
