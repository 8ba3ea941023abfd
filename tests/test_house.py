"""The house rules of `CONTRIBUTING.md`, held statically."""

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

HOST = {"torch", "torchrl", "tensordict"}
# What a room may import beside itself and the standard library.
ALLOWED = {
    "functional": {"torch"},
    "modules": HOST | {"functional"},
    "transforms": HOST | {"functional"},
    "envs": HOST | {"numpy", "gymnasium", "mujoco", "envpool"},
    "objectives": HOST | {"functional", "modules"},
    "configs": {"torchrl", "hydra", "modules", "transforms", "objectives"},
}


def room_of(file):
    """The folder under the package that a file belongs to; "" for the package itself."""
    parts = file.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


def imports(file):
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


def reached(module, name):
    """The room that an import of the package reaches, "" for the package itself, None outside."""
    first, _, rest = module.partition(".")
    if first != PACKAGE.name:
        return None
    return rest.partition(".")[0] or (name if name in ROOMS else "")


every_file = pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(PACKAGE)))


@every_file
def test_a_room_imports_only_what_its_rule_allows_and_no_underscore_name(file):
    room, own = room_of(file), {*sys.stdlib_module_names, PACKAGE.name, "__future__"}
    foreign = {module.split(".")[0] for module, _ in imports(file)} - own
    allowed = ALLOWED[room] if room else set()  # the package itself gathers all rooms
    assert foreign <= allowed, f"{file}: {room} may not import {foreign - allowed}"
    for module, name in imports(file):
        target = reached(module, name)
        if target is None or target == room:
            continue
        assert target, f"{file}: imports the package itself; import from the room instead"
        assert not room or target in ALLOWED[room], f"{file}: {room} may not import {target}"
        private = any(part.startswith("_") for part in (*module.split("."), name))
        assert not private, f"{file}: {module}.{name}"


@every_file
def test_a_file_says_what_it_is_is_short_and_neither_prints_nor_asserts_nor_seeds_the_world(file):
    text = file.read_text()
    tree = ast.parse(text)
    assert ast.get_docstring(tree)
    assert text.count("\n") <= LONGEST_FILE, f"{file}: split it"
    for node in ast.walk(tree):
        if isinstance(node, ast.Assert):  # narrowing a type for mypy is the one use allowed
            narrows = ast.unparse(node.test).startswith("isinstance(")
            assert narrows, f"{file}:{node.lineno}: raise a clear error"
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            forbidden = {"print", "torch.manual_seed", "np.random.seed", "random.seed"}
            assert called not in forbidden, f"{file}:{node.lineno}: {called}"


@pytest.mark.parametrize("room", ROOMS)
def test_all_of_a_room_lists_what_its_init_imports_and_the_package_offers_its_classes(room):
    file = PACKAGE / room / "__init__.py"
    imported = {name for module, name in imports(file) if reached(module, name) is not None}
    module, package = (importlib.import_module(n) for n in (f"{PACKAGE.name}.{room}", PACKAGE.name))
    assert imported == set(module.__all__)
    for names in (module.__all__, package.__all__):
        assert len(names) == len(set(names))
    classes = {name for name in module.__all__ if inspect.isclass(getattr(module, name))}
    assert (classes if room != "functional" else {room}) <= set(package.__all__)


def test_the_version_is_written_once_and_is_the_one_installed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    version = project["version"]
    assert importlib.metadata.version(project["name"]) == version
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.search(rf"^version: {re.escape(version)}$", citation, re.MULTILINE)
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text()
    for file in FILES:
        assert f'"{version}"' not in file.read_text(), f"{file}: read the metadata"


def test_the_readme_names_no_file_that_does_not_exist():
    text = (ROOT / "README.md").read_text()
    for path in re.findall(r"`((?:docs|conf|recipes|tests|results)/[\w./]*)`", text):
        assert (ROOT / path).exists(), path
