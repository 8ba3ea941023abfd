"""What the pages are held to: they name what exists, leave nothing out, and their code runs."""

import ast
import importlib
import re
import shutil
from functools import cache
from pathlib import Path

import pytest
from recipe_tools import ROOT, printed
from transform_cases import CASES

DOCS = ROOT / "docs"
PACKAGE = ROOT / "torchrl_drbpn"
PAGES = [*sorted(DOCS.rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
SCRIPT = DOCS / "guide" / "library_example.py"
TRAINER = DOCS / "guide" / "trainer_example.py"
GUIDE = DOCS / "guide" / "belief_in_your_ppo.md"
FAULTS = DOCS / "faults.md"
SIMULATOR = DOCS / "faults" / "faulty_simulator.py"
EXTENDING = DOCS / "extending.md"
EXAMPLE = DOCS / "extending"
EQUATIONS = {2, 3, 8, 10, 11, 12, 13}

# "Eq. (8), (10), (12) [DRBPN]", "eq. 2, 3, 8 [DRBPN]", "(eq. 10 and 12 [DRBPN])"
CITATION = re.compile(r"\b[Ee]qs?\.\s+((?:\(?\d+\)?(?:,\s+|\s+and\s+)?)+)\s+\[DRBPN\]")


def tables(page):
    """The tables of a page, each as its rows of cells without the rule."""
    rows = []
    for line in [*page.read_text(encoding="utf-8").splitlines(), ""]:
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip("|").split("|")])
        elif rows:
            yield [row for row in rows if not re.fullmatch(r"[-: ]+", row[0])]
            rows = []


def quoted(cell):
    return re.findall(r"`([^`]+)`", cell)


def equation_rows():
    """Each row of the table of equations: its numbers, the code and the tests it names."""
    head, *rows = next(tables(DOCS / "theory.md"))
    assert head == ["equation", "what it says", "code", "tests"]
    return [
        ({int(n) for n in re.findall(r"\((\d+)\)", row[0])}, quoted(row[2]), quoted(row[3]))
        for row in rows
    ]


def resolve(name):
    """The object called `torchrl_drbpn.<name>`."""
    value = importlib.import_module(PACKAGE.name)
    path = PACKAGE.name
    for part in name.split("."):
        path += f".{part}"
        if not hasattr(value, part):
            importlib.import_module(path)
        value = getattr(value, part)
    return value


@cache
def names_of_tests(file):
    """Every test function of a file, those of its classes included."""
    text = (ROOT / "tests" / file).read_text(encoding="utf-8")
    return frozenset(re.findall(r"^ *def (test_\w+)", text, re.MULTILINE))


def test_every_equation_has_a_row_and_what_theory_names_exists():
    rows = equation_rows()
    assert set().union(*(numbers for numbers, _, _ in rows)) >= EQUATIONS
    for numbers, code, tests in rows:
        assert numbers, "a row without a number"
        assert code, numbers
        assert tests, numbers
        assert all(callable(resolve(name)) for name in code), numbers
        assert all(re.fullmatch(r"\w+\.py::test_\w+", test) for test in tests), tests
    text = (DOCS / "theory.md").read_text(encoding="utf-8")
    for file, test in re.findall(r"`(test_\w+\.py|suites\.py)::(\w+)`", text):
        assert test in names_of_tests(file), f"{file}::{test}"
    for name in re.findall(r"`(functional\.[\w.]+)`", text):
        assert resolve(name) is not None, name


def citations():
    """Every docstring that cites the paper: file, name of the top-level owner, equations."""
    found = []
    for file in sorted(PACKAGE.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        # A citation in another spelling would escape.
        for sentence in re.findall(
            r"[^.]*\b[Ee]qs?\. [^\[]{1,40}\[DRBPN\]", " ".join(text.split())
        ):
            assert CITATION.search(sentence), f"{file}: {sentence[-80:]}"
        tree = ast.parse(text)
        for owner in [tree, *tree.body]:
            if isinstance(owner, ast.Module | ast.ClassDef | ast.FunctionDef):
                cited = " ".join(CITATION.findall(ast.get_docstring(owner) or ""))
                if numbers := {int(n) for n in re.findall(r"\d+", cited)}:
                    found.append((str(file.name), getattr(owner, "name", ""), numbers))
    return found


def test_every_equation_that_a_docstring_cites_has_a_row_that_names_it():
    rows = equation_rows()
    owners = {n: {name.split(".")[-1] for s, code, _ in rows if n in s for name in code}
              for n in set().union(*(s for s, _, _ in rows))}  # fmt: skip
    found = citations()
    assert {n for _, _, numbers in found for n in numbers} >= EQUATIONS
    for file, name, numbers in found:
        for number in numbers:
            assert number in owners, f"{file}: {name} cites eq. ({number}), which has no row"
            if name and not name.startswith("_"):
                assert name in owners[number], f"theory.md, eq. ({number}): `{name}` of {file}"


def test_the_reference_takes_in_every_room():
    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    rooms = sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))
    assert sorted(re.findall(r"automodule:: torchrl_drbpn\.(\w+)", text)) == rooms


