"""The house rules of `CONTRIBUTING.md`, held statically.

Specified here: which room imports which, that no underscore name crosses a room, that `__all__`
is complete and every public name has a docstring, how long a file may be, that the library prints
nothing, and that version and defaults are not written twice.
"""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import inspect
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "torchrl_drbpn"
FILES = sorted(PACKAGE.rglob("*.py"))
ROOMS = sorted(folder.name for folder in PACKAGE.iterdir() if (folder / "__init__.py").is_file())
LONGEST_FILE = 500

# What a room may import of the package, beside itself.
INNER = {
    "functional": set(),
    "modules": {"functional"},
    "transforms": {"functional"},
    "envs": set(),
    "objectives": {"functional", "modules"},
}
HOST = {"torch", "torchrl", "tensordict"}
# What it may import from outside, beside the standard library.
OUTER = {
    "functional": {"torch"},
    "modules": HOST,
    "transforms": HOST,
    "envs": HOST | {"numpy", "gymnasium", "mujoco", "envpool"},
    "objectives": HOST,
}


def room_of(file: Path) -> str:
    """The folder under the package that a file belongs to; "" for the package itself."""
    parts = file.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


def imports(file: Path) -> list[tuple[str, str]]:
    """Every import of a file, also inside functions, as (module, name); name "" for `import x`."""
    found = []
    package = (PACKAGE.name, *file.relative_to(PACKAGE).parent.parts)
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            found += [(module, alias.name) for alias in node.names]
    return found


def inner_target(module: str, name: str) -> str | None:
    """The room that an import of the package reaches, "" for the package itself, None outside."""
    parts = module.split(".")
    if parts[0] != PACKAGE.name:
        return None
    if len(parts) > 1:
        return parts[1]
    return name if name in ROOMS else ""


def outside(file: Path) -> list[tuple[str, str]]:
    """The imports that are neither of the package nor of the standard library."""
    return [
        (module, name)
        for module, name in imports(file)
        if module.split(".")[0] not in {*sys.stdlib_module_names, PACKAGE.name, "__future__"}
    ]


def ids(files):
    return [str(file.relative_to(PACKAGE)) for file in files]


def test_every_room_has_a_rule():
    assert set(ROOMS) == set(INNER) == set(OUTER)


@pytest.mark.parametrize("file", FILES, ids=ids(FILES))
def test_a_room_imports_only_what_its_rule_allows(file):
    room = room_of(file)
    if not room:  # the package itself gathers all rooms
        assert not outside(file)
        return
    for module, name in imports(file):
        target = inner_target(module, name)
        if target is None:
            continue
        assert target, f"{file}: imports the package itself; import from the room instead"
        assert target == room or target in INNER[room], f"{file}: {room} may not import {target}"
    foreign = {module.split(".")[0] for module, _ in outside(file)}
    assert foreign <= OUTER[room], f"{file}: {room} may not import {foreign - OUTER[room]}"


@pytest.mark.parametrize("file", FILES, ids=ids(FILES))
def test_no_underscore_name_crosses_a_room(file):
    for module, name in imports(file):
        target = inner_target(module, name)
        if target and target != room_of(file):
            parts = [*module.split("."), name]
            assert not any(part.startswith("_") for part in parts), f"{file}: {module}.{name}"


@pytest.mark.parametrize("file", FILES, ids=ids(FILES))
def test_no_file_is_longer_than_the_limit(file):
    lines = file.read_text().count("\n")
    assert lines <= LONGEST_FILE, f"{file}: split it"


@pytest.mark.parametrize("file", FILES, ids=ids(FILES))
def test_the_library_neither_prints_nor_asserts_nor_seeds_the_world(file):
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Assert):  # narrowing a type for mypy is the one use allowed
            narrows = ast.unparse(node.test).startswith("isinstance(")
            assert narrows, f"{file}:{node.lineno}: raise a clear error"
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in {"print", "torch.manual_seed", "np.random.seed", "random.seed"}, (
                f"{file}:{node.lineno}: {called}"
            )


@pytest.mark.parametrize("file", FILES, ids=ids(FILES))
def test_every_file_says_what_it_is(file):
    assert ast.get_docstring(ast.parse(file.read_text()))


@pytest.mark.parametrize("room", ROOMS)
def test_all_of_a_room_lists_what_its_init_imports_in_order(room):
    file = PACKAGE / room / "__init__.py"
    imported = {name for module, name in imports(file) if inner_target(module, name) is not None}
    listed = importlib.import_module(f"{PACKAGE.name}.{room}").__all__
    assert imported == set(listed)
    assert len(listed) == len(set(listed))


def test_the_package_offers_every_class_of_its_rooms():
    package = importlib.import_module(PACKAGE.name)
    rooms = [importlib.import_module(f"{PACKAGE.name}.{room}") for room in ROOMS]
    classes = {
        name
        for module in rooms
        for name in module.__all__
        if inspect.isclass(getattr(module, name)) and module.__name__ != "torchrl_drbpn.functional"
    }
    assert classes <= set(package.__all__)
    assert "functional" in package.__all__
    assert len(package.__all__) == len(set(package.__all__))


# An incomplete package must not keep the other rules from being checked.
@pytest.mark.parametrize("module", [PACKAGE.name, *(f"{PACKAGE.name}.{room}" for room in ROOMS)])
def test_every_public_name_exists_and_is_documented(module):
    room = importlib.import_module(module)
    for name in room.__all__:
        value = getattr(room, name)
        if callable(value) or inspect.ismodule(value):
            assert len((inspect.getdoc(value) or "").partition("\n")[0]) > 10, name
            # A class that inherits its docstring describes its parent.
            assert not inspect.isclass(value) or vars(value).get("__doc__"), name


def project() -> dict[str, str]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_version_is_written_once():
    version = project()["version"]
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.search(rf"^version: {re.escape(version)}$", citation, re.MULTILINE)
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text()
    for file in FILES:
        assert f'"{version}"' not in file.read_text(), f"{file}: read the metadata"


def test_the_installed_version_is_that_of_the_checkout():
    try:
        installed = importlib.metadata.version(project()["name"])
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("the project is not installed")
    assert installed == project()["version"]


def test_the_readme_names_no_file_that_does_not_exist():
    text = (ROOT / "README.md").read_text()
    linked = re.findall(r"\]\((?!https?://)([^)#]+)\)", text)
    named = re.findall(r"`((?:docs|conf|recipes|tests|results)/[\w./]*)`", text)
    for path in [*linked, *named]:
        assert (ROOT / path).exists(), path
