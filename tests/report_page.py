"""The page of a result as one text."""

from boresight.pipeline.report.page import report_parts
from boresight.pipeline.report.saved import Saved


def report_html(saved: Saved, **given: int) -> str:
    """All parts of the page of a saved result."""
    return "".join(report_parts(saved, **given))
