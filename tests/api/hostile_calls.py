"""Calls of all public functions with hostile arguments, for a test and for `benchmarks/fuzz_door.py`.

A call begins with arguments that are cheap and nearly right; one to three of them are replaced by values that
a program hands over by mistake. What comes back is a result or one of the errors that docs/python.md lists.
"""

import datetime
import decimal
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import astropy.units as u
import numpy as np
import pandas as pd
from astropy.time import Time
from scipy.spatial.transform import Rotation
from tasks import arrays_of
from wrong_vectors import drawn_vectors

import boresight as bs

__all__ = ["DOCUMENTED", "Door", "door", "hostile_calls"]

DOCUMENTED = (ValueError, bs.RawDataError, bs.DataNotSufficientError, bs.WorkerError)
MOST_REPLACED = 3


class Deceiver:
    """A class that breaks whatever is asked of it."""

    def __array__(self, *args: Any, **named: Any) -> Any:
        raise RuntimeError("no array")

    def __len__(self) -> int:
        raise RuntimeError("no length")

    def __repr__(self) -> str:
        raise RuntimeError("no text")


EMPTY: dict[str, Any] = {}
RECURSIVE: list[Any] = []
RECURSIVE.append(RECURSIVE)
VALUES: list[Any] = [
    *(None, True, 0, -1, 9, 2.5, 1e308, -1e-308, np.nan, np.inf, 10**400, 1j, np.float64(3)),
    *("", "yesterday", "\0", "\x1b[31m", "x" * 5000, "mini", "s01", "spice", b"bytes", "2026-13-45T99:00:00"),
    *([], [[]], [1, 2, 3], [[1, 2], [3]], ["a", None], EMPTY, {"a": 1}, {1: 2}, (), set(), RECURSIVE),
    *(object(), Deceiver(), int, len, lambda: 1, slice(None), ...),
    *(Path("nowhere"), Path("/dev/null"), Path(), decimal.Decimal("NaN")),
    *(np.array([]), np.zeros((3, 3)), np.eye(3), -np.eye(3), np.zeros((2, 2, 2, 2))),
    *(np.full((64, 64), np.nan), np.zeros((64, 64, 3)), np.full((40, 40), 1e200), np.zeros((64, 64), bool)),
    *(np.array(["a"]), np.zeros((64, 64), complex), np.array([None, 1]), np.full((33, 33), -5)),
    *(datetime.datetime(1, 1, 1), datetime.datetime.max, datetime.date(2026, 1, 1), datetime.timedelta(1)),
    *(np.datetime64("NaT"), pd.NaT, Time(["2026-01-01", "2026-01-02"])),
    *(pd.DataFrame(), pd.DataFrame({"a": ["b"]}), pd.Series([1.0]), 3.0 * u.m, [1.0, 2.0] * u.deg),
    *(pd.DataFrame({"lat_deg": [91.0], "lon_deg": ["east"]}), print, "".join),
    *(Rotation.identity(2), Rotation.identity(0)),
    *(bs.StarSettings(), bs.MatchSettings(), bs.RawDataError("a", "b", "c", "d")),
]
PLAUSIBLE: list[Any] = [
    *(1, 0.5, 20.0, 64.0, 1e-6, (48.1, 11.6, 500.0), (3.0, 4.0), "json", "2026-01-01T00:00:00"),
    *([0.1, 0.2, 0.3], datetime.datetime(2026, 1, 1), Time("2026-01-01")),
    *(Rotation.identity(), np.array([[1.0, 2.0], [3.0, 4.0]])),
    *(np.full((64, 64), 7, np.uint16), np.full((64, 64), 255, np.uint8), np.eye(64), np.full((64, 64), 1e15)),
    *(np.random.default_rng(3).normal(100.0, 5.0, (64, 64)), np.random.default_rng(4).random((64, 64))),
    *(np.random.default_rng(5).integers(0, 4096, (64, 64)), np.ones((20, 3)), np.linspace(0.0, 1.0, 20)),
    *(["json", "csv"], [1.0, 2.0, 3.0], {"strips": {"count": -1}}, {"position_m": 1.0}, [{"id": "a"}]),
]
VALUES += PLAUSIBLE
USED_UP: list[Callable[[], Any]] = [lambda: iter([1, 2]), lambda: (row for row in [[1.0, 2.0, 3.0]])]


class Door(NamedTuple):
    """A public function, or method of a result, with arguments that are nearly right."""

    name: str
    call: Callable[..., Any]
    base: dict[str, Any]
    documented: tuple[type[Exception], ...] = DOCUMENTED
    share: float = 1.0  # of the calls


