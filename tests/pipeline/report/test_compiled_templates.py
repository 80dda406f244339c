"""Compiled templates are kept where that is possible, and never trusted where they differ."""

from __future__ import annotations

from pathlib import Path

import jinja2
import pytest

from boresight.pipeline.report import compiled_templates
from boresight.pipeline.report.compiled_templates import CompiledTemplates


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(compiled_templates, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def rendered(text: str) -> str:
    """What a template of this text gives in a fresh process."""
    loader = jinja2.FunctionLoader(lambda name: (text, "page.html", lambda: True))
    return jinja2.Environment(loader=loader, bytecode_cache=CompiledTemplates()).get_template("page").render()


def test_a_template_is_compiled_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert rendered("{{ 1 + 1 }}") == "2"
    assert len(list(folder.iterdir())) == 1
    monkeypatch.setattr(jinja2.Environment, "_compile", None)  # not called again
    assert rendered("{{ 1 + 1 }}") == "2"


def test_another_source_or_a_damaged_file_is_compiled_again(folder: Path) -> None:
    assert rendered("{{ 1 + 1 }}") == "2"
    assert rendered("{{ 1 + 2 }}") == "3"
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"x" + whole[1:]):
        file.write_bytes(damaged)
        assert rendered("{{ 1 + 2 }}") == "3"
    assert file.read_bytes() == whole


def test_a_folder_that_cannot_be_written_changes_nothing(folder: Path) -> None:
    folder.write_text("a file where the folder should be")
    assert rendered("{{ 1 + 1 }}") == "2"