def test_notation_names_the_keys_that_are_read_and_written():
    package = importlib.import_module(PACKAGE.name)
    module = package.BeliefFilterModule(package.BeliefFilter(3, 2))
    text = (DOCS / "notation.md").read_text(encoding="utf-8")
    keys = [*module.in_keys, *module.out_keys, *package.BeliefModelLoss().out_keys]
    transforms = [case.make() for case in CASES.values()]
    names = {type(transform).__name__ for transform in transforms}
    assert names == set(package.transforms.__all__) - {"seed_env"}
    for name in names:
        assert f"`{name}`" in text, name
    for transform in transforms:
        keys += [*transform.in_keys, *transform.out_keys, *getattr(transform, "state_keys", [])]
    for key in keys:
        spelt = key if isinstance(key, str) else str(tuple(key)).replace("'", '"')
        assert f"`{spelt}`" in text, key


def slug(heading):
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_relative_link_leads_somewhere(page):
    prose = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", prose):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = page if not path else page.parent / path
        assert file.exists(), f"{page.name}: {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in map(slug, headings), f"{page.name}: {target}"


def blocks_of(page, language="python"):
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize(
    ("blocks", "script"),
    [
        (blocks_of(GUIDE), SCRIPT),
        (blocks_of(DOCS / "guide" / "ppo_trainer.md")[:-1], TRAINER),
        (blocks_of(FAULTS), SIMULATOR),
        (blocks_of(DOCS / "deploy.md"), DOCS / "deploy" / "control_loop.py"),
        (blocks_of(EXTENDING)[:1], EXAMPLE / "drift.py"),
        (blocks_of(EXTENDING)[1:], EXAMPLE / "cautious.py"),
    ],
    ids=["guide", "trainer", "faults", "deploy", "transform", "loss"],
)
def test_the_blocks_of_a_page_are_the_script_and_all_of_it(blocks, script):
    rest = script.read_text(encoding="utf-8")
    left = []
    for block in blocks:
        before, found, rest = rest.partition(block)
        assert found, f"not in the script at its place:\n{block}"
        left.append(before)
    module_docstring, *between = left
    assert [type(node) for node in ast.parse(module_docstring).body] == [ast.Expr]
    assert not "".join([*between, rest]).strip(), "the page leaves out a part of the script"
    (entry,) = blocks_of(EXTENDING, "yaml")
    assert entry == (EXAMPLE / "conf/belief/moving_average.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize("script", [SCRIPT, TRAINER], ids=["loop", "trainer"])
def test_the_scripts_of_the_guide_import_core_dependencies_alone(script):
    text = script.read_text(encoding="utf-8")
    modules = set(re.findall(r"^\s*(?:import|from) (\w+)", text, re.MULTILINE))
    assert modules <= {"__future__", "torch", "tensordict", "torchrl", "torchrl_drbpn", SCRIPT.stem}


def test_the_sensors_of_the_faulty_simulator_fail_as_the_page_says():
    shares = [
        float(s) for s in re.findall(r"in (0\.\d+) of the steps", printed(SIMULATOR, cwd=ROOT))
    ]
    late = 1 - (2 / 3) ** 3  # of 3 delays one at least brings a reading
    started = 1 - 1.2 / 50  # nearly nothing arrives at the first two steps
    stuck = 0.01 / 0.06 * (1 - (1 - 0.94**50) / (50 * 0.06))  # from sensors that all work
    wanted = [0.25 * 0.8 * started, late * 0.8 * started, 0.8, stuck]
    assert shares == pytest.approx(wanted, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("script", [SCRIPT, TRAINER], ids=["loop", "trainer"])
def test_the_scripts_of_the_guide_run_elsewhere_and_learn(script, tmp_path):
    shutil.copy(SCRIPT, tmp_path)
    text = printed(Path(shutil.copy(script, tmp_path)), cwd=tmp_path)
    first, last = map(float, re.findall(r"20 episodes ([\d.]+).*last 20 ([\d.]+)", text)[0])
    assert last > 3 * first
    assert re.findall(r"missing 0\.(\d\d)", text)[0] in {"28", "29", "30", "31", "32"}
