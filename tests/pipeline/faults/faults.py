"""Faults of the inputs of a dump, one at a time, made by changing its files alone.

`faults_of(dump, rng)` gives every kind that a dump can have in each strip, CCD, head or target that it can
hit, of a size that `rng` draws: from what its data just show to 30 times that. A size is in the unit of its
kind; the smallest is some six standard deviations of the strip, CCD or campaign as the dump states its
errors.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from edits import repaint
from scipy.spatial.transform import Rotation

__all__ = ["Facts", "Fault", "change", "faults_of", "repaint", "sized", "table", "write"]

LARGEST = 30.0  # times the smallest size
EARTH_RAD_S = 7.292115e-5
REVOLUTION_S = 5710.0  # at 530 km
GROUND_M = 6.4  # a pixel of the strips on the ground
LEAP_S = {"TAI": 37, "GPS": 18, "TT": 69.184}  # ahead of UTC at the dumps' date
Make = Callable[[Path], None]


@dataclass(frozen=True)
class Fault:
    """One fault. `words` are regular expressions, all of which what is named first must match."""

    kind: str
    item: str  # what is wrong: a strip, "CCD 0", a head, a target; "" for all
    size: float  # in `unit`
    unit: str
    times: float  # the smallest size
    make: Make
    words: tuple[str, ...]
    blind: str = ""  # regular expression of an entry of what the result cannot see
    own: tuple[str, ...] = ()  # items that may be accused
    other_words: tuple[str, ...] = ()  # of a second fault: what is named first must match these or `words`
    harmless: bool = False  # nothing is wrong: no finding of a fault is right

    @property
    def name(self) -> str:
        return f"{self.kind} {self.item} {self.size:+.6g} {self.unit}".replace("  ", " ").strip()


# ---- changing files ----


def table(path: Path) -> list[list[str]]:
    """Rows of a CSV, its header first."""
    with path.open(newline="") as stream:
        return list(csv.reader(stream))


def write(path: Path, rows: Iterable[list[str]]) -> None:
    """Write rows as a new file: the old one may be a link."""
    rows = list(rows)
    path.unlink()
    with path.open("w", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows(rows)


def write_text(path: Path, text: str) -> None:
    """The same for text."""
    path.unlink()
    path.write_text(text)


def change(path: Path, old: str, new: str) -> None:
    """Replace a regular expression in a text, which must occur."""
    text, n = re.subn(old, new, path.read_text())
    if n == 0:
        raise ValueError(f"{path.name} has no {old}")
    write_text(path, text)


def edited(name: str, edit: Callable[[dict[str, str]], None], dump: Path) -> None:
    """Apply `edit` to every row of a table."""
    header, *rows = table(dump / name)
    changed = []
    for row in rows:
        cells = dict(zip(header, row))
        edit(cells)
        changed.append([cells[column] for column in header])
    write(dump / name, [header, *changed])


def later(utc: str, seconds: float) -> str:
    """An instant so much later."""
    moved = np.datetime64(utc.removesuffix("Z"), "ns") + np.timedelta64(round(seconds * 1e9), "ns")
    return str(moved)


def toml_number(name: str, key: str, edit: Callable[[float], float], which: int | None, dump: Path) -> None:
    """Change the number of a key: its occurrence `which` from 0, None for all."""
    pattern = re.compile(rf"(?m)^({key} = )([-+.\de]+)$")
    count = -1

    def replaced(found: re.Match[str]) -> str:
        nonlocal count
        count += 1
        if which not in (None, count):
            return found.group()
        return f"{found.group(1)}{float(edit(float(found.group(2))))!r}"

    write_text(dump / name, pattern.sub(replaced, (dump / name).read_text()))


def ground_moved(listed: str, strips: tuple[str, ...], axis: str, metres: float, dump: Path) -> None:
    """Targets of some strips, of all where none is named, moved east, north or in height."""

    def edit(row: dict[str, str]) -> None:
        if strips and row.get("strip", row["id"].partition("-")[0]) not in strips:
            return
        if axis == "height":
            row["height_m"] = repr(float(row["height_m"]) + metres)
            return
        narrow = np.cos(np.radians(float(row["lat_deg"]))) if axis == "east" else 1.0
        column = "lon_deg" if axis == "east" else "lat_deg"
        row[column] = f"{float(row[column]) + metres / (111_200.0 * narrow):.10f}"

    edited(listed, edit, dump)


def rows_late(strips: Iterable[str], seconds: float, dump: Path) -> None:
    """Rows of some strips dated later."""

    def edit(row: dict[str, str]) -> None:
        if row["id"] in strips:
            row["utc_first_row"] = later(row["utc_first_row"], seconds)

    edited("strips.csv", edit, dump)


def period(strips: Iterable[str], relative: float, dump: Path) -> None:
    """The row period of some strips, longer by a part of it."""

    def edit(row: dict[str, str]) -> None:
        if row["id"] in strips:
            row["row_period_s"] = repr(float(row["row_period_s"]) * (1.0 + relative))

    edited("strips.csv", edit, dump)


def files_exchanged(name: str, pairs: Iterable[tuple[int, int]], dump: Path) -> None:
    """Files of rows of a table, from 0, in each other's place."""
    header, *rows = table(dump / name)
    at = header.index("file")
    for a, b in pairs:
        rows[a][at], rows[b][at] = rows[b][at], rows[a][at]
    write(dump / name, [header, *rows])


