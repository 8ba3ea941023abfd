"""Configuration of the pages: ``sphinx-build -W -b html docs docs/_build``.

A link that leads nowhere is a warning, and -W makes it an error. DOCS_ONLINE=1 links to the pages
of torch, tensordict and torchrl too; without it no network is needed. Notebooks run in the build;
what one gave is kept until it changes.
"""

import os
import re
from importlib.metadata import version as installed
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent

project, author = "torchrl-drbpn", "the authors of torchrl-drbpn"
version = release = installed(project)
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build", "jupyter_execute"]  # what the build writes
suppress_warnings = ["toc.not_included"]  # the page of a study is reached from that of all

myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 4
nb_execution_mode = "cache"
nb_execution_cache_path = str(DOCS / "_build" / ".jupyter_cache")
nb_execution_raise_on_error = True

# The reference: what every room exports, in the order of its `__all__`.
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes and units stand in the docstrings
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"torchrl-drbpn {release}"

if os.environ.get("DOCS_ONLINE") == "1":
    extensions.append("sphinx.ext.intersphinx")
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "tensordict": ("https://docs.pytorch.org/tensordict/stable", None),
        "torchrl": ("https://docs.pytorch.org/rl/stable", None),
    }


def within_site(app: Sphinx, name: str, source: list[str]) -> None:
    """Lead links among docs/ and results/ to their pages here; name what else is in the checkout.

    docs/results is a symbolic link to results/, so that the studies are pages too. In a checkout
    all links are right as they stand.
    """
    there = Path(app.env.doc2path(name)).resolve().parent

    def lead(link: re.Match[str]) -> str:
        text, path, anchor = link[1], link[2], link[3] or ""
        target = (there / path).resolve()
        if not target.exists():
            return link[0]
        place = target.relative_to(ROOT)
        if target.suffix == ".md" and place.parts[0] == "docs":
            return f"[{text}](/{place.relative_to('docs')}{anchor})"
        if target.suffix == ".md" and place.parts[0] == "results":
            return f"{{doc}}`{text} </{place.with_suffix('')}>`"
        if target.is_file() and target.is_relative_to(there):
            return link[0]
        return text if str(place) in text else f"{text} (`{place}`)"

    source[0] = re.sub(r"\[([^\]]*)\]\((?!\w+:)([^)#\s]+)(#[^)\s]*)?\)", lead, source[0])


def setup(app: Sphinx) -> None:
    """Register the above."""
    app.connect("source-read", within_site)
