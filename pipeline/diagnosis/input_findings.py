"""What the inputs of a calibration contradict by themselves, without its residuals; Earth orientation too."""

from __future__ import annotations

import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from boresight.calib.finding import Finding
from boresight.calib.settings import CalibrationSettings
from boresight.calib.slow_motion import motion_is_shown
from boresight.gct_match.records import Target
from boresight.geometry.constants import ARCSEC, EARTH_ROTATION_RATE, WGS84
from boresight.geometry.earth_orientation import EarthOrientationTable, EarthOrientationWarning
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.geoid import egm96
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.files.coordinate_slips import off_middle_m
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import Head
from boresight.pipeline.files.star_tables import survey_of
from boresight.pipeline.files.terrain_files import TerrainFiles
from boresight.pipeline.stages.head import Basis
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, compass, misses
from boresight.records.ledger import Entry, Kind, Reason, Subject, count_words, list_words
from boresight.records.record import Floats, record, scalar
from boresight.star_id.beyond_chance import MAD_SIGMA

__all__ = [
    "NOTHING",
    "EarthTableCheck",
    "assumed_motion",
    "check_earth_table",
    "chip_maps",
    "contradicting_rows",
    "earth_findings",
    "heights",
    "input_findings",
    "nearest_miss",
    "outside_chips",
    "shifted_chips",
]

FEWEST = 3  # targets that make a pattern
SMALLEST_HEIGHT_M = 5.0  # systematic difference of heights that is reported
SINGLE_HEIGHT_M = 30.0  # ... of one target from the others: slopes and trees stay below
CLEAR_SIGMAS = 3.0  # of what was compared, from which a difference of heights or tables is reported
SINGLE_SIGMAS = 6.0  # ... of one target from the others
AS_GEOID = 0.2  # of its height, within which a difference is that of the geoid
ALIKE = 0.1  # of their distance, by which targets may be apart that lie off their chips alike
MOST_CHIPS = 256  # that are opened for it
# Of the maps from chips to strips: fewest of one source that are compared; scatter from chip to chip, 0.001
# of sound ones; size from which places in the middle of 128 px move by a fifth of a pixel.
FEWEST_MAPS, MAP_SCATTER, SMALLEST_MAP = 6, 1e-3, 3e-3
MAP_SIGMAS = 6.0  # of the median of a source, from which it is reported


@dataclass(frozen=True)
class ChipMap:
    """What the maps from chips to strips may have in common."""

    cause: str
    text: str  # with its size and 1-sigma, and which way it is wrong
    unit: str
    si: float  # of one unit
    parts: Callable[[Floats], Floats]  # both parts (N, 2) of affine maps (N, 2, 2) that agree in it


LARGER, TURNED = "pixels stated {0:.3g} ± {1:.2g} % too {2}", "a rotation by {0:.3g} ± {1:.2g}°"
DEG = float(np.radians(1.0))
CHIP_MAPS = (
    ChipMap("pixel size of the chips", LARGER, "%", 1e-2, lambda A: -A[:, [0, 1], [0, 1]]),
    ChipMap("rotation of the chips", TURNED, "°", DEG, lambda A: A[:, [0, 1], [1, 0]] * [1.0, -1.0]),
)
ROUNDED_M = (10.0, 100.0, 1000.0)  # steps to which positions may have been rounded: 1 m moves 0.1″
# Reasons of targets whose place is wrong.
WRONG = (Reason.OUTSIDE_CHIP, Reason.INCONSISTENT, Reason.TARGET_RESIDUAL)


def input_findings(
    basis: Basis, tasks: Sequence[StripTask], matched: Sequence[MatchedTargets], omissions: Sequence[Entry]
) -> list[Finding]:
    """All such findings; `tasks` are the strips of the ground, `matched` what was matched in them and
    `omissions` what is not used.
    """
    dump = basis.dump
    every = {target.target_id: target for task in tasks for target in task.targets}
    without = {entry.subject.id for entry in omissions if entry.reason in WRONG}
    return [
        *_out_of_view(dump, tasks, matched),
        *contradicting_rows(omissions),
        *_of_nothing(omissions),
        *(shifted := list(shifted_chips(dump, omissions))),
        *(() if shifted else outside_chips(omissions)),
        *chip_maps(tasks, matched),
        *_rounded_orbit(dump),
        *_smeared(dump, omissions),
        *_still_stars(dump),
        *(_assumed_noise(head) for head in dump.heads if head.noise_is_assumed),
        *_heights(basis, {name: target for name, target in every.items() if name not in without}, tasks),
    ]


