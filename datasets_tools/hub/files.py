"""Files on their way to the Hub: sizes, batches, and whether the Hub has them already."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from huggingface_hub.hf_api import RepoFile

__all__ = ["Content", "Hashes", "batches", "size_of"]

type Content = Path | bytes

BATCH_FILES, BATCH_BYTES = 16, 16 * 10**6  # larger files go alone, so that Ctrl-C need not wait for several


def size_of(content: Content) -> int:
    """Bytes of a file or of content in memory."""
    return len(content) if isinstance(content, bytes) else content.stat().st_size


def batches(paths: Sequence[str], files: Mapping[str, Content]) -> Iterator[list[str]]:
    """Paths in their order, in groups of a size after which progress is worth telling."""
    batch: list[str] = []
    size = 0
    for path in paths:
        more = size_of(files[path])
        if batch and (len(batch) == BATCH_FILES or size + more > BATCH_BYTES):
            yield batch
            batch, size = [], 0
        batch.append(path)
        size += more
    if batch:
        yield batch


class Hashes:
    """Compares files with those on the Hub, and reads each file once as long as it does not change."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, Path, int, int], str] = {}

    def equal(self, content: Content, there: RepoFile) -> bool:
        """Whether the Hub has this content: it tells the SHA-256 of large files and git's SHA-1 of the others."""
        size = size_of(content)
        if (there.lfs.size if there.lfs else there.size) != size:
            return False
        return self._of(content, size, "sha256" if there.lfs else "git") == (
            there.lfs.sha256 if there.lfs else there.blob_id
        )

    def _of(self, content: Content, size: int, kind: str) -> str:
        state: Any = hashlib.sha256()
        if kind == "git":
            state = hashlib.sha1(b"blob %d\0" % size, usedforsecurity=False)
        if isinstance(content, bytes):
            state.update(content)
            return str(state.hexdigest())
        key = (kind, content, size, content.stat().st_mtime_ns)
        if key not in self._known:
            with content.open("rb") as file:
                while chunk := file.read(1 << 20):
                    state.update(chunk)
            self._known[key] = str(state.hexdigest())
        return self._known[key]
