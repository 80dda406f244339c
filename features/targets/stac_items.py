"""Images of a STAC catalogue: of each item its image, its day and its mask of clouds.

A static catalogue is a file or a folder, on a disk or in a store; an API is searched. A catalogue in a store
may name files of stores only.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer
from rasterio.errors import RasterioError

from boresight.features.targets.ortho_files import RasterFile, band_count, open_raster
from boresight.pipeline.console.arguments import option
from boresight.pipeline.console.completion import first_argument
from boresight.pipeline.errors import RawDataError, WorkerError
from boresight.pipeline.files.content import content_of
from boresight.pipeline.files.object_store import OF_GDAL, StoredPath, dump_folder, is_address
from boresight.records.record import record, scalar

__all__ = ["StacQuery", "stac_images"]

RASTERS = ("image/tiff", "image/jp2", "image/vnd.stac.geotiff")  # media types, before any parameter
# Masks of clouds by the lower-case name of their asset: values, bits. Scene classification of Sentinel-2 L2A:
# no data, saturated, shadow, cloud of medium and high probability, cirrus. QA_PIXEL of Landsat, collection 2:
# fill, dilated cloud, cirrus, cloud, cloud shadow.
CLOUD_ASSETS = {"scl": ((0, 1, 3, 8, 9, 10), 0), "qa_pixel": ((), 0b11111)}
CLOUD_WORDS = ("cloud", "cirrus", "shadow", "no_data", "nodata", "saturated")  # in names of classes


def _bands_of(context: typer.Context, incomplete: str) -> list[str]:
    """Bands of the first image that is named."""
    count = 0
    if ortho := first_argument(context, "orthos"):
        with suppress(RawDataError, RasterioError, OSError):
            count = band_count(Path(ortho))
    return [str(n) for n in range(1, count + 1) if str(n).startswith(incomplete)]


@record(kw_only=True)
class StacQuery:
    """Which items of a catalogue are wanted, and which of their images."""

    source: Path = scalar("a folder or file of a catalogue, or an address", default=Path())
    asset: str | None = option("Asset of the catalogue's items; default: visual.")
    bbox: tuple[float, float, float, float] | None = option(
        "Only items of the catalogue within these degrees.", metavar="W S E N"
    )
    days: str = option("Only items from first to last day: 2019-04-01/2020-09-30.", "")
    band: int | None = option(
        "Band of the images; default: the mean of the first three.", min=1, autocompletion=_bands_of
    )


def stac_images(query: StacQuery) -> tuple[list[RasterFile], list[str]]:
    """Images, the newest first, and what was not used, a line each. `RawDataError` if there are none."""
    images, unused = [], []
    for item in _items(query):
        try:
            if _is_wanted(item, query):
                images.append(_image(item, query))
        except (RawDataError, WorkerError) as error:
            unused.append(f"{item.id}: {error}")
    if not images:
        found = unused[0] if unused else "no item of that place and time"
        raise RawDataError(str(query.source), "catalogue", found, "items with an image")
    return sorted(images, key=lambda one: one.day, reverse=True), unused


def _items(query: StacQuery) -> Iterator[Any]:
    """Items of a static catalogue, or those of the place and time that an API finds."""
    try:
        import pystac
        from pystac.stac_io import DefaultStacIO
    except ImportError as error:
        raise WorkerError(f"{error}: pip install 'boresight[stac]'") from error

    class Files(DefaultStacIO):
        def read_text_from_href(self, href: str) -> str:
            return content_of(_named(href, query.source)).decode("utf-8")

    source = str(query.source)
    if not is_address(source) and query.source.is_dir():
        kinds = [query.source / f"{kind}.json" for kind in ("catalog", "collection")]
        source = str(next((path for path in kinds if path.exists()), kinds[0]).resolve())
    try:
        root: Any = pystac.read_file(source, stac_io=Files())
        if isinstance(root, pystac.Item):
            yield root
        elif "conformsTo" in root.extra_fields:
            import pystac_client

            search = pystac_client.Client.open(source).search(bbox=query.bbox, datetime=query.days or None)
            yield from search.items()
        else:
            yield from root.get_items(recursive=True)
    except (RawDataError, WorkerError):
        raise
    except Exception as error:  # of foreign content pystac raises whatever it meets
        raise RawDataError(source, "catalogue", f"{type(error).__name__}: {error}", "STAC") from error


def _named(href: str, source: Path) -> Path:
    """The file that a catalogue names; `RawDataError` for one of this machine in a catalogue of a store."""
    href = href.removeprefix("file://")
    if is_address(href) and href.partition("://")[0] not in OF_GDAL:
        raise RawDataError(str(source), "href", href, f"one of {', '.join(OF_GDAL)}")
    path = dump_folder(href)
    if isinstance(source, StoredPath) and not isinstance(path, StoredPath):
        raise RawDataError(str(source), "href", href, "an address, as the catalogue has")
    return path


def _day(item: Any) -> str:
    taken = item.datetime or item.common_metadata.start_datetime
    return taken.date().isoformat() if taken else ""


def _is_wanted(item: Any, query: StacQuery) -> bool:
    """Whether an item is of the place and time that are wanted."""
    first, _, last = query.days.replace("..", "").partition("/")
    if not (first or "0") <= (_day(item) or "9") <= (last or "9"):
        return False
    if query.bbox is None or item.bbox is None:
        return True
    half = len(item.bbox) // 2  # 4 numbers, or 6 with heights
    west, south, east, north = query.bbox
    low, high = item.bbox[:half], item.bbox[half:]
    return bool(low[0] <= east and high[0] >= west and low[1] <= north and high[1] >= south)


def _image(item: Any, query: StacQuery) -> RasterFile:
    """The image of an item, with its mask of clouds where it has one."""
    rasters = {name: one for name, one in item.assets.items() if (one.media_type or "").startswith(RASTERS)}
    if query.asset is not None:
        named = item.assets.get(query.asset)
    else:
        order = ("visual", "data")
        ranked = [
            one for kind in order for name, one in rasters.items() if kind in (name, *(one.roles or ()))
        ]
        named = next(iter([*ranked, *rasters.values()]), None)
    if named is None:
        found = ", ".join(item.assets) or "none"
        raise RawDataError(
            str(query.source), f"{item.id}: assets", found, query.asset or "a GeoTIFF or JPEG 2000"
        )
    image = open_raster(_named(named.get_absolute_href(), query.source), query.band, _day(item))
    for name, one in item.assets.items():
        if (how := _clouds(name, one)) is not None:
            mask = open_raster(_named(one.get_absolute_href(), query.source), 1)
            return replace(image, clouds=mask, cloudy=how[0], cloudy_bits=how[1])
    return image


def _clouds(name: str, asset: Any) -> tuple[tuple[int, ...], int] | None:
    """Values and bits of clouds in an asset; None if it is no mask of them."""
    if name.lower() in CLOUD_ASSETS:
        return CLOUD_ASSETS[name.lower()]
    classes = asset.extra_fields.get("classification:classes") or ()
    values = [one["value"] for one in classes if any(word in one["name"].lower() for word in CLOUD_WORDS)]
    if values:
        return tuple(values), 0
    return ((), -1) if "cloud" in (asset.roles or ()) else None
