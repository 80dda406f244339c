"""Templates of pages are compiled once for all runs, and in each run where nothing can be kept."""

from __future__ import annotations

import jinja2
import pytest

from boresight.pipeline.report import page


@pytest.fixture(autouse=True)
def fresh_environment():
    page._environment.cache_clear()
    yield
    page._environment.cache_clear()


def test_template_is_compiled_by_the_first_run_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = dir(page.template("observations.html.j2").module)
    assert {path.suffix for path in (tmp_path / "boresight" / "templates").iterdir()} == {".cache"}
    page._environment.cache_clear()
    monkeypatch.setattr(jinja2.Environment, "compile", lambda *_: pytest.fail("compiled again"))
    assert dir(page.template("observations.html.j2").module) == first


def test_other_syntax_is_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    page.template("observations.html.j2")
    page._environment.cache_clear()
    monkeypatch.setitem(page.SYNTAX, "trim_blocks", False)
    again = []
    compiled = jinja2.Environment.compile
    monkeypatch.setattr(jinja2.Environment, "compile", lambda *a, **k: again.append(a) or compiled(*a, **k))
    page.template("observations.html.j2")
    assert len(again) == 1


def test_page_is_made_where_no_folder_can_be_written(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert page.template("observations.html.j2").module
