"""The report as a document: complete, self-contained, and every number in it the one that was saved."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from boresight.pipeline.cli import app
from boresight.pipeline.report.page import report_html
from boresight.pipeline.report.saved import read_saved

SECTIONS = {
    "matrix",
    "checks",
    "convergence",
    "angles",
    "stars",
    "targets",
    "image",
    "matches",
    "covariance",
    "statistics",
    "omitted",
    "provenance",
}
VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """All elements with their attributes, text and place in the document."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.texts: list[str] = []
        self.open: list[int] = []
        self.children: dict[int, list[int]] = {}
        self.feed(text)
        self.close()
        assert not self.open, "elements that are not closed"

    def handle_starttag(self, tag, attributes):
        n = len(self.elements)
        self.elements.append((tag, dict(attributes)))
        self.texts.append("")
        for parent in self.open:
            self.children.setdefault(parent, []).append(n)
        if tag not in VOID:
            self.open.append(n)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.elements[self.open[-1]][0] == tag, f"</{tag}> closes {self.elements[self.open[-1]]}"
        self.open.pop()

    def handle_data(self, data):
        for n in self.open:
            self.texts[n] += data

    def all(self, tag):
        return [(n, attributes) for n, (name, attributes) in enumerate(self.elements) if name == tag]


@pytest.fixture(scope="module")
def html(finished) -> str:
    return (finished[1] / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


def test_all_sections_are_there_and_linked(page: Page):
    assert {attributes.get("id") for _, attributes in page.all("section")} == SECTIONS
    links = {attributes["href"] for _, attributes in page.all("a")}
    assert {f"#{name}" for name in SECTIONS} <= links


def test_nothing_outside_the_page_is_named(html: str, page: Page):
    assert "http:" not in html and "https:" not in html and "@import" not in html
    for _, attributes in page.elements:
        for name in ("src", "href", "xlink:href", "srcset", "action"):
            if name in attributes:
                assert attributes[name].startswith(("#", "data:")), attributes[name][:80]
    assert set(re.findall(r"url\((.)", html)) <= {"#"}


def test_every_picture_has_words(page: Page):
    pictures = page.all("img")
    assert pictures and all(len(attributes["alt"]) > 10 for _, attributes in pictures)
    ids = {attributes.get("id"): n for n, (_, attributes) in enumerate(page.elements)}
    drawings = [(n, a) for n, a in page.all("svg") if a.get("aria-hidden") != "true"]
    assert len(drawings) >= 11
    for n, attributes in drawings:
        assert attributes["role"] == "img"
        title = ids[attributes["aria-labelledby"]]
        assert title in page.children[n] and len(page.texts[title]) > 20


def test_ids_are_not_used_twice(page: Page):
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))


def test_every_number_is_the_one_that_was_saved(page: Page, finished):
    _, result = finished
    numbers = page.all("data")
    assert len(numbers) > 60
    for n, attributes in numbers:
        exact = float(attributes["value"])
        saved = saved_number(result / attributes["data-source"], attributes["data-key"])
        assert exact == (np.sqrt(saved) if "data-root" in attributes else saved)
        shown = format(exact * float(attributes.get("data-scale", "1")), attributes["data-form"])
        assert page.texts[n].replace("\N{MINUS SIGN}", "-") == shown


def saved_number(path: Path, key: str) -> float:
    if path.suffix == ".parquet":
        column, row = key.rsplit(".", 1)
        return float(pq.read_table(path, columns=[column]).column(column)[int(row)].as_py())
    content = json.loads(path.read_text())
    for part in key.split("."):
        content = content[int(part)] if isinstance(content, list) else content[part]
    return float(content)


def test_captions_tell_what_the_tables_hold(html: str, finished):
    _, result = finished
    context = json.loads((result / "evidence/context.json").read_text())
    stars = pq.read_table(result / "sightings/stars.parquet").to_pandas()
    kept = stars[stars.kept]
    residual = np.vstack(kept.residual_s)[:, :2] / context["star_camera"]["pixel_rad"]
    assert f"Mean residual of {len(kept)} stars" in html
    assert f"Single stars scatter by {np.sqrt((residual**2).mean()):.3f} px rms per axis" in html
    targets = pq.read_table(result / "sightings/targets.parquet").to_pandas()
    good = targets[targets.kept]
    residual = np.vstack(good.residual_c) / context["remote_camera"]["pixel_rad"]
    assert f"{len(good)} sightings of targets" in html
    assert f"Rms {np.sqrt((residual**2).mean()):.3f} px per axis" in html
    angles = pq.read_table(result / "evidence/angles.parquet").to_pandas()
    spread = np.sqrt(((angles.z / angles.sigma) ** 2).mean())
    assert f"{len(angles)} pairs of star and target; standard deviation of z/σ {spread:.3f}" in html
    for table, what in ((stars, "stars"), (targets, "targets")):
        mean = table.normalised[table.kept].mean()
        text = f"{table.kept.sum()} {what} used, mean {mean:.3f} (2 expected); {(~table.kept).sum()} rejected"
        assert text in html


