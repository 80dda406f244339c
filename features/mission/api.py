"""Two results compared, and a result with other strips."""

from __future__ import annotations

from collections.abc import Mapping

from boresight.accepted import PathLike, instance_of, number_of, path_of
from boresight.features.mission.mounting_comparison import Comparison, compare_mountings
from boresight.features.mission.saved_mounting import read_saved_mounting
from boresight.features.mission.what_if import WhatIf, what_if_of

__all__ = ["compare", "what_if"]


def compare(first: PathLike, second: PathLike, *, false_alarm: float = 0.01, camera: str = "") -> Comparison:
    """Whether the matrices of two results differ by more than their errors.

    Parameters
    ----------
    first, second : path or Calibration
        Folders of finished results.
    false_alarm : float, optional
        Probability that equal mountings are said to differ.
    camera : str, optional
        Which camera, of results of several.

    Returns
    -------
    Comparison
        Difference in both frames with the covariance of what the results do not share; `p_value`, `differs`,
        `ground_m`; `table()` is what differs in inputs, settings and versions.

    Raises
    ------
    RawDataError
        If a folder holds no finished result.
    ValueError
        If an argument is not as described.

    Examples
    --------
    >>> import boresight as bs
    >>> est = bs.calibrate(bs.example("mini"))
    >>> bs.compare(est, est).dof
    0
    """
    limit = number_of(false_alarm, "false_alarm", 1e-9, 0.5)
    which = instance_of(camera, str, "camera")
    folders = path_of(first, "first"), path_of(second, "second")
    one, other = (read_saved_mounting(folder, which) for folder in folders)
    return compare_mountings(one, other, limit)


def what_if(result: PathLike, factors: Mapping[str, float], *, camera: str = "") -> WhatIf:
    """A finished result with the errors of its strips larger by factors, without a new calibration.

    Parameters
    ----------
    result : path or Calibration
        Folder of a finished result.
    factors : mapping of float
        By the strip's name, the factor by which all its errors are larger; infinite leaves the strip out.
    camera : str, optional
        Which camera, of a result of several.

    Returns
    -------
    WhatIf
        `shift` of theta and `covariance` with the change.

    Raises
    ------
    RawDataError
        If the folder holds no finished result.
    ValueError
        If a strip is unknown or a factor not above 0.
    DataNotSufficientError
        If what is left does not determine the matrix.

    Examples
    --------
    >>> import boresight as bs
    >>> est = bs.calibrate(bs.example("mini"))
    >>> bs.what_if(est, {"s02": float("inf")}).strips
    ('s01', 's03')
    """
    return what_if_of(path_of(result, "result"), factors, instance_of(camera, str, "camera"))
