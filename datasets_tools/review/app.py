"""The routes of the review page. Everything but the page itself passes the token first (`cqn_data.web.access`)."""

import shlex
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_cqn.errors import ConfigError, CQNError

from ..disk.folders import local_root, refuse_existing, refuse_inside
from ..operations.task import MAX_LENGTH
from ..web.access import Guard
from ..web.routes import NonsenseError, add_errors, add_files, body, error
from .decided import Desk
from .errand import Errand
from .recording import Recording

if TYPE_CHECKING:
    from fastapi import FastAPI

__all__ = ["Review", "make_app"]

MOST_PICTURES, TALLEST = 40, 720  # of a strip; pixels
FIELDS: dict[str, tuple[type, ...]] = {
    "success": (bool, type(None)), "drop": (bool,), "head": (int,), "tail": (int,),
    "threshold": (float, int, type(None)), "task": (str, type(None)),
}  # fmt: skip


class Review:
    """A recording on a desk: what is shown, what was decided, and the command that carries it out."""

    def __init__(
        self, recording: Recording, desk: Desk, repo_id: str, root: str | None, revision: str | None = None
    ) -> None:
        self.recording, self.desk, self.errand = recording, desk, Errand()
        self.repo_id, self.root, self.revision = repo_id, root, revision
        self.lock = threading.Lock()

    def arguments(self, new_repo_id: str, new_root: str) -> list[str]:
        """The recipe's command without `cqn-data`; empty names take the command's own."""
        given = {"repo_id": self.repo_id, "root": self.root, "revision": self.revision}
        given |= {"new_repo_id": new_repo_id, "new_root": new_root}
        return ["run", str(self.desk.recipe), *(f"--{name}={value}" for name, value in given.items() if value)]

    def state(self) -> dict[str, Any]:
        """All that changes."""
        decided, errand = self.desk.decided, self.errand
        looked = self.recording.look_at(self.recording.recorded, decided)
        left = [i for i in looked if not decided.of(i).drop]
        return {
            **decided.as_json(),
            "kept": [looked[i].kept for i in looked],
            "total": {"episodes": len(left), "kept": sum(looked[i].kept for i in left)},
            "recipe": self.desk.text(),
            "file": str(self.desk.recipe),
            "command": shlex.join(["cqn-data", *self.arguments("", "")]),
            "undoable": self.desk.undoable,
            "errand": {"running": errand.running, "code": errand.code, "lines": errand.lines},
        }

    def run(self, new_repo_id: str, new_root: str) -> None:
        """Start the recipe. Raises CQNError for what the command would refuse at once."""
        if self.errand.running:
            raise ConfigError("A recipe is at work already; wait until it has ended.")
        if not self.desk.steps():
            raise ConfigError("Nothing is decided yet: there is nothing to run.")
        target = local_root(new_repo_id or f"{self.repo_id}_{self.desk.recipe.stem}", new_root or None)
        refuse_existing(target)
        refuse_inside(self.recording.source.root, target)
        self.errand.start(self.arguments(new_repo_id, new_root))


def make_app(review: Review, token: str, host: str = "127.0.0.1") -> "FastAPI":
    """The FastAPI app that shows `review`; `token` must come with every request but those for the page's own files."""
    from fastapi import FastAPI

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, redirect_slashes=False)
    add_errors(app, {CQNError: 409})
    _add_decisions(app, review)
    _add_looks(app, review)
    public = add_files(app, Path(__file__).parent / "static")
    app.add_middleware(Guard, token=token, host=host, public=public)
    return app


