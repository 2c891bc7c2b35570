"""The learner's side of the collectors: hands out turns and weights, takes in episodes, and keeps the ratio of both."""

import math
import secrets
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from lerobot_cqn.errors import ConfigError, CQNError

from ..agent import Agent
from ..interfaces import Interrupted, Label
from ..loop.acting import Finished
from ..loop.evaluate import Evaluation
from ..loop.experience import Turns
from ..replay.demonstrations import Recorded
from .agreement import check_fit, check_versions
from .calls import Calls, Gone
from .collector import Description, Done, Fit, Left, NewbornError, Paused, Pulse
from .parcel import pack, weights_of

__all__ = ["Fleet"]

PULSE_S = 1.0
WAIT_S = 0.2  # for an answer, before signals are looked at
WAITS_S = 15.0  # for a first collector before a line says so
CLOSES_WITHIN_S = 5.0
STALLED_S = 30.0  # without a sign of life after which a collector counts as lost
RETRY_S = 3.0  # before a collector that was lost is asked again


@dataclass
class _Seat:
    """One collector as the fleet knows it.

    state: joining (not yet equipped), idle, acting, evaluating, lost (asked again at `retry_at`), left (for good).
    """

    index: int
    state: str = "joining"
    promise: Any = None
    asked: str = ""
    pulse: Any = None
    pulsed: float = 0.0  # when it was asked for that sign of life
    retry_at: float = 0.0
    fit: Fit | None = None
    host: str = ""
    part: tuple[int, int] = (0, 0)  # of an evaluation: its first episode and their number
    doing: str = ""
    episodes: int = 0
    successes: int = 0


