"""Whether all combinations are tested, or a sample of them: `EPIPOLE_WHOLE_TESTS=1`, as `make test-whole` sets."""

import os

import pytest

IS_WHOLE = bool(os.environ.get("EPIPOLE_WHOLE_TESTS"))
in_whole_run = pytest.mark.skipif(not IS_WHOLE, reason="in `make test-whole`")
