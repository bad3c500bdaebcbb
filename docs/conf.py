"""How Sphinx makes the site: `make docs` builds it from these pages into build/site."""

from importlib.metadata import version as version_of

project = "sweep"
release = version = version_of("sweep")
author = copyright = "the authors of sweep"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_click"]
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
napoleon_use_rtype = False
html_theme = "furo"
html_title = f"sweep {version}"
html_show_sphinx = False

myst_heading_anchors = 3
exclude_patterns = ["Thumbs.db"]
language = "en-GB"
# Other shells' prompts, durations and specs with comments are all shown as they are.
highlight_language = "text"
# Pages link to files of the repository beyond docs/ as well; a test sees that every link leads on.
suppress_warnings = ["myst.xref_missing"]