def _still_stars(dump: Dump) -> Iterator[Finding]:
    """That no star of the user's catalogue has a proper motion."""
    if dump.star_catalogue and dump.sky_strips:
        places = survey_of(dump.star_catalogue).places
        if not (places.pm_ra_rad_yr.any() or places.pm_dec_rad_yr.any()):
            yield Finding(
                cause="catalogue of the stars, proper motions",
                item="all stars",
                text=f"all are zero, epoch {places.epoch_jyear:g}: stars move by arc-seconds in decades; "
                f"take pmra, pmdec into {dump.star_catalogue.file}.",
                file=dump.star_catalogue.file,
                field="pmra, pmdec",
            )


def contradicting_rows(entries: Sequence[Entry]) -> Iterator[Finding]:
    """Images that several rows name, and different images of one time."""
    for kind, table in TABLES.items():
        for reason, text in CONTRADICTIONS.items():
            those = [entry.subject for entry in entries if entry.reason is reason]
            if subjects := tuple(subject for subject in those if subject.kind == kind):
                names = list_words([subject.name for subject in subjects])
                yield Finding(
                    cause=reason.value,
                    item=count_words(len(subjects), kind),
                    subjects=subjects,
                    text=f"{names}: {text} {table}.",
                    file=table,
                )


# File of a dump that lists the images of a kind.
TABLES = {Kind.STRIP: "strips.csv", Kind.CCD: "strips.csv", Kind.EXPOSURE: "exposures.csv"}
# What a finding says of images of one reason, before the file to correct.
CONTRADICTIONS = {
    Reason.SAME_PIXELS: "one image under several times, so none is used; correct file in",
    Reason.SAME_TIME: "several images of one time, so none is used; correct utc_mid in",
}


# Why a strip, or a CCD of one, gives nothing, whatever it shows; what a strip that is read does not show is a
# loss.
NOTHING = (
    Reason.UNREADABLE,
    Reason.NOT_IDENTIFIED,
    Reason.NOT_A_SKY_STRIP,
    Reason.NOT_OF_THE_GROUND,
    Reason.NOT_COVERED,
)


def _of_nothing(entries: Sequence[Entry]) -> Iterator[Finding]:
    """Strips and CCDs that give nothing, each with its reason."""
    for entry in entries:
        if entry.subject.kind in (Kind.STRIP, Kind.CCD) and entry.reason in NOTHING:
            cause, text = f"images, {entry.reason.value}", f"it gives nothing: {entry.text}."
            yield Finding.about(cause, entry.subject, text, entry.file or "strips.csv")


def outside_chips(entries: Sequence[Entry]) -> Iterator[Finding]:
    """Targets that do not lie in their chips, or not in view of the satellite, each once."""
    of_target: dict[str, list[Entry]] = defaultdict(list)
    for entry in entries:
        if entry.reason in (Reason.OUTSIDE_CHIP, Reason.HIDDEN):
            of_target[entry.subject.id].append(entry)
    alike: dict[str, list[str]] = defaultdict(list)
    for name, those in of_target.items():
        alike[those[0].slip].append(name)
    common = {slip: names for slip, names in alike.items() if len(names) > FEWEST}
    if common and alike.get(""):  # off by what is common, though no slip of digits puts them right
        common[""] = alike[""]
    for slip, names in common.items():
        far = "lie far outside their chips" if len(names) > 1 else "lies far outside its chip"
        fits = f"lie in their chips with {slip}" if slip else far
        yield Finding(
            cause="coordinates",
            item=count_words(len(names), "target"),
            subjects=tuple(Subject(Kind.TARGET, id=name) for name in names),
            text=f"{list_words(names)} {fits}: correct lat_deg, lon_deg in targets.csv, or the chips.",
            file="targets.csv",
            field="lat_deg, lon_deg",
            explains=tuple(entry.subject for name in names for entry in of_target[name]),
        )
    told = {name for names in common.values() for name in names}
    for name, those in ((name, those) for name, those in of_target.items() if name not in told):
        file = "points.csv" if those[0].reason is Reason.HIDDEN else "targets.csv"
        target, lost = Subject(Kind.TARGET, id=name), tuple(one.subject for one in those if one.subject.strip)
        text, field = f"{those[0].text}.", "lat_deg, lon_deg"
        yield Finding.about("coordinates or chip", target, text, file, field, explains=lost)