def door(solution: bs.StarSolution, result: bs.Calibration, dump: Path, out: Path) -> list[Door]:
    """All public functions, and the methods of results."""
    noise = np.random.default_rng(1).normal(100.0, 5.0, (40, 48))
    given = drawn_vectors(np.random.default_rng(2))._asdict()
    nowhere = out / "nowhere"
    camera = solution.camera
    line_camera = bs.open_dump(dump).line_camera
    table = {"time": "2026-01-01T00:00:00", "exposure_s": 0.1, "image": noise}
    vectors = {key: part[0] if isinstance(part, list) else part for key, part in given.items()}
    arrays = {
        "star_camera": camera,
        "remote_camera": line_camera,
        "R_cs0": np.eye(3),
        "sigma_R_cs0_rad": 1e-3,
        "orbit": [table],
        "exposures": [table],
        "strips": [table],
        "targets": [table],
        "errors": {},
    }
    cells = arrays_with(dump)
    small = bs.StarCamera(focal_m=1e-3, pixel_m=1e-5, width_px=48, height_px=40, principal_px=(23.5, 19.5))
    places = {"strip": "s01", "ccd": 1, "dump": dump}
    doors = [
        Door("find_stars", bs.find_stars, {"image": noise}),
        Door("identify", bs.identify, {"image": solution.stars, "camera": camera}),
        Door("identify", bs.identify, {"image": noise, "fov_deg": 20.0}),
        Door("track", bs.track, {"frames": [noise, noise], "camera": small, "times_s": [0.0, 0.1]}),
        Door("calibrate_star_camera", bs.calibrate_star_camera, {"images": [noise], "fov_deg": 20.0}),
        Door(
            "match_template", bs.match_template, {"template": noise, "picture": noise, "start_px": (20, 20)}
        ),
        Door("match_targets", bs.match_targets, {"dump": nowhere}),
        Door("calibrate", bs.calibrate, {"dump": nowhere}),
        Door("calibrate", bs.calibrate, {"dump": [nowhere, nowhere]}),
        Door("calibrate_vectors", bs.calibrate_vectors, vectors, share=3.0),
        Door("dump_from_arrays", bs.dump_from_arrays, arrays, share=2.0),
        Door("cells of dump_from_arrays", cells, {}, share=3.0),
        Door("open_dump", bs.open_dump, {"root": nowhere}),
        Door("read_result", bs.read_result, {"folder": nowhere}),
        Door("validate", bs.validate, {"result": nowhere, "dump": nowhere}),
        Door("geolocate", bs.geolocate, {"result": result, **places, "sample": 3.0, "line": 9.0}, share=0.3),
        Door("compare", bs.compare, {"first": nowhere, "second": nowhere}, share=0.5),
        Door("what_if", bs.what_if, {"result": result, "factors": {"s01": 2.0}}, share=0.3),
        Door("forecast", bs.forecast, {"plan": nowhere}),
        Door("simulate", bs.simulate, {"scenario": "nowhere", "out": out / "made"}),
        Door("example", bs.example, {"name": "maxi"}),
        Door("pixel_to_sky", solution.pixel_to_sky, {"xy_px": [(3.0, 4.0)]}),
        Door("wcs", solution.wcs, {}, share=0.5),
        Door("residuals", result.residuals, {}),
        Door("export", result.export, {"formats": "json", "out": out / "kernels", "dump": dump}, share=0.3),
        Door("report", result.report, {"path": ""}, share=0.1),
        Door("save", result.save, {"folder": ""}, share=0.2),
        Door("of_camera", result.of_camera, {"name": ""}, share=0.2),
        Door("method geolocate", result.geolocate, {**places, "line": 9.0, "sample": 3.0}, share=0.3),
        Door("StarSettings", stars_found_with, {"image": noise}),
        Door("MatchSettings", matched_with, {"picture": noise}),
        Door("StarCamera", bs.StarCamera, dict(zip(CAMERA, (0.1, 1e-5, 64, 64, (31.5, 31.5))))),
        Door("Ccd", bs.Ccd, dict(zip(DETECTOR, (64, -3e-4, 0.0, 0.0, 1e-5, 31.5)))),
        Door("LookTable", bs.LookTable, {"n_px": 64, "samples": [0, 63], "tan_x": [0, 0], "tan_y": [0, 1]}),
    ]
    tested = {one.name for one in doors}
    functions = {name for name in bs.__all__ if inspect.isfunction(getattr(bs, name))}
    assert functions <= tested, functions - tested
    return doors


