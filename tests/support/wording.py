"""Rules of ``wording.toml`` for names and prose, applied to sources and pages."""

from __future__ import annotations

import ast
import io
import re
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[2]
RULES: dict[str, Any] = tomllib.loads((Path(__file__).parent / "wording.toml").read_text())
CLIENT = "egs_warp/web/client/src"
MEMBER = re.compile(
    r"^(?:export )?(?:abstract )?(?:async )?(?:class|function|interface|type|const|let|enum) (\w+)"
    r"|^  (?:(?:private|protected|public|readonly|static|async|get|set) )*(\w+)[?!]?(?:\(|:|;| = )",
    re.MULTILINE,
)
TYPESCRIPT_COMMENT = re.compile(r"/\*.*?\*/|(?<!:)//[^\n]*", re.DOTALL)
CODE = re.compile(r"^```.*?^```|^~~~.*?^~~~|``[^`]+``|`[^`\n]+`|\\\(.*?\\\)|\$\$.*?\$\$|\]\([^)\s]*\)", re.S | re.M)
WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
PROSE = [(re.compile(key.replace(" ", r"\s+"), re.I), advice) for key, advice in RULES["prose"].items()]
PAGES = [(re.compile(key), advice) for key, advice in RULES["pages"].items()]


class Finding(NamedTuple):
    """Violation of a rule, with its category, the path relative to the root, the line, the text and the advice of the
    rule."""

    category: str
    path: str
    line: int
    text: str
    advice: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.category} {self.text!r}; write {self.advice}"


def check_name(name: str, is_constant: bool) -> tuple[str, str] | None:
    """Return the part of an identifier that is ruled out and what to write instead; None if nothing is ruled out."""
    rules = RULES["identifiers"]
    plain = name.strip("_").lower()
    words = [word.lower() for word in WORD.findall(name)]
    if name in rules["allowed"]:
        return None
    if plain in rules["names"]:
        return name, rules["names"][plain]
    tables = [rules["words"], rules["constants"]] if is_constant else [rules["words"]]
    return next(((name, table[word]) for table in tables for word in words if word in table), None)


def defined_names(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield the name and the line of every function, class, parameter, field, attribute and module constant, but not of
    local variables."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self":
            yield node.attr, node.lineno
        if isinstance(node, ast.Module | ast.ClassDef):
            for statement in node.body:
                targets = statement.targets if isinstance(statement, ast.Assign) else []
                if isinstance(statement, ast.AnnAssign):
                    targets = [statement.target]
                for part in (part for target in targets for part in ast.walk(target)):
                    if isinstance(part, ast.Name):
                        yield part.id, part.lineno


def identifier_findings(path: str, source: str) -> Iterator[Finding]:
    """Yield the identifiers of a Python or TypeScript file that are ruled out, each once per file."""
    if path.endswith(".ts"):
        found = MEMBER.finditer(source)
        names = [(match[1] or match[2], source.count("\n", 0, match.start()) + 1) for match in found]
    else:
        names = list(defined_names(ast.parse(source)))
    reported: set[str] = set()
    for name, line in names:
        violation = None if name in reported else check_name(name, name.isupper())
        if violation is not None:
            reported.add(name)
            yield Finding("identifier", path, line, *violation)


def prose_tokens(source: str) -> Iterator[tokenize.TokenInfo]:
    """Yield the comments and docstrings of a Python file, including the docstrings of attributes and constants."""
    previous = tokenize.NEWLINE
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token
        elif token.type != tokenize.NL:
            begins = previous in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
            if begins and token.type == tokenize.STRING and token.string.lstrip("rR").startswith('"""'):
                yield token
            previous = token.type


def docstring_findings(path: str, tokens: list[tokenize.TokenInfo]) -> Iterator[Finding]:
    """Yield docstrings that are empty or begin in a way that is ruled out."""
    for token in tokens:
        if token.type != tokenize.STRING:
            continue
        first = ast.literal_eval(token.string).strip().split("\n\n")[0]
        line, start = token.start[0], first[:40].split("\n")[0]
        word = re.match(r"[a-z]{3,}\b|[a-z]+\d+\b", first)
        if not first:
            yield Finding("docstring", path, line, "", "a sentence or a noun phrase")
        elif word and word[0] not in RULES["symbols"]["words"]:
            yield Finding("docstring", path, line, start, "a capital letter, or a noun phrase before the value")
        for pattern, advice in RULES["beginnings"].items():
            if re.match(pattern, first):
                yield Finding("docstring", path, line, start, advice)
                break


def lines_of(text: str) -> str:
    """Return only the line breaks of a text, which can replace the text without changing line numbers."""
    return "\n" * text.count("\n")


def prose_of(path: str, source: str, tokens: list[tokenize.TokenInfo]) -> str:
    """Return the prose of a file, with each word on its original line: comments and docstrings, or a page without
    code."""
    if path.endswith(".md"):
        return CODE.sub(lambda match: lines_of(match[0]), source)
    if path.endswith(".py"):
        pieces = [(token.start[0], token.string) for token in tokens]
    else:
        matches = TYPESCRIPT_COMMENT.finditer(source)
        pieces = [(source.count("\n", 0, match.start()) + 1, match[0]) for match in matches]
    text, last = "", 1
    for line, piece in pieces:
        text += "\n" * (line - last) + re.sub(r"(?m)^\s*[#*/]+", " ", piece)
        last = line + piece.count("\n")
    return re.sub(r"``[^`]+``|`[^`\n]+`", lambda match: lines_of(match[0]), text)


def prose_findings(path: str, source: str, tokens: list[tokenize.TokenInfo]) -> Iterator[Finding]:
    """Yield words in docstrings, comments and pages that are ruled out."""
    tables = [(prose_of(path, source, tokens), PROSE)]
    if path.endswith(".md"):
        tables.append((source, PAGES))
    for text, rules in tables:
        for pattern, advice in rules:
            for match in pattern.finditer(text):
                words = " ".join(match[0].split())
                if f"{path}: {words}" not in RULES["prose_allowed"]:
                    yield Finding("prose", path, text.count("\n", 0, match.start()) + 1, words, advice)


def files_under(folders: list[str], *endings: str) -> Iterator[str]:
    """Yield paths of files with one of the ``endings``, relative to the root, without the excluded ones."""
    for name in folders:
        top = ROOT / name
        for path in [top] if top.is_file() else sorted(top.rglob("*")):
            relative = path.relative_to(ROOT).as_posix()
            is_excluded = any(relative == one or relative.startswith(f"{one}/") for one in RULES["roots"]["excluded"])
            if path.suffix in endings and not is_excluded and "__pycache__" not in path.parts:
                yield relative


def all_findings() -> list[Finding]:
    """Return the findings of the whole tree."""
    roots = RULES["roots"]
    findings: list[Finding] = []
    for path in [*files_under(roots["identifiers"], ".py"), *files_under([CLIENT], ".ts")]:
        findings += identifier_findings(path, (ROOT / path).read_text())
    for path in files_under(roots["prose"], ".py", ".md", ".ts", ".mjs"):
        source = (ROOT / path).read_text()
        tokens = list(prose_tokens(source)) if path.endswith(".py") else []
        findings += docstring_findings(path, tokens)
        findings += prose_findings(path, source, tokens)
    return sorted(findings, key=lambda finding: (finding.path, finding.line))
