"""What `boresight validate` keeps of its outcome."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from boresight.pipeline.console.messages import say
from boresight.pipeline.report.check_points import write_validation
from boresight.pipeline.report.page import write_report

if TYPE_CHECKING:
    from boresight.pipeline.results.validate import TruthErrors

__all__ = ["kept_validation"]


def kept_validation(result: Path, found: TruthErrors) -> tuple[Path, ...]:
    """Keep the errors in the folder of the result and draw its report again; the files written. A folder
    that cannot be written is left as it is, with a remark.
    """

    try:
        kept = write_validation(result, found)
        drawn = (write_report(result),) if (result / "evidence" / "context.json").is_file() else ()
    except OSError as error:
        say(f"{result}: {error.strerror}; the report does not show the check points")
        return ()
    return (kept, *drawn)
