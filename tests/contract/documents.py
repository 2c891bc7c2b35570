"""What the tests of the documentation share: its pages, their listings, and commands as a shell reads them."""

import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("benchmarks/*.md"), *ROOT.glob("tests/**/*.md")]
)
OURS = ("cqn-train", "cqn-data", "cqn-bench", "cqn-push")

# Every command that bash does not know itself is written down instead of run, as the words that it would get.
PRELUDE = r"""
command_not_found_handle() { printf '%s\0' "$LISTING" "$@" $'\n' >>"$COMMANDS"; }
source() { :; }
"""


@dataclass(frozen=True)
class Listing:
    """A block of code in a page. before: the line of text before it."""

    page: Path
    line: int
    language: str
    text: str
    before: str

    @property
    def named(self) -> str | None:
        """The file that the line before says it is, as "`path`:"."""
        found = re.search(r"`([\w./-]+)`:$", self.before)
        return found[1] if found else None


@dataclass(frozen=True)
class Command:
    """A command in a page, its words as the shell hands them on."""

    page: str
    line: int
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page}:{self.line} {' '.join(self.words)}"


def listings(page: Path) -> Iterator[Listing]:
    """Fenced blocks of a page, and indented ones that are a command of ours or of LeRobot's (as language "bash")."""
    lines = page.read_text(encoding="utf-8").splitlines()
    before, number = "", 0
    while number < len(lines):
        fence = re.match(r"( *)(`{3,}|~{3,})(\w*)", lines[number])
        if fence:
            end = next(n for n in range(number + 1, len(lines)) if lines[n].strip().startswith(fence[2]))
            text = "\n".join(line.removeprefix(fence[1]) for line in lines[number + 1 : end])
            yield Listing(page, number + 1, fence[3], text + "\n", before)
            number = end
        elif re.match(rf"    ({'|'.join(OURS)}|lerobot-)", lines[number]):
            end = number
            while lines[end].endswith("\\"):
                end += 1
            text = "\n".join(line[4:] for line in lines[number : end + 1])
            if " ... " not in text and "…" not in text:  # something is left out for the reader to fill in
                yield Listing(page, number + 1, "bash", text + "\n", before)
            number = end
        elif lines[number].strip():
            before = lines[number].strip()
        number += 1


def commands(page: Path, folder: Path) -> list[Command]:
    """Every command in a page's shell listings; they are read by bash as one script, in an empty folder.

    Variables, arrays and comments mean what they mean to a reader. Nothing is run but what bash has built in.
    """
    shell = shutil.which("bash")
    assert shell
    shown = [listing for listing in listings(page) if listing.language == "bash"]
    script = [PRELUDE, *(f"LISTING={listing.line}\n{listing.text}" for listing in shown)]
    written = folder / "commands"
    written.touch()
    done = subprocess.run(
        [shell, "-u", "-c", "\n".join(script)], cwd=folder, env={"PATH": "/nowhere", "COMMANDS": str(written)},
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert "syntax error" not in done.stderr, done.stderr
    assert "unbound variable" not in done.stderr, done.stderr
    found = []
    for entry in written.read_text(encoding="utf-8").split("\n\0")[:-1]:
        line, *words = entry.removesuffix("\0").split("\0")
        found.append(Command(str(page.relative_to(ROOT)), int(line), tuple(words)))
    return found


def without_code(text: str) -> str:
    """A page's text with empty lines in place of its listings, and code marks emptied."""
    kept, fence = [], ""
    for line in text.splitlines():
        mark = re.match(r" *(`{3,}|~{3,})", line)
        if fence:
            kept.append("")
            if line.strip().startswith(fence):
                fence = ""
        elif mark:
            fence = mark[1]
            kept.append("")
        else:
            kept.append(re.sub(r"(`+)(?!`).*?(?<!`)\1(?!`)", "``", line))
    return "\n".join(kept)


def links(text: str) -> list[tuple[int, str]]:
    """Line and target of every link and picture in a page's text."""
    found = []
    for number, line in enumerate(without_code(text).splitlines(), 1):
        targets = re.findall(r"\]\(<?([^()\s<>]+)>?(?: \"[^\"]*\")?\)", line) + re.findall(
            r"(?:src|href)=\"([^\"]+)\"", line
        )
        found += [(number, target) for target in targets]
    return found


def anchors(text: str) -> set[str]:
    """What GitHub makes of a page's headings."""
    found: set[str] = set()
    marks = [line for line in _outside_listings(text) if re.match(r"#{1,6} ", line)]
    for mark in marks:
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", mark.lstrip("#").strip()).lower()
        slug = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        name, again = slug, 0
        while name in found:
            again += 1
            name = f"{slug}-{again}"
        found.add(name)
    return found


def _outside_listings(text: str) -> Iterator[str]:
    fence = ""
    for line in text.splitlines():
        mark = re.match(r" *(`{3,}|~{3,})", line)
        if fence:
            fence = "" if line.strip().startswith(fence) else fence
        elif mark:
            fence = mark[1]
        else:
            yield line
