"""The journeys of docs/architecture.md against the calls while one strip of the fixture is calibrated."""

from collections.abc import Mapping
from itertools import pairwise

import pytest
from command_line import ran
from fixture_strips import strip_of_fixture
from journeys import ROOT, Call, Stop, calls_of, code_of_name, journeys

JOURNEYS = journeys((ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"))
STOPS = [stop for journey in JOURNEYS.values() for stop in journey]
FORWARD, BACK = ("Journey 1", "Journey 2"), ("Journey 3",)


@pytest.fixture(scope="module")
def calls(tmp_path_factory) -> Mapping[str, list[Call]]:
    """Who calls each stop of the page, in a run of the command by one process."""
    folder = tmp_path_factory.mktemp("journeys")
    strip_of_fixture(folder / "dump", 1)
    codes = {code_of_name(stop.name): stop.name for stop in STOPS}
    words = ("calibrate", folder / "dump", "--out", folder / "result", "--workers", 1, "--no-report")
    return calls_of(codes, lambda: ran(*words))


def test_the_page_has_three_journeys_of_several_stops():
    assert list(JOURNEYS) == [*FORWARD, *BACK]
    assert all(len(journey) > 9 for journey in JOURNEYS.values())
    assert [stop.name for stop in STOPS if not stop.by] == [STOPS[0].name]


@pytest.mark.parametrize("stop", STOPS[1:], ids=lambda stop: stop.name)
def test_a_stop_is_called_by_the_stop_that_the_page_names(stop, calls):
    callers = [other.name for other in STOPS if f".{other.name}".endswith(f".{stop.by}")]
    assert len(callers) == 1, f"{stop.by} names {callers or 'no stop of the page'}"
    assert callers[0] in [call.by for call in calls.get(stop.name, [])]


@pytest.mark.parametrize("heading", JOURNEYS)
def test_stops_are_called_in_the_order_of_the_page(heading, calls):
    def first(stop: Stop) -> int:
        by = f".{stop.by}" if stop.by else ""
        return min(call.number for call in calls[stop.name] if f".{call.by}".endswith(by))

    named = JOURNEYS[heading]
    for one, other in pairwise(named if heading in FORWARD else named[::-1]):
        assert first(one) < first(other), f"{other.name} is called before {one.name}"


def test_the_stages_run_through_the_runner_and_the_store(calls):
    """The runner's own rows: from any stage to the executor, the store around it, and the stage."""
    for stage in ("pipeline.stages.exposure.sight_exposure", "pipeline.stages.strip.match_strip_targets"):
        assert [call.by for call in calls[stage]] == ["pipeline.run.cached.Cached.__call__"]


def test_a_caller_behind_private_functions_and_comprehensions_is_found():
    def inner() -> list[object]:
        return [code_of_name(name) for name in ("calib.strips.linearise",)]

    found = calls_of({code_of_name.__code__: "code_of_name"}, inner)
    assert found == {"code_of_name": [Call(1, "")]}  # nothing of the program stands above a test
