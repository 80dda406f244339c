"""One self-contained HTML page about a result, drawn from what `calibrate` saved and from nothing else."""

from pipeline.report.page import write_report

__all__ = ["write_report"]
