"""Inputs whose errors no derivative of the estimate gives: clock of the exposures, aberration that is left in
attitudes and through which line of sight, velocity of the satellite, effects on light from the ground, unit
of heights; and an estimate held against all hypotheses about inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.estimate import InstallationEstimate
from boresight.calib.hypotheses import MovedInput
from boresight.calib.reliability import Reliability, examine
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude import ConstantRate
from boresight.geometry.constants import SPEED_OF_LIGHT
from boresight.geometry.groundlight import EFFECTS
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.sightings import GroundSightings, StripSightings
from boresight.geometry.starlight import earth_velocity_i
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import Head, SolvedAttitudes
from boresight.pipeline.files.star_tables import survey_of
from boresight.pipeline.files.terrain_files import TerrainFiles
from boresight.pipeline.stages.head import Basis
from boresight.records.record import Floats

__all__ = ["examined", "moved_inputs"]

MILLI, PERCENT = 1e-3, 1e-2  # sizes of errors whose effects are computed: of a second, of its rate
BOTH = "annual and orbital"  # parts of the aberration that a head may have removed
KM_S = 1e3  # ... of a velocity, m/s: a kilometre a second
USUAL_KM_S = 1e-3  # errors that a user may make: of a velocity
USUAL_YEARS, MOST_YEARS = 25.0, 200.0  # ... of an epoch or equinox
USUAL_PERCENT, MOST_PERCENT = 30.0, 400.0  # ... of heights
# Axes of the orbit (`Orbit.R_oi`), and what a finding says of a positive and a negative error along each.
AXES = (
    ("along the track", ("too large", "too small")),
    ("across the track", ("too far right", "too far left")),
    ("radial", ("too far down", "too far up")),
)
EQUINOXES = (1.0, 25.0, -25.0, -50.0)  # years from that of the ICRS, to which precession is taken as linear


def moved_inputs(dump: Dump, strips: Sequence[StripSightings]) -> tuple[MovedInput, ...]:
    """All such inputs of a dump whose strips are `strips`."""
    head = dump.heads[0]
    found = list(_clock_of_exposures(head, strips))
    if isinstance(head.source, SolvedAttitudes):
        found += _aberration_of_head(dump, head, strips)
        found += _line_of_sight(dump, head, head.source, strips)
    if sky := [strip for strip in strips if strip.ground.is_star.any()]:
        found += _velocity(dump, head, sky)
        found += _catalogue(dump, sky)
    if ground := [strip for strip in strips if not strip.ground.is_star.any()]:
        found += _of_ground(dump, ground)
    return tuple(found)


def examined(
    basis: Basis,
    estimate: InstallationEstimate,
    strips: Sequence[StripSightings],
    errors: CalibrationSettings,
    inputs: Sequence[MovedInput],
) -> Reliability:
    """The hypotheses about the inputs of a dump, held against an estimate that was made with `errors`."""
    camera = basis.dump.line_camera
    ccds = camera.ccds if isinstance(camera, LineCamera) else ()  # look angles are not rotated by CCD
    return examine(
        estimate,
        strips,
        errors,
        pixel_rad=camera.pixel_rad,
        star_camera=basis.dump.star_camera,
        inputs=inputs,
        pivots={("", n): ccd.principal_sample for n, ccd in enumerate(ccds)},
        target_files=basis.dump.target_files,
        sigma_understated=basis.settings.verdict.sigma_understated,
    )


def _clock_of_exposures(head: Head, strips: Sequence[StripSightings]) -> Iterator[MovedInput]:
    """Exposures dated late, alike, ever more over a strip, or every second one of all: attitudes of an
    earlier instant.
    """
    solved, (file, field) = isinstance(head.source, SolvedAttitudes), head.times_in
    every_s = np.unique([t_s for strip in strips for t_s in strip.times_s.tolist()])
    by_strip: dict[str, tuple[Floats, Floats]] = {}  # instants (K,), rate of rotation
    for strip in strips:
        seen = strip.attitudes.usable if strip.attitudes is not None else np.zeros(0, dtype=bool)
        if seen.sum() > 1:
            motion = ConstantRate.fitted(strip.times_s[seen], Rotation.from_matrix(strip.fitted.R_si[seen]))
            by_strip[strip.strip_id] = strip.times_s, motion.omega_o
    for which, unit, usual, late in (
        ("", "ms", 10.0, lambda t_s: np.full(len(t_s), MILLI)),
        (", rate", "%", 0.05, lambda t_s: PERCENT * (t_s - t_s[0])),
        (", every second one", "ms", 10.0, lambda t_s: MILLI * (np.searchsorted(every_s, t_s) % 2)),
    ):
        yield MovedInput(
            cause=f"clock of the exposures{which}",
            item=head.subject.words if solved else "all exposures",
            subjects=(head.subject,) if solved else (),
            unit=unit,
            words=("too late", "too early") if unit == "ms" else ("too fast", "too slow"),
            file=file,
            field=field,
            usual=usual,
            turns_s={name: np.outer(late(t_s), omega) for name, (t_s, omega) in by_strip.items()},
        )


def _turns(
    strips: Sequence[StripSightings], velocity: Callable[[Floats], Floats], line_of_sight_s: Floats
) -> dict[str, Floats]:
    """Rotations (K, 3), axes of s, of the attitudes of each strip, fitted to stars whose aberration is too
    large by that of a velocity at each instant: the line of sight (3,), axes of s, goes back by what the
    stars went forward.
    """
    turns = {}
    for strip in strips:
        if strip.exposures:
            beta_s = np.einsum("kab,kb->ka", strip.fitted.R_si, velocity(strip.times_s)) / SPEED_OF_LIGHT
            turns[strip.strip_id] = -np.cross(line_of_sight_s, beta_s)
    return turns


def _velocities(dump: Dump) -> Mapping[str, Callable[[Floats], Floats]]:
    """Velocities (K, 3) m/s, GCRS, whose aberration an attitude may contain, by the part's name."""
    return {
        "annual": partial(earth_velocity_i, dump.epoch),
        "orbital": lambda t_s: dump.orbit.states_i(t_s)[1],
    }


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
    left = {"none": ("annual", "orbital"), "annual": ("orbital",), BOTH: ()}
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
    in_attitudes = not (isinstance(source, SolvedAttitudes) and source.aberration_removed == BOTH)
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
            most=2.0 * float(np.linalg.norm(dump.orbit.states_i(strips[0].ground.t_s[:1])[1])) / KM_S,
            usual=USUAL_KM_S,
            directions_i=directions,
            turns_s=_turns(strips, velocity, head.line_of_sight_s) if in_attitudes else {},
        )


