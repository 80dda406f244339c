"""The text of the project is plain technical English, and public docstrings are complete."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

SCRIPTS = Path(__file__).parents[2] / "scripts"


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look up their module
    spec.loader.exec_module(module)
    return module


def test_no_replaced_phrase_occurs() -> None:
    assert script("plain_words").occurrences() == []


def test_public_docstrings_state_shapes_and_errors() -> None:
    check = script("sample_docstrings")
    found = check.functions()
    assert len(found) > 500
    assert [(f.place, marked) for f in found if (marked := check.marks(f))] == []
