"""Settings of the documentation: `make docs`.

gather.py collects text from other files, figures.py draws figures, and mathml.py renders equations
without network access.
"""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import figures  # noqa: E402  # docs is not a package
import gather  # noqa: E402

import hilctl  # noqa: E402

project = "hilctl"
author = "The hilctl developers"
version = release = hilctl.__version__
html_title = f"{project} {version}"

# An exception is found by the name of its module too, beside that of hilctl.api.
suppress_warnings = ["ref.python"]
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinxcontrib.typer",
    "mathml",
]
exclude_patterns = ["_build", "_generated"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

autodoc_typehints = "description"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"

html_math_renderer = "mathml"
html_theme = "pydata_sphinx_theme"
html_static_path = ["static"]
html_css_files = ["hilctl.css"]
html_show_sourcelink = False
html_copy_source = False
ALONE = ("tutorial", "safety", "faq", "glossary", "architecture", "contributing", "changelog")
html_sidebars = {page: [] for page in ("index", *ALONE)}  # pages without siblings
html_theme_options = {
    "navigation_with_keys": False,
    "header_links_before_dropdown": 7,
    "show_nav_level": 1,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": [],
    "footer_end": [],
}

gather.gather_all(HERE)
figures.draw_all(HERE / "_generated" / "figures")
