"""The tables of itables, without settings of the folder that a report is made in, or the user's.

itables looks for them as it is imported, in the current folder, all above it and in the user's own.
Pages would differ from place to place, and where a user has no such folder (an unknown number, as
in containers, and no HOME) the import fails.
"""

from __future__ import annotations

import os

_user_setting = os.environ.get("ITABLES_CONFIG")
os.environ["ITABLES_CONFIG"] = ""  # its own word for: no settings
try:
    import itables.options as options
    from itables.javascript import get_itable_arguments
finally:
    del os.environ["ITABLES_CONFIG"]
    if _user_setting is not None:
        os.environ["ITABLES_CONFIG"] = _user_setting

__all__ = ["get_itable_arguments", "options"]
