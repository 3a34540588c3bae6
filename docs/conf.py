"""Sphinx configuration: MyST pages, stage pages generated from their declarations at each build."""

import sys
from pathlib import Path

from sphinx.errors import ConfigError

sys.path.insert(0, str(Path(__file__).resolve().parent))

try:
    import stage_pages

    from pdal_stages import __version__
except ModuleNotFoundError as error:
    raise ConfigError(
        "The pages of the stages and of the API are made from the package itself, and "
        f"{error.name} is missing: "
        "pip install '.[docs]' in the environment that runs sphinx-build"
    ) from None

stage_pages.write()

project = "pdal_stages"
author = "the pdal_stages authors"
copyright = "2026, the pdal_stages authors"
release = version = __version__
extensions = ["myst_parser", "sphinx_design", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build", "stage_texts"]
html_theme = "pydata_sphinx_theme"
html_title = "pdal_stages"
html_theme_options = {
    "show_prev_next": False,
    "secondary_sidebar_items": ["page-toc"],
    "navigation_with_keys": False,
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_sidebars = {"index": []}
html_show_sourcelink = False
html_static_path = ["static"]
html_css_files = ["custom.css"]


def setup(app):
    """Lead links that a clone has to the pages that are generated."""

    def replace(app, page, content):
        text = content[0].replace("](stage_texts/)", "](stages/index.md)")
        text = text.replace("](stage_texts/", "](stages/")
        content[0] = text.replace("](../README.md#", "](index.md#")

    app.connect("source-read", replace)


autodoc_member_order = "bysource"
autodoc_typehints = (
    "none"  # docstrings say shapes and units; NumPy's own names of types fill ten lines
)
