# SPDX-License-Identifier: Apache-2.0

"""Write authors, version and requirements for those who archive, cite or package cloudrc.

`make docs` runs this with `tools.docs`. The authors come from CITATION.cff, the requirements from
pyproject.toml, the version from cloudrc/version.py.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from cloudrc import __version__

ROOT = Path(__file__).resolve().parents[1]
Person: TypeAlias = dict[str, str]
"""An entry of `authors` in CITATION.cff: a person, or an organization with a `name`."""
UNAFFILIATED = "Independent Researcher"
"""Affiliation in the paper of an author who names none: the journal wants one."""
CONDA_NAMES = {"prometheus-client": "prometheus_client"}
"""Name of a package on PyPI -> its name on conda-forge, if it differs."""


def outputs() -> dict[Path, str]:
    """Generate the files, and lines in files that are written by hand: file -> text."""
    cff = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    people = cff["authors"]
    names = [f"{{ name = {json.dumps(_name(each), ensure_ascii=False)} }}" for each in people]
    maintainers = [{"name": _name(each), **_only(each, "email")} for each in people]
    return {
        ROOT / ".zenodo.json": _json(zenodo(cff, project)),
        ROOT / "codemeta.json": _json(codemeta(cff, project)),
        ROOT / "conda" / "recipe.yaml": _recipe(recipe(cff, project)),
        **_with_line("pyproject.toml", r"^authors = .*$", f"authors = [{', '.join(names)}]"),
        **_with_line(
            "charts/cloudrc/Chart.yaml",
            r"^maintainers: .*$",
            f"maintainers: {json.dumps(maintainers, ensure_ascii=False)}",
        ),
        **_with_line("CITATION.cff", r"^version: .*$", f"version: {__version__}"),
        **_with_line(
            "paper/paper.md",
            r"(?<=from CITATION\.cff\n)(?s:.*?)(?=^# end)",
            yaml.safe_dump(paper(people), sort_keys=False, allow_unicode=True),
        ),
    }


def zenodo(cff: dict[str, Any], project: dict[str, Any]) -> dict[str, Any]:
    """Describe cloudrc for Zenodo, which makes a DOI of each release on GitHub."""
    creators = [
        {"name": _name(each, family_first=True), **_only(each, "affiliation"), **_orcid(each)}
        for each in cff["authors"]
    ]
    followed = cff["references"][0]["url"].rpartition("/")[2]
    return {
        "title": cff["title"],
        "description": project["description"],
        "upload_type": "software",
        "access_right": "open",
        "license": cff["license"],
        "creators": creators,
        "keywords": cff["keywords"],
        "related_identifiers": [
            {"identifier": f"arXiv:{followed}", "relation": "cites", "scheme": "arxiv"}
        ],
    }


def codemeta(cff: dict[str, Any], project: dict[str, Any]) -> dict[str, Any]:
    """Describe cloudrc in the terms of CodeMeta 3.0."""
    return {
        "@context": "https://w3id.org/codemeta/3.0",
        "@type": "SoftwareSourceCode",
        "name": project["name"],
        "description": project["description"],
        "version": __version__,
        "license": f"https://spdx.org/licenses/{cff['license']}",
        "author": [_as_node(each) for each in cff["authors"]],
        "keywords": cff["keywords"],
        "codeRepository": cff["repository-code"],
        "issueTracker": f"{cff['repository-code']}/issues",
        "url": cff["url"],
        "programmingLanguage": f"Python {project['requires-python']}",
        "operatingSystem": ["Linux", "macOS"],
        "developmentStatus": "active",
        "softwareRequirements": project["dependencies"],
        "referencePublication": [each["url"] for each in cff["references"]],
    }


def recipe(cff: dict[str, Any], project: dict[str, Any]) -> dict[str, Any]:
    """Describe the package for conda; it is built from the clone that it lies in."""
    python = project["requires-python"]
    required = [_conda_name(each) for each in project["dependencies"]]
    commands = [f"{name} = {where}" for name, where in project["scripts"].items()]
    return {
        "schema_version": 1,
        "context": {"version": __version__},
        "package": {"name": project["name"], "version": "${{ version }}"},
        "source": {"path": ".."},
        "build": {
            "number": 0,
            "noarch": "python",
            "script": "python -m pip install . --no-deps --no-build-isolation -vv",
            "python": {"entry_points": commands},
        },
        "requirements": {
            "host": [f"python {python}", "pip", "hatchling >=1.27"],
            "run": [f"python {python}", *required],
        },
        "tests": [
            {"python": {"imports": ["cloudrc", "cloudrc.link"], "pip_check": True}},
            {"script": ["cloudrc --version", "cloudrc list profiles"]},
        ],
        "about": {
            "summary": project["description"],
            "license": cff["license"],
            "license_file": "LICENSE",
            "homepage": cff["url"],
            "repository": cff["repository-code"],
        },
        "extra": {"recipe-maintainers": [cff["repository-code"].split("/")[3]]},
    }


def paper(people: list[Person]) -> dict[str, Any]:
    """Return the authors as the front matter of a paper for JOSS names them."""
    places = list(dict.fromkeys(each.get("affiliation", UNAFFILIATED) for each in people))
    authors = [
        {
            "name": _name(each),
            **_orcid(each),
            "affiliation": str(places.index(each.get("affiliation", UNAFFILIATED)) + 1),
        }
        for each in people
    ]
    affiliations = [{"index": number, "name": name} for number, name in enumerate(places, start=1)]
    return {"authors": authors, "affiliations": affiliations}


def _name(each: Person, *, family_first: bool = False) -> str:
    if "name" in each:
        return each["name"]
    given, family = each["given-names"], each["family-names"]
    return f"{family}, {given}" if family_first else f"{given} {family}"


def _only(each: Person, key: str) -> Person:
    return {key: each[key]} if key in each else {}


def _orcid(each: Person) -> Person:
    """Return the bare number of an author's ORCID, which CITATION.cff has as an address."""
    return {"orcid": each["orcid"].rpartition("/")[2]} if "orcid" in each else {}


def _as_node(each: Person) -> dict[str, Any]:
    if "name" in each:
        return {"@type": "Organization", "name": each["name"]}
    node = {"@type": "Person", "givenName": each["given-names"], "familyName": each["family-names"]}
    known = {"@id": each["orcid"]} if "orcid" in each else {}
    place = {"affiliation": {"@type": "Organization", "name": each["affiliation"]}}
    return {**known, **node, **_only(each, "email"), **(place if "affiliation" in each else {})}


def _conda_name(requirement: str) -> str:
    """Return a requirement of PyPI as one of conda-forge."""
    name, limits = re.fullmatch(r"([\w-]+)(.*)", requirement).groups()  # type: ignore[union-attr]
    return f"{CONDA_NAMES.get(name, name)} {limits}".strip()


def _json(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def _recipe(content: dict[str, Any]) -> str:
    head = "# Made by `make docs`. In a clone: rattler-build build --recipe conda/recipe.yaml\n"
    return head + yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=100)


def _with_line(name: str, pattern: str, line: str) -> dict[Path, str]:
    """Replace the only match of `pattern` in a file of the repository."""
    path = ROOT / name
    text, count = re.subn(pattern, lambda _: line, path.read_text("utf-8"), flags=re.MULTILINE)
    if count != 1:
        raise ValueError(f"{name}: {count} places match {pattern}, not one")
    return {path: text}
