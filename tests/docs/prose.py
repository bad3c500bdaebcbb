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
SENTENCE_WORDS_MAX = 35
RELATIVE_CLAUSE_OPENING = re.compile(r"(What|Whether|Where|How|Who|That|Which)\b(?!-|[^.?!]*\?$)")
"""Relative clauses that open a statement; a question may begin with the same words."""
WORDS_TO_AVOID = re.compile(
    r"\b(amid|beside|for all that|(held|holds?|holding)( \w+)? to (its|their) word|call(s|ed)? for"
    r"|stretch(es)?|chances?|lest|in the midst of|thereof|whereof|of its own accord)\b",
    re.I,
)

_CODE_FENCE = re.compile(r"^(?P<mark>`{3,}|~{3,}).*?^(?P=mark)[ \t]*$", re.S | re.M)
_TABLE = re.compile(r"^[ ]*=+( +=+)+\n.*?(?=\n[ ]*\n|\Z)", re.S | re.M)
"""A table of reStructuredText, up to an empty line."""
_COMMENT_OR_FRONT_MATTER = re.compile(r"<!--.*?-->|\A---\n.*?\n---\n", re.S)
_LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")
_CODE = re.compile(r"`+[^`]+`+(_+)?")
_LIST_ITEM = re.compile(r"\s*([-*+:]|\d+\.)\s+")
_NOT_PROSE = re.compile(r"\s*(\||#|>>>|\.\. |    |[-=+|_ ]+$)")
_SENTENCE_END = re.compile(r"(?<=[.!?])[\"')*]*\s+(?=[\"'(*[]*[A-Z0-9])")
_ABBREVIATION = re.compile(r"\b(e\.g|i\.e|etc|cf|Fig|Figs|Eq|Sec|vs|al|approx|No|St)\.(?=\s)")


def split_sentences(text: str) -> list[str]:
    """Sentences of a text in Markdown."""
    text = _TABLE.sub("\n", _CODE_FENCE.sub("\n\n", _COMMENT_OR_FRONT_MATTER.sub("", text)))
    paragraphs: list[list[str]] = [[]]
    for line in text.splitlines():
        list_item = _LIST_ITEM.match(line)
        if not line.strip() or (
            _NOT_PROSE.match(line) and not (list_item or _continues_list_item(paragraphs))
        ):
            paragraphs.append([])
        elif list_item:
            paragraphs.append([line[list_item.end() :]])
        else:
            paragraphs[-1].append(line.strip())
    return [
        sentence for paragraph in paragraphs for sentence in _split_paragraph(" ".join(paragraph))
    ]


def _continues_list_item(paragraphs: list[list[str]]) -> bool:
    """Tell whether an indented line goes on with a list item."""
    return bool(paragraphs[-1]) and not paragraphs[-1][-1].endswith("::")


def _split_paragraph(paragraph: str) -> list[str]:
    text = _LINK.sub(lambda match: "X" if re.search(r"[./]", match[1]) else match[1], paragraph)
    text = _CODE.sub("X", text).replace("**", "").replace("_", "")
    text = _ABBREVIATION.sub(r"\1", text)
    return [
        sentence.strip(" *\"'(")
        for sentence in _SENTENCE_END.split(text)
        if len(sentence.split()) > 1
    ]


def sentence_fault(sentence: str) -> str:
    """Faults of a sentence; none if it reads well."""
    if RELATIVE_CLAUSE_OPENING.match(sentence):
        return "opens with a relative clause"
    if match := WORDS_TO_AVOID.search(sentence):
        return f"uses {match.group()!r}"
    words = len([word for word in sentence.split() if re.search(r"\w", word)])
    return f"has {words} words" if words > SENTENCE_WORDS_MAX else ""


def iter_docstrings(source: str) -> Iterator[str]:
    """Docstrings of a module and of what is public in it, examples left out."""
    tree = ast.parse(source)
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    for node in ast.walk(tree):
        if node is tree or (isinstance(node, kinds) and not node.name.startswith("_")):
            docstring = ast.get_docstring(node) or ""
            docstring = re.sub(r"^\s*(>>>|\x08).*?(?=\n\s*\n|\Z)", "", docstring, flags=re.S | re.M)
            summary, *sections = re.split(r"^\w+\n-{3,}\n", docstring, flags=re.M)
            # In sections lines without an indent are names; "Whether to", as NumPy has it after a
            # name, is the rest of a sentence.
            section_texts = [
                re.sub(
                    r"^(?=\S).*\n(\s+(Whether|Where|How|Which) )?",
                    "\n    ",
                    f"{section}\n",
                    flags=re.M,
                )
                for section in sections
            ]
            text = "\n\n".join([summary, *map(textwrap.dedent, section_texts)])
            yield re.sub(r":\w+:`", "`", text)


def sentences_by_file() -> dict[str, list[str]]:
    """Sentences of each file that is checked."""
    page_paths = [*(REPOSITORY / "docs").rglob("*.md"), *REPOSITORY.glob("*.md")]
    module_paths = (REPOSITORY / "sweep").rglob("*.py")
    sentences_by_path = {}
    for path in sorted(page_paths) + sorted(module_paths):
        text = path.read_text(encoding="utf-8")
        if path.name == "CHANGELOG.md":
            text = "\n## ".join(text.split("\n## ")[:2])
        documents = [text] if path.suffix == ".md" else list(iter_docstrings(text))
        sentences_by_path[str(path.relative_to(REPOSITORY))] = [
            s for document in documents for s in split_sentences(document)
        ]
    return sentences_by_path


def main(names: list[str]) -> None:
    """Print counts and shares, and with --show every sentence at fault."""
    shows_sentences, names = (
        "--show" in names,
        [argument for argument in names if argument != "--show"],
    )
    count = total = 0
    for name, file_sentences in sentences_by_file().items():
        if names and not any(argument in name for argument in names):
            continue
        faulty_sentences = [(sentence_fault(s), s) for s in file_sentences if sentence_fault(s)]
        count, total = count + len(faulty_sentences), total + len(file_sentences)
        if faulty_sentences:
            print(
                f"{len(faulty_sentences):4d} of {len(file_sentences):4d}  "
                f"{len(faulty_sentences) / len(file_sentences):5.1%}  {name}"
            )
        if shows_sentences:
            print(
                "".join(f"      {reason}: {sentence}\n" for reason, sentence in faulty_sentences),
                end="",
            )
    print(f"{count:4d} of {total:4d}  {count / max(total, 1):5.1%}  all")


if __name__ == "__main__":
    main(sys.argv[1:])
