"""What an API page must hold: every name that its modules export, with the first words of its docstring."""

from __future__ import annotations

import ast
import html
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
WORDS = 6  # of a docstring: markup is left aside, as a page renders it in its own way


def undocumented(page: str, modules: list[str]) -> list[str]:
    """Exported functions and classes of `modules` that an HTML page lacks, or shows without their text."""
    text = _letters(html.unescape(re.sub(r"<[^>]+>", "", page)))
    return [
        name
        for module in modules
        for name, first in exported(module)
        if f'id="{name}"' not in page or _letters(first) not in text
    ]


def exported(module: str) -> Iterator[tuple[str, str]]:
    """Dotted name and first words of the docstring of each function and class in a module's `__all__`."""
    path = ROOT / Path(*module.split("."))
    tree = ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text("utf-8"))
    lists = [
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    ]
    named = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    for name, node in named.items():  # of an overloaded function the last
        if any(name in names for names in lists):
            words = (ast.get_docstring(node) or "no docstring").split()
            yield f"{module}.{name}", " ".join(words[:WORDS])


def _letters(text: str) -> str:
    return "".join(letter for letter in text if letter.isalnum())