@dataclass
class Fleet:
    """Collectors as the trainer's `Experience`.

    max_staleness: updates that may be owed when an episode begins, with those of episodes that wait to be stored;
    worth: updates that an episode of so many steps brings along; steps_apart: where updates follow control steps and
    one collector takes turns with the learner, each step waits for its updates, as in one process.
    """

    calls: Calls
    count: int
    max_staleness: int
    worth: Callable[[int], int]
    steps_apart: bool
    run_id: Callable[[], str]
    say: Callable[[str], None]
    should_stop: Callable[[], bool]
    batch: int = 1  # evaluation episodes at a time in a collector
    on_seats: Callable[[Sequence[Mapping[str, Any]]], None] = lambda _: None
    seats: list[_Seat] = field(init=False)
    waited_s: float = 0.0
    _over: deque[Finished] = field(default_factory=deque)
    _parts: dict[int, Evaluation] = field(default_factory=dict)
    _missing: list[tuple[int, int]] = field(default_factory=list)  # parts of an evaluation that nobody has
    _described: dict[int, Description] = field(default_factory=dict)
    _keys: set[str] = field(default_factory=set)  # of the turns that came back
    _kept: list[str] = field(default_factory=list)  # keys of stored episodes that nobody was told of
    _applied: dict[int, Label] = field(default_factory=dict)
    _corrected: dict[int, Label] = field(default_factory=dict)
    _weights: Any = None  # of now, where they are shared already
    _files: Any = None
    _recorded: Recorded | None = None
    _doing: str = "starting"
    _opened: bool = False
    _enough: bool = False  # no further turn
    _begun: float = 0.0
    _learner_s: float = 0.0  # that the learner waited for episodes
    _idle_s: float = 0.0  # that collectors waited for turns
    _acted_s: float = 0.0
    _pulsed: float = 0.0

    def __post_init__(self) -> None:
        self.seats = [_Seat(index) for index in range(self.count)]

    # -- getting ready ---------------------------------------------------------------------------------------

    def describe(self) -> Description:
        """What the first collectors that answer act in. Raises CQNError for one that cannot, or differs.

        Waits for all that can be had within seconds; the others may come later.
        """
        for seat in self.seats:
            self._ask(seat, "describe")
        began, first = time.monotonic(), math.inf
        while not self._described or (len(self._described) < self.count and time.monotonic() - first < RETRY_S):
            self._look(WAIT_S)
            if self._described:
                first = min(first, time.monotonic())
            elif time.monotonic() - began > WAITS_S:
                began = math.inf
                self.say("No collector yet: they wait for a free processor, or their resource, on the cluster.")
            if self.should_stop():
                raise Interrupted
            if all(seat.state == "lost" for seat in self.seats):
                raise ConfigError("No collector could be started: see Ray's logs in /tmp/ray/session_latest/logs.")
        if len(self._described) < self.count:
            self.say(f"{len(self._described)} of {self.count} collectors are there: the others may join later.")
        return self._described[min(self._described)]

    def equip(self, agent: Agent, recorded: Recorded | None) -> None:
        """Give the policy to all that are there; others get it when they join."""
        self._files, self._recorded = self.calls.shared(pack(agent)), recorded
        for seat in self.seats:
            if seat.index in self._described:
                self._ask(seat, "equip", self._files, self._recorded)

    def open(self, known: Collection[str]) -> None:
        """Wait until those that are there are ready. Raises CQNError where one cannot be, or differs from another."""
        self._keys |= {*known}
        self._kept += known  # whoever still keeps one need not
        while any(seat.asked in ("equip", "unstored") and seat.promise is not None for seat in self.seats):
            self._look(WAIT_S)
            if self.should_stop():
                raise Interrupted
        self._opened = True

    @property
    def fps(self) -> int:
        """Control steps a second."""
        return self._a_fit().fps

    @property
    def max_steps(self) -> int:
        """Control steps before an evaluation episode is cut off."""
        return self._a_fit().max_steps

    def _a_fit(self) -> Fit:
        fit = next((seat.fit for seat in self.seats if seat.fit is not None), None)
        assert fit is not None  # noqa: S101  # `open` waits for one
        return fit

    # -- the trainer's side ----------------------------------------------------------------------------------

    def collect(self, agent: Agent, next_turn: Turns, on_step: Callable[[int], None]) -> Finished:
        """The next episode that is over. Raises Interrupted when asked to stop, or when no collector is left."""
        began = time.monotonic()
        self._begun = self._begun or began
        while True:
            self._hand_out(agent, next_turn)
            self._look(0.0 if self._over else WAIT_S, agent, on_step)
            if self._over:
                break
            if self.should_stop() or all(seat.state == "left" for seat in self.seats):
                self._stop()
                raise Interrupted
        self._hand_out(agent, next_turn)  # nobody waits until these are stored
        self._learner_s += time.monotonic() - began
        return self._over.popleft()

    def tend(self, agent: Agent, next_turn: Turns, owed: int) -> None:
        """Take in what is over, and begin turns where not too many updates are owed."""
        self._weights = None
        self._look(0.0)
        if self.max_staleness:
            self._hand_out(agent, next_turn, owed)

    def evaluate(self, agent: Agent, episodes: int, seed: int, on_step: Callable[[], None], film: int) -> Evaluation:
        """Evaluation episodes, dealt out to the collectors once the turns under way are over."""
        weights = self._current(agent)
        while any(seat.state == "acting" for seat in self.seats):
            self._look(WAIT_S)
            on_step()
        there = max(1, sum(seat.state == "idle" for seat in self.seats))
        size = -(-episodes // there)
        size = -(-size // self.batch) * self.batch
        self._missing = [(first, min(size, episodes - first)) for first in range(0, episodes, size)]
        wanted, self._parts = len(self._missing), {}
        while len(self._parts) < wanted:
            for seat in self.seats:
                if seat.state == "idle" and self._missing:
                    seat.state, seat.part = "evaluating", self._missing.pop(0)
                    first, count = seat.part
                    self._ask(seat, "evaluate", weights, count, seed + first, max(0, min(film - first, count)))
            self._look(WAIT_S)
            on_step()
            if all(seat.state == "left" for seat in self.seats):
                raise Interrupted
        return Evaluation.together([self._parts[first] for first in sorted(self._parts)], episodes)

    def rest(self) -> Sequence[Finished]:
        """What was under way when the run had enough, once it is over."""
        self._enough = True
        while any(seat.state == "acting" for seat in self.seats) and not self.should_stop():
            self._look(WAIT_S)
        over, self._over = [*self._over], deque()
        return over

    def stored(self, finished: Finished) -> None:
        """Remember to tell the collectors that they need not keep it."""
        if finished.turn.key:
            self._kept.append(finished.turn.key)

    def learning(self, doing: str) -> None:
        """Say what the learner is at, with the next sign of life."""
        self._doing = doing

    def take_corrected(self) -> Mapping[int, Label]:
        """Labels that people changed since the last call."""
        taken, self._corrected = self._corrected, {}
        return taken

    @property
    def note(self) -> str:
        """Shares of the time that learner and collectors waited for one another."""
        total = time.monotonic() - self._begun
        waits = self._idle_s / max(1e-9, self._idle_s + self._acted_s)
        return f"waits: learner {self._learner_s / max(1e-9, total):.0%}, collectors {waits:.0%}"

    def close(self) -> None:
        """Tell the collectors what is stored: they keep nothing that is not needed."""
        told, deadline = self._tell_stored(), time.monotonic() + CLOSES_WITHIN_S
        while told and time.monotonic() < deadline:
            heard = [id(promise) for promise in self.calls.answered(told, WAIT_S)]
            told = [promise for promise in told if id(promise) not in heard]

    # -- turns and weights -----------------------------------------------------------------------------------

    def _hand_out(self, agent: Agent, next_turn: Turns, owed: int = 0) -> None:
        owed += sum(self.worth(finished.steps) for finished in self._over)
        if owed > self.max_staleness or (self._in_turns and self._over) or self._enough or self.should_stop():
            return
        for seat in (seat for seat in self.seats if seat.state == "idle"):
            turn = next_turn(sum(finished.steps for finished in self._over))
            if turn is None:
                return
            seat.state = "acting"
            key = f"{self.run_id()}-{secrets.token_hex(8)}"
            state = torch.get_rng_state().numpy() if self._in_turns else None
            self._ask(seat, "act", replace(turn, key=key), self._current(agent), state, self.steps_apart)

    @property
    def _in_turns(self) -> bool:
        """Whether one collector and the learner draw from one random state, as in one process."""
        return self.count == 1 and self.max_staleness == 0

    def _current(self, agent: Agent) -> Any:
        """Weights of now, put where every collector can fetch them, once between two updates."""
        if self._weights is None:
            self._weights = self.calls.shared(weights_of(agent))
        return self._weights

    # -- answers ---------------------------------------------------------------------------------------------

    def _ask(self, seat: _Seat, method: str, *arguments: Any) -> None:
        seat.promise, seat.asked = self.calls.call(seat.index, method, *arguments), method

    def _look(self, timeout_s: float, agent: Agent | None = None, on_step: Callable[[int], None] | None = None) -> None:
        """Take what is answered, waiting so long at most for the first answer."""
        now = time.monotonic()
        for seat in self.seats:
            if seat.state == "lost" and now >= seat.retry_at and seat.promise is None:
                self._ask(seat, "describe")
        pending = {id(seat.promise): seat for seat in self.seats if seat.promise is not None}
        promises = [seat.promise for seat in pending.values()]
        for promise in self.calls.answered(promises, timeout_s) if promises else ():
            seat = pending[id(promise)]
            seat.promise = None
            try:
                answer = self.calls.answer(promise)
            except (Gone, NewbornError) as error:
                self._lose(seat, str(error))
                continue
            except CQNError as error:
                if self._opened and seat.fit is None:  # a late one that does not fit: the others go on
                    seat.state = "left"
                    self.say(f"Collector {seat.index} is left out: {error}")
                    continue
                raise type(error)(f"Collector {seat.index}: {error}") from error
            self._take(seat, answer, agent, on_step)
        if not promises:
            time.sleep(min(timeout_s, WAIT_S))
        if now - self._pulsed > PULSE_S:
            self._pulsed = now
            self._give_signs()

    def _take(self, seat: _Seat, answer: Any, agent: Agent | None, on_step: Callable[[int], None] | None) -> None:
        """What an answer changes."""
        if isinstance(answer, Description):
            self._described[seat.index], seat.host = answer, answer.host
            check_versions(answer)
            if self._files is not None:
                self._ask(seat, "equip", self._files, self._recorded)
        elif isinstance(answer, Fit):
            check_fit(answer, {other.index: other.fit for other in self.seats if other.fit is not None})
            seat.fit = answer
            self._ask(seat, "unstored", f"{self.run_id()}-")
        elif isinstance(answer, list):  # of "unstored"
            seat.state = "idle"
            for finished in answer:
                self._bring_in(finished)
        elif isinstance(answer, Paused):
            assert on_step is not None and agent is not None  # noqa: S101, PT018  # only `collect` lets steps pause
            torch.set_rng_state(torch.from_numpy(answer.random_state.copy()))
            on_step(answer.steps)
            state = torch.get_rng_state().numpy()
            self._ask(seat, "go_on", self._current(agent), state)
        elif isinstance(answer, Done):
            seat.state = "idle"
            if self._in_turns:
                torch.set_rng_state(torch.from_numpy(answer.random_state.copy()))
            self._acted_s, self._idle_s = self._acted_s + answer.acted_s, self._idle_s + answer.idle_s
            seat.episodes, seat.successes = seat.episodes + 1, seat.successes + answer.finished.success
            self._bring_in(answer.finished)
        elif isinstance(answer, Evaluation):
            seat.state = "idle"
            self._parts[seat.part[0]] = answer
        elif isinstance(answer, Left):
            if seat.state == "evaluating":
                self._missing.append(seat.part)
            seat.state = "left"
            if not self.should_stop():
                self.say(f"Collector {seat.index} was stopped by its person and takes no more turns.")

    def _bring_in(self, finished: Finished) -> None:
        """Hand an episode on, once: it may come by itself and again from the disk of its collector."""
        key = finished.turn.key
        if key not in self._keys:
            self._keys.add(key)
            self._over.append(finished)
        elif key not in [one.turn.key for one in self._over]:  # stored, and its collector did not hear of it
            self._kept.append(key)

    def _lose(self, seat: _Seat, why: str) -> None:
        if seat.state == "evaluating":
            self._missing.append(seat.part)
        if seat.state != "lost":
            self.say(f"Collector {seat.index} is lost ({why}): the run goes on with the others, and asks again.")
        seat.state, seat.fit, seat.retry_at = "lost", None, time.monotonic() + RETRY_S

    # -- signs of life ---------------------------------------------------------------------------------------

    def _give_signs(self) -> None:
        """Tell every collector that the learner is there, and hear what its person says."""
        for seat in self.seats:
            if seat.pulse is not None and self.calls.answered([seat.pulse], 0.0):
                try:
                    pulse: Pulse = self.calls.answer(seat.pulse)
                except (Gone, CQNError):
                    pulse = Pulse(corrected={}, said=(), doing="")
                seat.pulse, seat.doing = None, pulse.doing
                for text in pulse.said:
                    self.say(f"Collector {seat.index}: {text}" if self.count > 1 else text)
                for number, label in pulse.corrected.items():
                    if self._applied.get(number) is not label:
                        self._applied[number] = self._corrected[number] = label
            if seat.fit is None or seat.state in ("lost", "left"):
                continue
            if seat.pulse is None:
                seat.pulse, seat.pulsed = self.calls.call(seat.index, "pulse", self._doing), time.monotonic()
            elif time.monotonic() - seat.pulsed > STALLED_S:
                seat.promise = seat.pulse = None  # what it is at comes from its disk, should it go on
                self._lose(seat, f"no sign of life for {STALLED_S:.0f} s")
        self._tell_stored()
        self.on_seats([
            {"collector": s.index, "host": s.host, "state": s.doing if s.state in ("idle", "acting") and s.doing
             else s.state, "episodes": s.episodes, "successes": s.successes, "page": s.fit.page if s.fit else ""}
            for s in self.seats
        ])  # fmt: skip

    def _tell_stored(self) -> list[Any]:
        keys, self._kept = self._kept, []
        there = [seat for seat in self.seats if seat.fit is not None and seat.state not in ("lost", "left")]
        return [self.calls.call(seat.index, "stored", keys) for seat in (there if keys else ())]

    def _stop(self) -> None:
        """Ask all to stop; what they were at is dropped, what was over is kept on their disks."""
        for seat in self.seats:
            if seat.state != "lost":
                self.calls.call(seat.index, "stop")
