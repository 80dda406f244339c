"""How the satellite really moves: its orbit under gravity, and its attitude with oscillation and vibration.

Frames i = GCRS, o = orbital, c = remote-sensing camera. The orbit is integrated with the Earth's mass and
J2 (the pole of date taken as the pole of GCRS, 0.14 deg away). The attitude is a formula in time, not a
table: every row has its own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import ConstantRate
from boresight.geometry.constants import ARCSEC, GM_EARTH, J2_EARTH, WGS84
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.geodesy import unit_vectors
from boresight.geometry.orbit import Orbit, orbital_frame
from boresight.records.record import array, record, scalar
from boresight.simulator.mission_records import OrbitReport
from boresight.simulator.scenario import ErrorSettings, OrbitSettings, PointingSettings, SkyScan

__all__ = [
    "ScanAttitude",
    "TrueAttitude",
    "acceleration",
    "flown_orbit",
    "reported_orbit",
    "scan_attitude",
    "true_attitude",
]

Array = NDArray[np.float64]

# Rows of roll, pitch and yaw in an attitude's rotation vector, orbital frame.
_AXES = {"roll": 0, "pitch": 1, "yaw": 2}
_SINES_OF_VIBRATION = 4  # for each axis


def flown_orbit(settings: OrbitSettings, t_start_s: float, t_stop_s: float, earth: EarthRotation) -> Orbit:
    """The true orbit over a stretch of time that includes zero: nodes every half second, GCRS."""
    state = _state_above(settings, earth)
    nodes = np.arange(np.floor(2.0 * t_start_s), np.ceil(2.0 * t_stop_s) + 1.0) / 2.0
    past, future = nodes[nodes < 0.0][::-1], nodes[nodes >= 0.0]
    parts = [np.empty((6, 0)), np.empty((6, 0))]
    for n, times in enumerate((past, future)):
        if len(times):
            span = (0.0, float(times[-1]))
            flown = solve_ivp(acceleration, span, state, "DOP853", times, rtol=1e-13, atol=1e-9, max_step=1.0)
            parts[n] = flown.y
    states = np.concatenate([parts[0][:, ::-1], parts[1]], axis=1).T
    return Orbit(
        epoch=earth.epoch,
        t_s=nodes,
        positions_m=states[:, :3],
        velocities_m_s=states[:, 3:],
        frame="GCRF",
        degree=7,
        earth=earth,
        method="hermite",
    )


def reported_orbit(orbit: Orbit, t_s: Array, strips_s: Array, errors_e: Array, hold_s: float) -> OrbitReport:
    """What the receiver reports at instants `t_s`, in ITRS.

    Its error is `errors_e` (S, 3) during the strips, whose middles are `strips_s` (S,), and `hold_s` to
    either side; in between it passes smoothly from one to the next.
    """
    positions, velocities = orbit.positions_e(t_s), orbit.velocities_e(t_s)
    error, rate = np.tile(errors_e[0], (len(t_s), 1)), np.zeros((len(t_s), 3))
    for n in range(len(strips_s) - 1):
        start, stop = strips_s[n] + hold_s, strips_s[n + 1] - hold_s
        x = np.clip((t_s - start) / (stop - start), 0.0, 1.0)[:, None]
        step = errors_e[n + 1] - errors_e[n]
        error += x**3 * (10.0 + x * (6.0 * x - 15.0)) * step
        rate += 30.0 * x**2 * (1.0 - x) ** 2 * step / (stop - start)
    return OrbitReport(t_s, positions + error, velocities + rate)


@record(kw_only=True)
class TrueAttitude:
    """Attitude of the satellite's cameras at any instant."""

    orbit: Orbit = scalar("true orbit")
    earth: EarthRotation = scalar("rotation of the Earth")
    R_cs: Rotation = scalar("star camera -> remote-sensing camera")
    offset: Rotation = scalar("nominal frame -> c, without the waves")
    yaw_steering: bool = scalar("whether yaw follows the ground's motion")
    axis: NDArray[np.int64] = array("W", "axis of frame c about which each wave rotates")
    amplitude_rad: Array = array("W", "of each wave, rad")
    frequency_rad_s: Array = array("W", "of each wave, rad/s")
    phase_rad: Array = array("W", "of each wave, rad")
    span_s: tuple[float, float] = array("2", "first and last instant of validity, s")

    def during(self, t_start_s: float, t_stop_s: float) -> TrueAttitude:
        """The attitude for a shorter time span."""
        return replace(self, span_s=(t_start_s, t_stop_s))

    def R_ci(self, t_s: ArrayLike) -> Rotation:
        """GCRS -> remote-sensing camera, at instants (N,)."""
        t = np.atleast_1d(np.asarray(t_s, dtype=float))
        p, v = self.orbit.states_i(t)
        if self.yaw_steering:
            omega_i = np.einsum("nij,j->ni", self.earth.matrices_ie(t), self.earth.omega_e)
            v = v - np.cross(omega_i, p)
        return Rotation.from_rotvec(self.waves_rad(t)) * self.offset * orbital_frame(p, v)

    def R_si(self, t_s: ArrayLike) -> Rotation:
        """GCRS -> star camera, at instants (N,)."""
        return self.R_cs.inv() * self.R_ci(t_s)

    def waves_rad(self, t_s: Array) -> Array:
        """Oscillation and vibration as a small rotation vector (N, 3) in frame c."""
        turn = np.zeros((len(t_s), 3))
        for axis, amplitude, frequency, phase in zip(
            self.axis, self.amplitude_rad, self.frequency_rad_s, self.phase_rad
        ):
            turn[:, axis] += amplitude * np.sin(frequency * t_s + phase)
        return turn


