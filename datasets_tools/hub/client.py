"""Send files to a repository of the Hugging Face Hub as one commit: resumable, retried, errors in one line.

Content goes first, a batch of files at a time; what has arrived is not sent again, also not by a later run. The commit
that makes it visible comes last, so the repository shows the old files or the new ones and never a part.
"""

import contextlib
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
from huggingface_hub import (
    CommitOperationAdd,
    CommitOperationDelete,
    HfApi,
    constants,
    get_session,
)
from huggingface_hub.errors import HfHubHTTPError, OfflineModeIsEnabled
from huggingface_hub.hf_api import RepoFile
from huggingface_hub.utils import build_hf_headers, hf_raise_for_status  # type: ignore[attr-defined]
from rich.console import Console

from lerobot_cqn.errors import CQNError, DataError
from lerobot_cqn.hub_retry import PASSING, HubError, cause, passing, retried, said, transport

from ..terminal.console import Interrupted, note, progress
from .files import Content, Hashes, batches, size_of

__all__ = ["MANAGED", "Hub", "HubError", "Sent"]

# By kind of repository: what begins so and is not sent is removed, since only the tools write there.
MANAGED = {
    "dataset": ("data/", "meta/", "videos/"),
    "model": ("videos/", "training/", "policy_preprocessor", "policy_postprocessor"),
}
WAITS = (1.0, 2.0, 4.0, 8.0)  # seconds before each further try
REPORT_EVERY = 60.0  # seconds between remarks where no bar can be drawn
TIMEOUT = httpx.Timeout(120, connect=20)  # seconds without any byte; the library's own is for ever


@dataclass
class Sent:
    """Changes that a push made.

    Attributes:
        url: page of the repository.
        new, changed, same, removed: paths in the repository.
        size: bytes of new and changed files.
        tagged: whether the tag had to be set or moved.
    """

    url: str
    new: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    same: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    size: int = 0
    tagged: bool = False


