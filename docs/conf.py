"""Sphinx configuration; `make docs` builds with it."""

from importlib import metadata

from sphinx.application import Sphinx

project = "sim2real"
author = "The sim2real authors"
copyright = author
release = metadata.version("sim2real")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.apidoc"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"sim2real {release}"

myst_heading_anchors = 3

# A name is documented once, in the module that defines it: hence without __all__, which repeats re-exported names.
apidoc_modules = [
    {
        "path": "../sim2real",
        "destination": "reference/api",
        "exclude_patterns": ["../sim2real/_pipelines"],
        "separate_modules": True,
        "module_first": True,
        "automodule_options": {"members", "show-inheritance", "ignore-module-all"},
    }
]
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
# "Attributes:" of a dataclass become a list in its description instead of entries that repeat its fields.
napoleon_use_ivar = True
# Rooms may use the same class name; a reference by the bare name then has several targets.
suppress_warnings = ["ref.python"]
# Warp is an extra, whose wheel has 150 MB: its modules are documented without it.
_WARP = "mujoco.mjx.third_party.mujoco_warp"
autodoc_mock_imports = ["warp", _WARP, f"{_WARP}._src"]


def setup(app: Sphinx) -> None:
    """Register the handler below with Sphinx."""
    app.connect("source-read", document_each_name_once)


def document_each_name_once(app: Sphinx, docname: str, source: list[str]) -> None:
    """Give a package's page the options of a module's page: apidoc ignores `automodule_options` for packages."""
    if docname.startswith("reference/api/"):
        source[0] = source[0].replace(":undoc-members:", ":ignore-module-all:")
