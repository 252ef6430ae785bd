"""A thousand wrong calls, the same in every run, in a process of their own."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from wrong_calls import Call, Case, failure_of, run_cases

from epipole.errors import ConfigError
from whole import in_whole_run


@in_whole_run
def test_a_thousand_wrong_calls_give_results_or_our_errors() -> None:
    assert run_cases(range(1000), seed=7) == []


def test_other_errors_are_findings() -> None:
    def refuse(kind: type[Exception]) -> None:
        raise kind("no")

    assert failure_of(Case(Call("refuse", refuse, {"kind": ConfigError}), {})) is None
    finding = failure_of(Case(Call("refuse", refuse, {"kind": ConfigError}), {"kind": ValueError}))
    assert finding is not None and finding.startswith("ValueError: no")
