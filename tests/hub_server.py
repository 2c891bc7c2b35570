"""A small Hugging Face Hub on this machine: enough of its endpoints to push to, to read from, and to fail on demand.

    with HubServer() as hub:
        subprocess.run([...], env={**os.environ, **hub.environment()})
        assert hub.files("datasets", "user/name")["README.md"].startswith(b"---")

``environment()`` leads another process to the server; ``huggingface_hub`` reads these variables when it is imported.
For code in the same process ``connect(monkeypatch)`` sets what it read instead.
Served are models and datasets: create, info, tree, refs, branches, tags, preupload, the LFS batch, PUT of content,
commits, validate-yaml, whoami and resolve (HEAD and GET, with ranges). Xet is not: clients set HF_HUB_DISABLE_XET.
Repositories live in memory. What is not served answers 404 and is found in ``requests``.

Failures are asked for with ``fail``: an answer with any status, or a connection that breaks off while the body is
being sent or after the request took effect, for the next so many requests that fit.
"""

import base64
import hashlib
import json
import re
import socket
import struct
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
import yaml

from .hub_store import Failure, File, Repository, is_large

TOKEN, USER = "hf_token_of_the_tests", "user"


class HubServer:
    """The server; a context manager that runs it in threads.

    Attributes:
        requests: ``METHOD /path`` of every request, in order.
        stored: content by SHA-256, as the LFS store holds it.
        writable: names of users and organisations that the token may write to.
        ignored: pattern of paths that preupload declares as ignored.
    """

    def __init__(self) -> None:
        self.requests: list[str] = []
        self.stored: dict[str, bytes] = {}
        self.writable = {USER}
        self.ignored = re.compile(r"(?!)")
        self.repositories: dict[tuple[str, str], Repository] = {}
        self.lock = threading.RLock()
        self._failures: list[Failure] = []
        self._http = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": self}))
        self._http.daemon_threads = True

    @property
    def url(self) -> str:
        """Address, to be taken for HF_ENDPOINT."""
        return f"http://127.0.0.1:{self._http.server_address[1]}"

    def environment(self, token: str | None = TOKEN) -> dict[str, str]:
        """Variables that lead another process here; without a token, one that is not logged in."""
        given = {"HF_TOKEN": token} if token else {"HF_TOKEN_PATH": "/nonexistent"}
        return {"HF_ENDPOINT": self.url, "HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_XET": "1", **given}

    def connect(self, monkeypatch: pytest.MonkeyPatch, token: str | None = TOKEN) -> None:
        """Lead this process here for the time of a test."""
        from huggingface_hub import constants

        for name, value in {"ENDPOINT": self.url, "HF_HUB_OFFLINE": False, "HF_HUB_DISABLE_XET": True}.items():
            monkeypatch.setattr(constants, name, value)
        template = self.url + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        if token:
            monkeypatch.setenv("HF_TOKEN", token)
        else:
            monkeypatch.delenv("HF_TOKEN", raising=False)

    def fail(
        self, method: str, path: str, status: int | None = None, *, times: int = 1, after: int = 0, done: bool = False
    ) -> None:
        """Let the next requests fail.

        Args:
            method: of HTTP.
            path: pattern that is searched in the request's path.
            status: of the answer; None breaks the connection off.
            times: how many requests fail.
            after: bytes of the body that are read before the connection breaks off.
            done: the request takes effect, and only its answer is lost.
        """
        self._failures.append(Failure(method, re.compile(path), status, after, times, done))

    def heal(self) -> None:
        """Let nothing fail any more."""
        self._failures.clear()

    def failure(self, method: str, path: str) -> Failure | None:
        """The failure that is due for a request; counts it."""
        with self.lock:
            for failure in self._failures:
                if failure.left and failure.method == method and failure.path.search(path):
                    failure.left -= 1
                    return failure
        return None

    def files(self, kind: str, repo_id: str, revision: str = "main") -> dict[str, bytes]:
        """Path -> content of a branch or tag; kind is ``datasets`` or ``models``."""
        repository = self.repositories[kind, repo_id]
        commit = repository.find(revision)
        assert commit is not None, f"{repo_id} has no {revision}"
        return {path: file.content for path, file in repository.commits[commit].items()}

    def write(self, kind: str, repo_id: str, files: dict[str, bytes], branch: str = "main") -> None:
        """Change files as another person would, making the repository where it is missing."""
        repository = self.repositories.get((kind, repo_id)) or self.create(kind, repo_id)
        tree = dict(repository.commits[repository.branches[branch]])
        tree |= {path: File(content, is_large(path)) for path, content in files.items()}
        repository.commit(branch, tree, "by another person")

    def create(self, kind: str, repo_id: str, *, private: bool = False) -> Repository:
        """A new repository with one commit, as the Hub makes it."""
        repository = self.repositories[kind, repo_id] = Repository(private)
        repository.commit("main", {".gitattributes": File(b"*.parquet filter=lfs\n", False)}, "initial commit")
        return repository

    def __enter__(self) -> "HubServer":
        threading.Thread(target=self._http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.shutdown()
        self._http.server_close()


class _AnswerError(Exception):
    """Ends a request with a status and a JSON body."""

    def __init__(self, status: int, content: Any, code: str = "") -> None:
        self.status, self.content, self.code = status, content, code


ROUTES = [  # method, pattern, name of the handler's method, whether a token is needed
    ("POST", r"/api/repos/create", "create", True),
    ("POST", r"/api/validate-yaml", "validate_yaml", False),
    ("GET", r"/api/whoami-v2", "whoami", True),
    ("GET", r"/api/(\w+)/([^/]+/[^/]+)(?:/revision/([^/]+))?", "info", False),
    ("GET", r"/api/(\w+)/([^/]+/[^/]+)/refs", "refs", False),
    ("GET", r"/api/(\w+)/([^/]+/[^/]+)/tree/([^/]+)", "tree", False),
    ("POST", r"/api/(\w+)/([^/]+/[^/]+)/branch/([^/]+)", "branch", True),
    ("POST", r"/api/(\w+)/([^/]+/[^/]+)/tag/([^/]+)", "tag", True),
    ("DELETE", r"/api/(\w+)/([^/]+/[^/]+)/tag/([^/]+)", "untag", True),
    ("POST", r"/api/(\w+)/([^/]+/[^/]+)/preupload/([^/]+)", "preupload", True),
    ("POST", r"/api/(\w+)/([^/]+/[^/]+)/commit/([^/]+)", "commit", True),
    ("POST", r"/(datasets/)?([^/]+/[^/]+)\.git/info/lfs/objects/batch", "batch", True),
    ("PUT", r"/lfs/([0-9a-f]{64})", "store", False),
    ("HEAD", r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", "resolve", False),
    ("GET", r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", "resolve", False),
]


class _Handler(BaseHTTPRequestHandler):
    """One connection."""

    hub: HubServer
    protocol_version = "HTTP/1.1"
    wbufsize = -1  # an answer in one piece: a client would wait for the second
    body: bytes

    def do_GET(self) -> None:
        path = urlsplit(self.path).path
        self.hub.requests.append(f"{self.command} {path}")
        failure = self.hub.failure(self.command, path)
        if failure and failure.status is None and not failure.done:
            self.rfile.read(min(failure.after, int(self.headers.get("Content-Length") or 0)))
            self._break_off()
            return
        self.body = self._read()
        try:
            if failure and failure.status:
                raise _AnswerError(failure.status, {"error": "As the test wants it"})
            with self.hub.lock:
                self._route(path)
        except _AnswerError as answer:
            if failure and failure.done:
                self._break_off()
                return
            headers = {"X-Error-Code": answer.code} if answer.code else {}
            if answer.status >= 400:
                headers["X-Error-Message"] = str(answer.content.get("error", ""))
            self._send(answer.status, json.dumps(answer.content).encode(), headers)

    do_POST = do_PUT = do_DELETE = do_HEAD = do_GET  # noqa: N815  # names that http.server asks for

    def log_message(self, format: str, *args: Any) -> None:
        """Silent."""

    def _route(self, path: str) -> None:
        for method, pattern, name, guarded in ROUTES:
            found = re.fullmatch(pattern, path)
            if found and method == self.command:
                token = self.headers.get("Authorization", "")
                if (guarded or token) and token != f"Bearer {TOKEN}":
                    raise _AnswerError(401, {"error": "Invalid username or password."})
                getattr(self, f"_{name}")(*[unquote(g or "") for g in found.groups()])
                return
        raise _AnswerError(404, {"error": "Not served here"})

    # --- the account

    def _whoami(self) -> None:
        raise _AnswerError(200, {"type": "user", "name": USER, "orgs": [], "auth": {}})

    def _validate_yaml(self) -> None:
        text = self._json()["content"]
        try:
            front = yaml.safe_load(text.split("---\n")[1])
            assert isinstance(front["license"], str)
        except (yaml.YAMLError, IndexError, KeyError, AssertionError, TypeError) as error:
            raise _AnswerError(400, {"errors": [{"message": str(error)}], "warnings": []}) from error
        raise _AnswerError(200, {"errors": [], "warnings": []})

    # --- repositories

    def _create(self) -> None:
        given = self._json()
        kind, owner = f"{given.get('type') or 'model'}s", given.get("organization") or USER
        repo_id = f"{owner}/{given['name']}"
        self._may_write(repo_id)
        url = f"{self.hub.url}/{'' if kind == 'models' else kind + '/'}{repo_id}"
        if (kind, repo_id) in self.hub.repositories:
            raise _AnswerError(409, {"error": "You already created this repo", "url": url})
        self.hub.create(kind, repo_id, private=given.get("visibility") == "private")
        raise _AnswerError(200, {"url": url, "name": repo_id})

    def _info(self, kind: str, repo_id: str, revision: str) -> None:
        repository, commit = self._commit_of(kind, repo_id, revision or "main")
        paths = [{"rfilename": path} for path in repository.commits[commit]]
        raise _AnswerError(
            200, {"id": repo_id, "sha": commit, "private": repository.private, "siblings": paths, "tags": []}
        )

    def _refs(self, kind: str, repo_id: str) -> None:
        repository = self._repository(kind, repo_id)

        def listed(where: str, names: dict[str, str]) -> list[dict[str, str]]:
            return [{"name": n, "ref": f"refs/{where}/{n}", "targetCommit": c} for n, c in names.items()]

        refs = {"branches": listed("heads", repository.branches), "tags": listed("tags", repository.tags)}
        raise _AnswerError(200, {**refs, "converts": []})

    def _tree(self, kind: str, repo_id: str, revision: str) -> None:
        repository, commit = self._commit_of(kind, repo_id, revision)
        raise _AnswerError(200, [file.described(path) for path, file in repository.commits[commit].items()])

    def _branch(self, kind: str, repo_id: str, name: str) -> None:
        self._may_write(repo_id)
        repository, commit = self._commit_of(kind, repo_id, self._json().get("startingPoint") or "main")
        if name in repository.branches:
            raise _AnswerError(409, {"error": "Reference already exists"})
        repository.branches[name] = commit
        raise _AnswerError(200, {})

    def _tag(self, kind: str, repo_id: str, revision: str) -> None:
        self._may_write(repo_id)
        repository, commit = self._commit_of(kind, repo_id, revision)
        name = self._json()["tag"]
        if name in repository.tags:
            raise _AnswerError(409, {"error": "Tag already exists"})
        repository.tags[name] = commit
        raise _AnswerError(200, {})

    def _untag(self, kind: str, repo_id: str, name: str) -> None:
        self._may_write(repo_id)
        if self._repository(kind, repo_id).tags.pop(name, None) is None:
            raise _AnswerError(404, {"error": "No such tag"}, "RevisionNotFound")
        raise _AnswerError(200, {})

    # --- writing

    def _preupload(self, kind: str, repo_id: str, revision: str) -> None:
        self._may_write(repo_id)
        repository, commit = self._commit_of(kind, repo_id, revision)
        answer = []
        for given in self._json()["files"]:
            path = given["path"]
            mode = "lfs" if is_large(path) else "regular"
            entry = {"path": path, "uploadMode": mode, "shouldIgnore": bool(self.hub.ignored.search(path))}
            if file := repository.commits[commit].get(path):
                entry["oid"] = file.sha256 if file.lfs else file.git_oid
            answer.append(entry)
        raise _AnswerError(200, {"files": answer})

    def _batch(self, prefix: str, repo_id: str) -> None:
        self._may_write(repo_id)
        objects = []
        for given in self._json()["objects"]:
            entry = {"oid": given["oid"], "size": given["size"]}
            if given["oid"] not in self.hub.stored:
                entry["actions"] = {"upload": {"href": f"{self.hub.url}/lfs/{given['oid']}", "header": {}}}
            objects.append(entry)
        raise _AnswerError(200, {"transfer": "basic", "objects": objects})

    def _store(self, oid: str) -> None:
        if hashlib.sha256(self.body).hexdigest() != oid:
            raise _AnswerError(400, {"error": "The content is not what was announced"})
        self.hub.stored[oid] = self.body
        raise _AnswerError(200, {})

    def _commit(self, kind: str, repo_id: str, revision: str) -> None:
        self._may_write(repo_id)
        repository, head = self._commit_of(kind, repo_id, revision)
        lines = [json.loads(line) for line in self.body.splitlines()]
        header = lines[0]["value"]
        if header.get("parentCommit") not in (None, head):
            raise _AnswerError(412, {"error": "A commit has happened since. Please refresh and try again."})
        tree = dict(repository.commits[head])
        for line in lines[1:]:
            value, path = line["value"], line["value"]["path"]
            if line["key"] == "file":
                tree[path] = File(base64.b64decode(value["content"]), False)
            elif line["key"] == "lfsFile":
                if value["oid"] not in self.hub.stored:
                    raise _AnswerError(400, {"error": f"LFS content of {path} was never uploaded"})
                tree[path] = File(self.hub.stored[value["oid"]], True)
            elif tree.pop(path, None) is None:
                raise _AnswerError(404, {"error": "A file with this name doesn't exist"}, "EntryNotFound")
        commit = repository.commit(revision, tree, header["summary"])
        raise _AnswerError(200, {"commitUrl": f"{self.hub.url}/{kind}/{repo_id}/commit/{commit}", "commitOid": commit})

    # --- reading

    def _resolve(self, prefix: str, repo_id: str, revision: str, path: str) -> None:
        repository, commit = self._commit_of(prefix.strip("/") or "models", repo_id, revision)
        file = repository.commits[commit].get(path)
        if file is None:
            raise _AnswerError(404, {"error": "Entry not found"}, "EntryNotFound")
        etag = file.sha256 if file.lfs else file.git_oid
        headers = {"ETag": f'"{etag}"', "X-Repo-Commit": commit, "Accept-Ranges": "bytes"}
        wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
        if not wanted:
            self._send(200, file.content, headers)
            return
        start, stop = int(wanted[1]), int(wanted[2] or len(file.content) - 1) + 1
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{len(file.content)}"
        self._send(206, file.content[start:stop], headers)

    # --- tools

    def _json(self) -> dict[str, Any]:
        return dict(json.loads(self.body or b"{}"))

    def _repository(self, kind: str, repo_id: str) -> Repository:
        repository = self.hub.repositories.get((kind, repo_id))
        hidden = repository is not None and repository.private and not self.headers.get("Authorization")
        if repository is None or hidden:
            raise _AnswerError(404, {"error": "Repository not found"}, "RepoNotFound")
        return repository

    def _commit_of(self, kind: str, repo_id: str, revision: str) -> tuple[Repository, str]:
        repository = self._repository(kind, repo_id)
        commit = repository.find(revision)
        if commit is None:
            raise _AnswerError(404, {"error": f"Invalid rev id: {revision}"}, "RevisionNotFound")
        return repository, commit

    def _may_write(self, repo_id: str) -> None:
        if repo_id.partition("/")[0] not in self.hub.writable:
            raise _AnswerError(403, {"error": "You don't have the rights to create or change this repository"})

    def _read(self) -> bytes:
        if self.headers.get("Transfer-Encoding", "").lower() != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length") or 0))
        parts = []
        while size := int(self.rfile.readline().split(b";")[0], 16):
            parts.append(self.rfile.read(size))
            self.rfile.readline()
        self.rfile.readline()
        return b"".join(parts)

    def _break_off(self) -> None:
        """Reset the connection."""
        self.close_connection = True
        with suppress(OSError):
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.connection.close()

    def _send(self, status: int, content: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": "application/json", **headers}.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)
