"""The typed names of options that jobs take by keyword, written from the configs.

`python -m tests.option_types` writes `options.py` of every pipeline anew; a test compares.
"""

from __future__ import annotations

import dataclasses
import importlib
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import epipole

PIPELINES = {
    "sfm": ("ReconstructConfig",),
    "slam": ("SlamConfig",),
    "fields": ("SplatConfig", "NerfConfig", "RenderConfig", "MeshConfig"),
    "stereo": ("StereoConfig",),
    "calibration": ("CalibrationConfig",),
    "localization": ("LocalizeConfig",),
    "georeferencing": ("GeoreferenceConfig",),
    "surfaces": ("SurfaceConfig",),
}
"""Of each pipeline, the configs of its jobs."""
TAKEN = {"ReconstructConfig": ("executor",)}
"""Fields that are arguments of the job, too."""
HEAD = '''"""Options that the jobs take by keyword, for editors and type checkers. Written by `tests/option_types.py`."""

from __future__ import annotations

'''


def declared(config: type) -> Iterator[tuple[str, str, object]]:
    """Name, annotation and default of every field, those of bases first."""
    for field in dataclasses.fields(config):
        owner = next(base for base in config.__mro__ if field.name in vars(base).get("__annotations__", {}))
        kind = str(owner.__annotations__[field.name])
        kind = re.sub(r"^Annotated\[(.*), tyro\.conf\.arg\(.*\)\]$", r"\1", kind)
        default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        yield field.name, kind, default


def options_of(config: type) -> dict[str, str]:
    """The fields of a config and of the configs in it, where one has the name alone."""
    own = {name: kind for name, kind, _ in declared(config)}
    inner = [
        (name, kind)
        for _, _, default in declared(config)
        if dataclasses.is_dataclass(default)
        for name, kind, _ in declared(type(default))
    ]
    count = Counter(name for name, _ in inner)
    return own | {name: kind for name, kind in inner if name not in own and count[name] == 1}


def accepted(kind: str) -> str:
    """What may be given for a field: files also as text, and one file for several."""
    kind = kind.replace("tuple[Path, ...]", "Path | tuple[Path, ...]")
    return re.sub(r"\bPath\b", "str | Path", kind)


def source_of(pipeline: str) -> str:
    """The text of a pipeline's `options.py`."""
    module = importlib.import_module(f"epipole.pipelines.{pipeline}.config")
    body, used = [], set[str]()
    for name in PIPELINES[pipeline]:
        job = name.removesuffix("Config")
        body.append(
            f'\n\nclass {job}Keywords(TypedDict, total=False):\n    """Fields of `{name}`, each optional."""\n\n'
        )
        for option, kind in options_of(getattr(module, name)).items():
            if option in TAKEN.get(name, ()):
                continue
            body.append(f"    {option}: {accepted(kind)}\n")
            used |= set(re.findall(r"\b[A-Z]\w+", kind))
    text = HEAD + ("from pathlib import Path\n" if "Path" in used else "")
    text += "from typing import " + ("Literal, " if "Literal" in used else "") + "TypedDict\n\n"
    named = sorted(used - {"Path", "Literal", "None"} - {w for w in used if w.isupper()})
    for home in ("epipole.config", module.__name__):
        here = [n for n in named if getattr(importlib.import_module(home), n, None) is not None]
        named = [n for n in named if n not in here]
        text += f"from {home} import {', '.join(here)}\n" if here else ""
    return text + "".join(body)


def path_of(pipeline: str) -> Path:
    """Where it stands."""
    return Path(epipole.__file__).parent / "pipelines" / pipeline / "options.py"


if __name__ == "__main__":
    for each in PIPELINES:
        path_of(each).write_text(source_of(each), encoding="utf-8")
