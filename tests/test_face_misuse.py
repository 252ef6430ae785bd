"""Whatever is handed to a verb or an option, the answer is a result or an error of ours."""

import dataclasses
import inspect
from pathlib import Path

import pytest

import epipole
from epipole.errors import EpipoleError
from epipole.pipelines.stereo.run import examine_stereo, stereo_many, stereo_of_model

VERBS = (
    "reconstruct",
    "stereo",
    "stereo_many",
    "stereo_of_model",
    "calibrate",
    "evaluate",
    "undistort",
    "convert",
)
MORE_VERBS = ("view", "share", "examine_stereo", "slam", "evaluate_trajectory")
MORE = {job.__name__: job for job in (examine_stereo, stereo_many, stereo_of_model)}
CONFIGS = [name for name in dir(epipole) if name.endswith("Config")]
WRONG = (
    None,
    5,
    -1,
    10**30,
    b"x",
    [1],
    (1,),
    {},
    object(),
    True,
    float("nan"),
    "zz",
    "a\0b",
    "",
    "/dev/null",
)

pytestmark = pytest.mark.usefixtures("unchecked")


@pytest.mark.parametrize("verb", [*VERBS, *MORE_VERBS])
def test_verbs(verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside one wrong argument the others name files that are not there."""
    monkeypatch.chdir(tmp_path)
    function = MORE.get(verb) or getattr(epipole, verb)
    parameters = [p for p in inspect.signature(function).parameters.values() if p.kind != p.VAR_KEYWORD]
    usual = {p.name: "missing" if p.default is p.empty else p.default for p in parameters}
    usual |= {"block": False} if verb == "view" else {}
    for name in usual:
        for value in WRONG:
            with pytest.raises(EpipoleError):
                function(**{**usual, name: value})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", CONFIGS)
def test_options(name: str) -> None:
    kind = getattr(epipole, name)
    num_refused = 0
    for field in dataclasses.fields(kind):
        for value in WRONG:
            try:
                kind(**{field.name: value})
            except EpipoleError:
                num_refused += 1
    assert num_refused > len(WRONG) * len(dataclasses.fields(kind)) / 2
