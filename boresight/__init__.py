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
    from boresight.features.geolocate.api import geolocate
    from boresight.features.planning.api import forecast
    from boresight.features.simulation.api import simulate
    from boresight.features.sky_images.api import (
        CameraSolution,
        Stars,
        StarSolution,
        calibrate_star_camera,
        find_stars,
        identify,
    )
    from boresight.features.targets.api import TargetMatches, match_targets
    from boresight.geometry.line_camera import LineCamera
    from boresight.geometry.star_camera import StarCamera
    from boresight.matching import Match, NotMatched, match_template
    from boresight.missions import Calibration, calibrate, read_result, validate
    from boresight.pipeline.errors import DataNotSufficientError, RawDataError
    from boresight.pipeline.files.dump import open_dump
    from boresight.star_id.identification.identify import NotIdentified
    from boresight.vectors import calibrate_vectors
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
    "features.geolocate.api": "geolocate",
    "features.planning.api": "forecast",
    "features.simulation.api": "simulate",
    "features.sky_images.api": "CameraSolution StarSolution Stars calibrate_star_camera find_stars identify",
    "features.targets.api": "TargetMatches match_targets",
    "geometry.line_camera": "LineCamera",
    "geometry.star_camera": "StarCamera",
    "matching": "Match NotMatched match_template",
    "missions": "Calibration calibrate read_result validate",
    "pipeline.errors": "DataNotSufficientError RawDataError",
    "pipeline.files.dump": "open_dump",
    "star_id.identification.identify": "NotIdentified",
    "vectors": "calibrate_vectors",
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