def _add_decisions(app: "FastAPI", review: Review) -> None:
    """What a person may change."""
    from fastapi import Request
    from fastapi.concurrency import run_in_threadpool
    from fastapi.responses import JSONResponse

    async def after(change: Any, *given: Any, **changes: Any) -> JSONResponse:
        def work() -> dict[str, Any]:
            with review.lock:
                change(*given, **changes)
                return review.state()

        return JSONResponse(await run_in_threadpool(work))

    @app.get("/api/state")
    async def _() -> JSONResponse:
        return await after(lambda: None)

    @app.post("/api/decide")
    async def _(request: Request) -> JSONResponse:
        given = await body(request, {"episode": int, "changes": dict})
        index, changes = _episode(review, given["episode"]), given["changes"]
        for name, value in changes.items():
            if name not in FIELDS or type(value) not in FIELDS[name]:
                raise NonsenseError(f"Expected changes of {', '.join(FIELDS)}, of their types; got {name[:40]!r}.")
        if changes.get("threshold") is not None:
            changes["threshold"] = _threshold(changes["threshold"], least=0.0)
        if changes.get("task") is not None:
            changes["task"] = " ".join(changes["task"].split())[:MAX_LENGTH] or None
        return await after(review.desk.change, index, **changes)

    @app.post("/api/threshold")
    async def _(request: Request) -> JSONResponse:
        given = await body(request, {"threshold": float, "on": bool})
        value = _threshold(given["threshold"], least=1e-9) if given["on"] else None
        return await after(review.desk.change, None, threshold=value)

    @app.post("/api/undo")
    async def _(request: Request) -> JSONResponse:
        await body(request, {})
        return await after(review.desk.undo)

    @app.post("/api/run")
    async def _(request: Request) -> JSONResponse:
        given = await body(request, {"new_repo_id": str, "new_root": str})
        return await after(review.run, given["new_repo_id"].strip(), given["new_root"].strip())


def _add_looks(app: "FastAPI", review: Review) -> None:
    """What a person looks at. Not `async`: numbers and pictures are read beside the loop that answers requests."""
    from fastapi import Response
    from fastapi.responses import FileResponse, JSONResponse

    recording = review.recording

    @app.get("/api/recording")
    def _() -> JSONResponse:
        return JSONResponse({"repo_id": review.repo_id, **recording.summary()})

    @app.get("/api/episode/{index}")
    def _(index: int) -> JSONResponse:
        return JSONResponse(recording.curves(_episode(review, index)))

    @app.get("/api/pauses/{index}")
    def _(index: int, threshold: float | None = None) -> JSONResponse:
        moved = None if threshold is None else _threshold(threshold, least=1e-9)
        looked = recording.look_at([_episode(review, index)], review.desk.decided, moved)[index]
        return JSONResponse({"start": looked.start, "stop": looked.stop, "runs": looked.runs, "kept": looked.kept})

    @app.get("/api/film/{index}/{key:path}")
    def _(index: int, key: str) -> Any:
        path = recording.film(_episode(review, index), key)
        return error(404, "There is no such film.") if path is None else FileResponse(path, media_type="video/mp4")

    @app.get("/api/pictures/{index}/{key:path}")
    def _(index: int, key: str, first: int = 0, count: int = 1, height: int = 480) -> Any:
        length = recording.lengths[_episode(review, index)]
        fits = 0 <= first < length and 1 <= count <= MOST_PICTURES and 1 <= height <= TALLEST
        if key not in recording.source.cameras or not fits:
            return error(404, "There is no such picture.")
        frames = np.unique(np.linspace(first, first if count == 1 else length - 1, count).round().astype(np.int64))
        strip = np.concatenate(recording.pictures(index, key, frames, height), axis=1)
        return Response(_jpeg(strip), media_type="image/jpeg", headers={"X-Frames": ",".join(map(str, frames))})


def _episode(review: Review, index: int) -> int:
    if not 0 <= index < len(review.recording.lengths):
        raise NonsenseError(f"No episode {index}: expected numbers from 0 to {len(review.recording.lengths) - 1}.")
    return index


def _threshold(value: float, least: float) -> float:
    if not least <= value < float("inf"):
        raise NonsenseError(f"Expected a finite threshold of at least {least:g}, got {value}.")
    return float(f"{value:.4g}")


def _jpeg(picture: Any) -> bytes:
    import io

    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="JPEG", quality=85)
    return buffer.getvalue()
