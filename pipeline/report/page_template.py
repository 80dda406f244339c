"""Templates of pages, and numbers in them that carry their source."""

from __future__ import annotations

import functools
import html
import math
import os
from contextlib import suppress
from typing import Any
from unicodedata import category

import jinja2
from markupsafe import Markup

from boresight.geometry.epoch import Epoch
from boresight.pipeline import __version__
from boresight.pipeline.run.index_cache import cache_folder
from boresight.records.record import record, scalar

__all__ = ["UTC_FROM", "Number", "number_from", "template", "utc_text"]

UTC_FROM = "UTC from "  # form of a number that counts seconds from the epoch behind it


@record(kw_only=True)
class Number:
    """A number of a page with the file and key that it comes from; shown as `exact * scale` in `form`."""

    exact: float = scalar("unscaled value")
    source: str = scalar("file in the result folder")
    key: str = scalar("path of keys and indices in that file, separated by dots")
    form: str = scalar('format specification of the shown text, or "UTC from" and an epoch')
    scale: float = scalar("factor before formatting, such as rad to arcsec", default=1.0)
    root: bool = scalar("`exact` is the square root of the saved value", default=False)

    @property
    def text(self) -> str:
        """Shown text: "not known" for NaN, "no limit" for infinity."""
        value = self.exact * self.scale
        if not math.isfinite(value):
            return "not known" if math.isnan(value) else "no limit"
        if self.form.startswith(UTC_FROM):
            return utc_text(self.form.removeprefix(UTC_FROM), value, 24)
        return format(value, self.form).replace("-", "\N{MINUS SIGN}")


_epoch = functools.cache(Epoch.from_utc)


def utc_text(epoch_utc: str, t_s: float, digits: int = 19) -> str:
    """The date and time of `t_s` seconds after an epoch."""
    return _epoch(epoch_utc).utc_from_seconds([t_s])[0][:digits].replace("T", " ")


def number_from(
    content: Any, source: str, key: str, form: str, *, scale: float = 1.0, root: bool = False
) -> Number:
    """The number that the JSON `content` of the file `source` holds under `key`; null is NaN."""
    value = content
    for part in key.split("."):
        value = value[int(part)] if isinstance(value, list) else value[part]
    exact = math.nan if value is None else float(value)
    exact = math.sqrt(exact) if root else exact
    return Number(exact=exact, source=source, key=key, form=form, scale=scale, root=root)


def template(name: str) -> jinja2.Template:
    """A Jinja template that escapes all text and shows each `Number` with its source."""
    return _environment().get_template(name)


@functools.cache  # with the templates that it has compiled
def _environment() -> jinja2.Environment:
    kept = cache_folder() / f"templates-{__version__}-{jinja2.__version__}"
    with suppress(OSError):
        kept.mkdir(parents=True, exist_ok=True)
    return jinja2.Environment(
        loader=jinja2.PackageLoader("boresight.pipeline.report", "templates"),
        autoescape=True,
        optimized=False,  # most expressions are evaluated once
        bytecode_cache=jinja2.FileSystemBytecodeCache(str(kept)) if os.access(kept, os.W_OK) else None,
        finalize=_visible,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _visible(value: Any) -> Any:
    """A number with its source; text without characters that act unseen, such as those that reverse it."""
    if isinstance(value, Number):
        return _number(value)
    if isinstance(value, Markup) or not isinstance(value, str) or value.isprintable():
        return value
    return "".join(c if c in "\n\t" or category(c)[0] != "C" else repr(c)[1:-1] for c in value)


def _number(value: Number) -> Markup:
    """HTML `data` element: the formatted number, with its source as attributes for verification."""
    parts = {"value": repr(value.exact), "data-source": value.source, "data-key": value.key}
    parts["data-form"] = value.form
    if value.scale != 1.0:
        parts["data-scale"] = repr(value.scale)
    if value.root:
        parts["data-root"] = "1"
    attributes = " ".join(f'{name}="{html.escape(text)}"' for name, text in parts.items())
    return Markup(f"<data {attributes}>{html.escape(value.text)}</data>")
