"""What the Hub of the tests holds: files, repositories of commits, and failures to come."""

import hashlib
import re
from dataclasses import dataclass, field
from typing import Any

LARGE = (".parquet", ".mp4", ".safetensors", ".png", ".bin")


def is_large(path: str) -> bool:
    """Whether a file is stored as LFS."""
    return path.endswith(LARGE)


@dataclass(frozen=True)
class File:
    """One stored file."""

    content: bytes
    lfs: bool

    @property
    def git_oid(self) -> str:
        """SHA-1 that git gives this content (here of the content for LFS files too, not of their pointer)."""
        return hashlib.sha1(b"blob %d\0" % len(self.content) + self.content, usedforsecurity=False).hexdigest()

    @property
    def sha256(self) -> str:
        """SHA-256 of the content."""
        return hashlib.sha256(self.content).hexdigest()

    def described(self, path: str) -> dict[str, Any]:
        """As the tree lists it."""
        entry: dict[str, Any] = {"type": "file", "path": path, "size": len(self.content), "oid": self.git_oid}
        if self.lfs:
            entry["lfs"] = {"oid": self.sha256, "size": len(self.content), "pointerSize": 134}
        return entry


@dataclass
class Repository:
    """One repository: commits that never change, and names for some of them."""

    private: bool
    commits: dict[str, dict[str, File]] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)

    def commit(self, branch: str, tree: dict[str, File], message: str) -> str:
        """Put a new commit on a branch and return its id."""
        name = hashlib.sha1(f"{len(self.messages)} {message}".encode(), usedforsecurity=False).hexdigest()
        self.commits[name] = tree
        self.messages.append(message)
        self.branches[branch] = name
        return name

    def find(self, revision: str) -> str | None:
        """Id of the commit that a branch, tag or id names."""
        named = self.branches.get(revision) or self.tags.get(revision)
        return named or (revision if revision in self.commits else None)


@dataclass
class Failure:
    """What goes wrong, and how often still; see ``HubServer.fail``."""

    method: str
    path: re.Pattern[str]
    status: int | None
    after: int
    left: int
    done: bool
