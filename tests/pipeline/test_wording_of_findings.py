"""Findings are short: cause, item and text of every one have at most `MOST_WORDS` words."""

import ast
from collections.abc import Iterator

from outside import ROOT

from boresight.calib.finding import MOST_WORDS

ROOMS = ("calib", "pipeline", "features")


def calls() -> Iterator[tuple[str, ast.FunctionDef, ast.Call]]:
    """Every place that makes a finding, and the function that it stands in."""
    for path in sorted(one for room in ROOMS for one in (ROOT / room).rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        for function in ast.walk(ast.parse(source)) if "Finding(" in source else ():
            if isinstance(function, ast.FunctionDef):
                for node in ast.walk(function):
                    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding":
                        yield f"{path.relative_to(ROOT)}:{node.lineno}", function, node


def texts(node: ast.expr, function: ast.FunctionDef) -> list[str]:
    """What an expression of text may be, each value that is put in as one word."""
    match node:
        case ast.Constant(value=str(value)):
            return [value]
        case ast.JoinedStr(values=parts):
            return ["".join(part.value if isinstance(part, ast.Constant) else "x" for part in parts)]
        case ast.IfExp(body=body, orelse=other):
            return [*texts(body, function), *texts(other, function)]
        case ast.BinOp(left=left, right=right):
            return [a + b for a in texts(left, function) for b in texts(right, function)]
        case ast.Name(id=name):
            return assigned(name, function) or ["x"]
    return ["x"]


def assigned(name: str, function: ast.FunctionDef) -> list[str]:
    found: list[str] = []
    for node in ast.walk(function):
        match node:
            case ast.Assign(targets=[ast.Name(id=other)], value=value) if other == name:
                if not any(isinstance(one, ast.Name) and one.id == name for one in ast.walk(value)):
                    found += texts(value, function)
    return found


def test_a_finding_has_at_most_thirty_words():
    every = list(calls())
    assert {place.partition("/")[0] for place, _, _ in every} == {"calib", "pipeline"}
    assert len(every) > 15
    for place, function, call in every:
        parts = {one.arg: one.value for one in call.keywords if one.arg in ("cause", "item", "text")}
        assert set(parts) == {"cause", "item", "text"}, place
        most = sum(max(len(text.split()) for text in texts(value, function)) for value in parts.values())
        assert most <= MOST_WORDS, (place, most)
