"""How mkdocstrings reads this project's docstrings (an extension of griffe, for docs/api.md).

The code writes parameters and attributes as ``name : what it is, shape and unit``, several to a line where they are
short. numpydoc takes the words behind the colon for a type. Here they become the description; types are those of the
signature. A short first line above an indented text is a type, as numpydoc has it.
"""

from __future__ import annotations

import re
import textwrap
from typing import Any

from griffe import Docstring, Extension, Object

SECTION = re.compile(r"^(Parameters|Attributes|Class attributes|Returns|Raises)\n-+\n", re.MULTILINE)
FIELD = re.compile(r"^(?P<names>[*`\w][\w*`, …]*) : (?P<told>.*)$")
ANOTHER = re.compile(r"; (?=\*{0,2}`?[a-z_]\w*`? : )")
LINE = 80  # words longer than this were broken for their length, and go on in the next line


class Fields(Extension):
    """Rewrites the sections of every docstring before it is parsed."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring = Docstring(
                rewritten(obj.docstring.value), lineno=obj.docstring.lineno, endlineno=obj.docstring.endlineno,
                parent=obj, parser=obj.docstring.parser, parser_options=obj.docstring.parser_options,
            )  # fmt: skip


def rewritten(text: str) -> str:
    """A docstring whose fields are descriptions of their own; words that follow a section come before all of them."""
    prose, *parts = SECTION.split(text)
    sections = ""
    for title, body in zip(parts[::2], parts[1::2], strict=True):
        section, _, rest = body.partition("\n\n")
        if rest.strip():
            prose = f"{prose.rstrip()}\n\n{rest}"
        if title in ("Parameters", "Attributes", "Class attributes"):
            title = title.replace("Class attributes", "Attributes")
            section = "\n".join(field(lines) for lines in fields(section))
        elif title == "Raises":
            section = re.sub(r"^(\w+) : (.*)$", r"\1\n    \2", section, flags=re.MULTILINE)
        else:  # words below a colon: the type is that of the signature
            words = re.sub(r"^\w+ : ", "", textwrap.dedent(section))
            section = ":\n" + textwrap.indent(words, "    ")
        sections += f"\n\n{title}\n{'-' * len(title)}\n{section}"
    return f"{prose.rstrip()}{sections}"


def fields(section: str) -> list[list[str]]:
    """The lines of each field: its own, and those that are indented below it."""
    found: list[list[str]] = []
    for line in section.splitlines():
        if line.startswith(" ") and found:
            found[-1].append(line.strip())
        else:
            found.append([line])
    return found


def field(lines: list[str]) -> str:
    """A field with its words as the description, in numpydoc's form; several fields where one line has several."""
    head, *more = lines
    match = FIELD.match(head)
    if match is None:
        return "\n".join([head, *(f"    {line}" for line in more)])
    told = [match["told"], *more]
    if more and is_type(match["told"], more[0]):  # told by the signature, but for the shape of an array
        told = [f"{match['told']}:", *more] if match["told"].startswith("array") else more
    first, *others = ANOTHER.split(" ".join(told))
    parts = [f"{name.strip('` ')}\n{textwrap.indent(first, '    ')}" for name in re.split("[,…]", match["names"])]
    return "\n".join([*parts, *(field([other]) for other in others)])


def is_type(told: str, below: str) -> bool:
    """Is it a type, with a sentence below it, or a sentence that goes on in the next line?"""
    return (
        len(told) < LINE
        and told[-1] not in ",;:"
        and (told.startswith("array") or below[0].isupper() or below[0] in '"`')
    )
