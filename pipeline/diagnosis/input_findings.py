"""What the inputs of a calibration contradict by themselves, without its residuals."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from boresight.calib.estimate import WhyRejected
from boresight.calib.finding import Finding
from boresight.calib.settings import CalibrationSettings
from boresight.calib.slow_motion import motion_is_shown
from boresight.gct_match.records import Reason, Target
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.geoid import egm96
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.record import Floats
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.errors import Cause, Omission
from boresight.pipeline.files.dump import Dump, TerrainFiles, surface_of
from boresight.pipeline.files.star_side import Head
from boresight.pipeline.stages.coordinate_slips import off_middle_m
from boresight.pipeline.stages.strip import StripTask, compass

__all__ = ["assumed_motion", "given_twice", "heights", "input_findings", "outside_chips", "shifted_chips"]

FEWEST = 3  # targets that make a pattern
SMALLEST_HEIGHT_M = 5.0  # systematic difference of heights that is reported
SINGLE_HEIGHT_M = 30.0  # ... of one target from the others: slopes and trees stay below
ALIKE = 0.1  # of their distance, by which targets may be apart that lie off their chips alike
MOST_CHIPS = 256  # that are opened for it
SHOWN = 4  # most names in the sentence of a finding; "and N more" follows
WRONG = (Reason.OUTSIDE_CHIP, Reason.INCONSISTENT)  # refusals of targets whose place is wrong


def input_findings(dump: Dump, tasks: Sequence[StripTask], omissions: Sequence[Omission]) -> list[Finding]:
    """All such findings; `tasks` are the strips that were matched and `omissions` what is not used."""
    every = {target.target_id: target for task in tasks for target in task.targets}
    wrong = {reason.replace("_", " ") for reason in WRONG} | {WhyRejected.TARGET_RESIDUAL.value}
    without = {one.target_id for one in omissions if one.cause in wrong}
    return [
        *given_twice(omissions),
        *(shifted := list(shifted_chips(dump, omissions))),
        *(() if shifted else outside_chips(omissions)),
        *_smeared(dump, omissions),
        *(_assumed_noise(head) for head in dump.heads if head.noise_is_assumed),
        *_heights(dump, {name: target for name, target in every.items() if name not in without}),
    ]


def given_twice(omissions: Sequence[Omission]) -> Iterator[Finding]:
    """Strips, CCDs, exposures and targets that repeat others, and images that several rows name."""
    tables = [*TABLES.items(), ("target", "points.csv")]
    for kind, table in tables:
        of_points = table == "points.csv"
        of_kind = [one for one in omissions if one.kind == kind and (one.file == "points.csv") == of_points]
        for cause, text in SEVERAL.items():
            names = [one.name for one in of_kind if one.cause == cause]
            if names:
                more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
                yield Finding(
                    cause=cause.value,
                    item=f"{len(names)} {kind}{'s' if len(names) > 1 else ''}",
                    text=f"{', '.join(names[:SHOWN])}{more}: {text} {table}.",
                    file=table,
                    is_fault=kind != "target" or of_points,  # chips may overlap
                )


# File of a dump that states a kind of thing, for the messages of findings.
TABLES = {
    "strip": "strips.csv",
    "ccd": "strips.csv",
    "exposure": "exposures.csv",
    "head": "dump.toml",
    "target": "targets.csv",
}
# What a finding says of items of one cause, before the file to correct.
SEVERAL = {
    Cause.REPEATED: "not independent of others, so left out; remove from",
    Cause.SAME_PIXELS: "one image under several times, so none is used; correct file in",
}


def outside_chips(omissions: Sequence[Omission]) -> Iterator[Finding]:
    """Targets that do not lie in their chips, each once."""
    of_target: dict[str, list[Omission]] = defaultdict(list)
    for one in omissions:
        if one.kind == "target" and one.cause == Cause.OUTSIDE_CHIP:
            of_target[one.target_id].append(one)
    alike: dict[str, list[str]] = defaultdict(list)
    for name, those in of_target.items():
        slip = re.search(r"([^;]*) would lie in its chip", those[0].reason)
        alike[re.sub(r" \S+ for \S+", "", slip[1]).strip() if slip else ""].append(name)
    common = {words: names for words, names in alike.items() if len(names) > FEWEST}
    if common and alike.get(""):  # off by what is common, though no slip of digits puts them right
        common[""] = alike[""]
    for words, names in common.items():
        more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
        far = "lie far outside their chips" if len(names) > 1 else "lies far outside its chip"
        fits = f"lie in their chips with {words}" if words else far
        yield Finding(
            cause="coordinates",
            item=f"{len(names)} target{'s' if len(names) > 1 else ''}",
            text=f"{', '.join(names[:SHOWN])}{more} {fits}: correct lat_deg, lon_deg in targets.csv.",
            file="targets.csv",
            field="lat_deg, lon_deg",
            targets=tuple(names),
        )
    told = {name for names in common.values() for name in names}
    for name, those in ((name, those) for name, those in of_target.items() if name not in told):
        yield Finding(
            cause="coordinates or chip",
            item=f"target {name}",
            text=f"{those[0].reason}.",
            file="points.csv" if those[0].file == "points.csv" else "targets.csv",
            field="lat_deg, lon_deg",
            targets=tuple(one.name for one in those if "/" in one.name),
        )


def shifted_chips(dump: Dump, omissions: Sequence[Omission]) -> Iterator[Finding]:
    """That the coordinates of most targets lie as far outside their chips, in the same direction."""
    outside = {one.target_id for one in omissions if one.kind == "target" and one.cause == Cause.OUTSIDE_CHIP}
    pairs = [pair for pair in zip(dump.targets, dump.chips) if pair[0].target_id in outside]
    if len(pairs) <= max(FEWEST, len(dump.targets) // 2):
        return
    off_m = np.array([off_middle_m(*pair) for pair in pairs[:MOST_CHIPS]])
    middle_m = np.nanmedian(off_m, axis=0)
    apart_m = float(np.nanmedian(np.hypot(*(off_m - middle_m).T)))
    if apart_m < ALIKE * float(np.hypot(*middle_m)):
        yield Finding(
            cause="common shift of coordinates or chips",
            item=f"{len(pairs)} of {len(dump.targets)} targets",
            text=f"they lie {compass(*middle_m.tolist())} of the middle of their chips: check datum and "
            "geo-reference of the chips, lat_deg, lon_deg in targets.csv.",
            file="targets.csv",
            field="lat_deg, lon_deg, chip",
            targets=tuple(target.target_id for target, _ in pairs),
        )


def _smeared(dump: Dump, omissions: Sequence[Omission]) -> Iterator[Finding]:
    """Strips of the sky whose stars are not those of the stated TDI stages. By half of the stages a row's
    time differs from a label at their start or end: then the matrix is refuted.
    """
    camera = dump.line_camera
    label_matters = isinstance(camera, LineCamera) and camera.time_of_row != "middle"
    for one in omissions:
        if one.cause == Cause.OTHER_SMEAR:
            yield Finding(
                cause="TDI stages",
                item=f"strip {one.name}",
                text=f"{one.reason}.",
                file="remote_camera.toml",
                field="tdi_stages, time_of_row",
                refutes=label_matters,
            )


def _assumed_noise(head: Head) -> Finding:
    return Finding(
        cause="noise of a star camera",
        item=f"head {head.name}",
        text="white noise is assumed: errors that last longer are not in sigma; state them in dump.toml, "
        "or estimate them by `boresight noise --write`.",
        file="dump.toml",
        field="star_cameras.noise",
        is_fault=False,
    )


def assumed_motion(strips: Sequence[StripSightings], settings: CalibrationSettings) -> Iterator[Finding]:
    """That no strip has exposures enough to show how the satellite moves between them; `strips` with fitted
    attitudes.
    """
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


def _heights(dump: Dump, targets: Mapping[str, Target]) -> Iterator[Finding]:
    if not isinstance(dump.terrain, TerrainFiles) or len(targets) < FEWEST:
        return
    lat, lon, height = geodetic_from_ecef(np.array([target.p_e for target in targets.values()]), WGS84)
    above = height - surface_of(dump.terrain).height_m(lat, lon)
    yield from heights(list(targets), above, float(np.median(egm96().undulation_m(lat, lon))))


def heights(names: Sequence[str], above_m: Floats, geoid_m: float) -> Iterator[Finding]:
    """Targets (N) that lie above or below the terrain model, all of them or single ones."""
    known = np.isfinite(above_m)
    if known.sum() < FEWEST:
        return
    middle = float(np.median(above_m[known]))
    scatter = 1.4826 * float(np.median(np.abs(above_m[known] - middle)))
    if abs(middle) >= max(SMALLEST_HEIGHT_M, 3.0 * scatter / np.sqrt(known.sum())):
        n, size = int(known.sum()), f"{middle:+.1f} m (median)"
        text = f"{n} targets differ from the terrain model by {size}: check height_m."
        cause, item = "heights of targets or terrain", "all targets, or the terrain model"
        if abs(abs(middle) - abs(geoid_m)) < 0.2 * abs(geoid_m):
            cause, item = "kind of height", "all targets"
            true, stated = ("ellipsoidal", "EGM96") if middle * geoid_m > 0.0 else ("EGM96", "ellipsoidal")
            text = (
                f"{n} targets differ by {size}, as the geoid: the targets' heights are {true} but stated as "
                f"{stated}, or the terrain's conversely: check height_kind."
            )
        yield Finding(cause=cause, item=item, text=text, file="targets.csv", field="height_m, height_kind")
    off = np.abs(np.where(known, above_m - middle, 0.0))
    for n in np.flatnonzero(off > max(SINGLE_HEIGHT_M, 6.0 * scatter))[:FEWEST].tolist():
        text = f"it lies {above_m[n] - middle:+.0f} m above the terrain, compared with the other targets"
        yield Finding(cause="height", item=f"target {names[n]}", text=f"{text}; check its height_m.")
