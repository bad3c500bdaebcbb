"""Packages that only some studies need: `pip install 'sweep[scenes]'` and the like bring them."""

EXTRA_BY_MODULE = {
    "laspy": "scenes", "mapbox_earcut": "scenes", "plyfile": "scenes", "pyproj": "scenes",
    "rasterio": "scenes", "trimesh": "scenes",
    "itables": "report", "jinja2": "report", "plotly": "report",
    "obstore": "cloud",
    "asyncssh": "clusters", "dask_jobqueue": "clusters",
    "dask_kubernetes": "kubernetes", "httpx": "kubernetes", "kr8s": "kubernetes",
}  # fmt: skip
"""Extra of `pyproject.toml` that installs a module."""


def install_hint(error: BaseException) -> str:
    """Command that installs the module that an import lacked; empty for any other error.

    Examples
    --------
    >>> install_hint(ModuleNotFoundError("No module named 'trimesh'", name="trimesh.exchange"))
    "trimesh is not installed: pip install 'sweep[scenes]'"
    """
    module = (getattr(error, "name", None) or "").split(".")[0]
    if not isinstance(error, ImportError) or module not in EXTRA_BY_MODULE:
        return ""
    return f"{module} is not installed: pip install 'sweep[{EXTRA_BY_MODULE[module]}]'"
