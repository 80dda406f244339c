"""Direct location against Orekit's Rugged: same camera, orbit and attitude, each effect on light on and off.

    python benchmarks/bench_rugged.py --peers-python peer/bin/python

where peer/bin/python is an environment with orekit-jpype and Java (see rugged_peer.py). Both sides read the
same IERS series (finals2000A). Refraction is compared with Rugged's own layers of air given to boresight;
what its standard atmosphere makes of it is printed beside.

On terrain with refraction Rugged refines its point within one cell of the grid and may leave it: such points
hover over or under its own terrain by metres. They are counted and excluded from the comparison.
"""

import importlib.resources
import subprocess
import sys
import tempfile
from pathlib import Path

import erfa
import numpy as np
from record import arguments_of, exit_status, head, judge_largest, not_run
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.constants import GM_EARTH, WGS84
from boresight.geometry.earth_orientation import bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from boresight.geometry.groundlight import LightEffects, layered_atmosphere, standard_atmosphere
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.terrain import ConstantHeight, Surface, TerrainGrid

UTC = "2026-10-08T10:31:00"  # measured values of finals2000A, after the end of EOP 20 C04
N_PX, PIXEL_M, FOCAL_M = 24_576, 8.75e-6, 10.0
LINES, ROW_PERIOD_S, EVERY = np.linspace(0.0, 26_000.0, 27), 7e-5, 512
HEIGHT_M = 250.0
DEM_STEP_DEG = 1.0 / 3600.0
MOST_M = 1e-3  # from Rugged
EFFECTS = ("light_time", "aberration", "refraction")


class CircularOrbit:
    """Closed form, 530 km up, 97.5 deg; phased so that the scene is over land and daylight at 45 N."""

    radius = 6_378_137.0 + 530e3
    to_i = Rotation.from_euler("zx", [0.7, np.radians(97.5)]).as_matrix()

    def state(self, t_s):
        rate = np.sqrt(GM_EARTH / self.radius**3)
        angle = rate * np.asarray(t_s) + 0.1
        cosine, sine, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
        p = self.radius * np.stack([cosine, sine, zero], axis=-1) @ self.to_i.T
        v = self.radius * rate * np.stack([-sine, cosine, zero], axis=-1) @ self.to_i.T
        return p, v


def scene_of(roll_deg):
    """A strip of one straight CCD of the full width, with pitch and roll waves; Pushbroom without effects."""
    epoch = Epoch.from_utc(UTC)
    earth = EarthRotation.over(epoch, -10.0, 20.0, bundled_earth_orientation())
    t_nodes = np.arange(-8.0, 18.0)
    p, v = CircularOrbit().state(t_nodes)
    orbit = Orbit(
        epoch=epoch,
        t_s=t_nodes,
        positions_m=p,
        velocities_m_s=v,
        frame="GCRF",
        degree=7,
        earth=earth,
        method="hermite",
    )
    t_att = np.arange(-2.0, 6.0, 0.05)
    wave = 5.0 * np.pi / 648_000.0 * np.sin(2 * np.pi * t_att[:, None] / [5.0, 7.0, 11.0] + [0.3, 1.0, 2.0])
    R_bo = Rotation.from_rotvec(wave) * Rotation.from_euler("x", np.radians(roll_deg))
    attitude = AttitudeTrack(t_att, R_bo * orbit.R_oi(t_att), orbit, points=6)
    half = 0.5 * (N_PX - 1) * PIXEL_M
    camera = LineCamera(
        FOCAL_M,
        (
            Ccd(
                n_px=N_PX,
                y_first_m=-half,
                x_offset_m=0.0,
                rotation_rad=0.0,
                pixel_m=PIXEL_M,
                principal_sample=0.5 * (N_PX - 1),
            ),
        ),
    )
    clock = RowClock(0.5, ROW_PERIOD_S)
    off = LightEffects(light_time=False, aberration=False, refraction=False)
    strip = Pushbroom(
        camera=camera,
        rows=clock,
        orbit=orbit,
        earth=earth,
        attitude=attitude,
        R_cs=Rotation.identity(),
        effects=off,
    )
    return epoch, strip, t_att


def relief_under(strip):
    """Rolling ground under the strip: heights (rows from the south), south-west corner and step (rad)."""
    corners = strip.ground_points(
        0, np.repeat([0.0, N_PX - 1.0], 2), np.tile([0.0, 26_000.0], 2), ConstantHeight(0.0)
    )
    lat, lon, _ = geodetic_from_ecef(corners, WGS84)
    step = np.radians(DEM_STEP_DEG)
    south, west = (step * np.floor(np.min(a) / step - 40) for a in (lat, lon))
    rows, columns = (int((np.max(a) - b) / step) + 80 for a, b in ((lat, south), (lon, west)))
    y, x = np.mgrid[:rows, :columns] * DEM_STEP_DEG * 111.0  # about km
    heights = 300.0 + 150.0 * np.sin(x / 1.7) * np.cos(y / 2.3) + 60.0 * np.sin(x / 0.45 + y / 0.6)
    return heights.astype(np.float32), (south, west, step)


