"""Conventions of attitudes, installation matrices and tables, tried where no strip sees what it must see.

A quaternion of the other sense, with its scalar first, or the files of two heads exchanged turn the camera by
tens of degrees: far from any linear test. So do times and points that are read in another way
(`other_readings`). Each is put right in memory, and the strips that then see their
stars or targets are counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.finding import Finding
from boresight.geometry.record import Floats
from boresight.pipeline.diagnosis.missing import misses
from boresight.pipeline.diagnosis.other_readings import Convention, other_readings
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import Head, SolvedAttitudes
from boresight.pipeline.stages.strip import StripTask, pushbroom_of

__all__ = ["likely_convention", "sees_its_targets"]


def likely_convention(dump: Dump, agreeing: Callable[[Dump], int]) -> Finding | None:
    """The change of a convention with which most strips agree with what they must see, more than as stated;
    None where there is none. `agreeing` counts such strips.
    """
    strips, stated = len(dump.strips) + len(dump.sky_strips), agreeing(dump)
    if 2 * stated > strips:
        return None
    found = [(agreeing(one.dump), one) for one in (*_conventions(dump), *other_readings(dump))]
    count, best = max(found, key=lambda pair: pair[0])
    if count <= stated or 2 * count <= strips:
        return None
    return Finding(
        cause=best.cause,
        item=best.item,
        text=f"{best.changed} {count} of {strips} strips see their stars or targets, as stated {stated}: "
        f"check {best.field} in {best.file}.",
        file=best.file,
        field=best.field,
        refutes=True,
    )


def _conventions(dump: Dump) -> Iterator[Convention]:
    """Every convention changed alone, the commonest mistakes first."""
    for n, head in enumerate(dump.heads):
        item = f"head {head.name}"
        yield Convention(
            cause="sense of the installation matrix",
            item=item,
            changed="inverted,",
            file=f"the installation file of {head.name}",
            field="quaternion_cs",
            dump=_with_head(dump, n, replace(head, R_cs0=head.R_cs0.inv())),
        )
        if isinstance(head.source, SolvedAttitudes):
            R_si = head.source.rows.R_si
            yield Convention(
                cause="sense of the attitudes' rotation",
                item=item,
                changed="with the quaternions conjugated",
                file="dump.toml",
                field="star_cameras.rotation",
                dump=_with_head(dump, n, _with_attitudes(head, head.source, R_si.inv())),
            )
            for is_inverse in (True, False):
                yield Convention(
                    cause="order of the quaternions' components",
                    item=item,
                    changed="with the scalar first",
                    file=head.source.file,
                    field="qx, qy, qz, qw",
                    dump=_with_head(
                        dump,
                        n,
                        _with_attitudes(head, head.source, _scalar_first(R_si, is_inverse=is_inverse)),
                    ),
                )
    solved = [n for n, head in enumerate(dump.heads) if isinstance(head.source, SolvedAttitudes)]
    for a, b in pairwise(solved):
        one, other = dump.heads[a], dump.heads[b]
        exchanged = _with_head(dump, a, replace(one, source=other.source))
        yield Convention(
            cause="files of two heads",
            item=f"heads {one.name} and {other.name}",
            changed="exchanged,",
            file="dump.toml",
            field="star_cameras.attitudes",
            dump=_with_head(exchanged, b, replace(other, source=one.source)),
        )


def _with_head(dump: Dump, n: int, head: Head) -> Dump:
    return replace(dump, heads=(*dump.heads[:n], head, *dump.heads[n + 1 :]))


def _with_attitudes(head: Head, source: SolvedAttitudes, R_si: Rotation) -> Head:
    return replace(head, source=replace(source, rows=replace(source.rows, R_si=R_si)))


def _scalar_first(R_si: Rotation, *, is_inverse: bool) -> Rotation:
    """The attitudes if the first of four numbers was the scalar; the file states them, or their inverses."""
    stated = (R_si.inv() if is_inverse else R_si).as_quat()
    meant = Rotation.from_quat(np.roll(stated, -1, axis=1))
    return meant.inv() if is_inverse else meant


def sees_its_targets(task: StripTask, dump: Dump) -> bool:
    """Whether a strip shows a target, or its measured points lie where the pre-launch matrix allows."""
    points = task.points
    if not len(points.ccd):
        outside = misses(task, dump.targets)[0] if dump.targets else np.full((1, 2), np.nan)
        return bool((np.hypot(*outside.T) == 0.0).any())
    limit_px = task.settings.sigmas * float(task.sigma_installation_rad.max()) / task.camera.pixel_rad
    p_e = np.array([target.p_e for target in points.targets])
    near: Floats = np.zeros(len(points.ccd))
    for ccd in np.unique(points.ccd).tolist():
        here = points.ccd == ccd
        sample, line = pushbroom_of(task).pixels_from_ground(ccd, p_e[here])
        off_px = np.hypot(sample - points.xy_px[here, 0], line - points.xy_px[here, 1])
        near[here] = np.nan_to_num(off_px, nan=np.inf) < limit_px
    return bool(near.mean() > 0.5)
