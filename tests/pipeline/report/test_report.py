"""The report as a document: complete, self-contained, and every number in it the one that was saved."""

import hashlib
import json
import re
import shutil
from dataclasses import replace
from datetime import datetime, timedelta
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command_line import ran
from matplotlib.path import Path as MplPath
from pytest import approx
from report_page import report_html

from boresight.pipeline.console import report_command
from boresight.pipeline.console.program import errors_reported
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.report.saved import EVIDENCE, Saved, read_saved
from boresight.pipeline.results.sightings_tables import COLUMNS

SECTIONS = set(
    "map matrix checks blind targets residuals accuracy exposures convergence angles stars image covariance "
    "statistics omitted provenance cards".split()
)
VOID = {"meta", "link", "img", "br", "input"}
MORE = re.compile(r'<script type="application/json" id="more-cards">(.*?)</script>', re.DOTALL)


class Page(HTMLParser):
    """All elements with their attributes, text and place in the document."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.texts: list[str] = []
        self.open: list[int] = []
        self.children: dict[int, list[int]] = {}
        more = MORE.search(text)
        cards = json.loads(more[1]).values() if more else ()  # put in as by the page when they are asked for
        self.feed(MORE.sub("", text).replace("</main>", "".join(cards) + "</main>"))
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
    assert {f"#{name}" for name in SECTIONS - {"cards"}} <= links


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
        holds_links = attributes.get("id") == "map-sheet"
        assert attributes["role"] == ("group" if holds_links else "img")
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
        form = attributes["data-form"]
        if form.startswith("UTC from "):
            instant = datetime.fromisoformat(form[9:][:26]) + timedelta(seconds=round(exact, 6))
            assert abs(datetime.fromisoformat(page.texts[n]) - instant) < timedelta(seconds=1e-4)
            continue
        shown = format(exact * float(attributes.get("data-scale", "1")), form)
        assert page.texts[n].replace("\N{MINUS SIGN}", "-") == shown


def saved_number(path: Path, key: str) -> float:
    if path.suffix == ".parquet":
        column, row = key.rsplit(".", 1)
        return float(pq.read_table(path, columns=[column]).column(column)[int(row)].as_py())
    content = json.loads(path.read_text())
    for part in key.split("."):
        content = content[int(part)] if isinstance(content, list) else content[part]
    return float(content)


def test_every_target_has_a_row_a_card_a_place_on_the_map_and_in_four_plots(page: Page, finished):
    targets = pq.read_table(finished[1] / "sightings/targets.parquet").to_pandas()
    ground = pq.read_table(finished[1] / "evidence/ground.parquet").to_pandas()
    cards = {a["id"]: page.texts[n] for n, a in page.all("article") if a["id"].startswith("t")}
    assert len(cards) == len(ground) >= len(targets)
    assert len(page.all("img")) == 4 * len(targets)
    marks = [a["href"] for _, a in page.all("a") if a.get("class", "").startswith("spot ")]
    dots = [a["data-link"] for _, a in page.all("path") if a.get("class", "").startswith("dot ")]
    rows = [a["data-link"] for _, a in page.all("tr") if "data-link" in a]
    for strip, target, ccd, kept in zip(targets.strip_id, targets.target_id, targets.ccd, targets.kept):
        (link,) = [link for link, text in cards.items() if f"{target}, strip {strip}, CCD {ccd}" in text]
        assert ("used" if kept else "rejected") in cards[link]
        assert marks.count(f"#{link}") == 1 and dots.count(link) == 8 and rows.count(link) == 1


def test_ground_residuals_are_those_of_the_sightings(finished):
    # A residual angle times the distance is the length on level ground below: the two differ by the slant of
    # the view, 1 / cos² of at most 10 degrees, 3 %. The sightings state the angles, the map metres.
    ground = pq.read_table(finished[1] / "evidence/ground.parquet").to_pandas()
    targets = pq.read_table(finished[1] / "sightings/targets.parquet").to_pandas()
    both = ground.merge(targets, on=["strip_id", "target_id", "ccd"])
    assert len(both) == len(targets)
    residual_c = np.vstack(both.residual_c) * both.range_m.to_numpy()[:, None]
    size = np.hypot(both.residual_east_m, both.residual_north_m)
    assert size.to_numpy() == approx(np.linalg.norm(residual_c, axis=1), rel=0.03)
    track = both[["residual_along_m", "residual_across_m"]].to_numpy()
    assert np.linalg.norm(track, axis=1) == approx(size.to_numpy(), rel=1e-9)
    # x of the camera is along the flight, and y to its right, but for the yaw of a few degrees
    assert track == approx(residual_c, abs=0.15 * float(size.max()))
    assert both.sigmas.to_numpy() ** 2 == approx(both.normalised.to_numpy(), rel=1e-9)


def test_footprints_hold_the_targets_that_strips_show(finished):
    scenes = json.loads((finished[1] / "evidence/context.json").read_text())["scenes"]
    ground = pq.read_table(finished[1] / "evidence/ground.parquet").to_pandas()
    outlines = {
        (s["id"], k): o for scene in scenes for s in scene["strips"] for k, o in enumerate(s["outlines_m"])
    }
    used = ground[ground.state == "used"]
    assert len(used) > 5
    for row in used.itertuples():
        assert MplPath(outlines[row.strip_id, row.ccd]).contains_point((row.east_m, row.north_m))


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
    omissions = pq.read_table(finished[1] / "sightings/ledger.parquet").to_pylist()
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
    for row in inputs:
        content = (dump / row["file"]).read_bytes()
        assert (row["bytes"], row["sha256"]) == (len(content), hashlib.sha256(content).hexdigest())
    assert "calibration.sigma_position_m" in text and "match." in text and "packages.numpy" in text


def test_the_command_draws_the_same_page_again(result):
    before = (result / "report.html").read_bytes()
    assert "report.html" in ran("report", result).output
    assert (result / "report.html").read_bytes() == before


TABLES = [f"evidence/{name}" for name in EVIDENCE] + ["sightings/stars", "sightings/targets"]


@pytest.mark.parametrize("name", TABLES)
def test_a_table_of_others_is_refused_with_its_column(name, result):
    file = result / f"{name}.parquet"
    sound, kept = pq.read_table(file), (EVIDENCE | COLUMNS)[name.rpartition("/")[2]]
    assert dict(zip(sound.schema.names, sound.schema.types)) == kept
    column = "residual_c" if name == "sightings/targets" else [*kept][-1]
    column = "normalised" if name == "sightings/stars" else column
    foreign = sound.set_column(sound.column_names.index(column), column, pa.array([True] * len(sound)))
    empty = sound.set_column(sound.column_names.index(column), column, pa.nulls(len(sound), kept[column]))
    for table in (sound.drop_columns([column]), foreign, empty):
        pq.write_table(table, file)
        if table is not empty or len(empty):
            with pytest.raises(RawDataError, match=rf"{name}\.parquet: (column {column}|file): found"):
                read_saved(result)


def test_what_is_no_number_in_a_result_of_others_is_refused(result):
    file = result / "installation.json"
    text = file.read_text()
    for word in ("NaN", "-Infinity"):
        file.write_text(re.sub(r'"chi2": [^,]*', f'"chi2": {word}', text))
        with pytest.raises(
            RawDataError, match=rf"installation\.json: JSON: found {word}, which JSON has not"
        ):
            read_saved(result)


def test_memory_that_is_not_there_is_told_in_a_line(finished, monkeypatch, caplog):
    def full(result):
        raise MemoryError("Unable to allocate 8.00 GiB")

    monkeypatch.setattr(report_command, "write_report", full)
    with pytest.raises(SystemExit) as ended, errors_reported():
        report_command.report_command(finished[1])
    assert ended.value.code == 1 and "memory: Unable to allocate 8.00 GiB" in caplog.text


def test_of_too_many_targets_the_worst_have_pictures_and_all_have_a_card(finished):
    page = Page(report_html(read_saved(finished[1]), most_matches=2))
    targets = pq.read_table(finished[1] / "sightings/targets.parquet").to_pandas()
    assert len(page.all("img")) == 8
    worst = targets.sort_values("normalised").target_id.iloc[-1]
    cards = [n for n, a in page.all("article") if a["id"].startswith("t")]
    assert len(cards) == len(targets)
    shown = {n for n, _ in page.all("img")}
    (card,) = [n for n in cards if f"{worst}, strip" in page.texts[n]]
    assert shown & set(page.children[card])


def test_cards_have_a_cross_hair_where_a_target_was_found_and_one_where_it_was_predicted(finished):
    saved = read_saved(finished[1])
    targets = len(saved.targets)
    # In chip, strip and correlation; in the chip the predicted place is that of the target as well.
    assert cross_hairs(saved) == (3 * targets, 2 * targets, targets)
    nowhere, table = pa.array(np.full(targets, np.nan)), saved.matches
    for name in ("off_x_px", "off_y_px"):
        table = table.set_column(table.schema.get_field_index(name), name, nowhere)
    # As of targets that were not found: all pictures show the predicted place.
    assert cross_hairs(replace(saved, matches=table)) == (0, 3 * targets, 0)


def cross_hairs(saved: Saved) -> tuple[int, int, int]:
    """Cross-hairs of places found and of places predicted, and sentences that tell the distance."""
    page = Page(report_html(saved))
    kinds = [attributes.get("class") for _, attributes in page.all("path")]
    told = sum(page.texts[n].startswith("+ found, × predicted") for n, _ in page.all("p"))
    return kinds.count("matched"), kinds.count("predicted"), told


def test_required_accuracy_is_kept_and_compared_with_each_axis(result):
    told = ran("report", result, "--require-arcsec", 0.6, "--require-m", 100).stdout
    assert json.loads((result / "requirement.json").read_text()) == {"arcsec": 0.6, "m": 100.0}
    covariance = np.array(json.loads((result / "installation.json").read_text())["covariance_rad2"])
    sigma = np.degrees(np.sqrt(np.diag(covariance))) * 3600.0
    missed = ", ".join(axis for axis, one in zip("XYZ", sigma) if one > 0.6)
    assert "Z" in missed
    numbers = ", ".join(f"{axis} {one:.4g}" for axis, one in zip("XYZ", sigma) if one > 0.6)
    assert f"0.6 arcsec about each axis: not met about {numbers}\n" in told
    assert "100 m on the ground: met\n" in told
    text = Page((result / "report.html").read_text(encoding="utf-8")).texts[0]
    assert f"Required: 0.6″ about every axis: not met (about {missed})" in text
    assert "Required: 100 m on the ground: met" in text


def test_a_result_with_next_to_nothing_in_it_gets_a_whole_page_too(finished):
    saved = read_saved(finished[1])
    names = ("angles", "matches", "ledger", "inputs", "convergence", "detections")
    empty = {name: getattr(saved, name).slice(0, 0).replace_schema_metadata(None) for name in names}
    page = Page(report_html(replace(saved, **empty, run={})))
    assert {attributes.get("id") for _, attributes in page.all("section")} == SECTIONS
    assert "No star image was kept" in page.texts[0] and "Nothing was rejected" in page.texts[0]


def test_names_of_a_mission_cannot_become_markup(finished):
    saved = read_saved(finished[1])
    name = "{{ 7 * 7 }} </style><script>alert('\"&</script>"
    hostile = replace(saved, context=saved.context | {"mission": f"\u202e\x1b{name}"})
    page = Page(report_html(hostile))
    assert rf"\u202e\x1b{name}" in page.texts[0] and not {"\u202e", "\x1b"} & set(page.texts[0])
    assert len(page.all("script")) == 1  # and the cards as data


def test_a_folder_without_a_result_gets_a_report_of_what_is_missing(tmp_path):
    assert "installation.json" in str(ran("report", tmp_path, status=1).exception)


def test_a_result_made_without_report_says_how_to_get_one(result):
    shutil.rmtree(result / "evidence")
    assert "run it again" in str(ran("report", result, status=1).exception)
