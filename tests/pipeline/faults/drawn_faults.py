"""Faults drawn by a seed: what is wrong, where, how it goes with time or over the field, how large it is, and
in some cases a second fault beside it.

To the kinds of `faults.faults_of` come profiles of what was measured or stated: rows, samples, ground,
attitudes and image lines that jump, drift, bend, scatter or are cut to a step, in a strip, several strips, a
CCD or all; and other star catalogues. A further kind is a row of `_profiles`.
"""

import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from edits import rows_of, write_rows
from faults import (
    LATE,
    Facts,
    Fault,
    Row,
    change,
    edited,
    faults_of,
    ground_moved,
    mistake,
    painted,
    rows_late,
    sized,
    turned_by,
)
from scipy.spatial.transform import Rotation

__all__ = ["both", "by_kind", "drawn"]

# Shares of the cases: files and conventions that are mistaken, which have no size; two faults at once.
CONVENTIONS, TWO_AT_ONCE = 0.25, 0.15
NO_SIZE = ("", "sign", "pair", "day", "strip", "files", "times", "targets", "a strip", "deg")
CURVED = "curved|row|clock|drift|bends"
# How an error goes with the part of a strip or of a CCD, 0 to 1, that has passed; `at` is where it steps.
PROFILES: dict[str, Callable[[float, float], float]] = {
    "constant": lambda part, at: 1.0,
    "step": lambda part, at: float(part > at),
    "drift": lambda part, at: 2.0 * part - 1.0,
    "bend": lambda part, at: 4.0 * part * (1.0 - part),
}


def drawn(root: Path, seed: int, n: int) -> Fault:
    """Case `n` of a dump."""
    rng = np.random.default_rng([seed, n])
    kinds = by_kind(root, rng)

    def one(names: list[str]) -> Fault:
        of_kind = kinds[names[int(rng.integers(len(names)))]]
        return of_kind[int(rng.integers(len(of_kind)))]

    def has_size(kind: str) -> bool:
        return not any(fault.harmless or fault.unit in NO_SIZE for fault in kinds[kind])

    with_size = sorted(kind for kind in kinds if has_size(kind))
    if (what := rng.random()) < CONVENTIONS:
        return one(sorted(kinds.keys() - set(with_size)))
    first = one(with_size)
    if what > CONVENTIONS + TWO_AT_ONCE:
        return first
    return both(first, one([kind for kind in with_size if kind != first.kind]))


def by_kind(root: Path, rng: np.random.Generator) -> dict[str, list[Fault]]:
    """All kinds of a dump, each in all its places, of sizes that `rng` draws."""
    kinds = defaultdict[str, list[Fault]](list)
    for fault in (*faults_of(root, rng), *_profiles(Facts.of(root), rng)):
        kinds[fault.kind].append(fault)
    return dict(kinds)


def both(first: Fault, second: Fault) -> Fault:
    """Two faults at once: either may be named first."""

    def make(dump: Path) -> None:
        first.make(dump)
        second.make(dump)

    blind = "|".join(one.blind for one in (first, second) if one.blind)
    of = {"size": 2, "unit": "faults", "times": max(first.times, second.times), "blind": blind}
    item, own = f"{first.name} and {second.name}", first.own + second.own
    return mistake("two at once", item, make, first.words, own, other_words=second.words, **of)


