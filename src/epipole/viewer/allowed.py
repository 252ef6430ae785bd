"""Which requests a viewer answers: other web pages open in the user's browser must not read the scene.

Browsers let any page connect to this machine, and let a page whose domain was made to resolve to it (DNS rebinding)
read the answers, too. Both are visible in request headers, which scripts cannot forge.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

_LOCAL_NAME = re.compile(r"localhost|127(\.\d+){3}|\[::1\]", re.IGNORECASE)


def is_allowed(hosts: Sequence[str], origins: Sequence[str], *, is_local: bool) -> bool:
    """Whether a request comes from the viewer's own page, or from a program other than a browser.

    Args:
        hosts: the request's `Host` headers.
        origins: its `Origin` headers; programs other than browsers send none.
        is_local: whether the server listens on this machine only, so that only local host names are valid.
    """
    if len(hosts) != 1 or len(origins) > 1:
        return False
    host = hosts[0].lower()
    if is_local and not _LOCAL_NAME.fullmatch(re.sub(r":\d*$", "", host)):  # any port, in case of a tunnel
        return False
    return not origins or origins[0].lower() in (f"http://{host}", f"https://{host}")
