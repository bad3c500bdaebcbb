"""Import of itables without configuration files of the current folder or of the user.

itables searches for configuration as it is imported, in the current folder, in all folders above it
and in the user's home. Pages would therefore differ from place to place. Without a home folder
(unknown user id and no HOME, as in containers) the import would fail.
"""

from __future__ import annotations

import os

_itables_config_of_user = os.environ.get("ITABLES_CONFIG")
os.environ["ITABLES_CONFIG"] = ""  # itables reads the empty string as "no configuration"
try:
    import itables.options as options
    from itables.javascript import get_itable_arguments
finally:
    del os.environ["ITABLES_CONFIG"]
    if _itables_config_of_user is not None:
        os.environ["ITABLES_CONFIG"] = _itables_config_of_user

__all__ = ["get_itable_arguments", "options"]