def _profiles(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    if facts.listed == "points.csv":
        yield from _of_points(facts, rng)
    if facts.images:
        yield from _of_lines(facts, rng)
    if facts.listed and facts.of_kind("ground"):
        yield from _of_ground(facts, rng)
    if facts.heads:
        yield from _of_mounting(facts, rng)
    yield from _of_instants(facts, rng)
    if facts.of_kind("sky"):
        yield from _of_catalogue(facts, rng)


def several(facts: Facts, names: tuple[str, ...], rng: np.random.Generator) -> dict[str, tuple[str, ...]]:
    """Places: one strip, two of at least four, all from one on of at least four, and every strip."""
    one = int(rng.integers(len(names)))
    places = {"": (names[one],)}
    if len(names) > 3:
        places["of two strips"] = tuple(rng.choice(names, 2, replace=False).tolist())
        places["from a strip on"] = names[int(rng.integers(2, len(names) - 1)) :]
    return places


def any_of(names: tuple[str, ...]) -> str:
    """Regular expression of any of some items, in small letters."""
    return rf"\b({'|'.join(names)})\b".lower()


# ---- measured points ----


def _of_points(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Rows and samples of points: lines lost or twice, curved clocks, longer or curved CCDs, more noise."""
    strip = facts.strips[int(rng.integers(len(facts.strips)))]
    ccd, at = int(rng.integers(facts.ccds)), float(rng.uniform(0.25, 0.75))
    name, camera = f"CCD {ccd}", f"ccd {ccd}\\b"
    of_strip, in_all = (strip,), facts.strips
    everything = (*facts.strips, *(f"CCD {n}" for n in range(facts.ccds)))
    rows = (
        # kind, column, profile of it, over which column, smallest px, strips, CCD, words
        ("lines lost", "line", "step", "line", 0.5, of_strip, None, (any_of(of_strip), "lines|row|clock")),
        ("lines lost in a CCD", "line", "step", "line", 1.0, of_strip, ccd, (camera, "lines|image|place")),
        ("rows curved", "line", "bend", "line", 0.7, of_strip, None, (any_of(of_strip), CURVED)),
        ("rows curved in all strips", "line", "bend", "line", 0.4, in_all, None, (CURVED,)),
        ("image of a CCD", "sample", "constant", "line", 0.7, of_strip, ccd, (camera, "image|place")),
        ("image of a CCD", "line", "constant", "line", 0.7, of_strip, ccd, (camera, "image|place|lines")),
        ("CCD longer", "sample", "drift", "sample", 0.5, in_all, ccd, (camera, "length|place")),
        ("CCD curved", "line", "bend", "sample", 0.7, in_all, ccd, (camera, "bend|place|rotation")),
    )  # fmt: skip
    for kind, column, profile, over, smallest, strips, one, words in rows:
        times, px = sized(smallest, rng, 10.0)
        make = partial(_points, column, profile, over, px, at, strips, one)
        own = everything if one is None else (name, *facts.strips, *facts.of_ccds((ccd,), strips))
        item = strip if strips is of_strip else "all" if one is None else name
        yield Fault(kind, item, px, f"px {column}", times, make, words, f"{words[0]}|{strip}", own)
    for place, strips in (("a strip", of_strip), ("all strips", in_all)):
        times, factor = sized(3.0, rng, 10.0)
        make = partial(_scattered, strips, abs(factor), int(rng.integers(1 << 30)))
        words = (any_of(of_strip) if strips is of_strip else "", "residual|noise|errors|scatter|contradict")
        yield Fault("noise of points", place, abs(factor), "times", times, make, words, "", ("*",))


def _points(
    column: str,
    profile: str,
    over: str,
    size: float,
    at: float,
    strips: tuple[str, ...],
    ccd: int | None,
    dump: Path,
) -> None:
    """Points of some strips, in one CCD or all, moved along a profile over lines or samples."""
    rows = rows_of(dump / "points.csv")
    for strip in strips:
        own = [one for one in rows if one["strip"] == strip]
        where = [float(one[over]) for one in own]
        low, wide = min(where), max(max(where) - min(where), 1.0)
        for one in own:
            if ccd is None or one["ccd"] == str(ccd):
                part = (float(one[over]) - low) / wide
                one[column] = repr(float(one[column]) + size * PROFILES[profile](part, at))
    write_rows(dump / "points.csv", rows)


def _scattered(strips: tuple[str, ...], factor: float, seed: int, dump: Path) -> None:
    """Points of some strips with errors so many times the stated ones more."""
    rng = np.random.default_rng(seed)

    def edit(row: Row) -> None:
        for column in ("sample", "line"):
            error = factor * float(row[f"sigma_{column}_px"]) * rng.standard_normal()
            if row["strip"] in strips:
                row[column] = repr(float(row[column]) + error)

    edited("points.csv", edit, dump)


# ---- images ----


def _of_lines(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Lines of images of a strip that are missing or there twice, strips that show nothing or too much."""
    strip = facts.strips[int(rng.integers(len(facts.strips)))]
    every, ccd = tuple(range(facts.ccds)), int(rng.integers(facts.ccds))
    at = float(rng.uniform(0.3, 0.7))

    def lines(n: int, image: np.ndarray) -> np.ndarray:
        first = int(at * len(image))
        if n > 0:  # missing: the last are dark
            return np.concatenate([image[:first], image[first + n :], np.zeros_like(image[:n])])
        return np.concatenate([image[:first], image[first : first - n], image[first:n]])

    def flat(value: int, image: np.ndarray) -> np.ndarray:
        return np.full_like(image, np.iinfo(image.dtype).max if value else 3)

    everything = (strip, *(f"CCD {n}" for n in every))
    for kind, ccds, own, words in (
        ("lines lost", every, everything, (any_of((strip,)), "line|row|clock|image")),
        ("lines lost in a CCD", (ccd,), (f"CCD {ccd}", strip), (f"ccd {ccd}\\b|{strip}", "line|image|place")),
    ):
        times, size = sized(1.0, rng, 20.0)
        n = round(size) or 1
        make = partial(painted, (strip,), ccds, partial(lines, n))
        yield Fault(kind, strip, n, "rows", times, make, words, strip, own)
    for kind, value in (("strip saturated", 1), ("strip dark", 0)):
        make = partial(painted, (strip,), every, partial(flat, value))
        yield mistake(kind, strip, make, (any_of((strip,)),), everything, unit="strip")


# ---- ground ----


def _of_ground(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Ground of strips that is moved, too high or scattered."""
    in_chips = facts.listed == "targets.csv"  # then a target is another point of its chip, seen where it is
    for place, strips in several(facts, facts.of_kind("ground"), rng).items():
        for axis, smallest in (("height", 60.0), ("east", 15.0), ("north", 15.0)):
            times, metres = sized(smallest, rng, 10.0)
            words = (any_of(strips), "height|datum|ground|orbit|clock|attitude|coordinates")
            make = partial(ground_moved, facts.listed, strips, axis, metres)
            kind, item = f"ground {axis} {place}".strip(), "/".join(strips[:3])
            of = {"size": metres, "unit": "m", "times": times, "blind": any_of(strips)}
            own, harmless = (*strips, *facts.ground) if in_chips else strips, in_chips and axis != "height"
            yield mistake(kind, item, make, words, own, harmless=harmless, **of)


# ---- attitudes and mounting ----


def _of_mounting(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """A camera that turns against all heads: from a strip on, in a pass, over each pass; noise of a head."""
    blind = "mounting|attitude|clock|period|rotation|orbit"
    for axis, scale in (("x", 1.0), ("y", 1.0), ("z", 12.0)):
        for kind, profile, smallest in (
            ("mounting jumps", "from", 6.0),
            ("attitude of a strip", "in", 8.0),
            ("mounting drifts", "drift", 3.0),
            ("mounting drifts in a strip", "drift in", 6.0),
            ("mounting bends", "bend", 3.0),
        ):
            if len(facts.strips) < 3 and profile != "drift":
                continue
            k = int(rng.integers(1, max(len(facts.strips), 2)))
            times, arcsec = sized(smallest * scale, rng, 10.0)
            make = partial(_turned, facts, "xyz".index(axis), arcsec, profile, k)
            words = (
                "mounting|attitude|clock|row period|line of sight|orbit or targets|strips|curved",
                any_of(facts.strips) if profile in ("from", "in", "drift in") else "",
            )
            item = f"{axis} {facts.strips[min(k, len(facts.strips) - 1)]}"
            yield Fault(kind, item, arcsec, "arcsec", times, make, words, blind, ("*",))
    for head in facts.heads:
        times, factor = sized(2.0, rng, 5.0)
        make = partial(_noisy, head, abs(factor), int(rng.integers(1 << 30)))
        words = (head.lower(), "errors|noise|scatter|times|motion|contradict")
        yield Fault("noise of a head", head, abs(factor), "times", times, make, words, "", (head,))


def _turned(facts: Facts, axis: int, arcsec: float, profile: str, k: int, dump: Path) -> None:
    """The camera turned about an axis of c against every head: attitudes turn the other way about it."""
    first = {row["id"]: row for row in reversed(rows_of(dump / "strips.csv"))}
    long = {name: float(row["row_period_s"]) * float(row["lines"]) for name, row in first.items()}
    begins = sorted((row["utc_first_row"], long[name]) for name, row in first.items())
    for head in facts.heads:
        quaternion = tomllib.loads((dump / f"installation_{head}.toml").read_text())["quaternion_cs"]
        axis_h = Rotation.from_quat(quaternion).inv().apply(np.eye(3)[axis])

        def edit(row: Row, axis_h: np.ndarray = axis_h) -> None:
            utc = np.datetime64(row["utc"].removesuffix("Z"), "ns")
            after = np.array([(utc - np.datetime64(one, "ns")) / np.timedelta64(1, "s") for one, _ in begins])
            n = int(np.argmin(np.abs(after - 0.5 * np.array([long for _, long in begins]))))
            part = float(after[n]) / begins[n][1]
            size = {
                "from": float(n >= k),
                "in": float(n == k),
                "drift": 2.0 * part - 1.0,
                "drift in": (2.0 * part - 1.0) * (n == k),
                "bend": 4.0 * part * (1.0 - part),
            }[profile]
            turned_by(row, Rotation.from_rotvec(np.radians(arcsec * size / 3600.0) * axis_h))

        edited(f"{head}.csv", edit, dump)


def _noisy(head: str, factor: float, seed: int, dump: Path) -> None:
    """Attitudes of a head with errors so many times the stated ones more."""
    rng = np.random.default_rng(seed)
    text = (dump / "dump.toml").read_text()
    heads = {one["name"]: one for one in tomllib.loads(text)["star_cameras"]}
    white = np.radians(np.array(heads[head]["noise"]["white_arcsec"]) / 3600.0)

    def edit(row: Row) -> None:
        turned_by(row, Rotation.from_rotvec(factor * white * rng.standard_normal(3)))

    edited(f"{head}.csv", edit, dump)


# ---- instants ----


def _of_instants(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Instants of a table cut to a step; clocks of several strips."""
    files = {"strips.csv": "utc_first_row"}
    files |= {f"{head}.csv": "utc" for head in facts.heads}
    files |= {"exposures.csv": "utc_mid"} if facts.star_images else {}
    for file, column in files.items():
        times, step_s = sized(0.01, rng, 12.0)

        def cut(dump: Path, file: str = file, column: str = column, step_s: float = abs(step_s)) -> None:
            edited(file, lambda row: row.update({column: _cut(row[column], step_s)}), dump)

        name, words = file.removesuffix(".csv"), ("clock|time|late|early|instants|utc|exposures",)
        yield Fault("times cut", name, 1e3 * abs(step_s), "ms", times, cut, words, LATE, ("*",))
    for place, strips in several(facts, facts.strips, rng).items():
        if place:
            times, ms = sized(2.0, rng)
            late, item = partial(rows_late, strips, 1e-3 * ms), "/".join(strips[:3])
            words = (any_of(strips), LATE + "|mounting|attitude")
            yield Fault(f"clock {place}", item, ms, "ms", times, late, words, any_of(strips), strips)


def _cut(utc: str, step_s: float) -> str:
    """The last multiple of a step of a second before an instant."""
    stated = np.datetime64(utc.removesuffix("Z"), "ns")
    ns = int((stated - stated.astype("datetime64[D]")) / np.timedelta64(1, "ns"))
    return str(stated - np.timedelta64(ns % round(1e9 * step_s), "ns"))


# ---- star catalogue ----


def _of_catalogue(facts: Facts, rng: np.random.Generator) -> Iterator[Fault]:
    """Another epoch, no proper motion, its other sign, another equinox, in a table of the bundled stars."""
    words = ("catalogue|star_catalogue|epoch|proper|equinox",)
    for kind, size, unit, times in (
        ("epoch", float(rng.uniform(5.0, 60.0)), "years", 3.0),
        ("proper motion zero", 1, "", 3.0),
        ("proper motion sign", -1, "", 6.0),
        ("equinox", float(rng.choice([1950.0, 1991.25, 2015.5])), "year", 30.0),
    ):
        make = partial(_catalogue, kind, size)
        yield Fault(f"catalogue {kind}", "", size, unit, times, make, words, "catalogue", ("*",))


def _catalogue(kind: str, size: float, dump: Path) -> None:
    """A table of stars, of which one thing is wrong, beside those of the bundled catalogue."""
    import erfa

    from boresight.star_id.whole_catalogue import all_hipparcos

    survey = all_hipparcos()
    survey = survey.take(survey.single)
    stars, MAS = survey.places, np.radians(1e-3 / 3600.0)
    ra, dec, epoch = stars.ra_rad.copy(), stars.dec_rad.copy(), stars.epoch_jyear
    pm = np.stack([stars.pm_ra_rad_yr * np.cos(dec), stars.pm_dec_rad_yr])
    if kind == "epoch":
        epoch += size
    elif kind.startswith("proper motion"):
        pm = 0.0 * pm if kind.endswith("zero") else -pm
    else:
        R = erfa.pmat06(2451545.0, (size - 2000.0) * 365.25)
        xyz = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]).T @ R.T
        ra, dec = np.arctan2(xyz[:, 1], xyz[:, 0]) % (2 * np.pi), np.arcsin(xyz[:, 2])
    columns = {
        "source_id": stars.hip,
        "ra": np.degrees(ra),
        "dec": np.degrees(dec),
        "ref_epoch": np.full(len(ra), epoch),
        "pmra": pm[0] / MAS,
        "pmdec": pm[1] / MAS,
        "phot_g_mean_mag": stars.v_mag,
    }
    columns |= dict.fromkeys(("ra_error", "dec_error"), survey.sigma_rad / MAS)
    columns |= dict.fromkeys(("pmra_error", "pmdec_error"), survey.sigma_pm_rad_yr / MAS)
    rows = (",".join(map(repr, row)) for row in zip(*(c.tolist() for c in columns.values())))
    (dump / "stars.csv").write_text("\n".join([",".join(columns), *rows]) + "\n")
    change(dump / "dump.toml", r"\[files\]\n", '[files]\nstar_catalogue = "stars.csv"\n')