def _out_of_view(dump: Dump, tasks: Sequence[StripTask], matched: Sequence[MatchedTargets]) -> list[Finding]:
    """That no target of a dump comes into view of any of its strips of the ground; empty where one does."""
    seen = any(
        len(one.target_id) or any(entry.subject.kind is Kind.TARGET for entry in one.omissions)
        for one in matched
    )
    if seen or not tasks or not dump.targets:
        return []
    far_m = float(np.hypot(*nearest_miss(tasks, dump.targets)[:2]))
    nearest = f"the nearest lies {far_m / 1e3:.0f} km from a strip"
    nearest = nearest if np.isfinite(far_m) else "the camera looks past the Earth"
    return [
        Finding(
            cause="orbit, times or coordinates",
            item="all targets",
            text=f"none of {len(dump.targets)} comes into view of a strip, {nearest}: "
            f"check the orbit, utc_first_row in strips.csv, targets.csv.",
            file="targets.csv",
            refutes=True,
        )
    ]


def nearest_miss(
    tasks: Sequence[StripTask], targets: Sequence[Target]
) -> tuple[float, float, float, str, str]:
    """Of the target nearest to any strip what `misses` says (m), the second as time, too (s), its id and the
    strip's; NaN where all strips look past the Earth.
    """
    found: list[tuple[float, float, float, str, str]] = []
    for task in tasks:
        outside, speed_m_s = misses(task, targets)
        n = int(np.argmin(np.nan_to_num(np.hypot(*outside.T), nan=np.inf)))
        across_m, along_m = outside[n].tolist()
        names = targets[n].target_id, task.strip.strip_id
        found.append((across_m, along_m, along_m / speed_m_s, *names))
    return min(found, key=lambda miss: float(np.nan_to_num(np.hypot(*miss[:2]), nan=np.inf)))