def paths_exchanged(one: Path, other: Path) -> None:
    """Two files under each other's name."""
    one.rename(one.with_name("kept"))
    other.rename(one)
    one.with_name("kept").rename(other)


def conjugate(row: dict[str, str]) -> None:
    """The inverse of the rotation of a row."""
    row.update({key: repr(-float(row[key])) for key in ("qx", "qy", "qz")})


def earth_turned(seconds: float, dump: Path) -> None:
    """The orbit as over an Earth so much earlier."""
    R = Rotation.from_rotvec([0.0, 0.0, -EARTH_RAD_S * seconds])

    def edit(t_s: np.ndarray, p: np.ndarray, v: np.ndarray) -> None:
        p[:], v[:] = R.apply(p), R.apply(v)

    states(edit, dump)


def states(edit: Callable[[np.ndarray, np.ndarray, np.ndarray], None], dump: Path) -> None:
    """Change the positions (K, 3), km, and velocities of the orbit; its times (K,) are given in s."""
    head, mark, body = (dump / "orbit.oem").read_text().partition("META_STOP\n")
    rows = [line.split() for line in body.splitlines() if line.strip()]
    times = np.array([row[0] for row in rows], dtype="datetime64[ns]")
    t_s = (times - times[0]) / np.timedelta64(1, "s")
    values = np.array([row[1:] for row in rows], dtype=float)
    edit(t_s, values[:, :3], values[:, 3:])
    lines = (" ".join([row[0], *(f"{v:.12f}" for v in value)]) for row, value in zip(rows, values))
    write_text(dump / "orbit.oem", f"{head}{mark}\n" + "\n".join(lines) + "\n")


def dated_later(seconds: float, dump: Path) -> None:
    """All dates of the orbit so much later."""
    text = (dump / "orbit.oem").read_text()
    pattern = r"(?m)^((?:START_TIME|STOP_TIME) = )?(\d{4}-\d\d-\d\dT[\d:.]+)"
    moved = re.sub(pattern, lambda m: (m.group(1) or "") + later(m.group(2), seconds), text)
    write_text(dump / "orbit.oem", moved)


# ---- what a dump has ----


@dataclass(frozen=True)
class Facts:
    """What can be hit in a dump."""

    root: Path
    strips: tuple[str, ...]
    kinds: dict[str, str]
    ccds: int
    heads: tuple[str, ...]  # of attitudes
    ground: tuple[str, ...]  # ids of targets or measured points
    listed: str  # the table of these

    @classmethod
    def of(cls, root: Path) -> Facts:
        header, *rows = table(root / "strips.csv")
        strips = [dict(zip(header, row)) for row in rows]
        heads = re.findall(r'(?m)^name = "(\w+)"', (root / "dump.toml").read_text())
        listed = next((name for name in ("targets.csv", "points.csv") if (root / name).is_file()), "")
        names = tuple(dict.fromkeys(row[0] for row in table(root / listed)[1:])) if listed else ()
        return cls(
            root=root,
            strips=tuple(dict.fromkeys(one["id"] for one in strips)),
            kinds={one["id"]: one.get("kind", "ground") for one in strips},
            ccds=len({one["ccd"] for one in strips}),
            heads=tuple(heads),
            ground=names,
            listed=listed,
        )

    @property
    def images(self) -> bool:
        """Whether strips have images."""
        return (self.root / "strips").is_dir()

    @property
    def star_images(self) -> bool:
        return (self.root / "exposures.csv").is_file()

    def of_ccds(self, ccds: tuple[int, ...], strips: tuple[str, ...]) -> tuple[str, ...]:
        """Ids of the measured points in some CCDs of some strips."""
        if self.listed != "points.csv":
            return ()
        header, *rows = table(self.root / "points.csv")
        cells = [dict(zip(header, row)) for row in rows]
        return tuple(one["id"] for one in cells if int(one["ccd"]) in ccds and one["strip"] in strips)

    @property
    def of_ground(self) -> tuple[str, ...]:
        return tuple(one for one in self.strips if self.kinds[one] == "ground")

    @property
    def of_sky(self) -> tuple[str, ...]:
        return tuple(one for one in self.strips if self.kinds[one] == "sky")


LATE = "late|early|clock|time|ms"


def faults_of(root: Path, rng: np.random.Generator) -> Iterator[Fault]:
    """Every kind of fault in each place of a dump; `rng` draws sizes, signs and targets that are hit."""
    facts = Facts.of(root)
    for maker in (
        _of_times,
        _of_line_camera,
        _of_star_camera,
        _of_orbit,
        _of_attitudes,
        _of_ground,
        _of_lists,
    ):
        yield from maker(facts, rng)