def true_attitude(
    settings: PointingSettings,
    errors: ErrorSettings,
    R_cs: Rotation,
    orbit: Orbit,
    earth: EarthRotation,
    rng: np.random.Generator,
) -> TrueAttitude:
    """The attitude of a scenario; phases, and the vibration's frequencies, come from `rng`."""
    waves = settings.waves
    axis = [_AXES[wave.axis] for wave in waves]
    amplitude = [wave.amplitude_arcsec * ARCSEC for wave in waves]
    frequency = [2.0 * np.pi / wave.period_s for wave in waves]
    if errors.vibration_arcsec > 0.0:
        size = errors.vibration_arcsec * ARCSEC * np.sqrt(2.0 / _SINES_OF_VIBRATION)
        for n in range(3):
            axis += [n] * _SINES_OF_VIBRATION
            amplitude += [size] * _SINES_OF_VIBRATION
            frequency += list(2.0 * np.pi * rng.uniform(*errors.vibration_hz, _SINES_OF_VIBRATION))
    angles = [settings.roll_deg, settings.pitch_deg, settings.yaw_deg]
    return TrueAttitude(
        orbit=orbit,
        earth=earth,
        R_cs=R_cs,
        offset=Rotation.from_euler("xyz", angles, degrees=True),
        yaw_steering=settings.yaw_steering,
        axis=np.array(axis, dtype=np.int64),
        amplitude_rad=np.array(amplitude),
        frequency_rad_s=np.array(frequency),
        phase_rad=rng.uniform(0.0, 2.0 * np.pi, len(axis)),
        span_s=(float(orbit.t_s[0]), float(orbit.t_s[-1])),
    )


@record(kw_only=True)
class ScanAttitude:
    """Attitude during a scan of the sky: a constant rate, with the waves of the flight over ground."""

    flight: TrueAttitude = scalar("oscillation, vibration and the installation matrix")
    scan: ConstantRate = scalar("GCRS -> c, without the waves")

    def R_ci(self, t_s: ArrayLike) -> Rotation:
        """GCRS -> remote-sensing camera, at instants (N,)."""
        t = np.atleast_1d(np.asarray(t_s, dtype=float))
        return Rotation.from_rotvec(self.flight.waves_rad(t)) * self.scan.R_oi(t)

    def R_si(self, t_s: ArrayLike) -> Rotation:
        """GCRS -> star camera, at instants (N,)."""
        return self.flight.R_cs.inv() * self.R_ci(t_s)


def scan_attitude(
    scan: SkyScan, flight: TrueAttitude, middle_s: float, pixel_rad: float, row_period_s: float
) -> ScanAttitude:
    """The attitude of a scan whose middle is at `middle_s`.

    The image point of a star on the axis moves by `f (omega_y, -omega_x)` along x and y of the focal plane;
    at `rate` = 1 by one pixel in a row period towards +x, as the ground does.
    """
    ra, dec, angle = np.radians([scan.ra_deg, scan.dec_deg, scan.position_angle_deg])
    z = unit_vectors(ra, dec)
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    x = np.cos(angle) * north + np.sin(angle) * np.cross(north, z)
    omega = np.array([-scan.drift, scan.rate, 0.0]) * pixel_rad / row_period_s
    middle = Rotation.from_matrix(np.array([x, np.cross(z, x), z]))
    return ScanAttitude(flight=flight, scan=ConstantRate(middle_s, middle, omega))


def _state_above(settings: OrbitSettings, earth: EarthRotation) -> Array:
    """Position and velocity (6,) in GCRS on a circular orbit above the given place at time zero."""
    lat, lon = np.radians(settings.latitude_deg), np.radians(settings.longitude_deg)
    up = earth.matrices_ie(np.zeros(1))[0] @ unit_vectors(lon, lat)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    sine = np.cos(np.radians(settings.inclination_deg)) / np.hypot(up[0], up[1])
    if abs(sine) > 1.0:
        raise ValueError(
            f"orbit.latitude_deg: an orbit inclined by {settings.inclination_deg} deg never reaches latitude "
            f"{settings.latitude_deg} deg"
        )
    cosine = np.sqrt(1.0 - sine**2) * (-1.0 if settings.descending else 1.0)
    radius = WGS84.semi_major_m + settings.altitude_km * 1e3
    speed = np.sqrt(GM_EARTH / radius)
    return np.concatenate([radius * up, speed * (sine * east + cosine * north)])


def acceleration(_t: float, state: Array) -> Array:
    """Derivative (6,) of position and velocity (6,), GCRS, by the Earth's mass and J2: m/s, m/s²."""
    p, v = state[:3], state[3:]
    r = np.sqrt(p @ p)
    central = -GM_EARTH / r**3 * p
    z2 = 5.0 * (p[2] / r) ** 2
    flattening = 1.5 * J2_EARTH * GM_EARTH * WGS84.semi_major_m**2 / r**5
    return np.concatenate([v, central + flattening * p * np.array([z2 - 1.0, z2 - 1.0, z2 - 3.0])])
