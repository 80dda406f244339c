"""What numerical code may raise on data that it was not written for.

One failure does not abort the run: the item concerned is counted, and its reason names the exception.
"""

from __future__ import annotations

import cv2

__all__ = ["UNFORESEEN", "internal_error"]

# Errors of computations that end one item with a reason, and not the run.
UNFORESEEN = (ValueError, ArithmeticError, LookupError, cv2.error)


def internal_error(error: Exception, where: str) -> str:
    """The reason of an item whose computation raised `error`."""
    return f"internal error in {where}: {type(error).__name__}: {str(error)[:300]}; please report"
