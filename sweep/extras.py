"""Optional packages that only some studies need, with the extras that install them."""

EXTRA_BY_MODULE = {
    "laspy": "scenes", "mapbox_earcut": "scenes", "plyfile": "scenes", "pyproj": "scenes",
    "rasterio": "scenes", "trimesh": "scenes",
    "itables": "report", "jinja2": "report", "plotly": "report",
    "obstore": "cloud",
    "asyncssh": "clusters", "dask_jobqueue": "clusters",
    "dask_kubernetes": "kubernetes", "httpx": "kubernetes", "kr8s": "kubernetes",
}  # fmt: skip
"""Name of the extra in `pyproject.toml` that installs an optional module, by the module's name."""


def install_hint(error: BaseException) -> str:
    """Return how to install the module that an import lacked; '' for an error of another kind.

    Examples
    --------
    >>> install_hint(ModuleNotFoundError("No module named 'trimesh'", name="trimesh.exchange"))
    "trimesh is not installed: pip install 'sweep[scenes]'"
    """
    module = (getattr(error, "name", None) or "").split(".")[0]
    if not isinstance(error, ImportError) or module not in EXTRA_BY_MODULE:
        return ""
    return f"{module} is not installed: pip install 'sweep[{EXTRA_BY_MODULE[module]}]'"