def test_every_placed_target_is_shown(page: Page, finished):
    targets = pq.read_table(finished[1] / "sightings/targets.parquet").to_pandas()
    cards = [page.texts[n] for n, a in page.all("figure") if a.get("class", "").startswith("card")]
    assert len(cards) == len(targets)
    for strip, target, ccd in zip(targets.strip_id, targets.target_id, targets.ccd):
        assert sum(f"{strip} / {target}, CCD {ccd}" in card for card in cards) == 1
    assert len(page.all("img")) == 3 * len(targets)


def test_every_detection_is_marked_by_its_state(page: Page, finished):
    detections = pq.read_table(finished[1] / "evidence/exposure.parquet").to_pandas()
    marks = [a["class"].split()[1] for _, a in page.all("g") if a.get("class", "").startswith("mark ")]
    assert sorted(marks) == sorted(detections.state)
    assert (detections.state == "used").sum() >= 20
    names = [page.texts[n] for n, a in page.all("text") if a.get("class", "").startswith("name ")]
    assert sorted(names) == sorted(f"HIP {hip}" for hip in detections.hip if hip)
    legend = " ".join(page.texts[n] for n, _ in page.all("li"))
    assert f"{(detections.state == 'used').sum()} identified and used" in legend


def test_what_was_rejected_is_listed_with_its_reason(html: str, page: Page, finished):
    omissions = pq.read_table(finished[1] / "sightings/omissions.parquet").to_pylist()
    listed = " ".join(page.texts[n] for n, a in page.all("section") if a.get("id") == "omitted")
    for omission in omissions:
        assert omission["name"] in listed and omission["reason"] in listed


def test_settings_and_checksums_of_every_input_are_listed(page: Page, finished):
    dump, result = finished
    text = next(page.texts[n] for n, a in page.all("section") if a.get("id") == "provenance")
    inputs = pq.read_table(result / "evidence/inputs.parquet").to_pylist()
    assert {row["file"] for row in inputs} >= {"dump.toml", "orbit.oem", "star_camera.toml", "targets.csv"}
    assert not any(row["file"].startswith("truth") for row in inputs)
    assert all(row["sha256"] in text and str(row["bytes"]) in text for row in inputs)
    assert all((dump / row["file"]).stat().st_size == row["bytes"] for row in inputs)
    assert "calibration.sigma_position_m" in text and "match." in text and "packages.numpy" in text


def test_the_command_draws_the_same_page_again(finished):
    before = (finished[1] / "report.html").read_bytes()
    ran = CliRunner().invoke(app, ["report", str(finished[1])])
    assert ran.exit_code == 0 and "report.html" in ran.output
    assert (finished[1] / "report.html").read_bytes() == before


def test_of_too_many_matches_the_worst_are_shown_and_the_rest_counted(finished):
    page = Page(report_html(read_saved(finished[1]), most_matches=2))
    targets = pq.read_table(finished[1] / "sightings/targets.parquet").to_pandas()
    assert len(page.all("img")) == 6
    worst = targets.sort_values("normalised").target_id.iloc[-1]
    assert any(f"/ {worst}, CCD" in page.texts[n] for n, _ in page.all("figcaption"))
    assert f"Shown are the 2 with the largest residuals of {len(targets)}" in page.texts[0]


def test_a_result_with_next_to_nothing_in_it_gets_a_whole_page_too(finished):
    saved = read_saved(finished[1])
    names = ("angles", "matches", "omissions", "inputs", "convergence")
    empty = {name: getattr(saved, name).slice(0, 0) for name in names}
    bare = replace(
        saved, **empty, detections=saved.detections.slice(0, 0).replace_schema_metadata(None), run={}
    )
    page = Page(report_html(bare))
    assert {attributes.get("id") for _, attributes in page.all("section")} == SECTIONS
    assert "No star image was kept" in page.texts[0] and "No target was matched" in page.texts[0]
    assert "Nothing was rejected" in page.texts[0]


def test_names_of_a_mission_cannot_become_markup(finished):
    saved = read_saved(finished[1])
    hostile = replace(saved, context=saved.context | {"mission": "<script>alert('\"&</script>"})
    page = Page(report_html(hostile))
    assert len(page.all("script")) == 1
    assert "<script>alert('\"&</script>" in page.texts[0]


def test_a_folder_without_a_result_gets_a_report_of_what_is_missing(tmp_path):
    ran = CliRunner().invoke(app, ["report", str(tmp_path)])
    assert ran.exit_code != 0
    assert "installation.json" in str(ran.exception)


def test_a_result_made_without_report_says_how_to_get_one(finished, tmp_path):
    shutil.copytree(finished[1], tmp_path / "result", ignore=shutil.ignore_patterns("work", "evidence"))
    ran = CliRunner().invoke(app, ["report", str(tmp_path / "result")])
    assert ran.exit_code != 0 and "run it again" in str(ran.exception)
