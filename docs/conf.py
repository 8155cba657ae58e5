"""The site: ``python -m sphinx -W docs site``; no network is needed."""

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from apu_casadi import __version__

project = "apu-casadi"
author = "apu-casadi developers"
copyright = "apu-casadi developers; Apache-2.0"
release = version = __version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "myst_nb",
    "sphinx_copybutton",
    "site_navigation",
    "site_parts",
]
exclude_patterns = ["estimation/**"]
API = os.environ.get("APU_DOCS_API", "on") != "off"
"""``APU_DOCS_API=off`` leaves out the reference made of docstrings."""
if not API:
    exclude_patterns += ["reference/api.md", "reference/made/**"]

html_theme = "furo"
html_title = f"apu-casadi {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"

# a script that runs under a Python of its own
autodoc_mock_imports = ["dpsimpy", "openmdao", "pycycle", "sklearn"]
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
# notebooks are run where the site is built; ``APU_DOCS_NOTEBOOKS=off`` shows them without output
nb_execution_mode = os.environ.get("APU_DOCS_NOTEBOOKS", "auto")
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_in_temp = True
# types of one name in several modules: Limits, Ambient, Profile
suppress_warnings = ["myst.header", "ref.python", "toc.excluded", "toc.not_readable"]
linkcheck_anchors = False
