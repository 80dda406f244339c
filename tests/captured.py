"""What commands print, as a terminal of 80 columns would show it."""

import re

COLUMNS = 80
FEWEST_CELLS = 4  # of a line that is a row of a table; others are sentences, which break between words
# Lines of images: each is a record by itself, of any length, as the names of files are.
RECORD = re.compile(r" stars +(rms|above) ")


def wide_rows(text: str) -> list[str]:
    """Rows of tables that are wider than the terminal, so that their columns would break."""
    lines = (line for line in text.splitlines() if len(line) > COLUMNS and not RECORD.search(line))
    return [line for line in lines if len(re.split(r" {2,}", line.strip())) >= FEWEST_CELLS]
