"""Which requests a viewer answers: other web pages that the user visits must not read the scene.

A browser lets any page open a connection to this machine, and a page whose name was made to point here (DNS rebinding)
read its answers, too. Both show in the request's headers, which no script can forge.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

_LOCAL_NAME = re.compile(r"localhost|127(\.\d+){3}|\[::1\]", re.IGNORECASE)


def is_allowed(hosts: Sequence[str], origins: Sequence[str], *, is_local: bool) -> bool:
    """Whether a request comes from the viewer's own page, or from a program that is no browser.

    Args:
        hosts: the request's `Host` headers.
        origins: its `Origin` headers; programs that are no browser send none.
        is_local: the server listens on this machine alone, so that only names of this machine lead to it.
    """
    if len(hosts) != 1 or len(origins) > 1:
        return False
    host = hosts[0].lower()
    if is_local and not _LOCAL_NAME.fullmatch(re.sub(r":\d*$", "", host)):  # any port: a tunnel may lead here
        return False
    return not origins or origins[0].lower() in (f"http://{host}", f"https://{host}")
