"""A process that answers requests line by line, and is started anew after it died or hung."""

import json
import os
import select
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class AnsweringProcess:
    """Runs a script that reads requests as JSON, one a line, and answers each with a line.

    Attributes:
        died_with: exit code if it ended without the last answer, else None.
    """

    def __init__(self, script: Path, env: Mapping[str, str] | None = None, stderr: int | None = None) -> None:
        self._script, self._env, self._stderr = script, {**os.environ, **(env or {})}, stderr
        self._process: subprocess.Popen[str] | None = None
        self.died_with: int | None = None

    def close(self) -> None:
        """Kill the process; the next request starts another one."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def ask(self, request: Any, longest_s: float) -> str:
        """Line of the answer; empty if the process died (`died_with`) or takes longer."""
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, str(self._script)],
                env=self._env,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._stderr,
                text=True,
            )
        assert self._process.stdin is not None and self._process.stdout is not None
        self.died_with = None
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        is_ready, _, _ = select.select([self._process.stdout], [], [], longest_s)
        line = self._process.stdout.readline() if is_ready else ""
        if is_ready and not line:
            self.died_with = self._process.wait()
        if not line:
            self.close()
        return line
