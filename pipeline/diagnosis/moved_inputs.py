"""Inputs of a dump whose errors are found by predicting again: clock of the exposures, aberration left in
attitudes and the line of sight through which it is taken, velocity of the satellite, and the effects on
light from the ground.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.moved_input import MovedInput
from boresight.geometry.attitude import ConstantRate
from boresight.geometry.constants import SPEED_OF_LIGHT
from boresight.geometry.groundlight import LightEffects, apparent_ground_directions
from boresight.geometry.record import Floats
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import Head, SolvedAttitudes
from boresight.pipeline.files.star_tables import survey_of
from boresight.pipeline.stages.strip import StripTask

__all__ = ["moved_inputs"]

AU_PER_DAY = erfa.DAU / erfa.DAYSEC  # m/s
MILLI = 1e-3  # size of an error whose effect is computed: milliseconds, millimetres or milliradians
KM_S = 1e3  # ... of a velocity, m/s: a kilometre a second
# Axes of the orbit (`Orbit.R_oi`), and what a finding says of a positive and a negative error along each.
AXES = (
    ("along the track", ("too large", "too small")),
    ("across the track", ("too far right", "too far left")),
    ("radial", ("too far down", "too far up")),
)
Switch = Callable[[LightEffects, bool], LightEffects]
# How each effect of light is switched, by its key in `[conventions]`.
EFFECTS: Mapping[str, Switch] = {
    "light_time": lambda effects, on: replace(effects, light_time=on),
    "aberration": lambda effects, on: replace(effects, aberration=on),
    "refraction": lambda effects, on: replace(effects, refraction=on),
}


def moved_inputs(
    dump: Dump, strips: Sequence[StripSightings], tasks: Sequence[StripTask]
) -> tuple[MovedInput, ...]:
    """All such inputs of a dump whose strips are `strips`; `tasks` are those of the ground."""
    head = dump.heads[0]
    found = [_clock_of_exposures(head, strips)]
    if isinstance(head.source, SolvedAttitudes):
        found += _aberration_of_head(dump, head, strips)
        found += _line_of_sight(dump, head, head.source, strips)
    if sky := [strip for strip in strips if strip.ground.is_star.any()]:
        found += _velocity(dump, head, sky)
        found += _catalogue(dump, sky)
    by_id = {task.strip.strip_id: task for task in tasks}
    if ground := [strip for strip in strips if strip.strip_id in by_id]:
        found += _light(ground, by_id)
    return tuple(found)


def _times(strip: StripSightings) -> Floats:
    return np.array([exposure.t_s for exposure in strip.exposures])


def _middle_s(strips: Sequence[StripSightings]) -> Floats:
    return np.array([float(strips[0].ground.t_s[0])])


def _attitudes(strip: StripSightings) -> Floats:
    assert strip.attitudes is not None
    return strip.attitudes.R_si


def _clock_of_exposures(head: Head, strips: Sequence[StripSightings]) -> MovedInput:
    """Exposures dated late: attitudes of an earlier instant, at the rate of rotation of the strip."""
    turns = {}
    for strip in strips:
        seen = strip.attitudes.usable if strip.attitudes is not None else np.zeros(0, dtype=bool)
        if seen.sum() > 1:
            motion = ConstantRate.fitted(_times(strip)[seen], Rotation.from_matrix(_attitudes(strip)[seen]))
            turns[strip.strip_id] = np.tile(MILLI * motion.omega_o, (len(seen), 1))
    solved = head.source.file if isinstance(head.source, SolvedAttitudes) else ""
    return MovedInput(
        cause="clock of the exposures",
        item=head.subject.words if solved else "all exposures",
        subjects=(head.subject,) if solved else (),
        unit="ms",
        words=("too late", "too early"),
        file=solved or "exposures.csv",
        field="utc" if solved else "utc_mid",
        usual=10.0,
        turns_s=turns,
    )


def _turned_by_velocity(R_si: Floats, v_i: Floats, line_of_sight_s: Floats) -> Floats:
    """Rotations (K, 3), axes of s, of attitudes (K, 3, 3) fitted to stars whose aberration is too large by
    that of a velocity (K, 3): the line of sight (3,), axes of s, goes back by what the stars went forward.
    """
    beta_s = np.einsum("kab,kb->ka", R_si, v_i) / SPEED_OF_LIGHT
    return -np.cross(line_of_sight_s, beta_s)


def _turns(
    strips: Sequence[StripSightings], velocity: Callable[[Floats], Floats], line_of_sight_s: Floats
) -> dict[str, Floats]:
    """The same strip by strip, by a velocity at each instant."""
    return {
        strip.strip_id: _turned_by_velocity(_attitudes(strip), velocity(_times(strip)), line_of_sight_s)
        for strip in strips
        if strip.exposures
    }


def _velocities(dump: Dump) -> Mapping[str, Callable[[Floats], Floats]]:
    """Velocities (K, 3) m/s, GCRS, whose aberration an attitude may contain, by the part's name."""

    def annual(t_s: Floats) -> Floats:
        return np.asarray(erfa.epv00(*dump.epoch.tt_jd(t_s))[1]["v"] * AU_PER_DAY)

    def orbital(t_s: Floats) -> Floats:
        return dump.orbit.states_i(t_s)[1]

    return {"annual": annual, "orbital": orbital}


def _aberration_of_head(dump: Dump, head: Head, strips: Sequence[StripSightings]) -> Iterator[MovedInput]:
    for name, velocity in _velocities(dump).items():
        yield MovedInput(
            cause=f"aberration of the attitudes, {name}",
            item=head.subject.words,
            subjects=(head.subject,),
            unit="times",
            words=("too much", "too little"),
            file="dump.toml",
            field=f"aberration_removed of {head.name}",
            most=2.0,
            turns_s=_turns(strips, velocity, head.line_of_sight_s),
        )