def _catalogue(dump: Dump, strips: Sequence[StripSightings]) -> Iterator[MovedInput]:
    """A star catalogue of the user's whose epoch, proper motions or equinox are years off: stars move by
    their proper motions, or all alike by precession, which is not linear in decades.
    """
    if dump.star_catalogue is None:
        return
    survey = survey_of(dump.star_catalogue)
    row = {f"{survey.name} {n}": k for k, n in enumerate(survey.places.hip.tolist())}

    def by_epoch(ground: GroundSightings) -> Floats:
        rows = np.array([row.get(name, 0) for name in ground.target_id.tolist()], dtype=np.int64)
        return -survey.places.take(rows).motions()

    moves: list[tuple[str, str, Callable[[GroundSightings], Floats]]]
    moves = [("equinox", "equinox (ICRS is expected)", partial(_by_precession, n)) for n in EQUINOXES]
    for what, field, move in [("epoch", "ref_epoch, pmra, pmdec", by_epoch), *moves]:
        yield MovedInput(
            cause=f"catalogue of the stars, {what}",
            item="all scans",
            unit="years",
            words=("too late", "too early"),
            file=dump.star_catalogue.file,
            field=field,
            most=MOST_YEARS,
            usual=USUAL_YEARS,
            directions_i={one.strip_id: one.ground.is_star[:, None] * move(one.ground) for one in strips},
        )


def _by_precession(years: float, ground: GroundSightings) -> Floats:
    """Change (N, 3) of directions a year, if of an equinox so many years from that of the ICRS."""
    return (ground.u_i - ground.u_i @ erfa.pmat06(erfa.DJ00, years * erfa.DJY)) / years


def _of_ground(dump: Dump, strips: Sequence[StripSightings]) -> Iterator[MovedInput]:
    """Effects on light from the ground, modelled and not, and heights in another unit."""
    moves = [{one.strip_id: one.ground.light_i[:, :, n] for one in strips} for n in range(len(EFFECTS) + 1)]
    terrain = (
        dump.terrain.files if dump.targets and isinstance(dump.terrain, TerrainFiles) else ()
    )  # of chips
    for key, directions in zip(EFFECTS, moves):
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
    yield MovedInput(
        cause="heights of the targets, scale",
        item="all targets",
        unit="% of themselves",
        words=("too high", "too low"),
        file=", ".join([*terrain[:1], dump.target_files]),
        field="heights (metres are expected)",
        most=MOST_PERCENT,
        usual=USUAL_PERCENT,
        directions_i=moves[-1],
    )
