"""A leap-second kernel for NAIF's toolkit."""

import erfa

MONTHS = "JAN FEB MAR APR MAY JUN JUL AUG SEP OCT NOV DEC".split()


def leap_second_kernel() -> str:
    """Text of an LSK with the leap seconds of ERFA, and NAIF's published constants."""
    rows = [row for row in erfa.leap_seconds.get() if row["year"] >= 1972]
    steps = "\n".join(f"{row['tai_utc']:.0f}, @{row['year']}-{MONTHS[row['month'] - 1]}-1" for row in rows)
    return (
        "KPL/LSK\n\\begindata\nDELTET/DELTA_T_A = 32.184\nDELTET/K = 1.657D-3\nDELTET/EB = 1.671D-2\n"
        f"DELTET/M = ( 6.239996D0 1.99096871D-7 )\nDELTET/DELTA_AT = ( {steps} )\n\\begintext\n"
    )
