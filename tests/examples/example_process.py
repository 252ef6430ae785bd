"""Runs the examples that standard input names, one a line, each as the main program; answers with the error, or what was printed."""

import io
import json
import os
import runpy
import sys
import traceback
from contextlib import redirect_stdout


def main() -> None:
    """A line is (path, working folder, output folder), an answer (whether it went well, text)."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    for line in sys.stdin:
        path, folder, out = json.loads(line)
        os.chdir(folder)
        sys.argv = [path, out]
        printed = io.StringIO()
        try:
            with redirect_stdout(printed):
                runpy.run_path(path, run_name="__main__")
            answer = True, printed.getvalue()
        except BaseException:  # noqa: BLE001 - the test shows it
            answer = False, printed.getvalue() + traceback.format_exc()
        answers.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