def write_scene(folder, epoch, strip, t_att, dem, origin, cases):
    orbit_p, orbit_v = strip.orbit.positions_m, strip.orbit.velocities_m_s
    np.savez(
        folder / "scene.npz",
        epoch_tai_s=epoch.tai_s,
        orbit_t=strip.orbit.t_s,
        orbit_p=orbit_p,
        orbit_v=orbit_v,
        attitude_t=t_att,
        attitude_R=strip.attitude.R_si(t_att).as_matrix(),
        looks=strip.camera.directions_from_pixels(0, np.arange(float(N_PX))),
        every=EVERY,
        lines=LINES,
        t_first_row=strip.rows.t_first_row_s,
        row_period=ROW_PERIOD_S,
        t_min=-1.0,
        t_max=4.0,
        height=HEIGHT_M,
        dem=dem,
        dem_origin=origin,
        cases=cases,
    )
    earth = folder / "earth"
    earth.mkdir(exist_ok=True)
    series = importlib.resources.files("astropy_iers_data") / "data" / "finals2000A.all"
    (earth / "finals2000A.all").write_text(series.read_text(encoding="ascii"), encoding="ascii")
    months = "JAN FEB MAR APR MAY JUN JUL AUG SEP OCT NOV DEC".split()
    lines = []
    for year, month, offset in erfa.leap_seconds.get():
        if year >= 1972:
            jd = sum(erfa.cal2jd(year, month, 1))
            name = f" {year} {months[month - 1]}  1 =JD {jd:9.1f}"
            lines.append(f"{name}  TAI-UTC= {offset:11.7f} S + (MJD - 41317.) X 0.0      S")
    (earth / "tai-utc.dat").write_text("\n".join(lines) + "\n", encoding="ascii")


def effects_of(case, atmosphere):
    return LightEffects(*(name in case for name in EFFECTS), atmosphere=atmosphere)


def ours(strip, case, surface, atmosphere):
    model = Pushbroom(
        camera=strip.camera,
        rows=strip.rows,
        orbit=strip.orbit,
        earth=strip.earth,
        attitude=strip.attitude,
        R_cs=strip.R_cs,
        effects=effects_of(case, atmosphere),
    )
    samples = np.arange(0.0, N_PX, EVERY)
    sample, line = (a.ravel() for a in np.meshgrid(samples, LINES))
    return model.ground_points(0, sample, line, surface).reshape(len(LINES), len(samples), 3)


def compare(peer, roll_deg):
    epoch, strip, t_att = scene_of(roll_deg)
    dem, origin = relief_under(strip)
    cases = ["none", *EFFECTS, "+".join(EFFECTS), "terrain", "terrain+" + "+".join(EFFECTS)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_scene(folder, epoch, strip, t_att, dem, origin, np.array(cases))
        script = Path(__file__).with_name("rugged_peer.py")
        subprocess.run([peer, script, folder / "scene.npz", folder / "result.npz"], check=True)
        theirs = dict(np.load(folder / "result.npz"))
    layers = theirs["layers"][np.argsort(theirs["layers"][:, 0], kind="stable")]
    layered = layered_atmosphere(*layers.T)
    south, west, step = np.degrees(origin)
    rows = dem.shape[0]
    transform = (step, 0.0, west - 0.5 * step, 0.0, -step, south + (rows - 0.5) * step)
    grid = TerrainGrid.from_raster(dem[::-1], transform, "EPSG:4326", None)
    print(f"\nroll {roll_deg:g} deg, java {theirs['java']}; distance on the ground, m")
    print(f"{'effects':41s} {'max':>9s} {'rms':>9s}   size of the effect (boresight, Rugged, standard air)")
    base = None
    for case in cases:
        surface: Surface = grid if "terrain" in case else ConstantHeight(HEIGHT_M)
        mine = ours(strip, case, surface, layered)
        lat, lon, height = np.moveaxis(theirs[f"points_{case}"], -1, 0)
        peers = ecef_from_geodetic(lat, lon, height, WGS84)
        astray = np.abs(height - surface.height_m(lat, lon)) > 1e-3
        error = np.linalg.norm(mine - peers, axis=-1)[~astray]
        base = (mine, peers) if case == "none" else base
        size = (
            f"({astray.sum()} of {astray.size} points of Rugged lie off its terrain)" if astray.any() else ""
        )
        if case in EFFECTS:
            standard = ours(strip, case, surface, standard_atmosphere())
            moved = (
                np.linalg.norm(a - b, axis=-1) for a, b in zip((mine, peers, standard), (*base, base[0]))
            )
            size = "  ".join(f"{m.min():7.4f}..{m.max():7.4f}" for m in moved)
        print(f"{case:41s} {error.max():9.6f} {np.sqrt(np.mean(error**2)):9.6f}   {size}")
        text = f"direct location, roll {roll_deg:g}, {case}: from Rugged"
        judge_largest(text, float(error.max()), MOST_M, "m", error.size)


def main() -> int:
    given = ("--peers-python", "", "interpreter with orekit-jpype, and Java")
    peer = arguments_of(__doc__, given).peers_python
    if not peer:
        not_run("no interpreter with orekit-jpype is given (--rugged-python)")
    head("Direct location: boresight against Rugged (Orekit), one thread each")
    print(f"{N_PX} px x 26 000 rows of {1e6 * ROW_PERIOD_S:g} us, f = {FOCAL_M:g} m, 530 km, {UTC}")
    for roll_deg in (0.0, 25.0):
        compare(peer, roll_deg)
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
