"""First screen of a report: what was calibrated, how well, whether that is enough, and what would help."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.report.observations import TargetCard
from boresight.pipeline.report.page_template import Number, number_from
from boresight.pipeline.report.saved import Saved
from boresight.pipeline.results.summary import REASON_WORDS
from boresight.records.ledger import State
from boresight.records.record import record, scalar

__all__ = ["FirstScreen", "Help", "Required", "first_screen", "required", "sigma_on_ground"]

MOST_GROUPS = 4  # of things that are not used, on the page's first screen


@record(kw_only=True)
class Required:
    """A required accuracy and whether each axis meets it."""

    words: str = scalar("what is required")
    limit: Number = scalar("largest 1-sigma allowed")
    met: tuple[bool, bool, bool] = scalar("about X, Y, Z")

    @property
    def missed(self) -> str:
        """Axes that do not meet it."""
        return ", ".join(axis for axis, met in zip("XYZ", self.met) if not met)


@record(kw_only=True)
class Help:
    """What one change of the data would do to the weakest axis."""

    change: str = scalar("what is different")
    sigma_arcsec: tuple[Number, ...] = scalar("1-sigma about X, Y, Z then")
    gain: float = scalar("by which share the 1-sigma of the weakest axis falls")


@record(kw_only=True)
class FirstScreen:
    """Everything above the fold but verdict and map."""

    about: tuple[str, ...] = scalar("mission, satellite, dates, cameras; one line each")
    sigma_arcsec: tuple[Number, ...] = scalar("1-sigma about X, Y, Z")
    sigma_m: tuple[Number, ...] = scalar("their effect on the ground")
    required: tuple[Required, ...] = scalar("requirements; empty if none was given")
    weakest: int = scalar("axis with the largest 1-sigma, 0 to 2")
    helps: tuple[Help, ...] = scalar("changes of the data, the one that helps the weakest axis most first")
    new_strip_ce90: Number = scalar("CE90 of a pixel of another strip, m")
    rejected: tuple[tuple[str, int, tuple[tuple[str, int], ...]], ...] = scalar(
        "by kind: how many are not used, and how many for which reason"
    )
    findings: tuple[dict[str, Any], ...] = scalar(
        "of context.json, the most specific first, with the `rows` of the targets that each explains"
    )
    items: tuple[tuple[TargetCard, ...], ...] = scalar(
        "targets in view that were not used and that no finding explains, of one strip and cause each"
    )


def first_screen(saved: Saved, targets: Sequence[TargetCard]) -> FirstScreen:
    """The first screen of a saved result with the rows of its targets."""
    findings = _findings(saved, targets)
    explained = {row.link for one in findings for row in one["rows"]}
    unused = [
        row for row in targets if row.state in (State.REJECTED, State.UNMATCHED) and row.link not in explained
    ]
    sigma_arcsec = tuple(
        saved.number(f"covariance_rad2.{i}.{i}", ".4f", scale=1.0 / ARCSEC, root=True) for i in range(3)
    )
    sigma_m = sigma_on_ground(saved.installation)
    weakest = int(np.argmax([number.exact for number in sigma_arcsec]))
    return FirstScreen(
        about=_about(saved),
        sigma_arcsec=sigma_arcsec,
        sigma_m=sigma_m,
        required=required(saved.requirement, sigma_arcsec, sigma_m),
        weakest=weakest,
        helps=_helps(saved, sigma_arcsec, weakest),
        new_strip_ce90=saved.context_number("new_strip.ce90_m", ".1f"),
        rejected=_rejected(saved),
        findings=findings,
        items=_items(unused),
    )


def sigma_on_ground(installation: dict[str, Any], camera: int = -1) -> tuple[Number, ...]:
    """1-sigma about X, Y, Z as metres on the ground, of one of several cameras; not known where no strip sees
    it.
    """
    matrix, of = (installation, "") if camera < 0 else (installation["cameras"][camera], f"cameras.{camera}.")
    return tuple(
        number_from(
            installation,
            "installation.json",
            f"{of}covariance_rad2.{i}.{i}",
            ".2f",
            scale=float("nan") if lever is None else lever,
            root=True,
        )
        for i, lever in enumerate(matrix["ground_m_per_rad"])
    )


def _about(saved: Saved) -> tuple[str, ...]:
    context = saved.context
    star, remote = context["star_camera"], context["remote_camera"]
    first, last = (str(utc)[:19].replace("T", " ") for utc in context["utc"])
    until = last[11:] if last[:10] == first[:10] else last
    samples = remote["samples"]
    sizes = f"{len(samples)} × {samples[0]}" if len(set(samples)) == 1 else " + ".join(map(str, samples))
    pixel_m = context["ground"]["range_m"] * remote["pixel_rad"]
    on_ground = saved.installation["ground_m_per_rad"][0] is not None
    satellite = f"{context['satellite']}; " if context["satellite"] else ""
    focal = f", {remote['focal_m']:.4g} m" if remote["focal_m"] else ""
    return (
        f"{satellite}{first} to {until} UTC",
        f"{_star_camera(star)} "
        f"Remote-sensing camera {sizes} px{focal}{f', {pixel_m:.2g} m a pixel on the ground' * on_ground}. "
        f"Satellite {context['altitude_m'] * 1e-3:.0f} km above the ellipsoid.",
    )


def _star_camera(star: dict[str, Any] | None) -> str:
    if star is None:
        return "Star camera that delivers attitudes."
    width_deg = np.degrees(2.0 * np.arctan(0.5 * star["width_px"] * star["pixel_rad"]))
    size = f"{star['width_px']} × {star['height_px']} px"
    return f"Star camera {size}, {star['focal_mm']:.4g} mm, {width_deg:.1f}° wide."


def required(
    requirement: dict[str, Any], sigma_arcsec: Sequence[Number], sigma_m: Sequence[Number]
) -> tuple[Required, ...]:
    """The limits of a requirement.json, with 1-sigmas about X, Y, Z held against them."""
    cases = (("arcsec", "″ about every axis", sigma_arcsec), ("m", " m on the ground", sigma_m))
    found = []
    for key, words, values in cases:
        if requirement.get(key) is None:
            continue
        limit = number_from(requirement, "requirement.json", key, ".4g")
        x, y, z = (value.exact * value.scale <= limit.exact for value in values)
        found.append(Required(words=words, limit=limit, met=(x, y, z)))
    return tuple(found)


def _helps(saved: Saved, now: tuple[Number, ...], weakest: int) -> tuple[Help, ...]:
    helps = []
    for n, one in enumerate(saved.context["improvements"]):
        key = f"improvements.{n}.sigma_rad"
        then = tuple(saved.context_number(f"{key}.{i}", ".3g", scale=1.0 / ARCSEC) for i in range(3))
        gain = 1.0 - then[weakest].exact / now[weakest].exact
        helps.append(Help(change=one["change"], sigma_arcsec=then, gain=gain))
    return tuple(sorted(helps, key=lambda one: -one.gain))


def _findings(saved: Saved, targets: Sequence[TargetCard]) -> tuple[dict[str, Any], ...]:
    rows: dict[tuple[str, str], list[TargetCard]] = {}
    for row in targets:
        rows.setdefault((row.strip_id, row.target_id), []).append(row)
    found = []
    for one in saved.context["findings"]:
        names = dict.fromkeys((subject["strip"], subject["id"]) for subject in one["explains"])
        found.append(one | {"rows": tuple(row for name in names for row in rows.get(name, ()))})
    return tuple(found)


def _items(unused: Sequence[TargetCard]) -> tuple[tuple[TargetCard, ...], ...]:
    """Groups of one strip and cause, the smallest first: single targets are likelier to be a mistake."""
    groups: dict[tuple[str, str, str], list[TargetCard]] = {}
    for row in unused:
        groups.setdefault((row.strip_id, row.state, row.why), []).append(row)
    return tuple(map(tuple, sorted(groups.values(), key=len)[:MOST_GROUPS]))


def _rejected(saved: Saved) -> tuple[tuple[str, int, tuple[tuple[str, int], ...]], ...]:
    rows: list[dict[str, Any]] = saved.ledger.to_pylist()
    order = ("strip", "ccd", "exposure", "chip", "target", "star")
    causes: dict[str, Counter[str]] = {}
    for row in rows:
        causes.setdefault(row["kind"], Counter())[REASON_WORDS.get(row["cause"], row["cause"])] += 1
    kinds = sorted(causes, key=lambda kind: order.index(kind) if kind in order else len(order))
    return tuple((kind, causes[kind].total(), tuple(causes[kind].most_common())) for kind in kinds)
