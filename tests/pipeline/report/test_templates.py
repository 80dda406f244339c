"""Compiled templates of the report are kept in the user's cache folder, where that can be written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import jinja2
import pytest

from boresight.pipeline.report.page import _environment, template


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str | None]]:
    """Names of the templates that are compiled from now on."""
    names: list[str | None] = []
    own = jinja2.Environment.compile

    def noted(self: jinja2.Environment, source: str, name: str | None = None, *rest: str) -> object:
        names.append(name)
        return own(self, source, name, *rest)

    monkeypatch.setattr(jinja2.Environment, "compile", noted)
    yield names
    _environment.cache_clear()  # it knows the folder of this test


def page_of(cache: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A page by an environment that begins anew, with this cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    _environment.cache_clear()
    return template("style.css").render()


def test_a_template_is_compiled_once_and_again_where_the_cache_is_damaged(
    compiled: list[str | None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = page_of(tmp_path, monkeypatch)
    once = len(compiled)
    assert once and page_of(tmp_path, monkeypatch) == first and len(compiled) == once
    for path in (tmp_path / "boresight").glob("*jinja2*"):
        path.write_bytes(path.read_bytes()[:40])
    assert page_of(tmp_path, monkeypatch) == first and len(compiled) == 2 * once


def test_a_cache_that_cannot_be_written_costs_time_only(
    compiled: list[str | None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    first = page_of(tmp_path / "file", monkeypatch)
    assert page_of(tmp_path / "file", monkeypatch) == first and len(compiled) >= 2