def _line_of_sight(
    dump: Dump, head: Head, source: SolvedAttitudes, strips: Sequence[StripSightings]
) -> Iterator[MovedInput]:
    """The stated line of sight u of a head, moved along two directions d across it, axes of s.

    The aberration that the head has left in, of velocity v, turns its attitudes by -u x v/c; with u + d they
    turn by -d x v/c more. The part of d across v turns them about u, along v it does nothing.
    """
    left = {"none": ("annual", "orbital"), "annual": ("orbital",), "annual and orbital": ()}
    parts = [_velocities(dump)[name] for name in left[source.aberration_removed]]
    if not parts:  # the line of sight is not used
        return

    def left_in(t_s: Floats) -> Floats:
        return np.asarray(np.sum([velocity(t_s) for velocity in parts], axis=0))

    u_s = head.line_of_sight_s
    first = np.cross(u_s, np.eye(3)[np.argmin(np.abs(u_s))])
    first /= np.linalg.norm(first)
    for d_s in (first, np.cross(u_s, first)):
        direction = ", ".join(f"{value:.2f}" for value in d_s + 0.0)
        yield MovedInput(
            cause="line of sight of the attitudes",
            item=f"head {head.name}, towards [{direction}]",
            unit="deg",
            words=("too far", "too short"),
            file="dump.toml",
            field=f"line_of_sight of {head.name}",
            turns_s=_turns(strips, left_in, np.radians(1.0) * d_s),
        )


def _velocity(dump: Dump, head: Head, strips: Sequence[StripSightings]) -> Iterator[MovedInput]:
    """Velocity of the satellite in its orbital frame: stars show it by their aberration alone."""
    source = head.source
    in_attitudes = (
        not isinstance(source, SolvedAttitudes) or source.aberration_removed != "annual and orbital"
    )
    for axis, (name, words) in enumerate(AXES):

        def velocity(t_s: Floats, axis: int = axis) -> Floats:
            return np.asarray(KM_S * dump.orbit.R_oi(t_s).as_matrix()[:, axis])

        directions = {}
        for strip in strips:
            u_i, v_i = strip.ground.u_i, velocity(strip.ground.t_s)
            along = np.sum(u_i * v_i, axis=1, keepdims=True)
            directions[strip.strip_id] = (v_i - along * u_i) / SPEED_OF_LIGHT
        yield MovedInput(
            cause=f"velocity of the orbit, {name}",
            item="all scans",
            unit="km/s",
            words=words,
            file="orbit",
            field="velocity, date and frame",
            most=2.0 * float(np.linalg.norm(dump.orbit.states_i(_middle_s(strips))[1])) / KM_S,
            usual=1e-3,
            directions_i=directions,
            turns_s=_turns(strips, velocity, head.line_of_sight_s) if in_attitudes else {},
        )


def _catalogue(dump: Dump, strips: Sequence[StripSightings]) -> Iterator[MovedInput]:
    """A star catalogue of the user's whose epoch, proper motions or equinox are a year off: stars move by
    their proper motions, or all alike by precession.
    """
    if dump.star_catalogue is None:
        return
    survey = survey_of(dump.star_catalogue)
    row = {f"{survey.name} {n}": k for k, n in enumerate(survey.places.hip.tolist())}
    precession = Rotation.from_matrix(erfa.pmat06(erfa.DJ00, erfa.DJY)).as_rotvec()
    moves: dict[str, dict[str, Floats]] = {"ref_epoch, pmra, pmdec": {}, "equinox (ICRS is expected)": {}}
    of_epoch, of_equinox = moves.values()
    for strip in strips:
        rows = np.array([row.get(name, 0) for name in strip.ground.target_id.tolist()], dtype=np.int64)
        is_star = strip.ground.is_star[:, None].astype(float)
        of_epoch[strip.strip_id] = -is_star * survey.places.take(rows).motions()
        of_equinox[strip.strip_id] = is_star * np.cross(precession, strip.ground.u_i)
    for field, directions in moves.items():
        yield MovedInput(
            cause=f"catalogue of the stars, {'epoch' if directions is of_epoch else 'equinox'}",
            item="all scans",
            unit="years",
            words=("too late", "too early"),
            file=dump.star_catalogue.file,
            field=field,
            most=200.0,
            usual=25.0,
            directions_i=directions,
        )


def _light(strips: Sequence[StripSightings], tasks: Mapping[str, StripTask]) -> Iterator[MovedInput]:
    """Effects on light from the ground, modelled and not."""
    for key, switched in EFFECTS.items():
        directions = {}
        for strip in strips:
            task = tasks[strip.strip_id]
            place = {one.target_id: one.p_e for one in (*task.targets, *task.points.targets)}
            p_e = np.array([place[one] for one in strip.ground.target_id.tolist()], dtype=float).reshape(
                -1, 3
            )
            on, off = (
                apparent_ground_directions(
                    p_e, strip.ground.t_s, task.orbit, task.orbit.earth, switched(task.effects, modelled)
                )[0]
                for modelled in (True, False)
            )
            directions[strip.strip_id] = on - off
        yield MovedInput(
            cause=f"light of the targets, {key.replace('_', ' ')}",
            item="all targets",
            unit="times",
            words=("too much", "too little"),
            file="dump.toml",
            field=f"light.{key}",
            most=1.0,
            directions_i=directions,
        )
