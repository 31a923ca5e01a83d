"""The site. ``sphinx-build -W -j auto docs build/docs`` runs every cell of its pages and refuses a
broken reference."""

import importlib
import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path.insert(0, str(HERE))

import measured

import dpdjax

project = "dpdjax"
author = "the dpdjax developers"
copyright = "2026, the dpdjax developers. Apache 2.0"
version = release = dpdjax.__version__

extensions = [
    "myst_nb",
    "names",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(numpy|collections|os|jax|matplotlib|xarray|pandas)\..*")]

# ------------------------------------------------------------ cells

nb_execution_mode = "cache"
nb_execution_cache_path = str(ROOT / "build" / "cells")
nb_execution_excludepatterns = ["notebooks/*"]
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True
# Said of each cell where none is run, `-D nb_execution_mode=off`.
suppress_warnings = ["myst-nb.lexer"]
# A page is a process of its own, which mostly compiles: some programs are the same, all are short.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / "build" / "programs"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

measured.copy_notebooks(HERE / "notebooks")
measured.write(HERE / "measured")

# ------------------------------------------------------------ text

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "attrs_inline"]
myst_heading_anchors = 3
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"
add_module_names = False
copybutton_exclude = ".linenos, .gp, .go"

# ------------------------------------------------------------ face

html_theme = "furo"
html_title = f"dpdjax {release}"
# Formulas without a network: this package holds MathJax.
_mathjax = Path(importlib.import_module("sphinx-mathjax-offline").__file__).parent / "static"
html_static_path = ["_static", str(_mathjax)]
mathjax_path = "mathjax/tex-chtml.js"
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