def shifted_chips(dump: Dump, entries: Sequence[Entry]) -> Iterator[Finding]:
    """That the coordinates of most targets lie outside their chips: all as far in one direction, or by the
    same slip.
    """
    outside = {entry.subject.id: entry.slip for entry in entries if entry.reason is Reason.OUTSIDE_CHIP}
    pairs = [pair for pair in zip(dump.targets, dump.chips) if pair[0].target_id in outside]
    if len(pairs) <= max(FEWEST, len(dump.targets) // 2):
        return
    off_m = np.array([off_middle_m(*pair) for pair in pairs[:MOST_CHIPS]])
    middle_m = np.nanmedian(off_m, axis=0)
    apart_m = float(np.nanmedian(np.hypot(*(off_m - middle_m).T)))
    slip, n = Counter(outside.values()).most_common(1)[0]
    where = "lie outside their chips"
    if slip and "digit" not in slip and 2 * n > len(outside):  # the same digit of most is no slip
        where = f"would lie in their chips with {slip}"
    elif apart_m < ALIKE * float(np.hypot(*middle_m)):
        where = f"lie {compass(*middle_m.tolist())} of the middle of their chips"
    yield Finding(
        cause="common shift of coordinates or chips",
        item=f"{len(pairs)} of {len(dump.targets)} targets",
        text=f"they {where}: check datum and geo-reference of the chips, lat_deg, lon_deg in targets.csv.",
        file="targets.csv",
        field="lat_deg, lon_deg, chip",
        subjects=tuple(Subject(Kind.TARGET, id=target.target_id) for target, _ in pairs),
    )


def _rounded_orbit(dump: Dump) -> Iterator[Finding]:
    """That the positions of the orbit were written with too few digits for their stated error."""
    p_m = dump.orbit.positions_m
    step_m = max(
        (one for one in ROUNDED_M if np.allclose(np.remainder(p_m / one + 0.5, 1.0), 0.5)), default=0.0
    )
    if step_m / np.sqrt(12.0) > dump.errors.position_m:
        text = f"all are multiples of {step_m:g} m, of an error of {step_m / np.sqrt(12.0):.2g} m (1σ): "
        yield Finding(
            cause="rounded positions of the orbit",
            item="all states",
            text=f"{text}write more digits, or state it as position_m in dump.toml.",
            value=step_m,
            unit="m",
            file="orbit",
            refutes=True,
        )


def chip_maps(tasks: Sequence[StripTask], matched: Sequence[MatchedTargets]) -> Iterator[Finding]:
    """That the chips of a source, or several of them alike, are larger or turned in the strips: about the
    corners from which their geo-references count that displaces their targets.
    """
    of_source: dict[str, list[tuple[str, Floats]]] = defaultdict(list)
    for task, one in zip(tasks, matched):
        source = {target.target_id: target.reference for target in task.targets}
        for name, affine in zip(one.target_id.tolist(), one.affine):
            if np.isfinite(affine).all():
                of_source[of.name if (of := source[name]) else ""].append((name, affine))
    for source_name, chips in of_source.items():
        names, maps = np.array([name for name, _ in chips]), np.array([affine for _, affine in chips])
        every = f"chips of reference {source_name}" if source_name else "all chips"
        for kind in CHIP_MAPS:
            both = kind.parts(maps)
            each = np.abs(both.mean(axis=1))
            off = each > MAP_SIGMAS * MAP_SCATTER
            if told := _of_maps(kind, every, both):
                yield told
            elif 0 < off.sum() < len(off) and np.median(each[off]) > MAP_SIGMAS * _map_scatter(both[~off]):
                some = f"chips of {list_words(sorted(set(names[off].tolist())))}"
                yield from filter(None, [_of_maps(kind, some, both[off])])


def _map_scatter(both: Floats) -> float:
    """Median deviation of maps (N, 2) from their median, no less than that of sound ones."""
    each = both.mean(axis=1)
    return max(MAP_SCATTER, float(np.median(np.abs(each - np.median(each)))))


def _of_maps(kind: ChipMap, item: str, both: Floats) -> Finding | None:
    """That chips have in common what their maps (N, 2) show, if they do."""
    if (n := len(both)) < FEWEST_MAPS:
        return None
    size, (one, other) = float(np.median(both.mean(axis=1))), np.median(both, axis=0).tolist()
    sigma = MAD_SIGMA * _map_scatter(both) * float(np.sqrt(0.5 * np.pi / n))  # of the median
    if abs(size) < max(SMALLEST_MAP, MAP_SIGMAS * sigma) or min(one / size, other / size) < 0.5:
        return None
    words = kind.text.format(abs(size) / kind.si, sigma / kind.si, "large" if size > 0.0 else "small")
    return Finding(
        cause=kind.cause,
        item=item,
        text=f"{n} places in the strips show {words}: check the geo-reference of the chips.",
        value=size / kind.si,
        sigma=sigma / kind.si,
        unit=kind.unit,
        file="targets.csv",
        field="chip",
        refutes=True,
    )


def _smeared(dump: Dump, entries: Sequence[Entry]) -> Iterator[Finding]:
    """Strips of the sky whose stars are not those of the stated TDI stages. By half of the stages a row's
    time differs from a label at their start or end: then the matrix is refuted.
    """
    camera = dump.line_camera
    label_matters = isinstance(camera, LineCamera) and camera.time_of_row != "middle"
    file, field = "remote_camera.toml", "tdi_stages, time_of_row"
    for one in (entry for entry in entries if entry.reason is Reason.OTHER_SMEAR):
        yield Finding.about("TDI stages", one.subject, f"{one.text}.", file, field, refutes=label_matters)


def _assumed_noise(head: Head) -> Finding:
    text = "white noise is assumed: errors that last longer are not in sigma; state them in dump.toml, "
    text, field = f"{text}or estimate them by `boresight noise --write`.", "star_cameras.noise"
    return Finding.about("noise of a star camera", head.subject, text, "dump.toml", field, is_fault=False)


def assumed_motion(strips: Sequence[StripSightings], settings: CalibrationSettings) -> Iterator[Finding]:
    """That no strip, with fitted attitudes and no gyro, has exposures enough to show its motion."""
    strips = [strip for strip in strips if strip.gyro is None]
    if settings.sigma_motion_rad and strips and not motion_is_shown(strips):
        most = max(len(strip.exposures) for strip in strips)
        yield Finding(
            cause="motion between exposures",
            item=f"{most} star exposures a strip, at most",
            text=f"{settings.sigma_motion_rad / ARCSEC:.3g}″ within {settings.motion_time_s:.2g} s are "
            "assumed, not measured: take 3 exposures or more, or state motion_arcsec and motion_s.",
            file="dump.toml",
            field="motion_arcsec, motion_s",
            is_fault=False,
        )


def _heights(basis: Basis, targets: Mapping[str, Target], tasks: Sequence[StripTask]) -> Iterator[Finding]:
    if not isinstance(basis.dump.terrain, TerrainFiles) or len(targets) < FEWEST:
        return
    lat, lon, height = geodetic_from_ecef(np.array([target.p_e for target in targets.values()]), WGS84)
    above = height - basis.surface.height_m(lat, lon)
    strips = {task.strip.subject.words: {target.target_id for target in task.targets} for task in tasks}
    yield from heights(list(targets), above, lambda: float(np.median(egm96().undulation_m(lat, lon))), strips)


def heights(
    names: Sequence[str], above_m: Floats, geoid_m: Callable[[], float], strips: Mapping[str, Collection[str]]
) -> Iterator[Finding]:
    """Targets (N) that lie above or below the terrain model: all of them, several alike, or single ones;
    `strips` have the names of those in view, `geoid_m` the geoid's height over the ellipsoid there.
    """
    known = np.isfinite(above_m)
    if known.sum() < FEWEST:
        return
    on_model = known & (np.abs(above_m) < SINGLE_HEIGHT_M)
    right = above_m[on_model if 2 * on_model.sum() >= known.sum() else known]  # half of them may be off
    middle = float(np.median(right))
    scatter = MAD_SIGMA * float(np.median(np.abs(right - middle)))
    if abs(middle) >= max(SMALLEST_HEIGHT_M, CLEAR_SIGMAS * scatter / np.sqrt(known.sum())):
        n, size = int(known.sum()), f"{middle:+.1f} m (median)"
        text = f"{n} targets differ from the terrain model by {size}: check height_m."
        cause, item = "heights of targets or terrain", "all targets, or the terrain model"
        if abs(abs(middle) - abs(geoid := geoid_m())) < AS_GEOID * abs(geoid):
            cause, item = "kind of height", "all targets"
            true, stated = ("ellipsoidal", "EGM96") if middle * geoid > 0.0 else ("EGM96", "ellipsoidal")
            text = (
                f"{n} targets differ by {size}, as the geoid: the targets' heights are {true} but stated as "
                f"{stated}, or the terrain's conversely: check height_kind."
            )
        yield Finding(cause=cause, item=item, text=text, file="targets.csv", field="height_m, height_kind")
    elif scatter > SINGLE_HEIGHT_M:
        n, size = int(known.sum()), f"{scatter:.0f} m"
        text = f"{n} targets scatter about it by {size}: check its geo-reference, and height_m."
        cause, item = "heights of targets or terrain", "all targets, or the terrain model"
        yield Finding(cause=cause, item=item, text=text, file="terrain, targets.csv", refutes=True)
    off = np.abs(np.where(known, above_m - middle, 0.0))
    odd = np.flatnonzero(off > max(SINGLE_HEIGHT_M, SINGLE_SIGMAS * scatter))
    alike = len(odd) > FEWEST and np.ptp(above_m[odd]) < SINGLE_HEIGHT_M
    for group in [odd] if alike else odd[:FEWEST, None]:
        those = [names[n] for n in group.tolist()]
        having = [(len(seen), strip) for strip, seen in strips.items() if set(those) <= set(seen)]
        of_strip = f" of {min(having)[1]}" if having else ""
        yield Finding(
            cause="height",
            item=f"{len(those)} targets{of_strip}" if alike else f"target {those[0]}",
            text=f"{np.median(above_m[group]) - middle:+.0f} m above the terrain, compared with the other "
            "targets; check height_m.",
            subjects=tuple(Subject(Kind.TARGET, id=name) for name in those),
        )


# m on the equator; a smaller error of predicted values is below that of any orbit and survey
NOTICEABLE_M = 0.1
# m on the equator: a mission that takes one value for several days is off by the length of day, at most 3 ms
# or 1.4 m each day, and by the pole's motion, 0.1 m each day; a table of another month by tens of metres
LARGEST_DIFFERENCE_M = 5.0


@record(kw_only=True)
class EarthTableCheck:
    """How well the Earth orientation that a dump is calibrated with is known at its date."""

    source: str = scalar("the bundled series, or the mission's own file")
    first_day: int = scalar("modified Julian date (UTC) of the first row of the table")
    last_day: int = scalar("the same of the last row")
    last_measured_day: int = scalar("the same of the last row that is no prediction")
    sigma_m: float = scalar("1-sigma of predicted or extrapolated values, on the equator, m; 0: measured")
    difference_m: float = scalar("of the mission's own table from the IERS series, on the equator, m")
    difference_ut1_s: float = scalar("the part of it that is UT1, own less IERS, s")


def check_earth_table(
    orbit: Orbit, table: EarthOrientationTable, reference: EarthOrientationTable
) -> EarthTableCheck:
    """`table` is that of the orbit, `reference` the bundled one, with which it is compared in mid-orbit."""
    middle = 0.5 * (orbit.earth.t_start_s + orbit.earth.t_stop_s)
    turn, sigma_m = np.zeros(3), orbit.earth.expected_error_m
    if table is not reference:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EarthOrientationWarning)  # sigma_m has it
            iers = EarthRotation.over(orbit.epoch, middle, middle, reference, allow_stale_eop=True)
        turn = (iers.rotations_ie(middle).inv() * orbit.earth.rotations_ie(middle))[0].as_rotvec()
        sigma_m = max(sigma_m, iers.expected_error_m)
    return EarthTableCheck(
        source=table.source,
        first_day=int(table.mjd_utc[0]),
        last_day=int(table.mjd_utc[-1]),
        last_measured_day=int(table.mjd_last_measured),
        sigma_m=sigma_m,
        difference_m=float(np.linalg.norm(turn)) * WGS84.semi_major_m,
        difference_ut1_s=float(turn[2]) / EARTH_ROTATION_RATE,
    )


