"""A strip with everything known about it before a search."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boresight.gct_match.predict.trajectories import Trajectories, trajectories_of
from boresight.gct_match.records import Chip, Target
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.line_camera import StripImage
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import Surface
from boresight.records.record import Floats, array, record, scalar

__all__ = ["Scene", "scene_of"]


@record(kw_only=True)
class Scene:
    """A strip, its targets and the models that predict where the strip shows them."""

    strip: StripImage = scalar("raw pixels")
    pushbroom: Pushbroom = scalar("rigorous model at the initial installation matrix R_cs0")
    targets: Sequence[Target] = scalar("T targets")
    chips: Sequence[Chip] = scalar("T chips, in the order of the targets")
    surface: Surface = scalar("ellipsoidal heights of the ground between the targets")
    sigma_installation_rad: Floats = array(
        "3", "1-sigma of the rotation by which R_cs0 may be wrong, axes of c"
    )
    is_known: bool = scalar("whether targets of other strips lie where R_cs0 predicts them", default=False)
    settings: MatchSettings = scalar("settings of target matching")
    trajectories: Trajectories = scalar("image trajectories of the targets")


def scene_of(
    strip: StripImage,
    pushbroom: Pushbroom,
    targets: Sequence[Target],
    chips: Sequence[Chip],
    surface: Surface,
    sigma_installation_rad: Floats,
    settings: MatchSettings,
    is_known: bool = False,
) -> Scene:
    """The scene of a strip: what `match_strip` starts from.

    Parameters
    ----------
    strip : StripImage
        Raw pixels of one CCD at least, read by window.
    pushbroom : Pushbroom
        The rigorous model at the initial installation matrix.
    targets, chips : sequences of one length and order
        Chip n shows the ground around target n. A sequence may read its files when they are asked for.
    surface : Surface
        Ellipsoidal heights of the ground between the targets.
    sigma_installation_rad : (3,) array
        1-sigma of the rotation by which the installation matrix may be wrong, about the axes of frame c.
    settings : MatchSettings
        Search ranges and limits of the tests.
    is_known : bool
        Whether targets of other strips lie where the initial installation matrix predicts them.

    Raises
    ------
    ValueError
        If targets and chips differ in number, or the strip has no CCD.
    """
    if len(targets) != len(chips):
        raise ValueError(f"{len(targets)} targets and {len(chips)} chips do not belong to one another")
    if not strip.ccds:
        raise ValueError("a strip without a CCD shows no target")
    ends = [pushbroom.rows.rows_of_lines(k, [-0.5, strip.shape(k)[0] - 0.5]) for k in strip.ccds]
    rows = float(np.min(ends)), float(np.max(ends))
    pushbroom = pushbroom.tabulated(*rows)
    return Scene(
        strip=strip,
        pushbroom=pushbroom,
        targets=targets,
        chips=chips,
        surface=surface,
        sigma_installation_rad=np.asarray(sigma_installation_rad, dtype=float),
        settings=settings,
        is_known=is_known,
        trajectories=trajectories_of(pushbroom, np.array([t.p_e for t in targets]).reshape(-1, 3), rows),
    )
