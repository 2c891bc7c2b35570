"""The two generated parts of docs/compatibility.md; each script writes its own and leaves the other as it is."""

import re
from collections.abc import Sequence

from .build import ROOT

PAGE = ROOT / "docs/compatibility.md"
PARTS = {
    "commands": (
        "# Compatibility\n\nWhich of LeRobot's commands take the policy, the datasets and the simulated arm. Each row"
        " is what came of running the\ncommand, written by `make compatibility`."
    ),
    "installed": (
        "## What was installed and tried\n\nWheel and sdist in empty environments, one for each extra, at the lowest"
        " and the newest versions; written by\n`make release-check`."
    ),
}


def read_section(name: str) -> list[str]:
    """Lines of a part as the page has them; none where the page or the part is not there yet."""
    text = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    found = re.search(rf"<!-- {name}: begin -->\n\n(.*?)\n\n<!-- {name}: end -->", text, re.DOTALL)
    return found[1].splitlines() if found else []


def write_section(name: str, lines: Sequence[str]) -> None:
    """Write one part anew."""
    parts = {part: list(lines) if part == name else read_section(part) for part in PARTS}
    text = "\n\n".join(
        f"{PARTS[part]}\n\n<!-- {part}: begin -->\n\n" + "\n".join(content) + f"\n\n<!-- {part}: end -->"
        for part, content in parts.items()
        if content
    )
    PAGE.write_text(text + "\n", encoding="utf-8")
