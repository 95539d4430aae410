"""Print a random sample of the tree's prose, with file and line, for a reader to judge.

``python docs/sample_prose.py --seed 1`` draws docstrings, comments, paragraphs of the pages and messages, which are
texts of errors and printed notes. The same seed and tree give the same sample.
"""

from __future__ import annotations

import argparse
import ast
import io
import random
import re
import textwrap
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
CODE_FOLDERS = ("egs_warp", "benchmarks", "examples", "tests", "docs")
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/**/*.md")
EXCLUDED = ("docs/notebook", "docs/vendor", "node_modules")
PRAGMA = re.compile(r"#!|# *(type|pyright|noqa|ruff|fmt)\b")
PRINTERS = ("print", "say", "print_note", "warn")


class Passage(NamedTuple):
    """Piece of prose, with the file and line at which it begins."""

    place: str
    text: str


def docstrings(place: str, tree: ast.AST) -> Iterator[Passage]:
    """Yield the docstrings of a module, including those of attributes and constants."""
    for node in ast.walk(tree):
        for statement in ast.iter_child_nodes(node):
            value = statement.value if isinstance(statement, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield Passage(f"{place}:{value.lineno}", textwrap.dedent(value.value).strip())


def comments(place: str, source: str) -> Iterator[Passage]:
    """Yield the comments; comments on consecutive lines are joined."""
    first, last, lines = 0, -1, []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not PRAGMA.match(token.string):
            if token.start[0] != last + 1 and lines:
                yield Passage(f"{place}:{first}", "\n".join(lines))
                lines = []
            first = first if lines else token.start[0]
            last = token.start[0]
            lines.append(token.string.lstrip("# "))
    if lines:
        yield Passage(f"{place}:{first}", "\n".join(lines))


def messages(place: str, tree: ast.AST) -> Iterator[Passage]:
    """Yield the texts of raised errors and of printed notes; formatted values are shown as their code."""
    for node in ast.walk(tree):
        call = node.exc if isinstance(node, ast.Raise) else node
        if not isinstance(call, ast.Call):
            continue
        name = ast.unparse(call.func).split(".")[-1]
        if isinstance(node, ast.Raise) or name in PRINTERS:
            for argument in call.args:
                parts = argument.values if isinstance(argument, ast.JoinedStr) else [argument]
                fixed = " ".join(str(part.value) for part in parts if isinstance(part, ast.Constant))
                if len(re.findall(r"[A-Za-z]{2,}", fixed)) >= 3:
                    yield Passage(f"{place}:{argument.lineno}", f"{name}: {ast.unparse(argument)}")


def paragraphs(place: str, page: str) -> Iterator[Passage]:
    """Yield the paragraphs, list entries and table rows of a Markdown page, without code, headings and short lines."""
    prose = re.sub(r"(?ms)^```.*?^```", lambda match: "\n" * match[0].count("\n"), page)
    blocks: list[list[str | int]] = []
    starts_new = True
    for number, line in enumerate(prose.splitlines(), 1):
        is_item = re.match(r"\s*([*-]|\d+\.|\|) ?", line) is not None
        if line.strip() and (starts_new or is_item):
            blocks.append([number, line.strip()])
        elif line.strip():
            blocks[-1].append(line.strip())
        starts_new = not line.strip()
    for number, *lines in blocks:
        text = "\n".join(map(str, lines))
        if len(text.split()) >= 8 and not text.startswith(("#", "|-", "<", "!")):
            yield Passage(f"{place}:{number}", text)


def collect() -> dict[str, list[Passage]]:
    """Return all passages of the tree by kind."""
    passages: dict[str, list[Passage]] = {"docstrings": [], "comments": [], "paragraphs": [], "messages": []}
    for path in sorted(path for folder in CODE_FOLDERS for path in (ROOT / folder).rglob("*.py")):
        place, source = path.relative_to(ROOT).as_posix(), path.read_text()
        if any(part in place for part in EXCLUDED):
            continue
        tree = ast.parse(source)
        passages["docstrings"] += docstrings(place, tree)
        passages["comments"] += comments(place, source)
        if not place.startswith("tests"):
            passages["messages"] += messages(place, tree)
    for path in sorted(path for pattern in PAGES for path in ROOT.glob(pattern)):
        place = path.relative_to(ROOT).as_posix()
        if not any(part in place for part in EXCLUDED):
            passages["paragraphs"] += paragraphs(place, path.read_text())
    return passages


def main() -> None:
    """Print the sample."""
    parser = argparse.ArgumentParser(description="Print a random sample of the tree's prose.")
    for kind, count in (("docstrings", 120), ("comments", 60), ("paragraphs", 60), ("messages", 40)):
        parser.add_argument(f"--{kind}", type=int, default=count, help=f"number of {kind} (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for kind, passages in collect().items():
        # Each kind has its own generator, so that its sample does not depend on the number of passages of another kind.
        drawn = random.Random(f"{args.seed} {kind}").sample(passages, min(getattr(args, kind), len(passages)))
        print(f"\n## {kind}: {len(drawn)} of {len(passages)}")
        for number, passage in enumerate(sorted(drawn), 1):
            print(f"\n[{kind} {number}] {passage.place}\n{textwrap.indent(passage.text, '    ')}")


if __name__ == "__main__":
    main()
