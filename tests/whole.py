"""Whether all combinations are tested, or a sample of them: `EPIPOLE_WHOLE_TESTS=1`, as `make test-whole` sets."""

import os

IS_WHOLE = bool(os.environ.get("EPIPOLE_WHOLE_TESTS"))
