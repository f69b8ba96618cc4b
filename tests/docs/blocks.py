"""The code blocks of a page, in order, with what stands before each."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
FENCE = re.compile(
    r"(?:<!-- not run: (?P<reason>.+?) -->\n)?"
    r"^```(?P<language>\w*)(?: title=\"(?P<title>[^\"]+)\")?\n(?P<code>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """A fenced block: its language ("" without one), the file it is of, why it is not run, its line in the page."""

    language: str
    code: str
    title: str
    reason: str
    line: int


def blocks_of(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    return [
        Block(m["language"], m["code"], m["title"] or "", m["reason"] or "", text[: m.start("code")].count("\n") + 1)
        for m in FENCE.finditer(text)
    ]


def file_of(page: Path, title: str) -> str:
    """The text of the file that a page writes out under this title."""
    (found,) = (block.code for block in blocks_of(page) if block.title == title)
    return found


def commands_of(code: str) -> list[str]:
    """The commands of a shell block, without comments; lines that end in a backslash go on."""
    joined = code.replace("\\\n", " ")
    lines = (re.sub(r"(^|\s)#.*", "", line).strip() for line in joined.splitlines())
    return [line for line in lines if line]
