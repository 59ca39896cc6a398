"""How Sphinx builds the documents: `make docs`, from the project's folder, with every warning as an error."""

from protocol.version import package_version

project = "sitegrid"
release = version = package_version()
root_doc = "docs/index"
include_patterns = ["docs/**", "examples/**/README.md", "lab/README.md", "lab/*/README.md", "lab/results/*.md", "*.md"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
suppress_warnings = ["toc.not_included"]  # decisions and results are reached from their indexes
myst_heading_anchors = 4  # links name headings as a code host does
autodoc_member_order = "bysource"
autodoc_typehints = "description"
html_theme = "furo"
html_title = "sitegrid"