def earth_findings(check: EarthTableCheck, file: str, places: Collection[Target]) -> Iterator[Finding]:
    """Findings of that check; `file` is the mission's own table, empty for the bundled one.

    A survey has errors. `places` whose 1-sigma are all 0 were computed by the mission's own model, to which
    its table belongs: its difference from the IERS series is then no fault.
    """
    if check.difference_m > max(LARGEST_DIFFERENCE_M, CLEAR_SIGMAS * check.sigma_m):
        is_model = len(places) > 0 and not any(place.sigma_m.any() for place in places)
        belongs = "it belongs to exact places, computed with it"
        yield Finding(
            cause="Earth orientation",
            item="own table",
            text=f"{check.difference_m:.0f} m on the equator from the IERS series (UT1 "
            f"{check.difference_ut1_s:+.4f} s); {belongs if is_model else 'take the values of the dates'}.",
            value=check.difference_m,
            sigma=check.sigma_m,
            unit="m",
            is_fault=not is_model,
            file=file,
            field="ut1_utc_s",
        )
    elif check.sigma_m > NOTICEABLE_M and not file:
        yield Finding(
            cause="Earth orientation",
            item="predicted values",
            text=f"{check.sigma_m:.1f} m on the equator (1 sigma), in the covariance; "
            "install a newer astropy-iers-data.",
            sigma=check.sigma_m,
            unit="m",
            is_fault=False,
        )
