"""Sphinx settings: pages in Markdown, the public names from their docstrings."""

from importlib.metadata import version as installed

project = "lcopa_bayes"
author = "The lcopa_bayes developers"
release = version = installed("lcopa_bayes")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
myst_heading_anchors = 3
html_theme = "furo"
html_title = f"lcopa_bayes {version}"
html_show_copyright = False
html_copy_source = False
exclude_patterns = ["_build"]
default_role = "code"
autodoc_default_options = {"members": True, "inherited-members": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_class_signature = "separated"
