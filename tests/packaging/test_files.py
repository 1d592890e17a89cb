"""The files for contributors, packagers and researchers: their links lead somewhere, and the citation is valid."""

import re
import tomllib

import pytest
import yaml

import holdfast
from tests.packaging.wheel import ROOT

LINK = re.compile(r"\]\((?!https?:)([^)#\s]+)(?:#[^)]*)?\)")
KINDS = {"article", "conference-paper", "generic", "software"}


@pytest.mark.parametrize(
    "page", ["CONTRIBUTING.md", "README.md", "SECURITY.md", "docs/releasing.md", "docs/stability.md"]
)
def test_links_lead_to_files(page: str) -> None:
    file = ROOT / page
    assert [to for to in LINK.findall(file.read_text("utf-8")) if not (file.parent / to).exists()] == []


def test_contributing_fits_a_page() -> None:
    assert len((ROOT / "CONTRIBUTING.md").read_text("utf-8").splitlines()) <= 80


def test_every_room_has_a_level_of_stability() -> None:
    text = (ROOT / "docs/stability.md").read_text("utf-8")
    bound = re.findall(r"^from holdfast import (\w+) as", (ROOT / "__init__.py").read_text("utf-8"), re.MULTILINE)
    assert [room for room in (*bound, "testing", "diagnosis") if f"`holdfast.{room}`" not in text] == []


def test_every_supported_python_is_named() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    versions = [one.rpartition(" ")[2] for one in project["classifiers"] if "Python :: 3." in one]
    text = (ROOT / "docs/stability.md").read_text("utf-8")
    assert versions
    assert [one for one in versions if one not in text] == []


def test_the_citation_is_valid() -> None:
    """By the rules of CFF 1.2.0 that concern it: what is required, and of which type it is."""
    found = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert found["cff-version"] == "1.2.0"
    assert (found["version"], found["license"], found["type"]) == (holdfast.__version__, "Apache-2.0", "software")
    papers = found["references"]
    assert [paper["authors"][0]["family-names"] for paper in papers] == ["Zou", "Lauer", "Zaman"]
    for one in (found, *papers):
        assert one["type"] in KINDS
        assert isinstance(one["title"], str)
        assert all("name" in who or {"family-names", "given-names"} <= who.keys() for who in one["authors"])
    assert all(isinstance(paper.get("year", 0), int) for paper in papers)
    assert re.fullmatch(r"10\.\d{4,9}(\.\d+)?/\S+", papers[1]["doi"])
