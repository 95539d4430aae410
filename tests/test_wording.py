"""Check of names and prose, which reports the words that the word list rules out, and no others."""

from __future__ import annotations

import pytest

from tests.support.wording import check_name, docstring_findings, identifier_findings, prose_findings, prose_tokens


@pytest.mark.parametrize(
    "name",
    ["told", "_foreseen", "ContactRoom", "newton_room", "check_way", "held", "PATIENCE", "GOOD_ENOUGH", "MOST_NODES"],
)
def test_ruled_out_names_are_reported(name: str) -> None:
    assert check_name(name, name.isupper()) is not None


@pytest.mark.parametrize(
    "name", ["contact_velocities", "ContactSelector", "held_index", "most_violated", "is_near", "MAX_SINK", "size"]
)
def test_technical_names_pass(name: str) -> None:
    assert check_name(name, name.isupper()) is None


def test_definitions_are_checked_and_local_names_are_not() -> None:
    source = "KEPT = 1\n\ndef read(held: int) -> int:\n    told = held\n    found = told\n    return found\n"
    names = [(finding.line, finding.text) for finding in identifier_findings("a.py", source)]
    assert names == [(1, "KEPT"), (3, "held")]


def test_fields_attributes_and_methods_are_checked() -> None:
    source = "class A:\n    rooms: int\n\n    def foresee(self) -> None:\n        self._told = 1\n        self.ok = 2\n"
    assert [finding.text for finding in identifier_findings("a.py", source)] == ["rooms", "foresee", "_told"]


def test_typescript_names_are_checked() -> None:
    source = "export class Crew {\n  private told = 1;\n  tellAll(): void {\n    const kept = 2;\n  }\n}\n"
    assert [finding.text for finding in identifier_findings("a.ts", source)] == ["Crew", "told", "tellAll"]


@pytest.mark.parametrize(
    "text",
    ["Of torch.", "What is stored.", "How many.", "Where it lies.", "Whether.", "See ``X``.", "", "the gaps."],
)
def test_ruled_out_docstrings_are_reported(text: str) -> None:
    source = f'def f():\n    """{text}"""\n'
    assert [finding.line for finding in docstring_findings("a.py", list(prose_tokens(source)))] == [2]


@pytest.mark.parametrize(
    "text",
    ["Return the gaps.", "(n, 3) m.", "rad/s, spin.", "m g H.", "``x`` of it.", "See ``X`` for why."],
)
def test_plain_docstrings_pass(text: str) -> None:
    source = f'X = 1\n"""{text}"""\n'
    assert not list(docstring_findings("a.py", list(prose_tokens(source))))


def test_prose_is_checked_in_comments_and_docstrings_but_not_in_code() -> None:
    source = '"""Nobody waits."""\n\n# It is\n# told twice.\nnobody = "nobody"\n"""``nobody`` is code."""\n'
    findings = prose_findings("a.py", source, list(prose_tokens(source)))
    assert [(finding.line, finding.text) for finding in findings] == [(1, "Nobody"), (3, "is told")]


def test_pages_have_no_commit_hashes_and_code_is_not_prose() -> None:
    page = "As of `9d6d377` it works.\n\n```\nnobody\n```\n\nThe deadbeef of 1234567 is\nasked twice.\n"
    findings = sorted(prose_findings("a.md", page, []), key=lambda finding: finding.line)
    assert [(finding.line, finding.text) for finding in findings] == [(1, "9d6d377"), (7, "is asked")]
