"""No test is content with the existence or the size of what it asks for: a wrong value would pass it."""

import ast
from pathlib import Path

TESTS = Path(__file__).parents[1]


def says_little(asserted: ast.expr) -> bool:
    """Whether an expression says no more than that something is there, or how large it is at least."""
    match asserted:
        case ast.BoolOp(values=values):
            return all(map(says_little, values))
        case ast.Call(ast.Attribute(attr="exists" | "is_file" | "is_dir")) | ast.Call(ast.Name("len")):
            return True
        case ast.Call(ast.Name("all"), [ast.GeneratorExp(elt) | ast.ListComp(elt)]):
            return says_little(elt)
        case ast.Compare(_, [ast.IsNot()], [ast.Constant(None)]):
            return True
        case ast.Compare(left, [ast.Gt() | ast.GtE() | ast.NotEq()], [right]):
            return is_size(left) and isinstance(right, ast.Constant | ast.Name)
    return is_size(asserted)


def is_size(value: ast.expr) -> bool:
    match value:
        case ast.Call(ast.Name("len")) | ast.Attribute(attr="st_size" | "size"):
            return True
    return False


def little_said(source: str) -> list[str]:
    """Tests of a module that assert something, but nothing beyond existence or size."""
    found = []
    for test in ast.walk(ast.parse(source)):
        if isinstance(test, ast.FunctionDef) and test.name.startswith("test_"):
            nodes = list(ast.walk(test))
            asserted = [node.test for node in nodes if isinstance(node, ast.Assert)]
            calls = [ast.dump(node.func) for node in nodes if isinstance(node, ast.Call)]
            others = any("raises" in call or "assert_" in call for call in calls)
            if asserted and not others and all(map(says_little, asserted)):
                found.append(test.name)
    return found


def test_tests_that_say_little_are_found():
    little = ("p.exists()", "len(a) > 0", "a is not None", "p.stat().st_size > 9 and len(b) >= c", "a.size")
    much = ("len(a) == 3", "a is None", "not path.exists()", "a > 0", "path.exists() and a == 1", "f(a)")
    for text in little:
        assert little_said(f"def test_a():\n    assert {text}\n") == ["test_a"], text
    for text in much:
        assert little_said(f"def test_a():\n    assert {text}\n") == [], text


def test_no_test_asserts_only_existence_or_size():
    found = {
        str(path.relative_to(TESTS)): names
        for path in sorted(TESTS.rglob("test_*.py"))
        if (names := little_said(path.read_text(encoding="utf-8")))
    }
    assert found == {}
