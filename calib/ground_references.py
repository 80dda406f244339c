"""Offsets of ground references: errors that all targets of one mosaic, or of one survey, have in common.

The offset of a reference, east, north and up, is one error everywhere; or, with a correlation length L, a
field whose values at places d apart have the correlation exp(-d / L). Over the places of its targets the
field is held by its largest modes, and what these leave is an error of each target by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from boresight.records.record import Floats, array, record, scalar

if TYPE_CHECKING:
    from boresight.calib.strips import PreparedStrip

__all__ = ["ReferenceField", "ReferenceOffset", "fields_of"]

MOST_MODES = 30  # of a field; a region is a few lengths wide
SMALLEST = 1e-9  # of the largest mode: less is rounding


@record(kw_only=True)
class ReferenceOffset:
    """The offset of one reference, stated less true, the mean over its targets."""

    name: str = scalar("id of the reference")
    value_m: Floats = array("3", "east, north, up, m")
    sigma_m: Floats = array("3", "its 1-sigma, m")
    stated_m: Floats = array("3", "1-sigma stated for it, m")


@record
class ReferenceField:
    """The offset of one reference at the places of its targets, by M modes of unit variance."""

    name: str
    row: dict[bytes, int]  # of each place
    root: Floats  # (U, M)
    sigma_m: Floats  # (3,) east, north, up

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns, mode after mode."""
        modes = range(self.root.shape[1])
        return tuple(f"reference/{self.name}/{m}/{axis}" for m in modes for axis in ("east", "north", "up"))

    def weights(self, strip: PreparedStrip) -> Floats:
        """Part (J, M) of the modes in the offset of each target; zero for targets of others."""
        of = strip.ground.referenced()
        found = np.zeros((len(of.name), self.root.shape[1]))
        for j in np.flatnonzero(of.name == self.name).tolist():
            found[j] = self.root[self.row[of.place[j].tobytes()]]
        return found

    def rest(self, strip: PreparedStrip) -> Floats:
        """Variance (J,), in units of the stated one, that the modes leave."""
        own = strip.ground.referenced().name == self.name
        return np.maximum(own - np.sum(self.weights(strip) ** 2, axis=1), 0.0)

    def offset(self, shared: Floats, covariance: Floats) -> ReferenceOffset:
        """The mean offset by the values (3 M,) and the covariance of its unknowns."""
        mean = np.kron(self.root.mean(axis=0), np.diag(self.sigma_m))
        variance = np.diag(mean @ covariance @ mean.T)
        return ReferenceOffset(
            name=self.name, value_m=-(mean @ shared), sigma_m=np.sqrt(variance), stated_m=self.sigma_m
        )


def fields_of(strips: Sequence[PreparedStrip]) -> tuple[ReferenceField, ...]:
    """The references of these strips whose offset has a stated error, by name."""
    places: dict[str, dict[bytes, Floats]] = {}
    sigma_m: dict[str, Floats] = {}
    for strip in strips:
        of = strip.ground.referenced()
        for j in np.flatnonzero((of.name != "") & of.sigma_m.any(axis=1)).tolist():
            name = str(of.name[j])
            places.setdefault(name, {}).setdefault(of.place[j].tobytes(), of.place[j])
            sigma_m[name] = of.sigma_m[j]
    return tuple(_field(name, places[name], sigma_m[name]) for name in sorted(places))


def _field(name: str, places: dict[bytes, Floats], sigma_m: Floats) -> ReferenceField:
    ordered = sorted(places)  # whatever strips and their order
    at = np.array([places[key] for key in ordered])
    distance = np.linalg.norm(at[:, None] - at, axis=2)
    values, vectors = np.linalg.eigh(np.exp(-distance))
    large = np.flatnonzero(values > SMALLEST * values[-1])[-MOST_MODES:]
    root = vectors[:, large] * np.sqrt(values[large])
    return ReferenceField(name, {key: n for n, key in enumerate(ordered)}, root, sigma_m)