def sized(smallest: float, rng: np.random.Generator, largest: float = LARGEST) -> tuple[float, float]:
    """How many times the smallest size, log-uniform up to the largest, and the size with a sign."""
    times = float(np.exp(rng.uniform(0.0, np.log(largest))))
    return times, float(rng.choice([-1.0, 1.0])) * times * smallest


def _of_times(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Clocks of strips, heads and exposures; row period; the instant of a row."""
    # 2 m of the orbit are 0.27 ms, clocks 0.1 ms; stars of the sky say a row's time to some 0.1 ms.
    for strip in facts.strips:
        times, ms = sized(2.0 if facts.kinds[strip] == "ground" else 1.0, rng)
        make = partial(rows_late, (strip,), 1e-3 * ms)
        blind = "clock|late|time|one.way" if len(facts.strips) == 1 else f"clock of the rows.*{strip}"
        yield Fault("strip clock", strip, ms, "ms", times, make, (strip, LATE), blind, (strip,))
    if len(facts.strips) > 1:
        times, ms = sized(2.0, rng)
        make = partial(rows_late, facts.strips, 1e-3 * ms)
        own = facts.strips
        yield Fault("all strips' clock", "", ms, "ms", times, make, ("all|common", LATE), LATE, own)
    for strip in facts.strips:  # 12 targets, each to 0.08 px, over 2000 rows
        times, part = sized(3e-4, rng)
        make = partial(period, (strip,), part)
        blind = f"row period.*{strip}"
        yield Fault(
            "row period", strip, 100.0 * part, "%", times, make, (strip, "period|rate"), blind, (strip,)
        )
    times, part = sized(3e-4, rng)
    make = partial(period, facts.strips, part)
    own = facts.strips
    yield Fault("all row periods", "", 100.0 * part, "%", times, make, ("period|rate",), "period|rate", own)

    def row_time(stages: int, which: str, dump: Path) -> None:
        change(dump / "remote_camera.toml", "tdi_stages = 1\n", f"tdi_stages = {stages}\n")
        change(dump / "remote_camera.toml", 'time_of_row = "middle"', f'time_of_row = "{which}"')

    for times, stages in ((1.0, 4), (3.0, 16), (30.0, 128)):
        for which in ("start", "end"):
            make, own = partial(row_time, stages, which), facts.strips
            words = ("time_of_row|tdi|" + LATE,)
            yield Fault("time of row", which, 0.5 * stages, "rows", times, make, words, LATE, own)
    if facts.star_images:
        yield from _exposure_times(rng)
    for head in facts.heads:

        def head_late(seconds: float, dump: Path, name: str = head) -> None:
            edited(f"{name}.csv", lambda row: row.update(utc=later(row["utc"], seconds)), dump)

        times, ms = sized(2.0, rng)
        make = partial(head_late, 1e-3 * ms)
        yield Fault("head clock", head, ms, "ms", times, make, (head, LATE), LATE, (head,))
        yield from _rows_dated_wrong(f"{head}.csv", "utc", head, rng)


def _rows_dated_wrong(file: str, column: str, head: str, rng: np.random.Generator) -> Iterator[Fault]:
    """Every second row, or rows at random, dated otherwise than the others."""

    def dated(chosen: Callable[[int], bool], seconds: float, dump: Path) -> None:
        header, *rows = table(dump / file)
        at = header.index(column)
        for k, row in enumerate(rows):
            if chosen(k):
                row[at] = later(row[at], seconds)
        write(dump / file, [header, *rows])

    drawn = rng.random(10_000) < 0.5
    for name, chosen in (("every second", lambda k: k % 2 == 1), ("at random", lambda k: bool(drawn[k]))):
        times, ms = sized(5.0, rng)
        make, words = partial(dated, chosen, 1e-3 * ms), (head.lower() or "exposure", "time")
        yield Fault("rows dated wrong", f"{head} {name}".strip(), ms, "ms", times, make, words, "", (head,))


def _exposure_times(rng: np.random.Generator) -> Iterator[Fault]:
    def exposures_late(seconds: float, dump: Path) -> None:
        edited("exposures.csv", lambda row: row.update(utc_mid=later(row["utc_mid"], seconds)), dump)

    times, ms = sized(2.0, rng)
    make = partial(exposures_late, 1e-3 * ms)
    yield Fault("exposures' clock", "", ms, "ms", times, make, ("exposure|star|all", LATE), LATE)
    yield from _rows_dated_wrong("exposures.csv", "utc_mid", "", rng)

    for times, (first, second) in ((3.0, (4, 5)), (30.0, (2, 9))):
        names = (f"e{first + 1:04d}", f"e{second + 1:04d}")
        make = partial(files_exchanged, "exposures.csv", [(first, second)])
        words = ("|".join(names), "exchang|swap|order|time")
        item = "/".join(names)
        yield Fault("exposure files exchanged", item, second - first, "places", times, make, words, "", names)


def _of_line_camera(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Places and rotations of CCDs, the remote-sensing camera's focal length, files of CCDs."""
    camera, pitch_mm = "remote_camera.toml", 0.12
    for ccd in range(facts.ccds):
        one = (f"CCD {ccd}",)
        for key, kind in (("x_offset_mm", "along"), ("y_first_mm", "across")):
            times, px = sized(0.3, rng)
            make = partial(toml_number, camera, key, lambda v, px=px: v + px * pitch_mm, ccd)
            words = (f"ccd {ccd}\\b", f"{kind}|{key}|place|look")
            # one CCD along the track is Z itself where few targets stand against it
            yield Fault(f"CCD {kind}", one[0], px, "px", times, make, words, f"ccd {ccd}", one)
        times, mrad = sized(2.0, rng)
        make = partial(toml_number, camera, "rotation_mrad", lambda v, mrad=mrad: v + mrad, ccd)
        words = (f"ccd {ccd}\\b", "rotat|turn")
        yield Fault("CCD rotation", one[0], mrad, "mrad", times, make, words, f"ccd {ccd}", one)
    every = tuple(f"CCD {ccd}" for ccd in range(facts.ccds))
    for kind, edit in (("x offsets zero", lambda v: 0.0 * v), ("x offsets' signs", lambda v: -v)):
        make = partial(toml_number, camera, "x_offset_mm", edit, None)
        yield Fault(kind, "", 20.0, "mm", 30.0, make, ("ccd|look", "x_offset|along|remote_camera"), "", every)
    times, part = sized(1.5e-4, rng)
    make = partial(toml_number, camera, "focal_length_m", lambda v, part=part: v * (1.0 + part), None)
    words = ("focal|scale|remote_camera|height",)
    yield Fault("remote focal length", "", 100.0 * part, "%", times, make, words, "focal|scale|radial", every)

    def exchanged(strip: str, first: int, second: int, dump: Path) -> None:
        """Files, or for measured points the CCDs that they are said to be on."""
        if facts.images:
            header, *rows = table(dump / "strips.csv")
            id_at, ccd_at, file_at = map(header.index, ("id", "ccd", "file"))
            own = {row[ccd_at]: row for row in rows if row[id_at] == strip}
            a, b = own[str(first)], own[str(second)]
            a[file_at], b[file_at] = b[file_at], a[file_at]
            write(dump / "strips.csv", [header, *rows])
            return
        other = {str(first): str(second), str(second): str(first)}

        def edit(row: dict[str, str]) -> None:
            if row["strip"] == strip:
                row["ccd"] = other.get(row["ccd"], row["ccd"])

        edited("points.csv", edit, dump)

    def exchanged_in_all(first: int, second: int, dump: Path) -> None:
        for strip in facts.strips:
            exchanged(strip, first, second, dump)

    for strip in facts.strips:
        first = int(rng.integers(0, facts.ccds - 1))
        make, own = partial(exchanged, strip, first, first + 1), (f"CCD {first}", f"CCD {first + 1}", strip)
        own = (*own, *facts.of_ccds((first, first + 1), (strip,)))
        words = (strip, f"ccd {first}\\b|ccds? {first} and", "exchang|swap|file")
        yield Fault(
            "CCD files exchanged", f"{strip} CCD {first}/{first + 1}", 1, "files", 30.0, make, words, "", own
        )
    if len(facts.strips) > 1:
        make = partial(exchanged_in_all, 0, 1)
        words = ("ccds? 0\\b", "exchang|swap|file")
        item = "CCD 0/1"
        yield Fault(
            "CCD files exchanged", item, 1, "files", 30.0, make, words, "", ("CCD 0", "CCD 1", *facts.strips)
        )
    if facts.images:
        yield from _of_strip_images(facts, rng)


def _of_strip_images(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    def painted(
        strips: tuple[str, ...], ccds: tuple[int, ...], paint: Callable[..., np.ndarray], dump: Path
    ) -> None:
        for strip in strips:
            for ccd in ccds:
                repaint(dump / f"strips/{strip}_ccd{ccd}.tif", paint)

    every = tuple(range(facts.ccds))
    for strip in facts.strips[:2]:
        for kind, paint in (
            ("rows reversed", lambda image: np.ascontiguousarray(image[::-1])),
            ("columns reversed", lambda image: np.ascontiguousarray(image[:, ::-1])),
        ):
            words = (strip, "mirror|revers|order|image")
            yield Fault(
                kind, strip, 1, "strip", 30.0, partial(painted, (strip,), every, paint), words, "", (strip,)
            )
    ccd = int(rng.integers(0, facts.ccds))
    dead = partial(painted, facts.strips, (ccd,), lambda image: np.full_like(image, 3))
    words = (f"ccd {ccd}\\b", "dead|grey|empty|image")
    yield Fault("dead CCD", f"CCD {ccd}", 1, "CCD", 30.0, dead, words, "", (f"CCD {ccd}", *facts.strips))
    for times, gain in ((3.0, 0.5), (30.0, 0.2)):

        def dim(image: np.ndarray, gain: float = gain) -> np.ndarray:
            return np.round(gain * image).astype(image.dtype)

        ccd = int(rng.integers(0, facts.ccds))
        make = partial(painted, facts.strips, (ccd,), dim)
        words = ()
        item = f"CCD {ccd}"
        yield Fault(
            "sensitivity of a CCD",
            item,
            gain,
            "times",
            times,
            make,
            words,
            "",
            (f"CCD {ccd}",),
            harmless=True,
        )
    if len(facts.of_ground) > 1:

        def other_strip(dump: Path) -> None:
            a, b = facts.of_ground[:2]
            for name in every:
                paths_exchanged(*(dump / f"strips/{strip}_ccd{name}.tif" for strip in (a, b)))

        own = facts.of_ground[:2]
        words = ("|".join(own),)
        yield Fault(
            "files of two strips exchanged", "/".join(own), 1, "pair", 30.0, other_strip, words, "", own
        )


def _of_star_camera(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    if not facts.star_images:
        return
    camera, star = "star_camera.toml", "star camera|star_camera"
    times, part = sized(2e-5, rng)
    make = partial(toml_number, camera, "focal_length_mm", lambda v, part=part: v * (1.0 + part), None)
    yield Fault("star focal length", "", 100.0 * part, "%", times, make, (star, "focal"), "star.*focal")

    def principal(dx: float, dy: float, dump: Path) -> None:
        text = (dump / camera).read_text()
        found = re.search(r"principal_point_px = \[\s*([\d.]+),\s*([\d.]+),?\s*\]", text)
        x, y = (float(value) for value in found.groups())
        new = f"principal_point_px = [{x + dx}, {y + dy}]"
        write_text(dump / camera, text[: found.start()] + new + text[found.end() :])

    times, px = sized(0.5, rng)
    dx, dy = (px, 0.0) if rng.random() < 0.5 else (0.0, px)
    make = partial(principal, dx, dy)
    words = (star, "principal|distortion")
    yield Fault("star principal point", "x" if dx else "y", px, "px", times, make, words, "principal")

    def signs(keys: tuple[str, ...], dump: Path) -> None:
        for key in keys:
            toml_number(camera, key, lambda v: -v, None, dump)

    make = partial(signs, ("q1_per_mm2", "q2_per_mm4"))
    yield Fault("star distortion sign", "q1", 1, "sign", 30.0, make, (star, "distortion|focal"))
    make = partial(signs, ("p1_per_mm", "p2_per_mm"))
    yield Fault("star distortion sign", "p1", 1, "sign", 3.0, make, (star, "distortion|principal"))

    def redrawn(how: Callable[[np.ndarray], np.ndarray], dump: Path) -> None:
        for path in sorted((dump / "exposures").iterdir()):
            image = how(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            path.unlink()
            cv2.imwrite(str(path), np.ascontiguousarray(image))

    make = partial(redrawn, lambda image: image[:, ::-1])
    yield Fault("star images mirrored", "", 1, "", 30.0, make, (star + "|exposure|image", "mirror"))
    make = partial(redrawn, lambda image: image[::-1])
    yield Fault("star images upside down", "", 1, "", 30.0, make, (star + "|exposure|image", "mirror"))
    make = partial(redrawn, lambda image: image[::-1, ::-1])
    words = (star + "|exposure|image|installation", "")
    yield Fault("star images rotated by 180 deg", "", 1, "", 30.0, make, words)


def _of_orbit(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    orbit = "orbit"
    sky_only = not facts.of_ground

    def moved(axis: str, metres: float, after_s: float, before_s: float, dump: Path) -> None:
        def edit(t_s: np.ndarray, p: np.ndarray, v: np.ndarray) -> None:
            up = p / np.linalg.norm(p, axis=1)[:, None]
            along = v - np.sum(v * up, axis=1)[:, None] * up
            along /= np.linalg.norm(along, axis=1)[:, None]
            unit = {"along": along, "across": np.cross(up, along), "radial": up}[axis]
            now = (t_s >= after_s) & (t_s < before_s)
            p[now] += 1e-3 * metres * unit[now]

        states(edit, dump)

    for axis in ("along", "across", "radial"):
        times, metres = sized(12.0 if axis != "radial" else 80.0, rng)
        make = partial(moved, axis, metres, -np.inf, np.inf)
        words = (f"{orbit}|position|datum|clock|time|height", "")
        blind = f"orbit|{axis}"
        yield Fault(
            f"orbit {axis}",
            "",
            metres,
            "m",
            times,
            make,
            words,
            blind,
            harmless=sky_only and abs(metres) < 1e4,
        )
    if not sky_only and len(facts.of_ground) > 1:
        begin = np.datetime64(
            re.search(r"START_TIME = (\S+)", (facts.root / "orbit.oem").read_text())[1], "ns"
        )
        header, *rows = table(facts.root / "strips.csv")
        at = {row[header.index("id")]: row[header.index("utc_first_row")] for row in rows}
        for strip in facts.of_ground:
            t = (np.datetime64(at[strip], "ns") - begin) / np.timedelta64(1, "s")
            for axis in ("along", "across"):
                times, metres = sized(15.0, rng)
                make = partial(moved, axis, metres, t - 8.0, t + 10.0)
                words = (rf"{strip}|orbit\.oem", "orbit|position|clock|time|late|early|point")
                yield Fault(f"orbit of a strip {axis}", strip, metres, "m", times, make, words, "", (strip,))

    yield Fault("orbit of the next day", "", 1, "day", 30.0, partial(dated_later, 86400.0), ("orbit.oem",))
    yield Fault(
        "orbit of the day before", "", -1, "day", 30.0, partial(dated_later, -86400.0), ("orbit.oem",)
    )
    make, words = partial(earth_turned, REVOLUTION_S), (orbit,)
    blind = "velocity of the orbit" if sky_only else ""
    yield Fault("orbit of the next revolution", "", 1, "", 30.0, make, words, blind)
    make, words = partial(earth_turned, -REVOLUTION_S), (orbit,)
    blind = "velocity of the orbit" if sky_only else ""
    yield Fault("orbit of the revolution before", "", -1, "", 30.0, make, words, blind)
    for frame in ("GCRF", "EME2000"):
        make = partial(_oem_key, "REF_FRAME", frame)
        yield Fault("orbit frame", frame, 1, "", 30.0, make, (orbit, "frame"))
    for scale, ahead_s in LEAP_S.items():
        make = partial(_oem_key, "TIME_SYSTEM", scale)
        words = (orbit, "time|scale|clock|s\\b")
        yield Fault("orbit time scale", scale, ahead_s, "s", 30.0, make, words, harmless=sky_only)

    def mirrored(axis: int, dump: Path) -> None:
        def edit(t_s: np.ndarray, p: np.ndarray, v: np.ndarray) -> None:
            p[:, axis] *= -1.0
            v[:, axis] *= -1.0

        states(edit, dump)

    for axis in range(3):
        make, words = partial(mirrored, axis), (orbit,)
        blind = "velocity of the orbit" if sky_only else ""
        yield Fault("orbit mirrored", "xyz"[axis], 1, "sign", 30.0, make, words, blind)


def _oem_key(key: str, value: str, dump: Path) -> None:
    change(dump / "orbit.oem", rf"(?m)^{key} = .*$", f"{key} = {value}")


def _of_attitudes(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Conventions of heads that state attitudes, and the pre-launch matrix."""
    Q = ("qx", "qy", "qz", "qw")

    def stated(edit: Callable[[dict[str, str]], None], name: str, dump: Path) -> None:
        edited(f"{name}.csv", edit, dump)

    def scalar_first(row: dict[str, str]) -> None:
        x, y, z, w = (row[key] for key in Q)
        row.update(qx=w, qy=x, qz=y, qw=z)

    def label(which: int, old: str, new: str, dump: Path) -> None:
        text = (dump / "dump.toml").read_text()
        parts = text.split(old)
        text = old.join(parts[: which + 1]) + new + old.join(parts[which + 1 :])
        write_text(dump / "dump.toml", text)

    for n, head in enumerate(facts.heads):
        own = (head,)
        words = (head, "conjugat|invers|rotation|quaternion")
        yield Fault("attitude conjugate", head, 1, "", 30.0, partial(stated, conjugate, head), words, "", own)
        words = (head, "scalar|quaternion|order")
        yield Fault(
            "attitude scalar first", head, 1, "", 30.0, partial(stated, scalar_first, head), words, "", own
        )
        for new in ("none", "annual"):
            make = partial(label, n, '"annual and orbital"', f'"{new}"')
            size = 20.0 if new == "none" else 5.2
            words = (head, "aberration")
            blind = "aberration|attitude"
            item = f"{head} {new}"
            yield Fault(
                "aberration label",
                item,
                size,
                "arcsec",
                30.0 if new == "none" else 3.0,
                make,
                words,
                blind,
                own,
            )
        make = partial(label, n, '"head to inertial"', '"inertial to head"')
        yield Fault("rotation label", head, 1, "", 30.0, make, (head, "rotation|conjugat|invers"), "", own)

        def rotated(axis: int, arcsec: float, name: str, dump: Path) -> None:
            turn = Rotation.from_rotvec(np.eye(3)[axis] * np.radians(arcsec / 3600.0))
            middle = table(dump / f"{name}.csv")
            half = middle[len(middle) // 2][0]  # the second half of its attitudes: a mounting that moved

            def edit(row: dict[str, str]) -> None:
                if row["utc"] >= half:
                    q = Rotation.from_quat([float(row[key]) for key in Q]) * turn
                    row.update(zip(Q, map(repr, q.as_quat().tolist())))

            edited(f"{name}.csv", edit, dump)

        times, arcsec = sized(6.0, rng)
        make = partial(rotated, 0, arcsec, head)
        words = (head,)
        blind = "attitude|head"
        yield Fault("head moves", head, arcsec, "arcsec", times, make, words, blind, (*own, *facts.strips))
    if len(facts.heads) == 2:

        def exchanged(dump: Path) -> None:
            paths_exchanged(*(dump / f"{head}.csv" for head in facts.heads))

        words = ("head|attitude|" + "|".join(facts.heads),)
        yield Fault("heads exchanged", "", 1, "pair", 30.0, exchanged, words, "", facts.heads)

    def installation(dump: Path) -> None:
        name = f"installation_{facts.heads[0]}.toml" if facts.heads else "installation.toml"
        text = (dump / name).read_text()
        found = re.search(r"quaternion_cs = \[([^\]]*)\]", text)
        values = [float(value) for value in found.group(1).split(",") if value.strip()]
        new = [-values[0], -values[1], -values[2], values[3]]
        write_text(dump / name, text[: found.start()] + f"quaternion_cs = {new}" + text[found.end() :])

    own = facts.heads[:1]  # whose file it is
    yield Fault("installation conjugate", "", 1, "", 30.0, installation, ("installation",), "", own)


def _of_ground(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Coordinates, heights and chips of targets, or coordinates of measured points."""
    if not facts.listed:
        return
    listed, metres_per_deg = facts.listed, 111_200.0
    in_chips = listed == "targets.csv"  # then a target is another point of its chip, and seen where it is

    def one(name: str, edit: Callable[[dict[str, str]], None], dump: Path) -> None:
        edited(listed, lambda row: edit(row) if row["id"] == name else None, dump)

    def add(column: str, amount: float, row: dict[str, str]) -> None:
        row[column] = f"{float(row[column]) + amount:.10f}"

    times, px = sized(1.0, rng)
    name = str(rng.choice(facts.ground))
    column, scale = ("lat_deg", metres_per_deg) if rng.random() < 0.5 else ("lon_deg", 0.81 * metres_per_deg)
    make = partial(one, name, partial(add, column, px * GROUND_M / scale))
    words = (name, column + "|coordinate")
    yield Fault(
        "target coordinate", name, px * GROUND_M, "m", times, make, words, "", (name,), harmless=in_chips
    )
    for digit in (0, 1, 2):

        def typo(row: dict[str, str], digit: int = digit) -> None:
            """Two neighbouring digits exchanged."""
            text = row["lon_deg"]
            at = text.index(".") + 1 + digit
            while text[at] == text[at + 1]:
                at += 1
            row["lon_deg"] = text[:at] + text[at + 1] + text[at] + text[at + 2 :]

        name = str(rng.choice(facts.ground))
        make, words = partial(one, name, typo), (name, "lon|coordinate")
        yield Fault("digits exchanged", name, 10.0**-digit, "deg", 30.0, make, words, "", (name,))
    name = str(rng.choice(facts.ground))

    def negative(row: dict[str, str]) -> None:
        row["lon_deg"] = f"-{row['lon_deg']}"

    make = partial(one, name, negative)
    yield Fault("sign of a coordinate", name, 1, "sign", 30.0, make, (name, "lon|coordinate"), "", (name,))
    times, metres = sized(60.0, rng)
    name = str(rng.choice(facts.ground))
    make = partial(one, name, partial(add, "height_m", metres))
    yield Fault("target height", name, metres, "m", times, make, (name,), "height", (name,))
    for axis in ("north", "east"):
        times, metres = sized(12.0, rng)
        make = partial(ground_moved, listed, (), axis, metres)
        words = ("all|common|datum|shift",)
        blind = "shift|target|along|across|orbit"
        yield Fault(f"all targets {axis}", "", metres, "m", times, make, words, blind, harmless=in_chips)
    times, metres = sized(80.0, rng)
    make = partial(edited, listed, partial(add, "height_m", metres))
    yield Fault("all heights", "", metres, "m", times, make, ("height",), "height|radial|scale")

    def kind(dump: Path) -> None:
        def edit(row: dict[str, str]) -> None:
            row["height_kind"] = {"egm96": "ellipsoidal", "ellipsoidal": "egm96"}[row["height_kind"]]

        edited(listed, edit, dump)

    yield Fault("height kind", "", 42.0, "m", 1.0, kind, ("height",), "height|radial|scale")

    def feet(row: dict[str, str]) -> None:
        row["height_m"] = f"{float(row['height_m']) / 0.3048:.4f}"

    yield Fault("heights in feet", "", 3.28, "times", 30.0, partial(edited, listed, feet), ("height",))

    def exchanged(dump: Path) -> None:
        def edit(row: dict[str, str]) -> None:
            row["lat_deg"], row["lon_deg"] = row["lon_deg"][:2] + row["lon_deg"][3:], row["lat_deg"]

        edited(listed, edit, dump)

    yield Fault(
        "latitude and longitude exchanged", "", 1, "", 30.0, exchanged, ("lat|lon|coordinate|target",)
    )
    if listed == "targets.csv":
        yield from _of_chips(facts, rng)


def _of_chips(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    def shifted(names: tuple[str, ...], metres: float, dump: Path) -> None:
        for name in names:
            repaint(dump / f"chips/{name}.tif", lambda image: image, metres)

    times, metres = sized(GROUND_M, rng)
    name = str(rng.choice(facts.ground))
    make = partial(shifted, (name,), metres)
    yield Fault("chip shifted", name, metres, "m", times, make, (name, "chip"), "", (name,))
    times, metres = sized(12.0, rng)
    make, words = partial(shifted, facts.ground, metres), ("all|common|datum|shift",)
    yield Fault("all chips shifted", "", metres, "m", times, make, words, "shift|target|along|across|orbit")

    def exchanged(a: str, b: str, dump: Path) -> None:
        files = {a: f"chips/{b}.tif", b: f"chips/{a}.tif"}
        edited("targets.csv", lambda row: row.update(chip=files.get(row["id"], row["chip"])), dump)

    a, b = map(str, rng.choice([one for one in facts.ground if one.startswith("s01")], 2, replace=False))
    make = partial(exchanged, a, b)
    yield Fault("chips exchanged", f"{a}/{b}", 1, "pair", 30.0, make, (f"{a}|{b}", "chip"), "", (a, b))


def _of_lists(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """What is listed twice, and lists that are short."""

    def strips_again(copies: int, dump: Path) -> None:
        header, *rows = table(dump / "strips.csv")
        more = [[f"{row[0]}x{n}", *row[1:]] for n in range(1, copies) for row in rows]
        write(dump / "strips.csv", [header, *rows, *more])
        if facts.listed == "points.csv":
            header, *rows = table(dump / "points.csv")
            more = [[row[0], f"{row[1]}x{n}", *row[2:]] for n in range(1, copies) for row in rows]
            write(dump / "points.csv", [header, *rows, *more])

    for times, copies in ((3.0, 3), (30.0, 9)):
        make, words = partial(strips_again, copies), ("strip|same|twice|repeat|duplicat",)
        yield Fault("strips repeated", "", copies, "times", times, make, words, "", ("*",), harmless=True)
    if facts.listed:

        def targets_again(copies: int, metres: float, dump: Path) -> None:
            header, *rows = table(dump / facts.listed)
            lat, more = header.index("lat_deg"), []
            for n in range(1, copies):
                for row in rows:
                    new = list(row)
                    new[0] = f"{row[0]}x{n}"
                    new[lat] = f"{float(row[lat]) + n * metres / 111_200.0:.10f}"
                    more.append(new)
            write(dump / facts.listed, [header, *rows, *more])

        for times, metres in ((30.0, 0.0), (3.0, 0.02)):
            make, words = partial(targets_again, 3, metres), ("target|same|twice|repeat|duplicat",)
            item = f"{metres} m apart"
            yield Fault("targets repeated", item, 3, "times", times, make, words, "", ("*",), harmless=True)

        def few(names: frozenset[str], dump: Path) -> None:
            header, *rows = table(dump / facts.listed)
            write(dump / facts.listed, [header, *(row for row in rows if row[0] in names)])

        for n in (2, 3, 4):
            names = frozenset(map(str, rng.choice(facts.ground, n, replace=False)))
            make, words = partial(few, names), ("few|redundan|check|degree",)
            yield Fault("few targets", "", n, "targets", 30.0, make, words, harmless=True)
    if facts.star_images:

        def exposures_again(copies: int, dump: Path) -> None:
            header, *rows = table(dump / "exposures.csv")
            at, more = header.index("utc_mid"), []
            for row in rows:
                for n in range(copies):
                    new = list(row)
                    new[0], new[at] = f"{row[0]}x{n}" if n else row[0], later(row[at], 1e-3 * n)
                    more.append(new)
            write(dump / "exposures.csv", [header, *more])

        make, words = partial(exposures_again, 2), ("exposure|same|twice|repeat|duplicat",)
        yield Fault("exposures repeated", "", 2, "times", 30.0, make, words, "", ("*",), harmless=True)

    def thinned(keep: int, dump: Path) -> None:
        """So many exposures or attitudes of each strip, evenly over it."""
        names = [f"{head}.csv" for head in facts.heads] or ["exposures.csv"]
        for name in names:
            header, *rows = table(dump / name)
            at = header.index("utc") if "utc" in header else header.index("utc_mid")
            t_s = np.array([row[at] for row in rows], dtype="datetime64[ns]").astype(float) / 1e9
            group = np.concatenate([[0], np.cumsum(np.diff(t_s) > 5.0)])
            left = []
            for n in range(group[-1] + 1):
                own = np.flatnonzero(group == n)
                left += own[np.unique(np.round(np.linspace(0, len(own) - 1, keep)).astype(int))].tolist()
            write(dump / name, [header, *(rows[k] for k in left)])

    for times, keep in ((30.0, 2), (3.0, 4)):
        make = partial(thinned, keep)
        yield Fault("few exposures", "", keep, "a strip", times, make, ("exposure|attitude",), harmless=True)
    if facts.of_ground:
        for key in ("light_time", "aberration", "refraction"):

            def light(dump: Path, key: str = key) -> None:
                text = "".join(
                    f"{one} = {'false' if one == key else 'true'}\n"
                    for one in ("light_time", "aberration", "refraction")
                )
                with (dump / "dump.toml").open() as stream:
                    before = stream.read()
                head, mark, heads = before.partition("[[star_cameras]]")
                write_text(dump / "dump.toml", f"{head}\n[light]\n{text}\n{mark}{heads}")

            # Aberration moves a target by 13 m, light time and refraction by 1 m near nadir: 2 m are stated.
            times = 3.0 if key == "aberration" else 0.5
            yield Fault("light", key, 1, "", times, light, ("light|aberration|refraction",), f"light|{key}")