class Hub:
    """One repository."""

    def __init__(self, repo_id: str, again: str, branch: str | None = None, kind: str = "dataset") -> None:
        """A repository by its name; nothing is sent yet.

        Args:
            repo_id: ``user/name``.
            again: the command to run once more, told in errors.
            branch: by default the main one.
            kind: "dataset" or "model", as the Hub calls policies.
        """
        self.kind = kind
        self.api = HfApi(endpoint=constants.ENDPOINT)
        self.repo_id = repo_id
        self.again = again
        self.branch = branch or constants.DEFAULT_REVISION
        self._hashes = Hashes()
        self._state = ""  # how far it has come, for errors

    def check_account(self) -> None:
        """Ask who is logged in, and whether the repository's name is theirs; nothing is made.

        Raises:
            HubError: the token is refused, or the name belongs to somebody else.
            ConnectionError: the Hub cannot be reached now.
        """
        owner = self.repo_id.partition("/")[0]
        try:
            account = self.api.whoami()
        except Exception as error:  # the client and its transport raise kinds of their own
            behind = cause(error)
            if passing(behind):
                raise ConnectionError(said(behind)) from error
            status = behind.response.status_code if isinstance(behind, HfHubHTTPError) else said(behind)
            raise HubError(
                f"The Hub does not accept the token ({status}): log in with `hf auth login`, or train without a push."
            ) from error
        names = {account["name"], *(org["name"] for org in account.get("orgs", []))}
        if owner not in names:
            raise HubError(
                f"'{account['name']}' is logged in to the Hub and may not write to {self.repo_id}: expected a name that"
                f" begins with {' or '.join(f'{name}/' for name in sorted(names))}."
            )

    def prepare(self, *, private: bool) -> None:
        """Create repository and branch where they are not there yet.

        Raises:
            HubError: not allowed, not reached, or private data would go to a repository that is public.
        """
        chosen = private or None  # None: as the organisation has set it; what is there already keeps what it is
        self._ask(
            lambda: self.api.create_repo(self.repo_id, repo_type=self.kind, private=chosen, exist_ok=True),
            waits=WAITS[:2],
        )
        if private and self._info(constants.DEFAULT_REVISION).private is False:
            raise HubError(
                f"{self.repo_id} is there already and public, and --private only makes new repositories private: change"
                " it in its settings on the Hub or choose another name. No file was sent."
            )
        if self.branch != constants.DEFAULT_REVISION:
            self._ask(
                lambda: self.api.create_branch(self.repo_id, repo_type=self.kind, branch=self.branch, exist_ok=True)
            )

    def check_card(self, card: str) -> None:
        """Let the Hub judge a card's front matter, before anything is sent; raises HubError with what it says."""

        def judge() -> None:
            url, given = f"{self.api.endpoint}/api/validate-yaml", {"content": card, "repoType": self.kind}
            hf_raise_for_status(get_session().post(url, json=given, headers=build_hf_headers()))

        self._ask(judge)

    def text(self, path: str) -> str | None:
        """A small file of the branch, decoded from UTF-8; None where there is no such file.

        Raises:
            HubError: not reached, not allowed, or not text.
        """
        if path not in self._tree():
            return None
        with tempfile.TemporaryDirectory() as folder:
            found = self._ask(
                lambda: self.api.hf_hub_download(
                    self.repo_id, path, repo_type=self.kind, revision=self.branch, local_dir=folder
                )
            )
            try:
                return Path(found).read_text(encoding="utf-8")
            except UnicodeDecodeError as error:
                raise HubError(f"{path} of {self.repo_id} on the Hub is not UTF-8 text: mend it there.") from error

    def send(self, files: Mapping[str, Content], message: str) -> Sent:
        """Make the branch hold these files, in one commit; nothing is committed where it does already.

        Args:
            files: path in the repository -> file on disk, or content.
            message: of the commit.

        Returns:
            what was sent.

        Raises:
            HubError: refused, not reached, or the branch was changed by somebody else meanwhile.
            DataError: a file on disk cannot be read.
            Interrupted: Ctrl-C; says what is on the Hub.
        """
        operations: dict[str, CommitOperationAdd] = {}
        sent = Sent(f"{self.api.endpoint}/{'datasets/' if self.kind == 'dataset' else ''}{self.repo_id}")
        try:
            first = self._changes(files, sent)
            if not first:
                return sent
            self._upload(first, files, operations, sent)
            self._ask(lambda: self._commit(files, operations, message))
        except KeyboardInterrupt as error:
            raise Interrupted(
                f"Interrupted: {self.repo_id} shows the old files or all of the new ones{self._state}."
                f" Go on with: {self.again}"
            ) from error
        except OSError as error:  # of the disk: what the network raises has become a HubError
            raise self._explained(error) from error
        left = self._changes(files, Sent(""))
        if left:
            raise HubError(
                f"{len(left)} files did not get into {self.repo_id}, {next(iter(left))} the first; does its .gitignore"
                f" on the Hub name them? Mend it and push again: {self.again}"
            )
        return sent

    def tag(self, name: str) -> bool:
        """Let a tag name the last commit of the branch; False where it does already. Raises HubError."""

        def move() -> bool:
            head = self._info(self.branch).sha
            refs = self.api.list_repo_refs(self.repo_id, repo_type=self.kind)
            there = {ref.name: ref.target_commit for ref in refs.tags}
            if there.get(name) == head:
                return False
            if name in there:
                self.api.delete_tag(self.repo_id, repo_type=self.kind, tag=name)
            self.api.create_tag(self.repo_id, repo_type=self.kind, tag=name, revision=self.branch, exist_ok=True)
            return True

        return bool(self._ask(move))

    def _info(self, revision: str) -> Any:
        return self._ask(lambda: self.api.repo_info(self.repo_id, revision=revision, repo_type=self.kind))

    def _tree(self) -> dict[str, RepoFile]:
        found = self._ask(
            lambda: list(
                self.api.list_repo_tree(self.repo_id, repo_type=self.kind, revision=self.branch, recursive=True)
            )
        )
        return {f.path: f for f in found if isinstance(f, RepoFile)}

    def _changes(self, files: Mapping[str, Content], sent: Sent) -> dict[str, Content | None]:
        """Path -> new content, None for one to remove; ``sent`` gets the lists."""
        there = self._tree()
        sent.new, sent.changed, sent.same, sent.size = [], [], [], 0
        for path, content in sorted(files.items()):
            size = size_of(content)
            kind = (
                sent.new
                if path not in there
                else sent.same
                if self._hashes.equal(content, there[path])
                else sent.changed
            )
            kind.append(path)
            sent.size += 0 if kind is sent.same else size
        sent.removed = [p for p in sorted(there) if p.startswith(MANAGED[self.kind]) and p not in files]
        changes: dict[str, Content | None] = {p: files[p] for p in [*sent.new, *sent.changed]}
        return changes | dict.fromkeys(sent.removed)

    def _upload(
        self,
        changes: Mapping[str, Content | None],
        files: Mapping[str, Content],
        operations: dict[str, CommitOperationAdd],
        sent: Sent,
    ) -> None:
        paths = [p for p, content in changes.items() if content is not None]
        done, arrived, told = 0, 0, time.monotonic()
        drawn = Console(stderr=True).is_terminal
        with progress() as bar:
            task = bar.add_task("Uploading", total=len(paths))
            for batch in batches(paths, files):
                for path in batch:
                    operations[path] = _operation(path, files[path])
                self._store([operations[p] for p in batch])
                done, arrived = done + len(batch), arrived + sum(size_of(files[p]) for p in batch)
                text = f"{arrived / 1e6:.1f} of {sent.size / 1e6:.1f} MB"
                self._state = f"; {done} of {len(paths)} files have arrived and are not sent again"
                bar.update(task, completed=done, description=text)
                if not drawn and time.monotonic() - told > REPORT_EVERY:
                    told = time.monotonic()
                    note(f"{done} of {len(paths)} files, {text}")

    def _commit(self, files: Mapping[str, Content], operations: dict[str, CommitOperationAdd], message: str) -> None:
        """One commit of what still differs: after an answer that was lost, that is nothing."""
        parent = self._info(self.branch).sha
        changes = self._changes(files, Sent(""))
        if not changes:
            return
        steps: list[CommitOperationAdd | CommitOperationDelete] = []
        for path, content in changes.items():
            if content is None:
                steps.append(CommitOperationDelete(path))
            else:
                steps.append(operations.get(path) or _operation(path, content))
        self.api.create_commit(
            self.repo_id,
            steps,
            commit_message=message,
            repo_type=self.kind,
            revision=self.branch,
            parent_commit=parent,
        )

    def _store(self, additions: list[CommitOperationAdd]) -> None:
        self._ask(
            lambda: self.api.preupload_lfs_files(
                self.repo_id, additions, repo_type=self.kind, revision=self.branch, free_memory=False
            )
        )

    def _ask(self, call: Callable[[], Any], waits: Sequence[float] = WAITS) -> Any:
        """Call, again after a while where that may help; raises HubError."""

        def patiently() -> Any:
            get_session().timeout = TIMEOUT
            return call()

        return retried(patiently, waits, self._explained, note)

    def _explained(self, error: BaseException) -> CQNError:
        if isinstance(error, OSError) and error.filename and not isinstance(error, ConnectionError):
            return DataError(f"{error.filename} cannot be read: {error.strerror}.")
        push = f"push again: {self.again}"
        if isinstance(error, HfHubHTTPError):
            return HubError(f"{self._refused(error.response.status_code, said(error))} {push}")
        if isinstance(error, OfflineModeIsEnabled):
            return HubError(f"HF_HUB_OFFLINE is set, which forbids any connection: unset it, then {push}")
        if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout | httpx.ProxyError):
            where = f"No connection to {self.api.endpoint} ({said(error)})"
            return HubError(f"{where}{self._state}. When there is one, {push}")
        if transport(error):
            return HubError(f"The connection to the Hub broke off ({said(error)}){self._state}. To go on, {push}")
        return HubError(f"The Hub refuses: {said(error)}{self._state}. When that is mended, {push}")

    def _refused(self, status: int, text: str) -> str:
        """Meaning of an answer, and what to do before pushing again."""
        name = self.repo_id
        if status == 403:
            who = self._who()
            return f"No permission to write to {name} (403){who}: take a token that may, or another name, then"
        known = {
            401: "The Hub does not accept the token (401): log in with `hf auth login`, then",
            404: f"{name} or its branch {self.branch} is not on the Hub (404): {text}. When that is mended,",
            409: f"{name} was changed by somebody else meanwhile (409): look at it, then",
            412: f"{name} was changed by somebody else meanwhile (412): look at it, then",
        }
        if status in PASSING:
            return f"The Hub answers {status} again and again ({text}){self._state}. Later,"
        return known.get(status, f"The Hub refuses ({status}): {text}. When that is mended,")

    def _who(self) -> str:
        with contextlib.suppress(Exception):  # it only makes an error clearer
            return f", logged in as {self.api.whoami()['name']}"
        return ""


def _operation(path: str, content: Content) -> CommitOperationAdd:
    try:
        return CommitOperationAdd(path, content if isinstance(content, bytes) else str(content))
    except ValueError as error:
        raise DataError(f"{content!s:.200} cannot be sent: {error}") from error
