"""Every link, anchor, path and function that the documentation names exists."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from cpcbl_agents.filtering import OFF_FIELD
from cpcbl_agents.input_diagnosis.problems import REASONS
from cpcbl_launch.lab.chaos.scenarios import SCENARIOS
from cpcbl_team.inputs import SightingFault
from cpcbl_team.timeline import TimelineRefusal
from cpcbl_transport.messages import Refusal

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted(ROOT.glob("*.md")) + sorted(ROOT.glob("docs/*.md"))
SOURCES = "cpcbl_team|transport|agents|launch|tests|docs|docker"


@cache
def anchors(document: Path) -> frozenset[str]:
    """The anchors that GitHub gives to the headings of a page, but not to code."""
    text = re.sub(r"^```.*?^```", "", document.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ +(.+?) *$", text, re.MULTILINE)
    slugs = (re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings)
    return frozenset(slugs)


@cache
def names_in(source: Path) -> frozenset[str]:
    """What a module defines: `name`, and inside of a class also `Class.name`."""
    found = set()
    for node in ast.parse(source.read_text()).body:
        found |= _names(node)
        if isinstance(node, ast.ClassDef):
            inside = {name for inner in node.body for name in _names(inner)}
            found |= inside | {f"{node.name}.{name}" for name in inside}
    return frozenset(found)


def _names(node: ast.stmt) -> set[str]:
    match node:
        case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
            return {name}
        case ast.Assign(targets=targets):
            return {n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)}
        case ast.AnnAssign(target=ast.Name(id=name)):
            return {name}
    return set()


def test_anchors_are_those_of_github(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# The paper, row by row\n```sh\n# no heading\n```\n## `joint`: 3 × 3 (default)\n"
    )
    assert anchors(page) == {"the-paper-row-by-row", "joint-3--3-default"}


def test_names_are_those_that_a_module_defines(tmp_path: Path) -> None:
    source = tmp_path / "a.py"
    source.write_text("A, B = 1, 2\nC: int = 3\nclass D:\n    e: int\n    def f(self): pass\n")
    assert names_in(source) == {"A", "B", "C", "D", "e", "f", "D.e", "D.f"}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_relative_links_lead_to_a_file_and_a_heading(document: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text()):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        page = (document.parent / path).resolve() if path else document
        assert page.exists(), target
        if anchor:
            assert anchor in anchors(page), target


def test_the_page_on_faults_has_every_scenario_with_its_texts() -> None:
    page = (ROOT / "docs" / "faults.md").read_text()
    for scenario in SCENARIOS:
        row = f"| `{scenario.name}` | {scenario.done} | {scenario.expectation} |"
        assert row in page, scenario.name


def test_pages_that_the_code_names_exist() -> None:
    for folder in ("cpcbl_team", "transport", "agents", "launch", "tests"):
        for source in (ROOT / folder).rglob("*.py"):
            for page in re.findall(r"\bdocs/\w+\.md", source.read_text()):
                assert (ROOT / page).exists(), f"{source}: {page}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_paths_and_the_names_behind_them_exist(document: Path) -> None:
    """A reference is `path` or `path: name, Class.name`, from the root of the repository."""
    pattern = rf"`((?:{SOURCES})/[\w/.-]+)(?:: ([\w., ]+))?`"
    for path, names in re.findall(pattern, document.read_text()):
        assert (ROOT / path).exists(), path
        for name in names.split(", ") if names else ():
            assert name in names_in(ROOT / path), f"{path}: {name}"


def test_every_reason_of_a_refusal_has_its_remedy_in_the_docs() -> None:
    """Those of the messages, and the literals that sensing and cameras refuse by."""
    page = (ROOT / "docs/refused_inputs.md").read_text()
    table = page.partition("## Reasons")[2].partition("## Other problems")[0]
    listed = {name for row in table.splitlines() for name in re.findall(r"`(\w+)`", _cell(row))}
    vision = ROOT / "agents/cpcbl_agents/vision"
    code = "".join((vision / name).read_text() for name in ("pictures.py", "detector.py"))
    images = set(re.findall(r'"((?:frame|camera)_\w+)"', code))
    faults = {*SightingFault, *TimelineRefusal, *images, "seen_twice", "no_camera", OFF_FIELD}
    assert listed == {str(reason) for reason in {*Refusal, *faults, "unknown_object"}}
    assert set(REASONS) <= listed
    inputs = {str(r) for r in {*Refusal, *faults}} - set(REASONS)
    assert inputs == {"unknown_robot", "own_message", "name_of_another", "clock_off"}


def _cell(row: str) -> str:
    """The first cell of a row of a table."""
    return row.split("|")[1] if row.startswith("|") else ""


def test_the_guide_for_contributors_lists_every_make_target() -> None:
    declared = re.search(r"^\.PHONY:((?:.*\\\n)*.*)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert declared is not None
    table = (ROOT / "CONTRIBUTING.md").read_text().partition("## Folders and layers")[0]
    rows = [row for row in table.splitlines() if row.startswith("|")]
    listed = {name for row in rows for name in re.findall(r"`(?:make )?([\w-]+)`", _cell(row))}
    listed |= {name for row in rows for name in re.findall(r"`make ([\w-]+)`", row)}
    assert listed == set(declared[1].replace("\\", "").split())
