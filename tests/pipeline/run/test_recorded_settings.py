"""Numbers that a user gets without asking: settings of all stages, of scenarios, and the limits of a dump's
fields. A changed default moves results and passes every test that states its own.
"""

import dataclasses
import typing
from collections.abc import Iterator

from recorded_numbers import assert_recorded

from boresight.pipeline.files import dump_schema
from boresight.pipeline.run.settings import Settings
from boresight.simulator.scenario import Scenario, mini_scenario


def numbers_of(record: object, name: str = "") -> Iterator[tuple[str, list[float]]]:
    """Name and numbers of every field of a dataclass, and of those that it leads to."""
    if dataclasses.is_dataclass(record):
        for field in dataclasses.fields(record):
            yield from numbers_of(getattr(record, field.name), f"{name}.{field.name}")
    elif isinstance(record, tuple):
        for n, one in enumerate(record):
            yield from numbers_of(one, f"{name}.{n}")
    elif isinstance(record, int | float):
        yield name, [float(record)]


def test_settings_are_the_recorded_ones():
    found = {}
    for name, record in (("run", Settings()), ("default", Scenario("any")), ("mini", mini_scenario())):
        found |= dict(numbers_of(record, name))
    assert_recorded("defaults", found, relative=1e-12)


def test_limits_of_the_fields_of_a_dump_are_the_recorded_ones():
    found = {}
    for name, kind in vars(dump_schema).items():
        for field in typing.get_args(kind)[1:]:
            stated = [(one, key) for one in getattr(field, "metadata", ()) for key in ("ge", "le")]
            bounds = [getattr(one, key) for one, key in stated if hasattr(one, key)]
            if bounds:
                found[name] = bounds
    assert {"TargetSigma", "FocalPlane", "PixelPitch"} <= found.keys()
    assert_recorded("dump_limits", found, relative=1e-12)
