"""On-orbit calibration of the installation matrix between star camera and remote-sensing camera.

    import boresight as bs

    stars = bs.find_stars(image)                   # stars of a raw image, with covariances
    solution = bs.identify(image, fov_deg=20)      # where it points; false if not identified
    match = bs.match_template(template, picture, start_px=(84, 88))
    est = bs.calibrate(bs.example("mini"))         # raw pixels to installation matrix
    est.R_cs, est.cov_theta, est.report("report.html")

All names of `__all__` are imported on first use. The rooms behind them (`boresight.geometry`, `.star_id`,
`.gct_match`, `.calib`, `.simulator`, `.pipeline`) can be used one by one.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # what a type checker and an editor see; at run time `__getattr__` imports the same
    from boresight.accepted import ImageLike, PathLike, RotationLike, SiteLike, TimeLike
    from boresight.array_dump import dump_from_arrays
    from boresight.features.geolocate.api import geolocate
    from boresight.features.mission.api import compare, what_if
    from boresight.features.mission.mounting_comparison import Comparison
    from boresight.features.mission.what_if import WhatIf
    from boresight.features.planning.api import forecast
    from boresight.features.planning.campaign_plan import PlanForecast
    from boresight.features.simulation.api import example, simulate
    from boresight.features.sky_images.api import (
        CameraSolution,
        Stars,
        StarSolution,
        calibrate_star_camera,
        find_stars,
        identify,
    )
    from boresight.features.sky_images.sequence import StarTrack, track
    from boresight.features.targets.api import TargetMatches, match_targets
    from boresight.gct_match.settings import MatchSettings
    from boresight.geometry.line_camera import Ccd, LineCamera, LookAngleCamera, LookTable
    from boresight.geometry.star_camera import StarCamera
    from boresight.matching import Match, NotMatched, match_template
    from boresight.missions import Calibration, Validation, calibrate, read_result, validate
    from boresight.pipeline.errors import DataNotSufficientError, RawDataError, WorkerError
    from boresight.pipeline.files.dump import Dump, open_dump
    from boresight.pipeline.run.settings import Settings
    from boresight.star_id.identification.identify import NotIdentified
    from boresight.star_id.settings import StarSettings
    from boresight.vectors import calibrate_vectors
    from boresight.version import __version__

__all__ = ["Calibration", "CameraSolution", "Ccd", "Comparison", "DataNotSufficientError", "Dump"]
__all__ += ["ImageLike", "LineCamera", "LookAngleCamera", "LookTable", "Match", "MatchSettings"]
__all__ += ["NotIdentified", "NotMatched", "PathLike", "PlanForecast", "RawDataError", "RotationLike"]
__all__ += ["Settings", "SiteLike", "StarCamera", "StarSettings", "StarSolution", "StarTrack", "Stars"]
__all__ += ["TargetMatches", "TimeLike", "Validation", "WhatIf", "WorkerError", "__version__", "calibrate"]
__all__ += ["calibrate_star_camera", "calibrate_vectors", "compare", "dump_from_arrays", "example"]
__all__ += ["find_stars", "forecast", "geolocate", "identify", "match_targets", "match_template", "open_dump"]
__all__ += ["read_result", "simulate", "track", "validate", "what_if"]

# Public names by the module, below `boresight`, that defines them; it is imported when one is asked for.
_MODULES = {
    "array_dump": "dump_from_arrays",
    "accepted": "ImageLike PathLike RotationLike SiteLike TimeLike",
    "features.geolocate.api": "geolocate",
    "features.mission.api": "compare what_if",
    "features.mission.mounting_comparison": "Comparison",
    "features.mission.what_if": "WhatIf",
    "features.planning.api": "forecast",
    "features.planning.campaign_plan": "PlanForecast",
    "features.simulation.api": "example simulate",
    "features.sky_images.api": "CameraSolution StarSolution Stars calibrate_star_camera find_stars identify",
    "features.sky_images.sequence": "StarTrack track",
    "features.targets.api": "TargetMatches match_targets",
    "gct_match.settings": "MatchSettings",
    "geometry.line_camera": "Ccd LineCamera LookAngleCamera LookTable",
    "geometry.star_camera": "StarCamera",
    "matching": "Match NotMatched match_template",
    "missions": "Calibration Validation calibrate read_result validate",
    "pipeline.errors": "DataNotSufficientError RawDataError WorkerError",
    "pipeline.files.dump": "Dump open_dump",
    "pipeline.run.settings": "Settings",
    "star_id.identification.identify": "NotIdentified",
    "star_id.settings": "StarSettings",
    "vectors": "calibrate_vectors",
    "version": "__version__",
}
if os.path.isfile(os.path.join(__path__[0], "geometry")):  # what git makes of a link where it may not
    raise ImportError(
        f"{os.path.join(__path__[0], 'geometry')} is a file: this checkout is without symbolic links;"
        " clone it by `git clone -c core.symlinks=true`, or install the package (a wheel has no links)"
    )
# The same, by name.
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}


if not TYPE_CHECKING:  # a type checker takes a name that is not imported above for an error

    def __getattr__(name: str) -> object:
        """Import a name of `__all__` from its module when it is first asked for."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module 'boresight' has no attribute {name!r}")
        value: object = getattr(import_module(f"boresight.{_MODULE_OF[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
