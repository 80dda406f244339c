"""Ten prepared faults in a dump, and four smaller ones: does the report's first screen, or its first click,
name cause and item?

    python benchmarks/prepared_faults.py [--images docs/images/faults] [--only NAME]

Each fault is put into a copy of `fixtures/mini`, calibrated and reported; whether the page names cause and
item is judged by the words that must occur in it. With --images a headless Chromium takes the picture of the
first screen, with the card of the item opened where the fault has one.
"""

from __future__ import annotations

import argparse
import html
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import record  # of this folder; sets the number of threads before NumPy is loaded

sys.path.insert(0, str(record.ROOT / "tests"))
sys.path.insert(0, str(record.ROOT / "tests" / "pipeline" / "faults"))

import cv2  # isort: skip
import numpy as np  # isort: skip
from edits import repaint, rows_of, write_rows
from faults import change, edited, later

from PIL import Image  # isort: skip

from boresight.pipeline.report.pdf import chromium
from boresight.pipeline.results.ownership import claimed
from boresight.pipeline.run.settings import Settings

FIXTURE = record.ROOT / "fixtures" / "mini"
CHIP_SHIFT_M, COORDINATE_DEG, CLOCK_S, PRINCIPAL_PX = 60.0, 0.01, 0.02, 12.0


@dataclass(frozen=True)
class Fault:
    """A fault, how it is made, and the words that must be on the first screen or its first click."""

    name: str
    made: str
    make: Callable[[Path], None]
    words: tuple[str, ...]
    item: str = ""  # target whose card the first click opens


def shifted_chip(dump: Path, shift_m: float = CHIP_SHIFT_M) -> None:
    repaint(dump / "chips/s02-t05.tif", lambda image: image, shift_m)


def cloud(dump: Path) -> None:
    rows, columns = np.mgrid[:2000, :512]
    thick = np.clip(1.6 - np.hypot(rows - 1000.0, columns - 256.0) / 400.0, 0.0, 1.0)
    for ccd in (1, 2):
        repaint(
            dump / f"strips/s01_ccd{ccd}.tif",
            lambda image: np.round(image * (1.0 - thick) + 245.0 * thick).astype(image.dtype),
        )


def height_kind(dump: Path) -> None:
    change(dump / "targets.csv", "egm96", "ellipsoidal")


def mirrored(dump: Path) -> None:
    for path in (dump / "exposures").iterdir():
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        path.unlink()
        cv2.imwrite(str(path), np.ascontiguousarray(image[:, ::-1]))


def clock(dump: Path, late_s: float = CLOCK_S) -> None:
    def edit(row: dict[str, str]) -> None:
        if row["id"] == "s02":
            row["utc_first_row"] = later(row["utc_first_row"], late_s)

    edited("strips.csv", edit, dump)


def dead_ccd(dump: Path) -> None:
    for strip in ("s01", "s02", "s03"):
        repaint(dump / f"strips/{strip}_ccd2.tif", lambda image: np.full_like(image, 3))


def coordinate(dump: Path) -> None:
    rows = rows_of(dump / "targets.csv")
    (row,) = [row for row in rows if row["id"] == "s03-t06"]
    row["lat_deg"] = f"{float(row['lat_deg']) + COORDINATE_DEG:.10f}"
    write_rows(dump / "targets.csv", rows)


def principal_point(dump: Path, moved_px: float = PRINCIPAL_PX) -> None:
    text = (dump / "star_camera.toml").read_text()
    x = float(re.search(r"principal_point_px = \[([\d.]+)", text).group(1))
    change(
        dump / "star_camera.toml", r"principal_point_px = \[[\d.]+", f"principal_point_px = [{x + moved_px}"
    )


def height(dump: Path) -> None:
    rows = rows_of(dump / "targets.csv")
    (row,) = [row for row in rows if row["id"] == "s01-t08"]
    row["height_m"] = f"{float(row['height_m']) + 300.0:.3f}"
    write_rows(dump / "targets.csv", rows)


def keep(dump: Path, ids: set[str]) -> None:
    write_rows(dump / "targets.csv", [row for row in rows_of(dump / "targets.csv") if row["id"] in ids])


CORNER = {f"s0{s}-t0{t}" for s in (1, 2, 3) for t in (1, 2, 5)}
# fmt: off
FAULTS = (  # name, what was done, how, words of the page, target whose card is opened
    Fault("shifted-chip", "chip of s02-t05 moved 60 m to the east", shifted_chip,
          ("chip", "s02-t05", "m east of the true place", "Consistent, findings"), "s02-t05"),
    Fault("cloud", "cloud over the middle of CCD 1 and 2 of s01", cloud, ("Cloud", "strip s01"), "s01-t06"),
    Fault("height-kind", "heights above EGM96 as ellipsoidal", height_kind,
          ("Kind of height", "check height_kind")),
    Fault("mirrored", "star images mirrored left to right", mirrored, ("mirrored",)),
    Fault("clock", "rows of s02 dated 20 ms late", clock, ("Clock of the rows", "strip s02")),
    Fault("dead-ccd", "CCD 2 delivers one grey value", dead_ccd, ("Dead detector", "CCD 2")),
    Fault("coordinate", "latitude of s03-t06 wrong by 0.01°", coordinate, ("s03-t06",), "s03-t06"),
    Fault("principal-point", "principal point wrong by 12 px", principal_point, ("principal point",)),
    Fault("few-targets", "one target", lambda dump: keep(dump, {"s01-t04"}), ("oo few targets", "s01")),
    Fault("corner", "three targets a strip, in one corner", lambda dump: keep(dump, CORNER), ("swath",)),
    Fault("small-chip-shift", "chip of s02-t05 moved 13 m, 2 px, to the east",
          lambda dump: shifted_chip(dump, 13.0), ("chip", "s02-t05"), "s02-t05"),
    Fault("small-clock", "rows of s02 dated 4 ms late", lambda dump: clock(dump, 4e-3), ("lock", "s02")),
    Fault("small-principal-point", "principal point wrong by 4 px", lambda dump: principal_point(dump, 4.0),
          ("principal point",)),
    Fault("height", "height of s01-t08 wrong by 300 m", height, ("Height", "s01-t08")),
)
# fmt: on


