"""Check the pages against the rules of plain English that can be checked mechanically.

``python -m tools.english [PAGE ...]`` reads ``tools/english.toml``: pages, banned wordings, verbs and exceptions.
"""

import re
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RULES = tomllib.loads((ROOT / "tools" / "english.toml").read_text(encoding="utf-8"))

_HIDDEN = re.compile(r"^```.*?^```$|<!--.*?-->", re.MULTILINE | re.DOTALL)
_NO_PROSE = ("|", "![", "<details", "<summary", "</details")
_GENERATED = re.compile(r"<!-- results:.*?<!-- end -->", re.DOTALL)
_SENTENCE = re.compile(r"(?:[^.?!]|[.?!](?!\s|$)|(?<=et al)\.|(?<=e\.g)\.|(?<=i\.e)\.)+[.?!]?")
_NUMBER = re.compile(r"(?<![\w.:-])\d[\d,.]*(?:(?: %)? \[[^]]*\])?")
_NO_QUANTITY = re.compile(
    r"\([^()]*(?:et al\.|arXiv)[^()]*\)|\b[A-Z][a-z]+ 20\d\d\b|\b\d+\.\d+\.\d+\b"
)  # citations, dates, versions
_OBJECTS = {*RULES["objects"].split()}
_QUESTIONS = ("what", "whether", "which", "who")


@dataclass(frozen=True)
class Finding:
    """A sentence on a page that breaks a rule of plain English."""

    page: str
    line: int
    rule: str
    sentence: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}: {self.rule}: {self.sentence}"


def _blanked(pattern: re.Pattern[str], text: str) -> str:
    """Replace matches with empty lines, so that line numbers do not change."""
    return pattern.sub(lambda match: "\n" * match[0].count("\n"), text)


def prose(text: str) -> str:
    """Return a page's text without code blocks, comments, tables and pictures; line numbers do not change."""
    lines = _blanked(_HIDDEN, text).split("\n")
    return "\n".join("" if line.lstrip().startswith(_NO_PROSE) else line for line in lines)


def _plain(text: str) -> str:
    """Replace inline code with a word, and links with their text."""
    text = re.sub(r"`[^`]*`", "CODE", text)
    text = re.sub(r"!?\[([^]]*)\]\([^)]*\)", r"\1", text)
    return text.replace("**", "").replace("*", "")


def _paragraphs(text: str) -> Iterator[tuple[int, str]]:
    """Yield the first line and the text of each paragraph and bullet; headings are left out."""
    text = re.sub(r"^#.*$", "", text, flags=re.MULTILINE)
    for match in re.finditer(r"(?:^[ ]*(?:[*-]|\d+\.) )?(?:.+(?:\n(?![ ]*(?:[*-]|\d+\.) ).+)*)", text, re.MULTILINE):
        yield text.count("\n", 0, match.start()) + 1, re.sub(r"^\s*(?:[*-]|\d+\.) ", "", match[0])


def sentences(text: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the plain text of every sentence of a page's prose."""
    for first, paragraph in _paragraphs(prose(text)):
        plain = _plain(paragraph)
        for match in _SENTENCE.finditer(plain):
            sentence = " ".join(match[0].split())
            if len(sentence.split()) > 2:
                yield first + plain.count("\n", 0, match.start() + 1), sentence


def _past(stem: str) -> set[str]:
    """Return the regular past forms of a verb, some of which do not exist."""
    return {stem + "d" * (stem[-2:] != "ee"), stem + "ed", stem + stem[-1] + "ed", stem.removesuffix("y") + "ied"}


def _present(stem: str) -> set[str]:
    return {stem, stem + "s", stem + "es", stem.removesuffix("y") + "ies"}


_NOUNS = set[str]().union(*(_present(stem) for stem in RULES["nouns"].split()))
_VERBS = set[str]().union(*(_past(stem) for stem in (RULES["verbs"] + RULES["nouns"]).split()))
_VERBS = _VERBS.union(*(_present(stem) for stem in RULES["verbs"].split()))


def _has_verb(clause: str) -> bool:
    words = re.findall(r"[\w'’]+", clause.lower().replace("’", "'"))
    for word, following in zip(words, [*words[1:], ""], strict=False):
        if word in _VERBS or (word in _NOUNS and (word == words[0] or following in _OBJECTS)):
            return True
    return False


def _broken(sentence: str) -> Iterator[str]:
    """Yield the rules that a sentence of prose breaks."""
    if sentence.split()[0].lower() in _QUESTIONS and not sentence.endswith("?"):
        yield "opens with a question word"
    if len(_NUMBER.findall(_NO_QUANTITY.sub("", sentence))) > 2:
        yield "more than two numbers"
    clauses = re.sub(r"\([^()]*\)", "", sentence).split(";")
    if not all(_has_verb(clause) for clause in clauses if clause.strip()):
        yield "no verb"


def check(page: str, text: str) -> Iterator[Finding]:
    """Yield a finding for each rule that is broken on a page."""
    text = _blanked(_GENERATED, text)
    for line, sentence in sentences(text):
        for rule in _broken(sentence):
            yield Finding(page, line, rule, sentence)
    for line, words in _paragraphs(_blanked(_HIDDEN, text)):
        plain = _plain(words)
        for rule, pattern in RULES["banned"].items():
            for match in re.finditer(pattern, plain, re.IGNORECASE):
                around = " ".join(plain[max(0, match.start() - 40) : match.end() + 40].split())
                yield Finding(page, line + plain.count("\n", 0, match.start()), rule, around)


def check_all(rules: dict[str, Any] = RULES, root: Path = ROOT) -> list[str]:
    """Return a message for each finding on the listed pages that is no exception.

    Exceptions that no finding needs get a message too.
    """
    pages = sorted({path.relative_to(root).as_posix() for glob in rules["pages"] for path in root.glob(glob)})
    pages = [page for page in pages if page not in rules.get("later", [])]
    findings = [finding for page in pages for finding in check(page, (root / page).read_text(encoding="utf-8"))]
    unused = list(rules.get("exceptions", []))
    messages = []
    for finding in findings:
        known = [e for e in rules.get("exceptions", []) if finding.page == e["page"] and e["words"] in finding.sentence]
        unused = [exception for exception in unused if exception not in known]
        if not known:
            messages.append(str(finding))
    messages += [f"tools/english.toml: exception not needed: {e['page']}: {e['words']}" for e in unused]
    return messages


if __name__ == "__main__":
    problems = check_all({**RULES, "pages": sys.argv[1:]} if sys.argv[1:] else RULES)
    print(*problems, sep="\n", end="\n" if problems else "")
    sys.exit(f"{len(problems)} sentences to mend" if problems else 0)
