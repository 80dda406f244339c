"""Faults of the inputs of a dump, one at a time, made by changing its files alone.

`faults_of(dump, rng)` gives every kind that a dump can have in each strip, CCD, head or target that it can
hit, of a size that `rng` draws: from what its data just show to 30 times that. A size is in the unit of its
kind; the smallest is some six standard deviations of the strip, CCD or campaign as the dump states its
errors. A mistake without a size counts as 30 times the smallest.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from edits import repaint, rows_of, write_rows
from scipy.spatial.transform import Rotation

__all__ = ["Facts", "Fault", "change", "changed_rows", "edited", "faults_of", "later", "repaint", "sized"]

LARGEST = 30.0  # times the smallest size
EARTH_RAD_S = 7.292115e-5
REVOLUTION_S = 5710.0  # at 530 km
GROUND_M = 6.4  # a pixel of the strips on the ground
LEAP_S = {"TAI": 37, "GPS": 18, "TT": 69.184}  # ahead of UTC at the dumps' date
Q = ("qx", "qy", "qz", "qw")
LATE = "late|early|clock|time|ms"
Make = Callable[[Path], None]
Row = dict[str, str]


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


def write_text(path: Path, text: str) -> None:
    """Write a text as a new file: the old one may be a link."""
    path.unlink()
    path.write_text(text)


def change(path: Path, old: str, new: str) -> None:
    """Replace a regular expression in a text, which must occur."""
    text, n = re.subn(old, new, path.read_text())
    if n == 0:
        raise ValueError(f"{path.name} has no {old}")
    write_text(path, text)


def changed_rows(name: str, changed: Callable[[list[Row]], Iterable[Row]], dump: Path) -> None:
    """Put other rows in the place of those of a table."""
    write_rows(dump / name, list(changed(rows_of(dump / name))))


def edited(name: str, edit: Callable[[Row], object], dump: Path) -> None:
    """Apply `edit` to every row of a table."""

    def all_edited(rows: list[Row]) -> list[Row]:
        for row in rows:
            edit(row)
        return rows

    changed_rows(name, all_edited, dump)


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

    def edit(row: Row) -> None:
        if strips and row.get("strip", row["id"].partition("-")[0]) not in strips:
            return
        if axis == "height":
            row["height_m"] = repr(float(row["height_m"]) + metres)
            return
        narrow = np.cos(np.radians(float(row["lat_deg"]))) if axis == "east" else 1.0
        add("lon_deg" if axis == "east" else "lat_deg", metres / (111_200.0 * narrow), row)

    edited(listed, edit, dump)


def add(column: str, amount: float, row: Row) -> None:
    """A larger number in a column."""
    row[column] = f"{float(row[column]) + amount:.10f}"


def rows_late(strips: Iterable[str], seconds: float, dump: Path) -> None:
    """Rows of some strips dated later."""
    chosen, column = tuple(strips), "utc_first_row"
    edited(
        "strips.csv",
        lambda row: row["id"] in chosen and row.update({column: later(row[column], seconds)}),
        dump,
    )


def period(strips: Iterable[str], relative: float, dump: Path) -> None:
    """The row period of some strips, longer by a part of it."""

    def edit(row: Row) -> None:
        if row["id"] in strips:
            row["row_period_s"] = repr(float(row["row_period_s"]) * (1.0 + relative))

    edited("strips.csv", edit, dump)


def files_exchanged(name: str, pairs: Iterable[tuple[int, int]], dump: Path) -> None:
    """Files of rows of a table, from 0, in each other's place."""

    def exchanged(rows: list[Row]) -> list[Row]:
        for a, b in pairs:
            rows[a]["file"], rows[b]["file"] = rows[b]["file"], rows[a]["file"]
        return rows

    changed_rows(name, exchanged, dump)


def paths_exchanged(one: Path, other: Path) -> None:
    """Two files under each other's name."""
    one.rename(one.with_name("kept"))
    other.rename(one)
    one.with_name("kept").rename(other)


