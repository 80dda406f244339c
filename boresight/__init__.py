"""On-orbit calibration of the installation matrix between star camera and remote-sensing camera.

    import boresight as bs

    stars = bs.find_stars(image)                   # stars of a raw image, with covariances
    solution = bs.identify(image, fov_deg=20)      # where it points; false if not identified
    match = bs.match_template(template, picture, start_px=(84, 88))
    est = bs.calibrate("fixtures/mini")            # raw pixels to installation matrix
    est.R_cs, est.cov_theta, est.report("report.html")

All names of `__all__` are imported on first use. The rooms behind them (`boresight.geometry`, `.star_id`,
`.gct_match`, `.calib`, `.simulator`, `.pipeline`) can be used one by one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # what a type checker and an editor see; at run time `__getattr__` imports the same
    from boresight.features.sky_images.api import (
        CameraSolution,
        Stars,
        StarSolution,
        calibrate_star_camera,
        find_stars,
        identify,
    )
    from boresight.geometry.line_camera import LineCamera
    from boresight.geometry.star_camera import StarCamera
    from boresight.matching import Match, NotMatched, TargetMatches, match_targets, match_template
    from boresight.missions import (
        Calibration,
        calibrate,
        calibrate_vectors,
        forecast,
        geolocate,
        open_dump,
        read_result,
        simulate,
        validate,
    )
    from boresight.pipeline.errors import DataNotSufficientError, RawDataError
    from boresight.star_id.identification.identify import NotIdentified
    from boresight.version import __version__

__all__ = [
    "Calibration",
    "CameraSolution",
    "DataNotSufficientError",
    "LineCamera",
    "Match",
    "NotIdentified",
    "NotMatched",
    "RawDataError",
    "StarCamera",
    "StarSolution",
    "Stars",
    "TargetMatches",
    "__version__",
    "calibrate",
    "calibrate_star_camera",
    "calibrate_vectors",
    "find_stars",
    "forecast",
    "geolocate",
    "identify",
    "match_targets",
    "match_template",
    "open_dump",
    "read_result",
    "simulate",
    "validate",
]

_MODULES = {
    "missions": "Calibration calibrate calibrate_vectors forecast geolocate open_dump read_result simulate"
    " validate",
    "geometry.line_camera": "LineCamera",
    "geometry.star_camera": "StarCamera",
    "matching": "Match NotMatched TargetMatches match_targets match_template",
    "pipeline.errors": "DataNotSufficientError RawDataError",
    "star_id.identification.identify": "NotIdentified",
    "features.sky_images.api": "CameraSolution StarSolution Stars calibrate_star_camera find_stars identify",
    "version": "__version__",
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    """Import a name of `__all__` from its module when it is first asked for."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'boresight' has no attribute {name!r}")
    from importlib import import_module

    value: object = getattr(import_module(f"boresight.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
