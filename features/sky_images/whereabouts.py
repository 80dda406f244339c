"""What a user states of the times and places of single star images."""

from __future__ import annotations

from pathlib import Path

from boresight.geometry.record import record, scalar

__all__ = ["NOWHERE", "Whereabouts"]


@record
class Whereabouts:
    """Times and position of single images, as far as the user states them."""

    times: Path | None = scalar("CSV with columns file, utc_mid", default=None)
    orbit: Path | None = scalar("OEM of a satellite", default=None)
    site_deg_m: tuple[float, float, float] | None = scalar(
        "latitude, longitude (degrees), ellipsoidal height (m)", default=None
    )


NOWHERE = Whereabouts()  # neither times nor place are known
