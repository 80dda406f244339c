"""The ground half from the command line: places of a dump's targets, and good targets in an ortho-image."""

import html
import json
import re
import shutil
from pathlib import Path

import numpy as np
import rasterio
import rasterio.warp
from command_line import ran
from edits import rows_of
from rasters import write_raster

MINI = Path(__file__).resolve().parents[3] / "fixtures" / "mini"


def test_the_page_of_candidates_shows_each_with_its_pictures_and_reason(tmp_path: Path):
    dump = shutil.copytree(MINI, tmp_path / "dump")
    for name, spoil in (("s01-t01", lambda a: a // 40 + 100), ("s01-t02", lambda a: a[::-1])):
        with rasterio.open(dump / f"chips/{name}.tif", "r+") as chip:
            values = chip.read(1)
            chip.write(spoil(values).astype(values.dtype), 1)
    out, page = tmp_path / "places.csv", tmp_path / "targets.html"
    ran("match", dump, "--strip", "s01", "--out", out, "--page", page, "--workers", 1)
    rows = rows_of(out)
    text = page.read_text(encoding="utf-8")
    more = json.loads(re.search(r'id="more-cards">(.*?)</script>', text).group(1))
    cards = more | dict(re.findall(r'<article id="(t\d+)"(.*?)</article>', text, re.DOTALL))
    assert len(cards) == len(rows) and "s01-t02" in {row["target_id"] for row in rows if row["reason"]}
    for n, row in enumerate(rows):
        card = html.unescape(cards[f"t{n}"])
        assert row["target_id"] in card and row["reason"] in card
        assert card.count("data:image/png") == 4  # chip, strip, difference, correlation
        if row["outcome"] == "placed":
            assert f'data-source="{out.name}" data-key="correlation.{n}"' in card
            assert f"{float(row['correlation']):.3f}" in card


def test_suggested_targets_are_a_list_that_a_dump_can_have(tmp_path: Path):
    rng = np.random.default_rng(4)
    image = np.kron(rng.integers(20, 230, (40, 50)), np.ones((12, 12))) + rng.normal(0.0, 1.0, (480, 600))
    placed = {"crs": "EPSG:32633", "transform": rasterio.Affine(0.5, 0, 4e5, 0, -0.5, 5e6)}
    ortho = write_raster(tmp_path / "ortho.tif", np.clip(image, 0, 255).astype(np.uint8), **placed)
    out = tmp_path / "targets"
    ran("targets", "suggest", ortho, "--out", out, "--size-px", 64, "--most", 5, "--height-m", 310)
    rows = rows_of(out / "targets.csv")
    assert len(rows) == 5
    assert {row["height_m"] for row in rows} == {"310.000"}
    for row in rows:
        with rasterio.open(out / row["chip"]) as chip:
            assert chip.shape == (64, 64)
            east, north = chip.transform @ (32.5, 32.5)
            lon, lat = rasterio.warp.transform("EPSG:32633", "EPSG:4326", [east], [north])
        # the list has nine decimals of a degree: 0.1 mm
        np.testing.assert_allclose(
            [float(row["lon_deg"]), float(row["lat_deg"])], [lon[0], lat[0]], atol=2e-9
        )
