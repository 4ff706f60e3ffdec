"""Configuration of Sphinx."""

from __future__ import annotations

import importlib
import importlib.metadata
import sys
from pathlib import Path

import torchrl_caiac

sys.path.insert(0, str(Path(__file__).parent))  # for the modules beside this one

import make_errors

project = "torchrl-caiac"
author = "torchrl-caiac contributors"
copyright = "2026, torchrl-caiac contributors"
version = release = importlib.metadata.version("torchrl-caiac")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "site_parts",
]
templates_path = ["_templates"]
exclude_patterns = ["_build", "inventories", "results", "tutorials"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
html_math_renderer = "mathml"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

# Listed in docs/inventories, so that the build needs no network.
intersphinx_mapping = {
    name: (address, f"inventories/{name}.inv")
    for name, address in {
        "gymnasium": "https://gymnasium.farama.org/",
        "matplotlib": "https://matplotlib.org/stable/",
        "minari": "https://minari.farama.org/",
        "numpy": "https://numpy.org/doc/stable/",
        "python": "https://docs.python.org/3/",
        "tensordict": "https://docs.pytorch.org/tensordict/stable/",
        "torch": "https://docs.pytorch.org/docs/stable/",
        "torchrl": "https://docs.pytorch.org/rl/stable/",
    }.items()
}

# The reference lists the names in the __all__ of every subpackage, and nothing else.
autosummary_generate = True
autosummary_ignore_module_all = False
autosummary_imported_members = True
# Names that the package re-exports are documented in their own subpackage.
_SUBPACKAGES = ("data", "envs", "influence", "modules", "objectives", "transforms")
autosummary_context = {
    "reexported": {
        name: f"torchrl_caiac.{subpackage}.{name}"
        for subpackage in _SUBPACKAGES
        for name in importlib.import_module(f"torchrl_caiac.{subpackage}").__all__
        if name in torchrl_caiac.__all__
    }
}
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the Args sections have the types
add_module_names = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_attr_annotations = False
napoleon_use_ivar = True
napoleon_use_rtype = False
napoleon_custom_sections = [("Keyword Args", "params_style")]

sphinx_gallery_conf = {
    "examples_dirs": "tutorials",
    "gallery_dirs": "auto_tutorials",
    "filename_pattern": r"plot_",
    "within_subsection_order": "gallery_figures.tutorial_order",
    "image_scrapers": ("gallery_figures.save_figures", "matplotlib"),
    "ignore_repr_types": r"matplotlib\.figure",
    "remove_config_comments": True,
    "show_memory": False,
    "write_computation_times": False,
    "download_all_examples": False,
    "abort_on_example_error": True,
}

html_theme = "pydata_sphinx_theme"
html_title = "torchrl-caiac"
html_show_sourcelink = False
html_sidebars = {"index": []}  # it has no pages below it
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {
    "header_links_before_dropdown": 7,
    "navigation_with_keys": False,
    "show_nav_level": 2,
    "show_prev_next": False,
}

make_errors.PAGE.write_text(make_errors.page(), encoding="utf-8")