def calibrated(fault: Fault, folder: Path, base: Path | None) -> tuple[Path, str]:
    """The result's folder and what the program printed."""
    dump, out = folder / fault.name / "dump", folder / fault.name / "result"
    shutil.rmtree(folder / fault.name, ignore_errors=True)
    shutil.copytree(FIXTURE, dump, ignore=shutil.ignore_patterns("truth"))
    fault.make(dump)
    if base is not None:  # finished exposures and strips that the fault does not touch
        with claimed(out, [dump], Settings()):
            pass
        shutil.copytree(base / "work", out / "work")
    command = [sys.executable, "-m", "boresight", "calibrate", str(dump), "--out", str(out), "--workers", "1"]
    ran = subprocess.run([*command, "--accept", "refuted"], capture_output=True, text=True)
    return out, ran.stdout + ran.stderr


def screenshot(page: Path, picture: Path, link: str) -> None:
    """The first 1280 x 900 px, with the card `link` opened."""
    picture.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as profile:
        command = [str(chromium()), "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command += [f"--user-data-dir={profile}", "--window-size=1280,900", f"--screenshot={picture}"]
        address = page.resolve().as_uri() + (f"#{link}" if link else "")
        subprocess.run([*command, address], check=True, capture_output=True, timeout=120)
    with Image.open(picture) as image:
        small = image.convert("RGB").resize((1024, 720), Image.Resampling.LANCZOS)
    small.quantize(48).save(picture, optimize=True)


def first_screen(page: str) -> str:
    """Text of the header: everything above the sections."""
    header = page[page.index("<header>") : page.index("</header>")]
    header = re.sub(r"<svg.*?</svg>", " ", header, flags=re.DOTALL)
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", header)))


def said(page: str, opened: str) -> Iterator[str]:
    """Verdict, what is to be looked at, and the reason on the card."""
    header = page[page.index("<header>") : page.index("</header>")]
    for kind, inner in (("verdict", r'<p class="verdict.*?</strong>'), ("says", r"<li>.*?</li>")):
        part = header.partition('<div class="buttons">')[0]  # the map has lists of its own
        for found in re.findall(inner, part, flags=re.DOTALL):
            yield f"{kind:10s}{plain(found)}"
    if opened:
        yield f"{'card':10s}{opened[:240]}"


def plain(text: str) -> str:
    """HTML as one line of text."""
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", "", text))).strip()


def card(page: str, item: str) -> tuple[str, str]:
    """Id and text of the card of a target, empty where there is none."""
    for link, text in re.findall(r'<article id="(t\d+)"[^>]*>(.*?)</article>', page, flags=re.DOTALL):
        words = plain(text)
        if item and f"{item}," in words:
            return link, words
    return "", ""


def lines(folder: Path, images: Path | None, only: list[str] | None) -> Iterator[str]:
    base, _ = calibrated(Fault("none", "", lambda dump: None, ()), folder, None)
    page = (base / "report.html").read_text(encoding="utf-8")
    found = list(said(page, ""))
    record.verdict(
        f"page without a fault: {'; '.join(found)}",
        "Consistent",
        len(found) == 1 and found[0].startswith("verdict   Consistent:"),
    )
    for fault in FAULTS:
        if only and fault.name not in only:
            continue
        out, printed = calibrated(fault, folder, base)
        path = out / "report.html"
        if not path.is_file():
            record.verdict(f"{fault.name}: no page, {printed.strip()[:80]}", "a page", False)
            continue
        page = path.read_text(encoding="utf-8")
        link, opened = card(page, fault.item)
        text = first_screen(page)
        missing = [word for word in fault.words if word not in text + opened]
        text = f"page of the fault {fault.name}: {len(missing)} words missing"
        record.verdict(text, ", ".join(fault.words), not missing)
        yield "\n".join([f"{fault.name}: {fault.made}", *(f"    {line}" for line in said(page, opened))])
        if images is not None:
            screenshot(path, images / f"{fault.name}.png", link)


def main() -> None:
    arguments = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    arguments.add_argument("--images", type=Path, help="folder for pictures; Chromium draws them")
    arguments.add_argument("--only", nargs="*")
    given = arguments.parse_args()
    record.head("Ten prepared faults, and four smaller ones: what the report says")
    with tempfile.TemporaryDirectory() as folder:
        for line in lines(Path(folder), given.images, given.only):
            print(line, flush=True)
    sys.exit(record.exit_status())


if __name__ == "__main__":
    main()