def conjugate(row: Row) -> None:
    """The inverse of the rotation of a row."""
    row.update({key: repr(-float(row[key])) for key in Q[:3]})


def turned_by(row: Row, turn: Rotation) -> None:
    """The rotation of a row after a turn of the head."""
    q = Rotation.from_quat([float(row[key]) for key in Q]) * turn
    row.update(zip(Q, map(repr, q.as_quat().tolist())))


def earth_turned(seconds: float, dump: Path) -> None:
    """The orbit as over an Earth so much earlier."""
    R = Rotation.from_rotvec([0.0, 0.0, -EARTH_RAD_S * seconds])

    def edit(t_s: np.ndarray, p: np.ndarray, v: np.ndarray) -> None:
        p[:], v[:] = R.apply(p), R.apply(v)

    states(edit, dump)


def orbit_mirrored(axis: int, dump: Path) -> None:
    """One coordinate of positions and velocities with its other sign."""

    def edit(t_s: np.ndarray, p: np.ndarray, v: np.ndarray) -> None:
        p[:, axis] *= -1.0
        v[:, axis] *= -1.0

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


def redrawn(how: Callable[[np.ndarray], np.ndarray], dump: Path) -> None:
    """All star images with other pixels."""
    for path in sorted((dump / "exposures").iterdir()):
        image = how(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        path.unlink()
        cv2.imwrite(str(path), np.ascontiguousarray(image))


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
        strips = rows_of(root / "strips.csv")
        listed = next((name for name in ("targets.csv", "points.csv") if (root / name).is_file()), "")
        return cls(
            root=root,
            strips=tuple(dict.fromkeys(one["id"] for one in strips)),
            kinds={one["id"]: one.get("kind", "ground") for one in strips},
            ccds=len({one["ccd"] for one in strips}),
            heads=tuple(re.findall(r'(?m)^name = "(\w+)"', (root / "dump.toml").read_text())),
            ground=tuple(dict.fromkeys(row["id"] for row in rows_of(root / listed))) if listed else (),
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
        rows = rows_of(self.root / "points.csv") if self.listed == "points.csv" else ()
        return tuple(one["id"] for one in rows if int(one["ccd"]) in ccds and one["strip"] in strips)

    def of_kind(self, kind: str) -> tuple[str, ...]:
        """Strips of the "ground" or of the "sky"."""
        return tuple(one for one in self.strips if self.kinds[one] == kind)


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


def mistake(
    kind: str, item: str, make: Make, words: tuple[str, ...], own: tuple[str, ...] = (), **more: object
) -> Fault:
    """A fault without a size, or of the one that `more` states."""
    return Fault(
        **{"size": 1, "unit": "", "times": LARGEST} | more,
        kind=kind,
        item=item,
        make=make,
        words=words,
        own=own,
    )


def _of_times(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Clocks of strips, heads and exposures; row period; the instant of a row."""
    # 2 m of the orbit are 0.27 ms, clocks 0.1 ms; stars of the sky say a row's time to some 0.1 ms.
    every = facts.strips
    for strip in every:
        times, ms = sized(2.0 if facts.kinds[strip] == "ground" else 1.0, rng)
        make = partial(rows_late, (strip,), 1e-3 * ms)
        blind = "clock|late|time|one.way" if len(every) == 1 else f"clock of the rows.*{strip}"
        yield Fault("strip clock", strip, ms, "ms", times, make, (strip, LATE), blind, (strip,))
    if len(every) > 1:
        times, ms = sized(2.0, rng)
        make = partial(rows_late, every, 1e-3 * ms)
        yield Fault("all strips' clock", "", ms, "ms", times, make, ("all|common", LATE), LATE, every)
    for strip in every:  # 12 targets, each to 0.08 px, over 2000 rows
        (times, part), words = sized(3e-4, rng), (strip, "period|rate")
        make, blind = partial(period, (strip,), part), f"row period.*{strip}"
        yield Fault("row period", strip, 100.0 * part, "%", times, make, words, blind, (strip,))
    (times, part), words = sized(3e-4, rng), "period|rate"
    make = partial(period, every, part)
    yield Fault("all row periods", "", 100.0 * part, "%", times, make, (words,), words, every)

    def row_time(stages: int, which: str, dump: Path) -> None:
        change(dump / "remote_camera.toml", "tdi_stages = 1\n", f"tdi_stages = {stages}\n")
        change(dump / "remote_camera.toml", 'time_of_row = "middle"', f'time_of_row = "{which}"')

    for times, stages in ((1.0, 4), (3.0, 16), (30.0, 128)):
        for which in ("start", "end"):
            make, words = partial(row_time, stages, which), ("time_of_row|tdi|" + LATE,)
            yield Fault("time of row", which, 0.5 * stages, "rows", times, make, words, LATE, every)
    if facts.star_images:
        yield from _exposure_times(rng)
    for head in facts.heads:
        times, ms = sized(2.0, rng)
        make = partial(_all_later, f"{head}.csv", "utc", 1e-3 * ms)
        yield Fault("head clock", head, ms, "ms", times, make, (head, LATE), LATE, (head,))
        yield from _rows_dated_wrong(f"{head}.csv", "utc", head, rng)


def _all_later(file: str, column: str, seconds: float, dump: Path) -> None:
    edited(file, lambda row: row.update({column: later(row[column], seconds)}), dump)


def _rows_dated_wrong(file: str, column: str, head: str, rng: np.random.Generator) -> Iterator[Fault]:
    """Every second row, or rows at random, dated otherwise than the others."""

    def dated(chosen: Callable[[int], bool], seconds: float, rows: list[Row]) -> list[Row]:
        return [
            row | {column: later(row[column], seconds)} if chosen(k) else row for k, row in enumerate(rows)
        ]

    drawn = rng.random(10_000) < 0.5
    for name, chosen in (("every second", lambda k: k % 2 == 1), ("at random", lambda k: bool(drawn[k]))):
        times, ms = sized(5.0, rng)
        make, words = (
            partial(changed_rows, file, partial(dated, chosen, 1e-3 * ms)),
            (head.lower() or "exposure", "time"),
        )
        yield Fault("rows dated wrong", f"{head} {name}".strip(), ms, "ms", times, make, words, "", (head,))


def _exposure_times(rng: np.random.Generator) -> Iterator[Fault]:
    times, ms = sized(2.0, rng)
    make = partial(_all_later, "exposures.csv", "utc_mid", 1e-3 * ms)
    yield Fault("exposures' clock", "", ms, "ms", times, make, ("exposure|star|all", LATE), LATE)
    yield from _rows_dated_wrong("exposures.csv", "utc_mid", "", rng)

    for times, (first, second) in ((3.0, (4, 5)), (30.0, (2, 9))):
        names = (f"e{first + 1:04d}", f"e{second + 1:04d}")
        make = partial(files_exchanged, "exposures.csv", [(first, second)])
        words, size = ("|".join(names), "exchang|swap|order|time"), second - first
        yield Fault(
            "exposure files exchanged", "/".join(names), size, "places", times, make, words, "", names
        )


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
        (times, mrad), words = sized(2.0, rng), (f"ccd {ccd}\\b", "rotat|turn")
        make = partial(toml_number, camera, "rotation_mrad", lambda v, mrad=mrad: v + mrad, ccd)
        yield Fault("CCD rotation", one[0], mrad, "mrad", times, make, words, f"ccd {ccd}", one)
    every = tuple(f"CCD {ccd}" for ccd in range(facts.ccds))
    for kind, edit in (("x offsets zero", lambda v: 0.0 * v), ("x offsets' signs", lambda v: -v)):
        make, words = (
            partial(toml_number, camera, "x_offset_mm", edit, None),
            ("ccd|look", "x_offset|along|remote_camera"),
        )
        yield mistake(kind, "", make, words, every, size=20.0, unit="mm")
    (times, part), words = sized(1.5e-4, rng), ("focal|scale|remote_camera|height",)
    make = partial(toml_number, camera, "focal_length_m", lambda v, part=part: v * (1.0 + part), None)
    yield Fault("remote focal length", "", 100.0 * part, "%", times, make, words, "focal|scale|radial", every)

    def exchanged(strips: tuple[str, ...], first: int, second: int, dump: Path) -> None:
        """Files, or for measured points the CCDs that they are said to be on."""
        other = {str(first): str(second), str(second): str(first)}
        if not facts.images:
            edited(
                "points.csv",
                lambda row: row["strip"] in strips and row.update(ccd=other.get(row["ccd"], row["ccd"])),
                dump,
            )
            return
        files = {(row["id"], row["ccd"]): row["file"] for row in rows_of(dump / "strips.csv")}

        def edit(row: Row) -> None:
            if row["id"] in strips and row["ccd"] in other:
                row["file"] = files[row["id"], other[row["ccd"]]]

        edited("strips.csv", edit, dump)

    exchange = partial(mistake, "CCD files exchanged", unit="files")
    for strip in facts.strips:
        first = int(rng.integers(0, facts.ccds - 1))
        make, own = (
            partial(exchanged, (strip,), first, first + 1),
            (f"CCD {first}", f"CCD {first + 1}", strip),
        )
        words = (strip, f"ccd {first}\\b|ccds? {first} and", "exchang|swap|file")
        own = (*own, *facts.of_ccds((first, first + 1), (strip,)))
        yield exchange(f"{strip} CCD {first}/{first + 1}", make, words, own)
    if len(facts.strips) > 1:
        make, words = partial(exchanged, facts.strips, 0, 1), ("ccds? 0\\b", "exchang|swap|file")
        yield exchange("CCD 0/1", make, words, ("CCD 0", "CCD 1", *facts.strips))
    if facts.images:
        yield from _of_strip_images(facts, rng)


def painted(strips: Iterable[str], ccds: Iterable[int], paint: Callable[..., np.ndarray], dump: Path) -> None:
    """Images of some CCDs in some strips with other pixels."""
    for strip in strips:
        for ccd in ccds:
            repaint(dump / f"strips/{strip}_ccd{ccd}.tif", paint)


def _of_strip_images(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    every = tuple(range(facts.ccds))
    for strip in facts.strips[:2]:
        for kind, paint in (
            ("rows reversed", lambda image: np.ascontiguousarray(image[::-1])),
            ("columns reversed", lambda image: np.ascontiguousarray(image[:, ::-1])),
        ):
            make, words = partial(painted, (strip,), every, paint), (strip, "mirror|revers|order|image")
            yield mistake(kind, strip, make, words, (strip,), unit="strip")
    ccd = int(rng.integers(0, facts.ccds))
    dead = partial(painted, facts.strips, (ccd,), lambda image: np.full_like(image, 3))
    words = (f"ccd {ccd}\\b", "dead|grey|empty|image")
    yield mistake("dead CCD", f"CCD {ccd}", dead, words, (f"CCD {ccd}", *facts.strips), unit="CCD")
    for times, gain in ((3.0, 0.5), (30.0, 0.2)):

        def dim(image: np.ndarray, gain: float = gain) -> np.ndarray:
            return np.round(gain * image).astype(image.dtype)

        ccd = int(rng.integers(0, facts.ccds))
        make, item = partial(painted, facts.strips, (ccd,), dim), f"CCD {ccd}"
        of = {"size": gain, "unit": "times", "times": times, "harmless": True}
        yield mistake("sensitivity of a CCD", item, make, (), (item,), **of)
    if len(own := facts.of_kind("ground")[:2]) > 1:

        def other_strip(dump: Path) -> None:
            for ccd in every:
                paths_exchanged(*(dump / f"strips/{strip}_ccd{ccd}.tif" for strip in own))

        yield mistake(
            "files of two strips exchanged", "/".join(own), other_strip, ("|".join(own),), own, unit="pair"
        )


def _of_star_camera(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    if not facts.star_images:
        return
    camera, star = "star_camera.toml", "star camera|star_camera"
    times, part = sized(2e-5, rng)
    make = partial(toml_number, camera, "focal_length_mm", lambda v, part=part: v * (1.0 + part), None)
    yield Fault("star focal length", "", 100.0 * part, "%", times, make, (star, "focal"), "star.*focal")

    def principal(dx: float, dy: float, dump: Path) -> None:
        pattern, text = r"principal_point_px = \[\s*([\d.]+),\s*([\d.]+),?\s*\]", (dump / camera).read_text()
        x, y = (float(value) for value in re.search(pattern, text).groups())
        change(dump / camera, pattern, f"principal_point_px = [{x + dx}, {y + dy}]")

    times, px = sized(0.5, rng)
    dx, dy = (px, 0.0) if rng.random() < 0.5 else (0.0, px)
    make, words = partial(principal, dx, dy), (star, "principal|distortion")
    yield Fault("star principal point", "x" if dx else "y", px, "px", times, make, words, "principal")

    def signs(keys: tuple[str, ...], dump: Path) -> None:
        for key in keys:
            toml_number(camera, key, lambda v: -v, None, dump)

    for keys, words, times in (
        (("q1_per_mm2", "q2_per_mm4"), "distortion|focal", 30.0),
        (("p1_per_mm", "p2_per_mm"), "distortion|principal", 3.0),
    ):
        make, words = partial(signs, keys), (star, words)
        yield mistake("star distortion sign", keys[0][:2], make, words, unit="sign", times=times)
    images = star + "|exposure|image"
    make = partial(redrawn, lambda image: image[:, ::-1])
    yield mistake("star images mirrored", "", make, (images, "mirror"))
    make = partial(redrawn, lambda image: image[::-1])
    yield mistake("star images upside down", "", make, (images, "mirror"))
    make = partial(redrawn, lambda image: image[::-1, ::-1])
    yield mistake("star images rotated by 180 deg", "", make, (images + "|installation", ""))


def _of_orbit(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    orbit, of_ground = "orbit", facts.of_kind("ground")
    sky_only = not of_ground
    blind = "velocity of the orbit" if sky_only else ""

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
        words = (f"{orbit}|position|datum|clock|time|height", "")
        of = {"size": metres, "unit": "m", "times": times, "blind": f"orbit|{axis}"}
        make, harmless = partial(moved, axis, metres, -np.inf, np.inf), sky_only and abs(metres) < 1e4
        yield mistake(f"orbit {axis}", "", make, words, **of, harmless=harmless)
    if len(of_ground) > 1:
        begin = re.search(r"START_TIME = (\S+)", (facts.root / "orbit.oem").read_text())[1]
        at = {row["id"]: row["utc_first_row"] for row in rows_of(facts.root / "strips.csv")}
        for strip in of_ground:
            t = (np.datetime64(at[strip], "ns") - np.datetime64(begin, "ns")) / np.timedelta64(1, "s")
            for axis in ("along", "across"):
                times, metres = sized(15.0, rng)
                make = partial(moved, axis, metres, t - 8.0, t + 10.0)
                words = (rf"{strip}|orbit\.oem", "orbit|position|clock|time|late|early|point")
                yield Fault(f"orbit of a strip {axis}", strip, metres, "m", times, make, words, "", (strip,))

    for name, days in (("of the next day", 1), ("of the day before", -1)):
        make = partial(dated_later, 86400.0 * days)
        yield mistake(f"orbit {name}", "", make, ("orbit.oem",), size=days, unit="day")
    for name, turns in (("of the next revolution", 1), ("of the revolution before", -1)):
        make = partial(earth_turned, REVOLUTION_S * turns)
        yield mistake(f"orbit {name}", "", make, (orbit,), size=turns, blind=blind)
    for frame in ("GCRF", "EME2000"):
        yield mistake("orbit frame", frame, partial(_oem_key, "REF_FRAME", frame), (orbit, "frame"))
    for scale, ahead_s in LEAP_S.items():
        make, words = partial(_oem_key, "TIME_SYSTEM", scale), (orbit, "time|scale|clock|s\\b")
        yield mistake("orbit time scale", scale, make, words, size=ahead_s, unit="s", harmless=sky_only)
    for axis in range(3):
        make = partial(orbit_mirrored, axis)
        yield mistake("orbit mirrored", "xyz"[axis], make, (orbit,), unit="sign", blind=blind)


def _oem_key(key: str, value: str, dump: Path) -> None:
    change(dump / "orbit.oem", rf"(?m)^{key} = .*$", f"{key} = {value}")


def _of_attitudes(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Conventions of heads that state attitudes, and the pre-launch matrix."""

    def scalar_first(row: Row) -> None:
        x, y, z, w = (row[key] for key in Q)
        row.update(qx=w, qy=x, qz=y, qw=z)

    def label(which: int, old: str, new: str, dump: Path) -> None:
        parts = (dump / "dump.toml").read_text().split(old)
        write_text(dump / "dump.toml", old.join(parts[: which + 1]) + new + old.join(parts[which + 1 :]))

    def moves(axis: int, arcsec: float, name: str, dump: Path) -> None:
        turn = Rotation.from_rotvec(np.eye(3)[axis] * np.radians(arcsec / 3600.0))
        rows = rows_of(dump / f"{name}.csv")
        half = rows[(len(rows) + 1) // 2 - 1][
            "utc"
        ]  # the second half of its attitudes: a mounting that moved
        edited(f"{name}.csv", lambda row: row["utc"] >= half and turned_by(row, turn), dump)

    for n, head in enumerate(facts.heads):
        own, stated = (head,), partial(partial, edited, f"{head}.csv")
        words = (head, "conjugat|invers|rotation|quaternion")
        yield mistake("attitude conjugate", head, stated(conjugate), words, own)
        yield mistake(
            "attitude scalar first", head, stated(scalar_first), (head, "scalar|quaternion|order"), own
        )
        for new, size, times in (("none", 20.0, 30.0), ("annual", 5.2, 3.0)):
            make = partial(label, n, '"annual and orbital"', f'"{new}"')
            of = {"size": size, "unit": "arcsec", "times": times, "blind": "aberration|attitude"}
            yield mistake("aberration label", f"{head} {new}", make, (head, "aberration"), own, **of)
        make = partial(label, n, '"head to inertial"', '"inertial to head"')
        yield mistake("rotation label", head, make, (head, "rotation|conjugat|invers"), own)
        times, arcsec = sized(6.0, rng)
        make, own = partial(moves, 0, arcsec, head), (*own, *facts.strips)
        yield Fault("head moves", head, arcsec, "arcsec", times, make, (head,), "attitude|head", own)
    if len(facts.heads) == 2:

        def exchanged(dump: Path) -> None:
            paths_exchanged(*(dump / f"{head}.csv" for head in facts.heads))

        words = ("head|attitude|" + "|".join(facts.heads),)
        yield mistake("heads exchanged", "", exchanged, words, facts.heads, unit="pair")

    def installation(dump: Path) -> None:
        path = dump / (f"installation_{facts.heads[0]}.toml" if facts.heads else "installation.toml")
        pattern = r"quaternion_cs = \[([^\]]*)\]"
        values = re.search(pattern, path.read_text()).group(1).split(",")
        x, y, z, w = (float(value) for value in values if value.strip())
        change(path, pattern, f"quaternion_cs = {[-x, -y, -z, w]}")

    whose = facts.heads[:1]
    yield mistake("installation conjugate", "", installation, ("installation",), whose)


def _of_ground(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Coordinates, heights and chips of targets, or coordinates of measured points."""
    if not facts.listed:
        return
    listed, metres_per_deg = facts.listed, 111_200.0
    in_chips = listed == "targets.csv"  # then a target is another point of its chip, and seen where it is

    def one(name: str, edit: Callable[[Row], object]) -> Make:
        return partial(edited, listed, lambda row: row["id"] == name and edit(row))

    times, px = sized(1.0, rng)
    name = str(rng.choice(facts.ground))
    column, scale = ("lat_deg", metres_per_deg) if rng.random() < 0.5 else ("lon_deg", 0.81 * metres_per_deg)
    make, words = one(name, partial(add, column, px * GROUND_M / scale)), (name, column + "|coordinate")
    of = {"size": px * GROUND_M, "unit": "m", "times": times, "harmless": in_chips}
    yield mistake("target coordinate", name, make, words, (name,), **of)
    for digit in (0, 1, 2):

        def typo(row: Row, digit: int = digit) -> None:
            """Two neighbouring digits exchanged."""
            text = row["lon_deg"]
            at = text.index(".") + 1 + digit
            while text[at] == text[at + 1]:
                at += 1
            row["lon_deg"] = text[:at] + text[at + 1] + text[at] + text[at + 2 :]

        name = str(rng.choice(facts.ground))
        of = {"size": 10.0**-digit, "unit": "deg"}
        yield mistake("digits exchanged", name, one(name, typo), (name, "lon|coordinate"), (name,), **of)
    name = str(rng.choice(facts.ground))
    make = one(name, lambda row: row.update(lon_deg=f"-{row['lon_deg']}"))
    yield mistake("sign of a coordinate", name, make, (name, "lon|coordinate"), (name,), unit="sign")
    times, metres = sized(60.0, rng)
    name = str(rng.choice(facts.ground))
    make = one(name, partial(add, "height_m", metres))
    yield Fault("target height", name, metres, "m", times, make, (name,), "height", (name,))
    for axis in ("north", "east"):
        times, metres = sized(12.0, rng)
        make, words = partial(ground_moved, listed, (), axis, metres), ("all|common|datum|shift",)
        blind = "shift|target|along|across|orbit"
        yield Fault(f"all targets {axis}", "", metres, "m", times, make, words, blind, harmless=in_chips)
    times, metres = sized(80.0, rng)
    make = partial(edited, listed, partial(add, "height_m", metres))
    radial = "height|radial|scale"
    yield Fault("all heights", "", metres, "m", times, make, ("height",), radial)

    def kind(row: Row) -> None:
        row["height_kind"] = {"egm96": "ellipsoidal", "ellipsoidal": "egm96"}[row["height_kind"]]

    yield Fault("height kind", "", 42.0, "m", 1.0, partial(edited, listed, kind), ("height",), radial)

    def feet(row: Row) -> None:
        row["height_m"] = f"{float(row['height_m']) / 0.3048:.4f}"

    make = partial(edited, listed, feet)
    yield mistake("heights in feet", "", make, ("height",), size=3.28, unit="times")

    def exchanged(row: Row) -> None:
        row["lat_deg"], row["lon_deg"] = row["lon_deg"][:2] + row["lon_deg"][3:], row["lat_deg"]

    make, words = partial(edited, listed, exchanged), ("lat|lon|coordinate|target",)
    yield mistake("latitude and longitude exchanged", "", make, words)
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
    a, b = map(str, rng.choice([one for one in facts.ground if one.startswith("s01")], 2, replace=False))
    files = {a: f"chips/{b}.tif", b: f"chips/{a}.tif"}
    make = partial(edited, "targets.csv", lambda row: row.update(chip=files.get(row["id"], row["chip"])))
    yield mistake("chips exchanged", f"{a}/{b}", make, (f"{a}|{b}", "chip"), (a, b), unit="pair")


def _of_lists(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """What is listed twice, and lists that are short."""
    again = "same|twice|repeat|duplicat"
    of_copies = {"own": ("*",), "unit": "times", "harmless": True}

    def once_more(copies: int, change: Callable[[Row, int], Row], rows: list[Row]) -> list[Row]:
        return [*rows, *(row | change(row, n) for n in range(1, copies) for row in rows)]

    def strips_again(copies: int, dump: Path) -> None:
        tables = {"strips.csv": "id"} | ({"points.csv": "strip"} if facts.listed == "points.csv" else {})
        for name, column in tables.items():
            renamed = lambda row, n, column=column: {column: f"{row[column]}x{n}"}  # noqa: E731
            changed_rows(name, partial(once_more, copies, renamed), dump)

    for times, copies in ((3.0, 3), (30.0, 9)):
        make, words = partial(strips_again, copies), (f"strip|{again}",)
        yield mistake("strips repeated", "", make, words, size=copies, times=times, **of_copies)
    if facts.listed:
        for times, metres in ((30.0, 0.0), (3.0, 0.02)):

            def moved(row: Row, n: int, metres: float = metres) -> Row:
                lat_deg = f"{float(row['lat_deg']) + n * metres / 111_200.0:.10f}"
                return {"id": f"{row['id']}x{n}", "lat_deg": lat_deg}

            make, words = (
                partial(changed_rows, facts.listed, partial(once_more, 3, moved)),
                (f"target|{again}",),
            )
            yield mistake(
                "targets repeated", f"{metres} m apart", make, words, size=3, times=times, **of_copies
            )
        for n in (2, 3, 4):
            names = frozenset(map(str, rng.choice(facts.ground, n, replace=False)))
            few = lambda rows, names=names: [row for row in rows if row["id"] in names]  # noqa: E731
            make, words = partial(changed_rows, facts.listed, few), ("few|redundan|check|degree",)
            yield mistake("few targets", "", make, words, size=n, unit="targets", harmless=True)
    if facts.star_images:

        def exposures_again(rows: list[Row]) -> Iterator[Row]:
            for row in rows:
                yield row
                yield row | {"id": f"{row['id']}x1", "utc_mid": later(row["utc_mid"], 1e-3)}

        make, words = partial(changed_rows, "exposures.csv", exposures_again), (f"exposure|{again}",)
        yield mistake("exposures repeated", "", make, words, size=2, **of_copies)

    def thinned(keep: int, dump: Path) -> None:
        for name in [f"{head}.csv" for head in facts.heads] or ["exposures.csv"]:
            changed_rows(name, partial(spread, keep), dump)

    for times, keep in ((30.0, 2), (3.0, 4)):
        of = {"size": keep, "unit": "a strip", "times": times, "harmless": True}
        yield mistake("few exposures", "", partial(thinned, keep), ("exposure|attitude",), **of)
    if facts.of_kind("ground"):
        effects = ("light_time", "aberration", "refraction")
        for key in effects:

            def light(dump: Path, key: str = key) -> None:
                text = "".join(f"{one} = {str(one != key).lower()}\n" for one in effects)
                head, mark, heads = (dump / "dump.toml").read_text().partition("[[star_cameras]]")
                write_text(dump / "dump.toml", f"{head}\n[light]\n{text}\n{mark}{heads}")

            # Aberration moves a target by 13 m, light time and refraction by 1 m near nadir: 2 m are stated.
            of = {"times": 3.0 if key == "aberration" else 0.5, "blind": f"light|{key}"}
            yield mistake("light", key, light, ("light|aberration|refraction",), **of)


def spread(keep: int, rows: list[Row]) -> list[Row]:
    """So many exposures or attitudes of each strip, evenly over it."""
    column = "utc" if "utc" in rows[0] else "utc_mid"
    t_s = np.array([row[column] for row in rows], dtype="datetime64[ns]").astype(float) / 1e9
    left = []
    for own in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(t_s) > 5.0) + 1):
        left += own[np.unique(np.round(np.linspace(0, len(own) - 1, keep)).astype(int))].tolist()
    return [rows[k] for k in left]
