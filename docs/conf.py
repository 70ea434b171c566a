"""Sphinx configuration; `make docs` builds build/docs with warnings as errors."""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

project = 'csgm_ros'
author = copyright = 'csgm_ros maintainers'
release = version = re.search(r"version='(.*?)'", (ROOT / 'setup.py').read_text())[1]
extensions = ['sphinx.ext.autodoc', 'sphinx.ext.mathjax', 'numpydoc']
autodoc_member_order = 'bysource'
autodoc_typehints = 'none'  # the docstrings say them, with shapes and units
numpydoc_show_class_members = False
html_theme = 'alabaster'
html_theme_options = {'description': 'Registers point clouds of different sensors', 'fixed_sidebar': True}
