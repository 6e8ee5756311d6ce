"""Sphinx configuration. `make docs` builds with warnings as errors."""

import os
import sys
from configparser import ConfigParser
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

metadata = ConfigParser()
metadata.read(HERE.parent / "setup.cfg", encoding="utf-8")

project = metadata["metadata"]["name"]
author = metadata["metadata"]["author"]
release = version = metadata["metadata"]["version"]
copyright = f"2026, {author}"

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "benchmark_tables",
    "model_tables",
    "matplotlib.sphinxext.plot_directive",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "sphinxcontrib.bibtex",
]
exclude_patterns = ["_build", "auto_examples/**/*.ipynb"]
templates_path = ["_templates"]
default_role = "py:obj"  # single backticks link where they can

# Links into other projects' inventories need the network, and their absence is a warning: on request only.
if os.environ.get("LSMGEO_DOCS_INTERSPHINX"):
    extensions.append("sphinx.ext.intersphinx")
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "kornia": ("https://kornia.readthedocs.io/en/latest", None),
    }

autosummary_generate = True
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Convention", "notes_style"), ("Differentiable", "notes_style"), ("Shape", "notes_style")]
napoleon_use_rtype = False
napoleon_use_ivar = True

bibtex_bibfiles = ["references.bib"]
bibtex_default_style = "unsrt"

plot_formats = [("svg", 100)]
plot_html_show_formats = False
plot_html_show_source_link = False
plot_include_source = False
plot_rcparams = {"font.size": 10, "svg.fonttype": "path"}
plot_apply_rcparams = True

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "auto_examples",
    "filename_pattern": r"/plot_",
    "ignore_pattern": r"^(?!plot_)",
    "within_subsection_order": "gallery_order.ReadingOrder",
    "backreferences_dir": "api/generated/backreferences",
    "doc_module": ("lsmgeo",),
    "reference_url": {"lsmgeo": None},
    "abort_on_example_error": True,
    "plot_gallery": True,
    "show_signature": False,
    "remove_config_comments": True,
    "min_reported_time": 1,
    "image_scrapers": ("matplotlib",),
}

html_theme = "pydata_sphinx_theme"
html_title = f"lsmgeo {release}"
html_static_path = ["_static"]
html_css_files = ["lsmgeo.css"]
html_theme_options = {
    "navigation_with_keys": False,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
without_siblings = (
    "index",
    "references",
    "conventions",
    "theory",
    "errors",
    "coming_from",
    "troubleshooting",
    "reconstruct",
    "metrics",
    "training",
    "evaluation",
)
html_sidebars = {page: [] for page in (*without_siblings, "formats/index", "models/*")}
html_show_sourcelink = False
