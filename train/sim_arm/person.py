"""A simulated person who looks at the arm and answers at the operator's page, through the page's own interface."""

import json
import os
import threading
import urllib.error
import urllib.request
from typing import Any, Protocol

from ..clock import Clock
from ..interfaces import PAGE_TOKEN

__all__ = ["Scene", "SimPerson"]

LOOK_S = 0.03
RETRY_S = 0.2
LOST_S = 3.0  # simulated seconds after which an arm that does not set off for home by itself is sent there
SURE_S = 0.2  # simulated seconds for which the task must look done


class Scene(Protocol):
    """What a person sees: now, seconds; success, whether the task is done; away, whether the arm has left home and
    neither come back nor has the scene been laid out anew; clock: by which time passes for the person.
    """

    clock: Clock
    now: float

    @property
    def success(self) -> bool: ...

    @property
    def away(self) -> bool: ...


class SimPerson:
    """Starts episodes, says how they went, waits for the scene; takes the leader when a try takes too long.

    What it knows is what a person sees: whether the task is done and whether the arm is home.
    """

    def __init__(self, world: Scene, url: str, takes_over_s: float = 0.0, helps_episodes: int = 0) -> None:
        """Watch a scene and answer at `url` (http://host:port), with the token of CQN_PAGE_TOKEN.

        takes_over_s: simulated seconds of an episode after which it takes the leader, until the task is done; 0: never.
        helps_episodes: how many episodes of the run it does so in, at their beginning; 0: all. A policy that is always
            helped meets no failure of its own.
        """
        self.world, self.url, self.takes_over_s = world, url.rstrip("/"), takes_over_s
        self.helps_episodes = helps_episodes
        self._closing = threading.Event()
        self._state, self._since, self._done_at = "", 0.0, -1.0
        self._thread = world.clock.thread(self._run, "simulated-person")

    def start(self) -> None:
        """Begin to watch."""
        self._thread.start()

    def close(self) -> None:
        """Go away; does not wait, since an answer may be under way."""
        self._closing.set()

    def _run(self) -> None:
        while not self.world.clock.wait(self._closing, LOOK_S):
            try:
                self._look()
            except (OSError, ValueError, KeyError):  # no page yet, or no more: look again
                self.world.clock.sleep(RETRY_S)

    def _look(self) -> None:
        seen = self._ask("/api/state")
        if seen["control"]["you"] != "operator" and not seen["control"]["present"]:
            self._ask("/api/control", {})  # who took it has left
        session = seen["session"]
        world, state = self.world, str(session["state"])
        if state != self._state:
            self._state, self._since = state, world.now
        if not world.success:
            self._done_at = -1.0
        elif self._done_at < 0:
            self._done_at = world.now
        done = self._done_at >= 0 and world.now - self._done_at >= SURE_S
        seconds = world.now - self._since
        lost = state in ("resetting", "waiting") and world.away and not session["homing"] and seconds > LOST_S
        event = "home" if lost else self._answer(state, done, seconds, int(session["episode"]))
        if event and event in session["allowed"]:
            self._ask("/api/event", {"event": event})

    def _answer(self, state: str, done: bool, seconds: float, episode: int) -> str:
        if state in ("running", "teaching") and done:
            return "success"
        helps = self.takes_over_s > 0 and (not self.helps_episodes or episode < self.helps_episodes)
        if state == "running" and helps and seconds > self.takes_over_s:
            return "take_over"
        if state == "labelling":
            return "success" if self.world.success else "failure"
        if state == "resetting" and not self.world.away:
            return "ready"
        if state == "waiting" and not self.world.away:
            return "start"
        return "resume" if state == "paused" and seconds > 1.0 else ""

    def _ask(self, path: str, body: dict[str, Any] | None = None) -> dict[str, Any]:
        request = urllib.request.Request(  # noqa: S310  # an address that the user gave
            f"{self.url}{path}?client=simulated-person",
            data=None if body is None else json.dumps(body).encode(),
            headers={"X-Token": os.environ.get(PAGE_TOKEN, ""), "Content-Type": "application/json"},
        )
        try:
            with urllib.request.urlopen(request, timeout=2) as answer:  # noqa: S310
                said: dict[str, Any] = json.load(answer)
        except urllib.error.HTTPError as error:  # refused: things have changed meanwhile, look again
            raise OSError(f"{path}: {error}") from error
        return said
