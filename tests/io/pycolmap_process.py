"""Run code with pycolmap in a process of its own: it must not share one with OpenCV."""

import importlib.util
import json
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

needs_pycolmap = pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (pip install -e .[bench])"
)


def run_pycolmap(script: str, *arguments: Path | str) -> Any:
    """Run a script that finds its arguments in `args` and prints one line of JSON last."""
    code = "import json, sys\nimport numpy as np\nimport pycolmap\nargs = sys.argv[1:]\n" + textwrap.dedent(
        script
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.strip().splitlines()[-1])