def arrays_with(dump: Path) -> Callable[..., bs.Dump]:
    """A function of cells, each of them right where it is not given, that makes a dump of arrays."""
    opened, whole = bs.open_dump(dump), arrays_of(dump)
    orbit, exposures = whole["orbit"][:60], whole["exposures"].iloc[:2]
    strip = whole["strips"].iloc[0].to_dict() | {"image": np.zeros((64, 512), np.uint8)}
    target = whole["targets"].iloc[0].to_dict() | {"chip": np.eye(20)}
    kept = ("remote_camera", "R_cs0", "sigma_R_cs0_rad", "errors")
    given = {key: whole[key] for key in kept} | {"orbit": orbit}
    t_s = opened.epoch.seconds_from_utc(exposures["time"].tolist())
    R_is = (opened.R_cs0.inv() * opened.orbit.R_oi(t_s)).inv()
    head = {"aberration_removed": "none", "line_of_sight_s": (0.0, 0.0, 1.0), "attitude_frame": "GCRF"}
    sigmas = dict.fromkeys(("sigma_x_arcsec", "sigma_y_arcsec", "sigma_z_arcsec"), 5.0)
    attitudes = [
        {"time": time, **dict(zip(("qx", "qy", "qz", "qw"), q)), **sigmas}
        for time, q in zip(exposures["time"], R_is.as_quat())
    ]

    def made(**cells: Any) -> bs.Dump:
        def row(of: dict[str, Any]) -> dict[str, Any]:
            return of | {key: cells[key] for key in of if key in cells}

        return bs.dump_from_arrays(
            **given,
            **row(head),
            attitudes=[row(attitudes[0]), *attitudes[1:]],
            strips=[row(strip)],
            targets=[row(target)],
        )

    names = [name for of in (head, attitudes[0], strip, target) for name in of]
    parameters = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY) for name in dict.fromkeys(names)]
    made.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return made


def stars_found_with(
    image: Any,
    false_alarms_per_frame: Any = 0.5,
    saturation_dn: Any = None,
    gain_e_per_dn: Any = None,
    psf_sigma_px: Any = None,
    max_stars: Any = 600,
) -> bs.Stars:
    """Stars by hostile settings."""
    settings = bs.StarSettings(
        false_alarms_per_frame=false_alarms_per_frame,
        saturation_dn=saturation_dn,
        gain_e_per_dn=gain_e_per_dn,
        psf_sigma_px=psf_sigma_px,
        max_stars=max_stars,
    )
    return bs.find_stars(image, settings=settings)


def matched_with(
    picture: Any, template_px: Any = 128, probability_wrong: Any = 1e-4, sigma_px: Any = 0.1, no_data: Any = 0
) -> bs.Match | bs.NotMatched:
    """A template matched by hostile settings."""
    settings = bs.MatchSettings(
        template_px=template_px, probability_wrong=probability_wrong, sigma_px=sigma_px, no_data=no_data
    )
    return bs.match_template(picture, picture, start_px=(20, 20), settings=settings)


CAMERA = ("focal_m", "pixel_m", "width_px", "height_px", "principal_px")
DETECTOR = ("n_px", "y_first_m", "x_offset_m", "rotation_rad", "pixel_m", "principal_sample")
VALID = (None, "mini", EMPTY)  # for which the heavy ones set to work
HEAVY = {"forecast": ("plan",), "calibrate": ("dump",), "match_targets": ("dump",), "simulate": ("scenario",)}


def hostile_calls(doors: list[Door], n: int, seed: int) -> Iterator[tuple[Door, dict[str, Any]]]:
    """`n` calls: the door and its arguments. Those that would do minutes of work are left out."""
    rng = np.random.default_rng(seed)
    share = np.array([one.share for one in doors])
    for _ in range(n):
        one = doors[rng.choice(len(doors), p=share / share.sum())]
        names = [name for name in inspect.signature(one.call).parameters if name != "self"]
        count = int(rng.integers(1, min(MOST_REPLACED, len(names)) + 1))
        chosen = rng.choice(names, count, replace=False).tolist()
        replaced = {name: _value(rng) for name in chosen}
        for name in HEAVY.get(one.name, ()):
            if any(replaced.get(name, 0) is valid for valid in VALID):
                del replaced[name]
        yield one, one.base | replaced


def _value(rng: np.random.Generator) -> Any:
    n = int(rng.integers(len(VALUES) + len(USED_UP)))
    return VALUES[n] if n < len(VALUES) else USED_UP[n - len(VALUES)]()
