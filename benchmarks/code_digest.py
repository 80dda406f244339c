"""Digest of the code that a benchmark's record depends on, of the working tree or of a commit.

A record depends on its script, on every module of this repository that the script imports, directly or not,
and on the commands that it runs: the one of its own command line, or, where the script starts the program,
those that its source names. What cannot change a number does not count: comments, docstrings, imports,
`__all__`, place and name of a module. `record.py`, which prints the head, does not count either.
"""

from __future__ import annotations

import ast
import hashlib
import re
import shlex
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

__all__ = ["Code", "Commit", "WorkingTree", "code_of"]

ROOT = Path(__file__).resolve().parents[1]
NOT_COUNTED = ("benchmarks/record.py", "benchmarks/code_digest.py")
PLACES = ("", "boresight/")  # of a module a.b.c of the package: a/b/c.py, or boresight/a/b/c.py
HELPERS = ("benchmarks/", "tests/", "scripts/")  # where a script's own helpers lie, by their file's name


@dataclass(frozen=True)
class Code:
    """Some modules: path of each, and the digest of what it computes."""

    modules: Mapping[str, str]

    @property
    def digest(self) -> str:
        """16 hexadecimal digits of all modules, whatever their paths."""
        forms = "".join(sorted(self.modules.values()))
        return hashlib.sha256(forms.encode()).hexdigest()[:16]

    def __str__(self) -> str:
        return f"{self.digest}, {len(self.modules)} modules"


class WorkingTree:
    """The Python files of a checkout as they are now: `paths`, from its root."""

    def __init__(self, root: Path = ROOT) -> None:
        self.root = root
        rooms = [path.name for path in root.iterdir() if (path / "__init__.py").is_file()]
        folders = {*rooms, "benchmarks", "tests", "scripts"}
        found = [path for name in sorted(folders) for path in (root / name).rglob("*.py")]
        links = {path for path in (root / "boresight").iterdir() if path.is_symlink()}
        self.paths = {
            path.relative_to(root).as_posix() for path in found if not links.intersection(path.parents)
        }

    def source(self, path: str) -> str:
        """Content of a file."""
        return (self.root / path).read_text(encoding="utf-8")


class Commit:
    """The Python files of a commit: `paths`, from its root. `ValueError` if git does not know it."""

    def __init__(self, name: str, root: Path = ROOT) -> None:
        self.root = root
        listing = _git(root, "ls-tree", "-r", "-z", name).split("\0")
        entries = [line.split("\t", 1) for line in listing if line.endswith(".py")]
        self._blobs = {path: about.split()[2] for about, path in entries}
        self.paths = set(self._blobs)

    def source(self, path: str) -> str:
        """Content of a file."""
        return _blob(self.root, self._blobs[path])


def code_of(command: str, tree: WorkingTree | Commit) -> Code:
    """Digest of the code that a record's command depends on.

    Parameters
    ----------
    command : str
        "python benchmarks/NAME.py ARGUMENTS" or "boresight COMMAND ARGUMENTS".
    tree : WorkingTree or Commit
        Where the code is taken from.

    Raises
    ------
    ValueError
        If the command names neither a script nor a command of the tree.
    """
    roots = list(_roots(command, tree))
    if not roots:
        raise ValueError(f"no script of benchmarks/ and no command of the program in: {command}")
    return Code({path: _digest(tree.source(path)) for path in sorted(_imported(roots, tree))})


def _roots(command: str, tree: WorkingTree | Commit) -> Iterator[str]:
    words = shlex.split(command)
    for at, word in enumerate(words):
        path = f"benchmarks/{Path(word).name}"
        if word.endswith(".py") and path in tree.paths:
            yield path
            strings = set(_strings(tree.source(path)))
            if "boresight" in strings or "program(" in tree.source(path):
                yield from _commands(strings, tree)
        elif word == "boresight":
            yield from _commands(set(words[at + 1 : at + 3]), tree)


def _commands(words: set[str], tree: WorkingTree | Commit) -> Iterator[str]:
    """Modules of the commands that are among some words: `dump_init_command.py` for "dump" and "init", and
    for "dump-init"; in a tree of one module for all commands this one.
    """
    for path in tree.paths:
        name = re.fullmatch(r"(?:pipeline|features)/.*?(\w+)_command\.py", path)
        if name and (set(name[1].split("_")) <= words or name[1].replace("_", "-") in words):
            yield path
    if "pipeline/cli.py" in tree.paths:
        yield "pipeline/cli.py"


@cache
def _strings(source: str) -> tuple[str, ...]:
    nodes = ast.walk(ast.parse(source))
    return tuple(n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str))


def _imported(roots: Iterable[str], tree: WorkingTree | Commit) -> set[str]:
    """Files of a tree that some of its files import, directly or not, these included."""
    found: set[str] = set()
    waiting = list(roots)
    known: dict[str, list[str]] = {}
    while waiting:
        path = waiting.pop()
        if path in found or path in NOT_COUNTED:
            continue
        found.add(path)
        for name in _imports(tree.source(path), path):
            if name not in known:
                known[name] = _files_of(name, tree)
            waiting += known[name]
    return found


@cache
def _imports(source: str, path: str) -> tuple[str, ...]:
    """Dotted names that a module imports, or has as strings: "package.module" and "package.module.name"."""
    names = []
    package = Path(path).parent.parts
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*above, *(node.module or "").split(".")))
            names += [module, *(f"{module}.{alias.name}" for alias in node.names)]
    names += [
        text
        for text in _strings(source)
        if re.fullmatch(r"(boresight|star_id|features|pipeline)(\.\w+)+", text)
    ]
    return tuple(dict.fromkeys(names))


def _files_of(name: str, tree: WorkingTree | Commit) -> list[str]:
    """Files that importing a dotted name runs: the module's, and `__init__.py` of the packages around it."""
    parts = name.removeprefix("boresight.").split(".")
    cuts = [
        f"{place}{'/'.join(parts[:cut])}{end}"
        for place in PLACES
        for cut in range(1, len(parts) + 1)
        for end in (".py", "/__init__.py")
    ]
    ours = [path for path in cuts if path in tree.paths]
    if ours or "." in name:
        return ours
    helpers = [path for path in tree.paths if path.endswith(f"/{name}.py") and path.startswith(HELPERS)]
    return helpers if len(helpers) == 1 else []


@cache
def _digest(source: str) -> str:
    return hashlib.sha256(repr(_form(ast.parse(source))).encode()).hexdigest()


def _form(node: object) -> object:
    """A syntax tree as nested tuples, without what changes no number and without what is empty, so that
    versions of Python agree.
    """
    if isinstance(node, list):
        return tuple(_form(one) for one in node if not _is_idle(one))
    if not isinstance(node, ast.AST):
        return node
    fields = [(name, _form(value)) for name, value in ast.iter_fields(node) if name not in ("ctx", "kind")]
    return (type(node).__name__, *((name, value) for name, value in fields if value not in (None, ())))


def _is_idle(node: object) -> bool:
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    if isinstance(node, ast.Assign):
        return ast.unparse(node.targets[0]) == "__all__"
    return isinstance(node, ast.Import | ast.ImportFrom)


@cache
def _blob(root: Path, blob: str) -> str:
    return _git(root, "cat-file", "blob", blob)


def _git(root: Path, *arguments: str) -> str:
    ran = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True)
    if ran.returncode:
        raise ValueError(f"git {' '.join(arguments)}: {ran.stderr.decode(errors='replace').strip()}")
    return ran.stdout.decode("utf-8")
