"""The ground half from the command line: places of a dump's targets."""

import html
import json
import re
import shutil
from pathlib import Path

import rasterio
import rasterio.warp
from command_line import ran
from edits import rows_of

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
