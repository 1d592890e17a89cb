"""A live view of a running system in the browser: what is ill, why, and what to do.

It needs the extra `dashboard`: `pip install 'holdfast[dashboard]'`.
"""

from __future__ import annotations

try:
    from .access import token_of
    from .serving import open_dashboard
    from .web_app import Dashboard, dashboard
except ModuleNotFoundError as missing:
    package = (missing.name or "").partition(".")[0]
    if package not in ("starlette", "uvicorn"):
        raise
    raise ImportError(
        f"holdfast.console.dashboard needs the package {package}: pip install 'holdfast[dashboard]'"
    ) from missing

__all__ = ["Dashboard", "dashboard", "open_dashboard", "token_of"]
