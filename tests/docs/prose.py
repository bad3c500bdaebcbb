"""Count sentences that are hard to read, by file: ``python tests/docs/prose.py [--show] [FILE]``.

A sentence counts against a file if it opens with a relative clause, uses a word of AVOID, or has
more than LONGEST words. Code, tables, headings and link targets are not prose.
"""

import ast
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
LONGEST = 35
OPENS = re.compile(r"(What|Whether|Where|How|Who|That|Which)\b(?!-|[^.?!]*\?$)")
"""Relative clauses that open a statement; a question may begin with the same words."""
AVOID = re.compile(
    r"\b(amid|beside|for all that|(held|holds?|holding)( \w+)? to (its|their) word|call(s|ed)? for"
    r"|stretch(es)?|chances?|lest|in the midst of|thereof|whereof|of its own accord)\b",
    re.I,
)

_FENCE = re.compile(r"^(?P<mark>`{3,}|~{3,}).*?^(?P=mark)[ \t]*$", re.S | re.M)
_TABLE = re.compile(r"^[ ]*=+( +=+)+\n.*?(?=\n[ ]*\n|\Z)", re.S | re.M)
"""A table of reStructuredText, up to an empty line."""
_COMMENT = re.compile(r"<!--.*?-->|\A---\n.*?\n---\n", re.S)
_LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
_CODE = re.compile(r"`+[^`]+`+(_+)?")
_ITEM = re.compile(r"\s*([-*+:]|\d+\.)\s+")
_NOT_PROSE = re.compile(r"\s*(\||#|>>>|\.\. |    |[-=+|_ ]+$)")
_END = re.compile(r"(?<=[.!?])[\"')*]*\s+(?=[\"'(*[]*[A-Z0-9])")
_SHORT = re.compile(r"\b(e\.g|i\.e|etc|cf|Fig|Figs|Eq|Sec|vs|al|approx|No|St)\.(?=\s)")


def sentences(text: str) -> list[str]:
    """Sentences of a text in Markdown."""
    text = _TABLE.sub("\n", _FENCE.sub("\n\n", _COMMENT.sub("", text)))
    paragraphs: list[list[str]] = [[]]
    for line in text.splitlines():
        item = _ITEM.match(line)
        if not line.strip() or (_NOT_PROSE.match(line) and not (item or _continues(paragraphs))):
            paragraphs.append([])
        elif item:
            paragraphs.append([line[item.end() :]])
        else:
            paragraphs[-1].append(line.strip())
    return [s for p in paragraphs for s in _split(" ".join(p))]


def _continues(paragraphs: list[list[str]]) -> bool:
    """Tell whether an indented line goes on with a list item."""
    return bool(paragraphs[-1]) and not paragraphs[-1][-1].endswith("::")


def _split(paragraph: str) -> list[str]:
    text = _LINK.sub(lambda m: "X" if re.search(r"[./]", m[1]) else m[1], paragraph)
    text = _CODE.sub("X", text).replace("**", "").replace("_", "")
    text = _SHORT.sub(r"\1", text)
    return [s.strip(" *\"'(") for s in _END.split(text) if len(s.split()) > 1]


def fault(sentence: str) -> str:
    """Faults of a sentence; none if it reads well."""
    if OPENS.match(sentence):
        return "opens with a relative clause"
    if found := AVOID.search(sentence):
        return f"uses {found.group()!r}"
    words = len([word for word in sentence.split() if re.search(r"\w", word)])
    return f"has {words} words" if words > LONGEST else ""


def docstrings(source: str) -> Iterator[str]:
    """Docstrings of a module and of what is public in it, examples left out."""
    tree = ast.parse(source)
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    for node in ast.walk(tree):
        if node is tree or (isinstance(node, kinds) and not node.name.startswith("_")):
            doc = ast.get_docstring(node) or ""
            doc = re.sub(r"^\s*(>>>|\x08).*?(?=\n\s*\n|\Z)", "", doc, flags=re.S | re.M)
            about, *parts = re.split(r"^\w+\n-{3,}\n", doc, flags=re.M)
            # In sections lines without an indent are names; "Whether to", as NumPy has it after a
            # name, is the rest of a sentence.
            described = [
                re.sub(
                    r"^(?=\S).*\n(\s+(Whether|Where|How|Which) )?",
                    "\n    ",
                    f"{part}\n",
                    flags=re.M,
                )
                for part in parts
            ]
            text = "\n\n".join([about, *map(textwrap.dedent, described)])
            yield re.sub(r":\w+:`", "`", text)


def files() -> dict[str, list[str]]:
    """Sentences of each file that is checked."""
    pages = [*(REPOSITORY / "docs").rglob("*.md"), *REPOSITORY.glob("*.md")]
    modules = (REPOSITORY / "sweep").rglob("*.py")
    found = {}
    for path in sorted(pages) + sorted(modules):
        text = path.read_text(encoding="utf-8")
        if path.name == "CHANGELOG.md":
            text = "\n## ".join(text.split("\n## ")[:2])
        texts = [text] if path.suffix == ".md" else list(docstrings(text))
        found[str(path.relative_to(REPOSITORY))] = [s for t in texts for s in sentences(t)]
    return found


def main(names: list[str]) -> None:
    """Print counts and shares, and with --show every sentence at fault."""
    show, names = "--show" in names, [n for n in names if n != "--show"]
    count = total = 0
    for name, own in files().items():
        if names and not any(n in name for n in names):
            continue
        faults = [(fault(s), s) for s in own if fault(s)]
        count, total = count + len(faults), total + len(own)
        if faults:
            print(f"{len(faults):4d} of {len(own):4d}  {len(faults) / len(own):5.1%}  {name}")
        if show:
            print("".join(f"      {why}: {sentence}\n" for why, sentence in faults), end="")
    print(f"{count:4d} of {total:4d}  {count / max(total, 1):5.1%}  all")


if __name__ == "__main__":
    main(sys.argv[1:])
